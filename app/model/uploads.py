"""Files that users open from the page: where they lie, who uses them, and when they go.

Each has a key that nobody can guess and whoever has it can use: it stands in the address of the
page, so that a page that is loaded anew, or a link in another tab, finds the file again.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable
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

MEBIBYTE = 2**20

MAX_UPLOAD_BYTES = 100 * MEBIBYTE


@dataclass(frozen=True)
class Bounds:
    """How much is accepted."""

    file_bytes: int = MAX_UPLOAD_BYTES
    session_files: int = 10
    session_bytes: int = 300 * MEBIBYTE
    all_files: int = 100
    all_bytes: int = 2048 * MEBIBYTE


class _Upload:
    """A file in a folder of its own, which goes with this object, at the latest with the process.

    Raises
    ------
    OSError
        If it cannot be written; nothing of it is left then.
    """

    def __init__(self, name: str, content: bytes, user: object) -> None:
        folder = mkdtemp(prefix="firstphoton-")
        self.remove = finalize(self, rmtree, folder, ignore_errors=True)
        self.n_bytes, self.users = len(content), WeakSet([user])
        path = Path(folder) / harmless(name)
        try:
            path.write_bytes(content)
        except OSError:
            self.remove()
            raise
        source = file_source(path)
        self.source = replace(source, load=kept_while_used(source.load))


class Uploads:
    """All sessions' files, each in a folder of its own among the system's temporary ones.

    A user is any object that stands for a session. Each file that it uses counts to its bounds,
    whoever brought it. A file goes with its last user, and all go when the process ends.

    Parameters
    ----------
    bounds : Bounds, optional
    """

    def __init__(self, bounds: Bounds | None = None) -> None:
        self.bounds = bounds or Bounds()
        self._kept: dict[str, _Upload] = {}
        self._lock = Lock()

    def add(self, name: str, content: bytes, user: object) -> str:
        """Keep a file for a user, and return its key.

        Raises
        ------
        ValueError
            If it is too large, or there are too many: says which bound it exceeds.
        OSError
            If it cannot be written.
        """
        with self._lock:
            self._sweep()
            self._require_room(len(content), user)
            key = secrets.token_urlsafe(16)
            self._kept[key] = _Upload(name, content, user)
            return key

    def use(self, key: str, user: object) -> Source | None:
        """The file of a key, which is kept for this user now, too; None if there is none."""
        with self._lock:
            upload = self._kept.get(key)
            if upload is None:
                return None
            upload.users.add(user)
            return upload.source

    def leave(self, user: object) -> None:
        """A user is gone for good, and with it the files that it was the last to use."""
        with self._lock:
            for upload in self._kept.values():
                upload.users.discard(user)
            self._sweep()

    def _sweep(self) -> None:
        """Remove the files that nobody uses."""
        unused = [key for key, upload in self._kept.items() if not upload.users]
        for key in unused:
            self._kept.pop(key).remove()

    def _require_room(self, n_bytes: int, user: object) -> None:
        bounds, everything = self.bounds, list(self._kept.values())
        own = [each for each in everything if user in each.users]
        _require_below("the file", n_bytes, bounds.file_bytes)
        for whose, kept, most_files, most_bytes in (
            ("this page", own, bounds.session_files, bounds.session_bytes),
            ("all pages", everything, bounds.all_files, bounds.all_bytes),
        ):
            files = len(kept) + 1
            more = f"at most {most_files}: close a page that has files open, or give their paths "
            require(f"files of {whose}", files, files <= most_files, more + "on the command line")
            _require_below(
                f"the files of {whose}", n_bytes + sum(each.n_bytes for each in kept), most_bytes
            )


def kept_while_used(load: Callable[..., Capture]) -> Callable[..., Capture]:
    """The same, but what somebody still holds is not loaded again.

    The session of a page that is loaded anew takes the capture from the one before.
    """
    kept: WeakValueDictionary[tuple[Any, ...], Capture] = WeakValueDictionary()

    def load_or_take(*how: Any) -> Capture:
        capture = kept.get(how)
        if capture is None:
            capture = kept[how] = load(*how)
        return capture

    return load_or_take


def _require_below(what: str, n_bytes: int, most_bytes: int) -> None:
    size = f"{n_bytes / MEBIBYTE:.1f} MiB"
    most = f"at most {most_bytes / MEBIBYTE:.0f} MiB, or the path of the file on the command line"
    require(f"size of {what}", size, n_bytes <= most_bytes, most)


def harmless(name: str) -> str:
    """A file's name from outside: only its last part, and only harmless letters of that."""
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    return re.sub(r"[^\w.-]+", "_", last)[-80:].lstrip(".") or "upload"
