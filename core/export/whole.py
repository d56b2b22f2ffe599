"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


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
    if path.exists() and not overwrite:
        raise _refusal(path)
    unfinished = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with unfinished.open("x+b") as file:
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
def whole_folder(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """A folder to be filled, which takes its name only once it is full; like `whole_file`.

    Yields
    ------
    Path
        Where to write.
    """
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
    return FileExistsError(f"{path} exists: give another name, or overwrite=True to replace it.")


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
