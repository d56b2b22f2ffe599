"""Attacks on the app and the command line: ``python -m tests.attack``, or `make attack`.

Attacks of `tests.attacks` are tried on a server on this machine, limited in number and time, while
another session moves its sliders. A row has the attempts, the observation, the longest wait of the
other session, and the memory of the attacked process with its children. An attack holds if the
server refuses or survives it within limits, and goes on serving the other session. The command
returns 1 if one did not hold. Requests of strangers and of other sites are tested in
`tests.test_limits`, `tests.test_routes` and `tests.test_serving`.
"""

from __future__ import annotations

import argparse
import asyncio
import inspect
import logging
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.attacks import cuts, files, sessions, uploads
from tests.attacks.attack import MIB, Attack, Bystander, Outcome, Server, last_line, running

ATTACKS: list[Attack] = [*uploads.ATTACKS, *files.ATTACKS, *cuts.ATTACKS, *sessions.ATTACKS]

LONGEST_WAIT_S = 5.0
"""Another session must never wait longer."""

SETTLED_BYTES = 1024 * MIB
"""A server with more memory is replaced, so that the next attack starts from little."""

HEADER = (
    "| attack | times | outcome | another session waited | peak memory | took | verdict |\n"
    "|---|---|---|---|---|---|---|"
)


class Target:
    """A server and a session on it, replaced once an attack has harmed them."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.server: Server | None = None

    def healthy(self) -> tuple[Server, Bystander]:
        """Return a server and a session that are well."""
        server = self.server
        if server is None or not self._is_well(server):
            self._stack.close()
            self.server = server = self._stack.enter_context(running())
            self.other = Bystander(server.address)
            self._stack.callback(self.other.leave)
        server.memory.restart()
        self.other.restart()
        return server, self.other

    def _is_well(self, server: Server) -> bool:
        return server.is_alive and not self.other.is_lost and server.memory.now() < SETTLED_BYTES


def row_of(attack: Attack, target: Target, folder: Path) -> tuple[str, bool]:
    """Try an attack; return its row of the table, and whether it held."""
    if attack.needs_server:
        server, other = target.healthy()
        begun = time.monotonic()
        outcome = _outcome(attack, server)
        time.sleep(1)  # the other session moves in the meantime
        waited_s, text = other.longest_s, outcome.text
        if not server.is_alive:
            how = "killed at its limit" if server.memory.is_killed else server.logged()
            text += f"; the server ENDED ({last_line(how, 60)})"
        elif other.is_lost:
            text += "; another session was LOST"
        held = outcome.held and server.is_alive and not other.is_lost and waited_s < LONGEST_WAIT_S
        outcome = replace(outcome, text=text, held=held, peak_bytes=server.memory.peak_bytes)
        waited = f"{waited_s:.1f} s"
    else:
        begun, waited = time.monotonic(), ""
        outcome = _outcome(attack, folder)
    row = (
        f"| {attack.title} | {outcome.times} | {outcome.text.replace('|', '/')} | {waited} "
        f"| {outcome.peak_bytes / MIB:.0f} MiB | {time.monotonic() - begun:.0f} s "
        f"| {'held' if outcome.held else 'did NOT hold'} |"
    )
    return row, outcome.held


def _outcome(attack: Attack, target: Server | Path) -> Outcome:
    async def awaited(found: object) -> Outcome:
        assert inspect.isawaitable(found)
        outcome: Outcome = await found
        return outcome

    try:
        found = attack.run(target)
        return found if isinstance(found, Outcome) else asyncio.run(awaited(found))
    except Exception as error:  # such as a server that has ended
        return Outcome(1, f"{type(error).__name__}: {last_line(str(error), 100)}", False)


def main(arguments: list[str] | None = None) -> int:
    """Try the attacks and print a row for each; return 1 if one did not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.attack", description=__doc__)
    parser.add_argument("--only", metavar="TEXT", default="", help="attacks with it in their title")
    chosen = parser.parse_args(arguments)
    logging.getLogger("asyncio").setLevel(logging.ERROR)  # the server cuts off sockets on purpose
    attacks = [each for each in ATTACKS if chosen.only.lower() in each.title.lower()]
    print(HEADER, flush=True)
    begun, held = time.monotonic(), []
    with TemporaryDirectory(prefix="firstphoton-attack-") as folder, ExitStack() as stack:
        target = Target(stack)
        for attack in attacks:
            row, has_held = row_of(attack, target, Path(folder))
            print(row, flush=True)
            held.append(has_held)
    minutes = (time.monotonic() - begun) / 60
    print(f"\n{sum(held)} of {len(held)} attacks held, in {minutes:.1f} minutes.")
    return 0 if held and all(held) else 1


if __name__ == "__main__":
    sys.exit(main())
