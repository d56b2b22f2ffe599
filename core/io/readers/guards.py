"""Limits and checks that turn a damaged or hostile file into a clear error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from core.capture import CaptureError
from core.checks import require

MAX_CUBE_BYTES = 2 * 1024**3
"""Largest cube, file, and decompressed part of a file; reading takes a few times as much memory.

Sizes are checked before memory is allocated, since a header of a hundred bytes can claim any size.
"""


def require_fits(name: str, n_bytes: int, remedy: str = "a smaller file") -> None:
    """Raise ``ValueError`` if something would take more than `MAX_CUBE_BYTES`."""
    allowed = f"{remedy}: at most {MAX_CUBE_BYTES:,} bytes are read"
    require(f"bytes of {name}", n_bytes, 0 <= n_bytes <= MAX_CUBE_BYTES, allowed)


@dataclass(frozen=True)
class FileVersion:
    """Version of a file or folder at the time when it was opened.

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
        """Return the present version."""
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
    """Turn any exception of a library on a damaged file into a `CaptureError`.

    The decoders do not document their exceptions, so every type is caught.
    """
    try:
        yield
    except CaptureError:
        raise  # already clear
    except Exception as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise CaptureError(
            f"{what} cannot be read, the file is damaged ({reason}): copy or save it again."
        ) from error
