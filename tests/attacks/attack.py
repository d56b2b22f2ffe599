"""An attack, what became of it, and the processes that it is tried on."""

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
from dataclasses import dataclass, field
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
"""A process that holds more is killed, so that the machine survives the attack."""

PATIENCE_S = 5.0
"""Another session must never wait longer than this."""

TOKEN = "a token of the attacks"


@dataclass(frozen=True)
class Outcome:
    """Result of an attack."""

    times: int
    """How often it was tried."""
    said: str
    """Sentence on what was observed."""
    held: bool
    peak_bytes: int = 0
    """Resident memory of the attacked process and its children at its highest."""


@dataclass(frozen=True)
class Served:
    """How the attacked server is started."""

    arguments: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()

    @property
    def has_token(self) -> bool:
        """Whether a client must know a token."""
        return bool(self.environment)


HERE = Served()
WITH_TOKEN = Served(("--origin", "localhost"), (("FIRSTPHOTON_TOKEN", TOKEN),))


@dataclass(frozen=True)
class Attack:
    """Something hostile to try.

    Parameters
    ----------
    title : str
        What is tried.
    run : callable
        Tries it on a `Server`; on the folder for its files if `served` is None.
    served : Served, optional
        How the server is started; None where the command line is attacked.
    """

    title: str
    run: Callable[[Any], Outcome | Awaitable[Outcome]]
    served: Served | None = HERE


class Memory:
    """Highest resident memory of a process and its children; kills it beyond `MOST_BYTES`."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self._over = threading.Event()
        self.peak_bytes = self.now()
        self.is_killed = False
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def now(self) -> int:
        """Bytes that they hold at present; 0 once the process has ended."""
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
        """Watch no longer."""
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._over.wait(0.05):
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
    folder: Path
    """First entry of the server's module search path; for modules and files of attacks."""
    log: IO[str]
    headers: dict[str, str] = field(default_factory=dict)
    """Headers of a client that knows the token."""

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.address.rstrip("/").rpartition(":")[2])

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    def logged(self, since: int = 0) -> str:
        """Text that it has printed, from this character on."""
        with open(f"/proc/self/fd/{self.log.fileno()}", encoding="utf-8", errors="replace") as log:
            return log.read()[since:]


@contextmanager
def running(served: Served, folder: Path) -> Iterator[Server]:
    """Start a server and end it, whatever has become of it."""
    port = free_port()
    command = [sys.executable, "-m", "app", "--port", str(port), *served.arguments]
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path, **dict(served.environment)}
    with TemporaryFile("w+") as log:
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, env=environment
        )
        try:
            address = when_up(f"http://127.0.0.1:{port}/", process, log)
            memory = Memory(process.pid)
            yield Server(address, process, memory, folder, log)
            memory.stop()
        finally:
            process.kill()
            process.wait()


class Bystander:
    """Another session, which moves controls all the time and notes how long it waits."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self.is_lost = False
        self._longest_s = 0.0
        self._sent_s: float | None = None
        self._over, self._ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._live()), daemon=True)
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
        self._over.set()
        self._thread.join(60)

    async def _live(self) -> None:
        wire = Wire()
        try:
            await wire.open(self._server.address, **self._server.headers)
            hand = Hand(wire, Random(0))
            self._ready.set()
            while not (self._over.is_set() or wire.is_closed or hand.troubles):
                self._sent_s = time.monotonic()
                await hand.step()
                self._longest_s = max(self._longest_s, time.monotonic() - self._sent_s)
                self._sent_s = None
                await asyncio.sleep(0.1)
            self.is_lost = not self._over.is_set()
            wire.close()
        except Exception:  # whatever it is, this session is served no longer
            self.is_lost = True
        finally:
            self._ready.set()


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int | None
    """None where it was stopped for taking too long or too much."""
    seconds: float
    peak_bytes: int
    printed: str


def command(
    *arguments: str | Path,
    limit_s: float = 45.0,
    largest_file_bytes: int | None = None,
    **environment: str,
) -> Ended:
    """Run this Python with arguments, bounded in time and memory."""
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
        seconds = time.monotonic() - begun
        return Ended(status, seconds, memory.peak_bytes, printed.read())


def last_line(text: str, most: int = 160) -> str:
    """The last line that says something, shortened."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    line = lines[-1] if lines else "nothing printed"
    return line if len(line) <= most else line[: most - 1] + "…"


def counted(things: Sequence[Any]) -> str:
    """Number of each, such as ``3 × 403, 1 × closed``."""
    return ", ".join(f"{things.count(each)} × {each}" for each in dict.fromkeys(things))
