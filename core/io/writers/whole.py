"""Files that are written whole or not at all."""

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
    """A file that keeps the first failure to write to it: some libraries report it as their own."""

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
        Of the failure's own type and number.
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
    """A file to be written, which takes its name only once all of it lies on the disk.

    Parameters
    ----------
    path : Path
        The name.
    overwrite : bool
        Replace a file of that name.

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
        if path.exists() and not overwrite:
            raise _refusal(path)
        unfinished = path.with_name(f".{secrets.token_hex(8)}.part")
        try:
            with _opened(unfinished) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if overwrite:
                os.replace(unfinished, path)
            else:
                _take_free_name(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """A new file to write and read, which reports its own failure before that of a library."""
    raw = _Watched(path, "x+")
    try:
        with io.BufferedRandom(raw) as file:
            yield file
    except Exception as error:
        if raw.failure is not None and not isinstance(error, OSError):
            raise raw.failure from error
        raise


@contextmanager
def whole_folder(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """A folder to be filled, which takes its name only once it is full; like `whole_file`.

    Yields
    ------
    Path
        Where to write.
    """
    with writing(path):
        if path.exists() and not overwrite:
            raise _refusal(path)
        unfinished = path.with_name(f".{secrets.token_hex(8)}.part")
        older = path.with_name(f".{secrets.token_hex(8)}.older")
        try:
            yield unfinished
            if overwrite and path.exists():
                path.rename(older)
            try:
                unfinished.rename(path)  # fails where something full of that name came meanwhile
            except BaseException as error:
                _put_back(older, path, error)
                raise
            _remove(older)
        finally:
            _remove(unfinished)


def _put_back(older: Path, path: Path, error: BaseException) -> None:
    """Give what was to be replaced its name again, or say where it is now."""
    if not os.path.lexists(older):
        return
    if os.path.lexists(path):
        error.add_note(f"What was {path} is now {older}.")
    else:
        older.rename(path)


def _remove(path: Path) -> None:
    """Remove a file, a link or a folder, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _refusal(path: Path) -> FileExistsError:
    return FileExistsError(
        f"{shown(path)} exists: give another name, or overwrite=True to replace it."
    )


def _take_free_name(unfinished: Path, path: Path) -> None:
    """Name a file; a link, unlike renaming, never replaces what came to exist meanwhile."""
    try:
        os.link(unfinished, path)
    except FileExistsError:
        raise _refusal(path) from None
    except OSError:  # this file system has no hard links
        _claim(path)
        try:
            os.replace(unfinished, path)
        except OSError:
            path.unlink()
            raise


def _claim(path: Path) -> None:
    """Make an empty file of a name that must be free."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise _refusal(path) from None
