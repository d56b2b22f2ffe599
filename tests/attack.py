"""Attacks on the app and the command line: ``python -m tests.attack``, or `make attack`.

Each attack of `tests.attacks` is tried on a server of its own on this machine, bounded in count and
time, while another session moves its sliders. A row says what was tried, how often, what came of
it, how long the other session had to wait at most, and the memory of the attacked process with its
children. An attack holds if the server refuses or survives it within bounds, and goes on serving
the other session. The command returns 1 if one did not hold.
"""

from __future__ import annotations

import argparse
import asyncio
import inspect
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import HTTPRedirectHandler, build_opener

from tests.attacks import cuts, files, routes, sessions, strangers, uploads
from tests.attacks.attack import (
    MIB,
    PATIENCE_S,
    TOKEN,
    Attack,
    Bystander,
    Outcome,
    Served,
    Server,
    last_line,
    running,
)

ATTACKS: list[Attack] = [
    *routes.ATTACKS,
    *strangers.ATTACKS,
    *uploads.ATTACKS,
    *files.ATTACKS,
    *cuts.ATTACKS,
    *sessions.ATTACKS,
]

SETTLED_BYTES = 1024 * MIB
"""A server that holds more is replaced, so that the next attack starts from little."""


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    title: str
    outcome: Outcome
    seconds: float
    waited_s: float | None = None
    """Longest wait of another session; None where no server was attacked."""

    @property
    def line(self) -> str:
        """A line of the table."""
        waited = "" if self.waited_s is None else f"{self.waited_s:.1f} s"
        outcome = self.outcome
        return (
            f"| {self.title} | {outcome.times} | {outcome.said.replace('|', '/')} | {waited} "
            f"| {outcome.peak_bytes / MIB:.0f} MiB | {self.seconds:.0f} s "
            f"| {'held' if outcome.held else 'did NOT hold'} |"
        )


HEADER = (
    "| attack | times | outcome | another session waited | peak memory | took | verdict |\n"
    "|---|---|---|---|---|---|---|"
)


class House:
    """A server and a session on it, replaced once an attack has harmed them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._served: Served | None = None
        self.server: Server
        self.other: Bystander

    def prepare(self, served: Served) -> None:
        """Have a healthy server of this kind."""
        if self._served == served:
            is_well = self.server.is_alive and not self.other.is_lost
            if is_well and self.server.memory.now() < SETTLED_BYTES:
                return
        self.leave()
        self.server = self._stack.enter_context(running(served, self._folder))
        if served.has_token:
            self.server.headers = cookie(self.server)
        self.other = Bystander(self.server)
        self._served = served

    def leave(self) -> None:
        """End the server."""
        if self._served is not None:
            self.other.leave()
        self._stack.close()
        self._served = None


def cookie(server: Server) -> dict[str, str]:
    """Let a client in by the token."""

    class Stay(HTTPRedirectHandler):
        def redirect_request(self, *_: object) -> None:
            """Go nowhere: the redirection itself brings the cookie."""

    try:
        build_opener(Stay).open(f"{server.address}?{urlencode({'token': TOKEN})}")
    except HTTPError as redirection:
        return {"Cookie": redirection.headers["Set-Cookie"].partition(";")[0]}
    raise ConnectionError("the server sent no cookie for its token")


def tried(attack: Attack, house: House, folder: Path) -> Row:
    """Try one attack."""
    begun = time.monotonic()
    if attack.served is None:
        return Row(attack.title, _outcome(attack, folder), time.monotonic() - begun)
    house.prepare(attack.served)
    server, other = house.server, house.other
    server.memory.restart()
    other.restart()
    begun = time.monotonic()
    outcome = _outcome(attack, server)
    time.sleep(1)  # the other session asks for something in the meantime
    waited_s, said = other.longest_s, outcome.said
    if not server.is_alive:
        how = "killed at its bound" if server.memory.is_killed else last_line(server.logged(), 60)
        said += f"; the server ENDED ({how})"
    elif other.is_lost:
        said += "; another session was LOST"
    held = outcome.held and server.is_alive and not other.is_lost and waited_s < PATIENCE_S
    peak = server.memory.peak_bytes
    outcome = replace(outcome, said=said, held=held, peak_bytes=peak)
    return Row(attack.title, outcome, time.monotonic() - begun, waited_s)


def _outcome(attack: Attack, target: Server | Path) -> Outcome:
    try:
        found = attack.run(target)
        if isinstance(found, Outcome):
            return found
        return asyncio.run(_awaited(found))
    except Exception as error:  # such as a server that has ended in the middle
        return Outcome(1, f"{type(error).__name__}: {last_line(str(error), 100)}", False)


async def _awaited(found: object) -> Outcome:
    assert inspect.isawaitable(found)
    outcome: Outcome = await found
    return outcome


def rows(attacks: list[Attack]) -> Iterator[Row]:
    """Try attacks, one after the other."""
    with TemporaryDirectory(prefix="firstphoton-attack-") as name:
        folder = Path(name)
        house = House(folder)
        try:
            for attack in attacks:
                yield tried(attack, house, folder)
        finally:
            house.leave()


def main(arguments: list[str] | None = None) -> int:
    """Try the attacks and print a row for each; returns 1 if one did not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.attack", description=__doc__)
    parser.add_argument(
        "--only", metavar="WORD", default="", help="attacks that have it in a title"
    )
    chosen = parser.parse_args(arguments)
    logging.getLogger("asyncio").setLevel(logging.ERROR)  # sockets that a server cuts off are meant
    attacks = [each for each in ATTACKS if chosen.only.lower() in each.title.lower()]
    print(HEADER, flush=True)
    begun, held = time.monotonic(), []
    for row in rows(attacks):
        print(row.line, flush=True)
        held.append(row.outcome.held)
    minutes = (time.monotonic() - begun) / 60
    print(f"\n{sum(held)} of {len(held)} attacks held, in {minutes:.1f} minutes.")
    return 0 if held and all(held) else 1


if __name__ == "__main__":
    sys.exit(main())
