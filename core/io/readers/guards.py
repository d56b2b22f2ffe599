"""What keeps a damaged or hostile file from doing more than being refused."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from core.capture import CaptureError
from core.checks import require

# Largest cube, file, and decompressed part of a file, each by itself: to read one takes a few times
# as much, which is in memory beside it. Checked before memory is asked for: a header of a hundred
# bytes can claim any size.
MAX_CUBE_BYTES = 2 * 1024**3

# What a process may take that looks at a file for us; on Windows, the time alone is limited.
MAX_CHILD_BYTES = 2 * 1024**3
MAX_CHILD_SECONDS = 120
_LEAST_CHILD_SECONDS, _CHILD_SECONDS_A_MIB = 15, 2  # a small file has no reason to take long

_LAST_BYTES = 2**12  # of what a process complained of


def require_fits(name: str, n_bytes: int, remedy: str = "a smaller file") -> None:
    """Raise ``ValueError`` if something would take more than `MAX_CUBE_BYTES`."""
    allowed = f"{remedy}: at most {MAX_CUBE_BYTES:,} bytes are read"
    require(f"bytes of {name}", n_bytes, 0 <= n_bytes <= MAX_CUBE_BYTES, allowed)


@dataclass(frozen=True)
class FileVersion:
    """A file or folder as it was when it was opened.

    Parameters
    ----------
    path : Path
    stamp : tuple of int
        Size in bytes, and when its content last changed in nanoseconds.
    """

    path: Path
    stamp: tuple[int, int]

    @classmethod
    def of(cls, path: Path) -> FileVersion:
        """The file as it is now."""
        status = path.stat()
        return cls(path, (status.st_size, status.st_mtime_ns))

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Raise `CaptureError` if the file has changed by the end, so that nothing is mixed."""
        try:
            yield
        except Exception:
            self.require()  # a change explains the failure
            raise
        self.require()

    def require(self) -> None:
        """Raise `CaptureError` if the file has changed or is gone."""
        try:
            found = "changed" if FileVersion.of(self.path) != self else ""
        except OSError:
            found = "gone"
        if found:
            raise CaptureError(
                f"version of {self.path.name} = {found!r} is not accepted: give a file that has "
                "not gone or changed since it was opened, or open it again."
            )


@contextmanager
def decoding(what: str) -> Iterator[None]:
    """Turn whatever a library raises on a damaged file into one clear refusal.

    The decoders document no list of their exceptions, so every one of them is taken.
    """
    try:
        yield
    except CaptureError:
        raise  # said already
    except Exception as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise CaptureError(
            f"{what} cannot be read, the file is damaged ({reason}): copy or save it again."
        ) from error


def isolated(
    script: Path, path: Path, what: str, task: str, *arguments: str
) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Run a script in a process of its own, which may crash, hang or swell in place of this one.

    Parameters
    ----------
    script : Path
        Limits itself to the bytes and seconds that are its first two arguments, and writes an
        ``.npz`` to its standard output: ``_told``, a JSON text, and other arrays. In place of an
        answer the text may have ``refused``, a sentence, or an ``error``.
    path : Path
        The file that it reads: a larger one may take longer.
    what : str
        What to call in a refusal that which it reads.
    task, arguments : str
        The script's others: `task`, the file's path, `arguments`.

    Returns
    -------
    told : object
        What the JSON text says.
    arrays : dict of ndarray

    Raises
    ------
    ValueError
        If the script refuses, takes more than it may, or ends otherwise.
    """
    allowed = _LEAST_CHILD_SECONDS + _CHILD_SECONDS_A_MIB * path.stat().st_size // 2**20
    seconds = min(allowed, MAX_CHILD_SECONDS)
    told_limits = (str(MAX_CHILD_BYTES), str(seconds))
    # Without the script's own folder, whose modules are named like others.
    command = [sys.executable, "-P", str(script), *told_limits, task, str(path.absolute())]
    command += arguments
    # Each thread of a linear algebra that nobody asked for would reserve memory of its own. And no
    # plugin is loaded that a file may name. What is installed here is so there.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    remedy = "a whole file: copy or save it again"
    with tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as complaints:
        try:
            status = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=answer,
                stderr=complaints,
                timeout=seconds,
                env=environment,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            found = f"{what} = more than {seconds} s to look at is not accepted: give"
            raise CaptureError(f"{found} {remedy}.") from None
        if status == 1:
            _require_installed(what, complaints)
        ending = signal.Signals(-status).name if status < 0 else f"status {status}"
        require(what, f"its library ended by {ending}", status == 0, remedy)
        answer.seek(0)
        with decoding(what), np.load(answer, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
            told = json.loads(str(arrays.pop("_told")))
    if "refused" in told:
        raise CaptureError(told["refused"])
    if "error" in told:
        raise CaptureError(f"{what} cannot be read ({told['error']}): give {remedy}.")
    return told, arrays


def _require_installed(what: str, complaints: IO[bytes]) -> None:
    """Raise `CaptureError` if Python ended because it did not find what a script imports."""
    complaints.seek(max(0, complaints.seek(0, os.SEEK_END) - _LAST_BYTES))
    last = complaints.read().decode(errors="replace").strip().rpartition("\n")[2]
    if last.startswith(("ImportError", "ModuleNotFoundError")):
        raise CaptureError(f"{what} cannot be read without its library ({last}): install it.")
