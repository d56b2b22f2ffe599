"""Uploaded files: where they are stored, which sessions use them, and when they are deleted.

Each file has an unguessable key, which is part of the page's link: a page that is reloaded, or a
link in another tab, finds the file again.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from threading import Lock
from typing import Any
from weakref import WeakSet, WeakValueDictionary, finalize

from app.model.store import Source, file_source
from core import Capture
from core.checks import require
from core.io import pattern_of

MEBIBYTE = 2**20

MAX_UPLOAD_BYTES = 100 * MEBIBYTE


@dataclass(frozen=True)
class Bounds:
    """Limits on uploaded files."""

    file_bytes: int = MAX_UPLOAD_BYTES
    session_files: int = 10
    session_bytes: int = 300 * MEBIBYTE
    all_files: int = 100
    all_bytes: int = 2048 * MEBIBYTE


class _Upload:
    """Files in a folder of their own, which is deleted with this object or with the process.

    The path of several is the pattern of their names: they are a sequence.

    Raises
    ------
    ValueError
        If the names of several files do not follow one pattern.
    OSError
        If they cannot be written; the folder is deleted then.
    """

    def __init__(self, files: Mapping[str, bytes], user: object) -> None:
        stored = {safe_name(name): content for name, content in files.items()}
        pattern = pattern_of(list(stored))
        fits = pattern is not None and len(stored) == len(files)
        require("files", ", ".join(files), fits, "names that differ in numbers only")
        folder = mkdtemp(prefix="firstphoton-")
        self.remove = finalize(self, rmtree, folder, ignore_errors=True)
        self.n_bytes, self.users = _size(files), WeakSet([user])
        self.path = Path(folder) / str(pattern)
        try:
            for name, content in stored.items():
                (Path(folder) / name).write_bytes(content)
        except OSError:
            self.remove()
            raise
        source = file_source(self.path)
        self.source = replace(source, load=cached_while_used(source.load))


class Uploads:
    """Uploaded files of all sessions, in temporary folders.

    A user is any object that stands for a session. A file counts towards the limits of each user,
    whoever uploaded it; a sequence counts as one file. It is deleted with its last user, and all
    files are deleted when the process ends.

    Parameters
    ----------
    bounds : Bounds, optional
    """

    def __init__(self, bounds: Bounds | None = None) -> None:
        self.bounds = bounds or Bounds()
        self._uploads: dict[str, _Upload] = {}
        self._lock = Lock()

    def add(self, files: Mapping[str, bytes], user: object) -> str:
        """Store a file, or the files of a sequence, for a user, and return the key.

        Parameters
        ----------
        files : mapping of str to bytes
            Contents by name. Names of several files differ in numbers only.
        user : object

        Raises
        ------
        ValueError
            If a limit is exceeded, or the names do not fit.
        OSError
            If a file cannot be written.
        """
        with self._lock:
            self._delete_unused()
            self._require_room(_size(files), user)
            key = secrets.token_urlsafe(16)
            self._uploads[key] = _Upload(files, user)
            return key

    def use(self, key: str, user: object) -> Source | None:
        """Return the capture of a key and keep it for another user; None if there is none."""
        upload = self._used(key, user)
        return None if upload is None else upload.source

    def path(self, key: str, user: object) -> Path | None:
        """Return the path of a file and keep it for another user; None if there is none."""
        upload = self._used(key, user)
        return None if upload is None else upload.path

    def _used(self, key: str, user: object) -> _Upload | None:
        with self._lock:
            upload = self._uploads.get(key)
            if upload is not None:
                upload.users.add(user)
            return upload

    def release(self, key: str, user: object) -> bool:
        """Remove a user from a file; return whether there is such a file."""
        with self._lock:
            upload = self._uploads.get(key)
            if upload is not None:
                upload.users.discard(user)
                self._delete_unused()
            return upload is not None

    def leave(self, user: object) -> None:
        """Remove a user, and the files that no other user has."""
        with self._lock:
            for upload in self._uploads.values():
                upload.users.discard(user)
            self._delete_unused()

    def _delete_unused(self) -> None:
        for key in [key for key, upload in self._uploads.items() if not upload.users]:
            self._uploads.pop(key).remove()

    def _require_room(self, n_bytes: int, user: object) -> None:
        bounds, uploads = self.bounds, list(self._uploads.values())
        own = [each for each in uploads if user in each.users]
        _require_size("the file", n_bytes, bounds.file_bytes)
        for whose, stored, most_files, most_bytes in (
            ("this page", own, bounds.session_files, bounds.session_bytes),
            ("all pages", uploads, bounds.all_files, bounds.all_bytes),
        ):
            files = len(stored) + 1
            accepted = f"at most {most_files}: close a page that has files open, or give their "
            require(f"files of {whose}", files, files <= most_files, f"{accepted}paths{_OPTION}")
            total = n_bytes + sum(each.n_bytes for each in stored)
            _require_size(f"the files of {whose}", total, most_bytes)


_OPTION = " on the command line"


def _require_size(what: str, n_bytes: int, most_bytes: int) -> None:
    size = f"{n_bytes / MEBIBYTE:.1f} MiB"
    accepted = f"at most {most_bytes / MEBIBYTE:.0f} MiB, or the path of the file{_OPTION}"
    require(f"size of {what}", size, n_bytes <= most_bytes, accepted)


def _size(files: Mapping[str, bytes]) -> int:
    return sum(map(len, files.values()))


def cached_while_used(load: Callable[..., Capture]) -> Callable[..., Capture]:
    """Return a loader that shares captures which a session still holds.

    The session of a reloaded page thus takes the capture of the session before.
    """
    captures: WeakValueDictionary[tuple[Any, ...], Capture] = WeakValueDictionary()

    def load_or_share(*arguments: Any) -> Capture:
        capture = captures.get(arguments)
        if capture is None:
            capture = captures[arguments] = load(*arguments)
        return capture

    return load_or_share


def safe_name(name: str) -> str:
    """Return the last part of a file name from outside, with harmless characters only."""
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    return re.sub(r"[^\w.-]+", "_", last)[-80:].lstrip(".") or "upload"
