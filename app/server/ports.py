"""TCP ports."""

from __future__ import annotations

import argparse

from tornado.netutil import bind_sockets


def port_number(text: str) -> int:
    """Parse a port given on the command line.

    Raises
    ------
    argparse.ArgumentTypeError
        If the text is not an integer from 0 to 65535.
    """
    if not (text.isdecimal() and int(text) < 2**16):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port: give 0 to {2**16 - 1}.")
    return int(text)


def free_port(address: str = "127.0.0.1") -> int:
    """Return a port of this address on which nothing listens."""
    first, *others = bind_sockets(0, address)
    port: int = first.getsockname()[1]
    for each in (first, *others):
        each.close()
    return port
