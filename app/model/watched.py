"""A folder whose captures are opened as they are written."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from stat import S_ISREG

from app.model import text
from app.model.store import NO_OPTIONS, Source, content_key, file_source, is_ambiguous
from app.model.uploads import cached_while_used
from core.checks import require
from core.io import SUFFIXES, ReadOptions

log = logging.getLogger(__name__)

LOOK_MS = 1000
"""Time between two looks at a folder."""

MOST_CAPTURES = 50
"""Captures of a folder that are offered, the newest ones."""

_State = tuple[int, int]  # size in bytes, and time of the last change in ns


@dataclass(frozen=True)
class Arrival:
    """Changes in a folder since it was last read."""

    found: Mapping[str, Source]
    """Captures that have just been written by key, the newest last."""
    outdated: tuple[str, ...]
    """Keys of older captures that are no longer offered."""
    refused: tuple[str, ...] = ()
    """Name of each of the latest files that cannot be opened, and why."""

    @property
    def newest(self) -> str:
        """Key of the newest capture."""
        return list(self.found)[-1]

    def update(self, sources: dict[str, Source], kept: str = "") -> None:
        """Offer the captures; an outdated one of the key `kept` stays."""
        sources.update(self.found)
        for key in self.outdated:
            if key != kept:
                sources.pop(key, None)


class WatchedFolder:
    """Find the captures of a folder.

    A file counts as written when two looks in a row find the same size and time. Of those that are
    there at the first look, only the newest is opened.

    Parameters
    ----------
    folder : Path
    given : ReadOptions, optional
        Options for reading.
    change : callable, optional
        Returns the source of a capture to offer in place of the one that was found.

    Raises
    ------
    ValueError
        If there is no such folder.
    """

    def __init__(
        self,
        folder: Path,
        given: ReadOptions = NO_OPTIONS,
        change: Callable[[Source], Source] = lambda source: source,
    ) -> None:
        require("watch", str(folder), folder.is_dir(), "an existing folder")
        self._folder, self._given, self._change = folder, given, change
        self._seen = self._states()
        newest = max(self._seen, key=lambda path: self._seen[path][1], default=None)
        self._handled = {path: at for path, at in self._seen.items() if path != newest}
        self._keys: list[str] = []
        self._refused: dict[Path, str] = {}

    def look(self) -> Arrival | None:
        """Return what has changed since the last look; None if nothing has.

        A file that could not be opened is named until it changes or others have been written.
        """
        states = self._states()
        written = [
            path
            for path, state in states.items()
            if self._seen.get(path) == state != self._handled.get(path)
        ]
        self._seen = states
        found: dict[str, Source] = {}
        refused: dict[Path, str] = {}
        before, handled = self._refused, self._handled
        still = {path: why for path, why in before.items() if states.get(path) == handled[path]}
        for path in sorted(written, key=lambda path: states[path][1]):
            self._handled[path] = states[path]
            try:
                key = content_key(path)
                source = self._change(file_source(path, given=self._given))
                source = replace(source, load=cached_while_used(source.load))
                source.read()
            except (ValueError, OSError) as error:
                if not is_ambiguous(error):
                    log.warning("not opened: %s", error)
                    refused[path] = text.cause_in(path.name, error)
                    continue
            found[key] = source  # of several arrays, the page asks for one
        keys = [key for key in self._keys if key not in found] + list(found)
        self._keys = keys[-MOST_CAPTURES:]
        self._refused = refused if found or refused else still
        if not found and self._refused == before:
            return None
        return Arrival(found, tuple(keys[:-MOST_CAPTURES]), tuple(self._refused.values()))

    def _states(self) -> dict[Path, _State]:
        """Return size and time of each file that may be a capture."""
        states = {}
        for path in self._folder.iterdir():
            suffix = path.with_suffix("").suffix if path.suffix == ".gz" else path.suffix
            if suffix.lower() in SUFFIXES and not path.name.startswith("."):
                try:
                    found = path.stat()
                except OSError:
                    continue  # it has just been removed
                if S_ISREG(found.st_mode):
                    states[path] = found.st_size, found.st_mtime_ns
        return states
