"""The headless command line, ``python -m core <command> --help``."""

from __future__ import annotations

import argparse
import io
import os
import sys
from pathlib import Path

import core
from core.cli import ablation as requires
from core.cli import captures, studies
from core.cli import sensitivity as stability
from core.cli import tradeoff as trade
from core.cli.options import as_options

ACCEPTED, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done; the machine (a full disk, say) or a check failed; bad input; Ctrl-C."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack letters of a file name
            stream.reconfigure(errors="backslashreplace")
    parser = argparse.ArgumentParser(
        prog="firstphoton-core"
        if Path(sys.argv[0]).stem == "firstphoton-core"
        else "python -m core",
        description="First-photon lidar without a screen: capture files in, ranges out.",
    )
    parser.add_argument("--version", action="version", version=f"firstphoton {core.__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    captures.add(commands)
    studies.add(commands)
    trade.add(commands)
    requires.add(commands)
    stability.add(commands)
    chosen = parser.parse_args(arguments)
    chosen.arguments = sys.argv[1:] if arguments is None else arguments
    try:
        chosen.work(chosen)
        sys.stdout.flush()
    except (ValueError, FileExistsError) as error:
        return _said(FAILED if _is_the_machines(error) else REFUSED, as_options(str(error)))
    except BrokenPipeError:  # whoever read us has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (OSError, stability.UnconfirmedZone) as error:
        return _said(FAILED, error)
    except MemoryError as error:
        return _said(FAILED, f"memory is too small: {error}")
    except KeyboardInterrupt:
        return _said(INTERRUPTED, "Interrupted.")
    return ACCEPTED


def _is_the_machines(error: BaseException | None) -> bool:
    """Whether a file was refused because the machine failed."""
    if error is None:
        return False
    failed = isinstance(error, OSError | MemoryError) and not isinstance(error, FileExistsError)
    return failed or _is_the_machines(error.__cause__)


def _said(code: int, why: object) -> int:
    print(f"\n{why}", file=sys.stderr)
    return code
