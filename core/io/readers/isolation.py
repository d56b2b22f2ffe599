"""Decode files in processes of limited memory and time, so that no file harms this one.

All formats that a library parses are decoded there, JSON records and depth maps too. Only NumPy's
formats, raw camera frames and gzip are read in this process: their sizes are checked before memory
is allocated, and nothing in them is interpreted.

Processes that are idle are used again, one for each thread that reads at the same time.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from math import prod
from pathlib import Path
from threading import Lock, Timer
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.capture import CaptureError
from core.checks import require
from core.io.readers import guards
from core.io.readers.guards import decoding

BASE_BYTES = 2**30
"""Address space for the libraries of a process, beyond what it reads. Not limited on Windows."""

MAX_SECONDS = 120
LEAST_SECONDS = 15
SECONDS_PER_MIB = 2
"""Processor time that a file may take: at most, at least, and for its size."""

WAIT_FACTOR = 4
"""Elapsed over processor time, at most: on a busy machine a process gets part of a processor."""

WORKER = Path(__file__).with_name("file_worker.py")
"""Script of the processes."""

_MOST_REPLY_BYTES = 2**27

Reply = tuple[dict[str, Any], list[NDArray[Any]]]
"""Description and arrays."""

_idle: list[_Process] = []
_lock = Lock()


class _Ended(Exception):
    """The process ended without a reply."""


class _Process:
    """Process that reads files."""

    def __init__(self) -> None:
        # No BLAS threads, which reserve memory; no plugins that a file may name.
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        environment["BLOSC_NTHREADS"] = "1"
        # -P: the folder of the script has modules named like others.
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pipesize=2**20,  # on Linux; larger pieces cost fewer switches between processes
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        self.owner = os.getpid()
        self.is_used = False

    @property
    def is_alive(self) -> bool:
        return self.owner == os.getpid() and self._process.poll() is None

    def ask(self, request: dict[str, Any]) -> Reply:
        """Send a request; return the reply."""
        timer = Timer(WAIT_FACTOR * request["seconds"], self._process.kill)
        timer.daemon = True
        timer.start()
        try:
            self._input.write(json.dumps(request).encode() + b"\n")
            self._input.flush()
            line = self._output.readline(_MOST_REPLY_BYTES)
            if not line:
                raise _Ended
            reply = json.loads(line)
            kinds = [(np.dtype(kind), shape) for kind, shape in reply["arrays"]]
            return reply["found"], [self._array(*each, request["most_bytes"]) for each in kinds]
        except OSError as error:
            raise _Ended from error
        finally:
            timer.cancel()
            timer.join()
            self.is_used = True

    def _array(self, dtype: np.dtype[Any], shape: list[int], most_bytes: int) -> NDArray[Any]:
        n_bytes = prod(shape) * dtype.itemsize
        plain = dtype.kind in "iuf" and 0 <= n_bytes <= most_bytes
        require("bytes of a reply", n_bytes, plain, f"up to {most_bytes:,}")
        array = np.empty(shape, dtype)
        data = array.reshape(-1).view(np.uint8).data
        if n_bytes and self._output.readinto(data) != n_bytes:  # type: ignore[attr-defined]
            raise _Ended
        return array

    def end(self) -> str:
        """End the process; return how it ended."""
        try:
            status = self._process.wait(0.1)
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait()
        for pipe in (self._input, self._output):
            with suppress(OSError):
                pipe.close()
        return signal.Signals(-status).name if status < 0 else f"status {status}"


def isolated(
    path: Path, what: str, task: str, *, working_bytes: int | None = None, **arguments: Any
) -> Reply:
    """Run a task of `core.io.readers.file_worker` in a process of its own.

    Parameters
    ----------
    path : Path
        File or directory that it reads; a large file may take longer.
    what : str
        Name for error messages.
    task : str
        Name of the task.
    working_bytes : int, optional
        Memory that the task may take beyond `BASE_BYTES`; by default that of two of the largest
        cubes.
    **arguments
        Passed to the task with the path.

    Returns
    -------
    found : dict
        The reply's JSON.
    arrays : list of ndarray

    Raises
    ------
    CaptureError
        If the file is refused or damaged, or the task ends or takes more than it may.
    """
    allowed = LEAST_SECONDS + SECONDS_PER_MIB * path.stat().st_size // 2**20
    working_bytes = 2 * guards.MAX_CUBE_BYTES if working_bytes is None else working_bytes
    request = {
        "task": task,
        "path": str(path.absolute()),
        "most_bytes": guards.MAX_CUBE_BYTES,
        "memory_bytes": BASE_BYTES + working_bytes,
        "seconds": min(allowed, MAX_SECONDS),
        **arguments,
    }
    with decoding(what):
        found, arrays = _reply_to(request)
    if "refused" in found:
        raise CaptureError(found["refused"])
    if "missing" in found:
        raise CaptureError(f"{what} needs a library ({found['missing']}): install it.")
    if "error" in found:
        raise CaptureError(
            f"{what} cannot be read, the file is damaged or too large ({found['error']}): copy or "
            "save it again."
        )
    return found, arrays


def _reply_to(request: dict[str, Any]) -> Reply:
    """Ask an idle process; if it fails, where an earlier file may be the cause, a new one."""
    process = _take()
    while True:
        was_used, began = process.is_used, monotonic()
        try:
            found, arrays = process.ask(request)
        except _Ended:
            found, arrays = {"error": f"its library ended by {process.end()}", "ended": True}, []
        except BaseException:
            process.end()
            raise
        if not {"ended", "exhausted"} & found.keys():
            _give(process)
            return found, arrays
        process.end()
        if monotonic() - began >= request["seconds"]:
            return {"error": f"more than {request['seconds']} s"}, []
        if not was_used:
            return found, []
        process = _Process()


def _take() -> _Process:
    """Return an idle process that is alive, else a new one."""
    with _lock:
        while _idle:
            process = _idle.pop()
            if process.is_alive:
                return process
            if process.owner == os.getpid():
                process.end()
    return _Process()


def _give(process: _Process) -> None:
    with _lock:
        if len(_idle) < (os.cpu_count() or 1):
            _idle.append(process)
            return
    process.end()


@atexit.register
def end_idle_processes() -> None:
    """End all processes that wait for work."""
    with _lock:
        while _idle:
            process = _idle.pop()
            if process.owner == os.getpid():
                process.end()
