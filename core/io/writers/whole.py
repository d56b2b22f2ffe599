"""Files and folders that are written whole or not at all."""

from __future__ import annotations

import errno
import io
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from core.checks import reason, shown

_REMEDIES = {errno.ENAMETOOLONG: "give a shorter name"}
_REMEDIES |= dict.fromkeys(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "free some space, or give another folder"
)


class _Watched(io.FileIO):
    """File that keeps its first failure to write: some libraries raise errors of their own."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        """Write bytes."""
        try:
            return super().write(data)
        except OSError as error:
            self.failure = self.failure or error
            raise


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Report the system's failures to write a file: its name, what happened, what to do.

    Raises
    ------
    OSError
        With the type and number of the failure.
    """
    try:
        yield
    except FileExistsError:
        raise  # says what to do already
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "free some space, or give a folder to write to")
        refusal = type(error)(f"{shown(path)} cannot be written ({reason(error)}): {remedy}.")
        refusal.errno = error.errno
        for note in getattr(error, "__notes__", ()):
            refusal.add_note(note)
        raise refusal from error


@contextmanager
def whole_file(path: Path, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a file that takes its name only once all of it lies on the disk.

    Yields
    ------
    file
        Open for bytes; can be read and sought.

    Raises
    ------
    FileExistsError
        If the file exists, or comes to exist meanwhile, and is not to be replaced.
    OSError
        If the folder cannot be written; an older file is then left as it was.
    """
    with writing(path):
        _require_free(path, overwrite)
        unfinished = path.with_name(f".{secrets.token_hex(8)}.part")
        raw = None
        try:
            raw = _Watched(unfinished, "x+")
            with io.BufferedRandom(raw) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if overwrite:
                os.replace(unfinished, path)
            else:
                _take_free_name(unfinished, path)
        except Exception as error:
            if raw is None or raw.failure is None or isinstance(error, OSError):
                raise
            raise raw.failure from error  # rather than what a library made of it
        finally:
            unfinished.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a folder to be filled, which takes its name only once it is full; as `whole_file`."""
    with writing(path):
        _require_free(path, overwrite)
        unfinished, older = (
            path.with_name(f".{secrets.token_hex(8)}.{kind}") for kind in ("part", "older")
        )
        try:
            yield unfinished
            if overwrite and path.exists():
                path.rename(older)
            try:
                unfinished.rename(path)  # fails where a folder of that name came meanwhile
            except BaseException as error:
                if os.path.lexists(older) and os.path.lexists(path):
                    error.add_note(f"What was {path} is now {older}.")
                elif os.path.lexists(older):
                    older.rename(path)
                raise
            _remove(older)
        finally:
            _remove(unfinished)


def _remove(path: Path) -> None:
    """Remove a file, a link or a folder, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _require_free(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise _refusal(path)


def _refusal(path: Path) -> FileExistsError:
    return FileExistsError(
        f"{shown(path)} exists: give another name, or overwrite=True to replace it."
    )


def _take_free_name(unfinished: Path, path: Path) -> None:
    """Rename a file, but never over another: an empty file claims the name first."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise _refusal(path) from None
    try:
        os.replace(unfinished, path)
    except OSError:
        path.unlink()
        raise
