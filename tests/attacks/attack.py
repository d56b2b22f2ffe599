"""An attack, its outcome, and the processes that it is tried on."""

from __future__ import annotations

import asyncio
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryFile
from typing import IO, Any

import psutil

from app.server.ports import free_port
from tests.browser import ROOT, when_up
from tests.load import Hand
from tests.wire import Wire

MIB = 2**20
MOST_BYTES = 6 * 1024 * MIB
"""A process with more memory is killed, so that the machine survives the attack."""


@dataclass(frozen=True)
class Outcome:
    """Result of an attack."""

    times: int
    """Number of attempts."""
    text: str
    """Observation."""
    held: bool
    peak_bytes: int = 0
    """Highest resident memory of the attacked process and its children."""


@dataclass(frozen=True)
class Attack:
    """A hostile action.

    Parameters
    ----------
    title : str
    run : callable
        Tries it on a `Server`, or with a folder for its files.
    needs_server : bool
    """

    title: str
    run: Callable[[Any], Outcome | Awaitable[Outcome]]
    needs_server: bool = True


class Memory:
    """Highest resident memory of a process and its children; kills it beyond `MOST_BYTES`."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self._stopped = threading.Event()
        self.peak_bytes = self.now()
        self.is_killed = False
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def now(self) -> int:
        """Return the present memory; 0 once the process has ended."""
        held = 0
        with suppress(psutil.NoSuchProcess):
            for each in (self._process, *self._process.children(recursive=True)):
                with suppress(psutil.NoSuchProcess):
                    held += each.memory_info().rss
        return held

    def restart(self) -> None:
        """Forget the highest value so far."""
        self.peak_bytes = self.now()

    def stop(self) -> None:
        """Stop watching."""
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stopped.wait(0.05):
            now = self.now()
            self.peak_bytes = max(self.peak_bytes, now)
            if now > MOST_BYTES:
                self.is_killed = True
                with suppress(psutil.NoSuchProcess):
                    self._process.kill()


@dataclass
class Server:
    """The app in a process of its own, which an attack may end."""

    address: str
    process: subprocess.Popen[bytes]
    memory: Memory
    log: IO[str]

    @property
    def port(self) -> int:
        """TCP port."""
        return int(self.address.rstrip("/").rpartition(":")[2])

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    def logged(self, since: int = 0) -> str:
        """Return the output from this character on."""
        with open(f"/proc/self/fd/{self.log.fileno()}", encoding="utf-8", errors="replace") as log:
            return log.read()[since:]


@contextmanager
def running(*arguments: str) -> Iterator[Server]:
    """Start a server, and kill it at the end."""
    port = free_port()
    options = [sys.executable, "-m", "app", "--port", str(port), *arguments]
    with TemporaryFile("w+") as log:
        process = subprocess.Popen(options, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)
        try:
            address = when_up(f"http://127.0.0.1:{port}/", process, log)
            memory = Memory(process.pid)
            yield Server(address, process, memory, log)
            memory.stop()
        finally:
            process.kill()
            process.wait()


class Bystander:
    """Another session, which moves controls all the time and measures how long it waits."""

    def __init__(self, address: str) -> None:
        self._address = address
        self.is_lost = False
        self._longest_s = 0.0
        self._sent_s: float | None = None
        self._stopped, self._ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._use()), daemon=True)
        self._thread.start()
        self._ready.wait(60)

    @property
    def longest_s(self) -> float:
        """Longest wait since the last `restart`, including one that has not ended yet."""
        sent_s = self._sent_s
        return max(self._longest_s, 0.0 if sent_s is None else time.monotonic() - sent_s)

    def restart(self) -> None:
        """Forget the waits so far."""
        self._longest_s = 0.0

    def leave(self) -> None:
        """Close the session."""
        self._stopped.set()
        self._thread.join(60)

    async def _use(self) -> None:
        wire = Wire()
        try:
            await wire.open(self._address)
            hand = Hand(wire, Random(0))
            self._ready.set()
            while not (self._stopped.is_set() or wire.is_closed or hand.troubles):
                self._sent_s = time.monotonic()
                await hand.step()
                self._longest_s = max(self._longest_s, time.monotonic() - self._sent_s)
                self._sent_s = None
                await asyncio.sleep(0.1)
            self.is_lost = not self._stopped.is_set()
            wire.close()
        except Exception:  # in any case, this session is not served any more
            self.is_lost = True
        finally:
            self._ready.set()


@dataclass(frozen=True)
class Ended:
    """Outcome of a command."""

    status: int | None
    """None if it was stopped for taking too long or too much."""
    seconds: float
    peak_bytes: int
    printed: str


def command(
    *arguments: str | Path,
    limit_s: float = 45.0,
    largest_file_bytes: int | None = None,
    **environment: str,
) -> Ended:
    """Run this Python with arguments, limited in time and memory."""
    begun = time.monotonic()
    with TemporaryFile("w+", encoding="utf-8", errors="replace") as printed:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=subprocess.STDOUT,
            env=os.environ | environment,
        )
        if largest_file_bytes is not None:
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (largest_file_bytes,) * 2)
        memory = Memory(process.pid)
        try:
            process.wait(limit_s)
        except subprocess.TimeoutExpired:
            for each in (*psutil.Process(process.pid).children(recursive=True), process):
                with suppress(psutil.NoSuchProcess):
                    each.kill()
            process.wait()
            status = None
        else:
            status = None if memory.is_killed else process.returncode
        memory.stop()
        printed.seek(0)
        return Ended(status, time.monotonic() - begun, memory.peak_bytes, printed.read())


def last_line(text: str, most: int = 160) -> str:
    """Return the last line that is not empty, shortened."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    line = lines[-1] if lines else "nothing printed"
    return line if len(line) <= most else line[: most - 1] + "…"


def counted(things: Sequence[Any]) -> str:
    """Return the number of each thing, such as ``3 × 403, 1 × closed``."""
    return ", ".join(f"{things.count(each)} × {each}" for each in dict.fromkeys(things))
