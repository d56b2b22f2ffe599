"""Zarr, versions 2 and 3: a directory of arrays, each a directory of chunks.

The library reads them in an isolated process (`core.io.readers.isolation`), array by array, without
consolidated metadata. A directory with a symbolic link anywhere in it is refused.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from core.checks import require
from core.io.readers.guards import FileVersion
from core.io.readers.stored import Stored, listed

MARKS = ("zarr.json", ".zarray", ".zgroup")
"""Names of files, one of which the folder contains."""

_METADATA = (*MARKS, ".zattrs")
_MOST_JSON_BYTES = 2**24  # of a whole directory


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """List all arrays in a directory, and the attributes of its groups by name."""
    n_bytes = 0
    described_folders: list[str] = []
    versions = {"": FileVersion.of(path)}
    folders: dict[str, tuple[FileVersion, ...]] = {}
    for folder, files in _folders(path):
        name = folder.relative_to(path).as_posix().removeprefix(".")
        described = [one for one in _METADATA if one in files]
        if described:
            n_bytes += sum((folder / one).stat().st_size for one in described)
            accepted = f"up to {_MOST_JSON_BYTES:,}"
            require("bytes of metadata", n_bytes, n_bytes <= _MOST_JSON_BYTES, accepted)
            mixed = "zarr.json" in files and bool(files & {".zarray", ".zgroup"})
            both = "versions 2 and 3"
            require(f"metadata of {name or path.name}", both, not mixed, "one of them")
            described_folders.append(name)
            versions[name or path.name] = FileVersion.of(folder / described[0])
            folders[name or path.name] = (FileVersion.of(folder),)
        elif described_folders and folder.is_relative_to(path / described_folders[-1]):
            folders[described_folders[-1] or path.name] += (FileVersion.of(folder),)
    found = listed(
        path, "list_zarr", "read_zarr", versions, folders, described_folders=described_folders
    )
    require("arrays", 0, bool(found[0]), "a directory that holds some, of Zarr version 2 or 3")
    return found


def _folders(path: Path) -> Iterator[tuple[Path, set[str]]]:
    """Yield every directory, depth first, with the names of its plain files; refuse all others."""
    waiting = [path]
    while waiting:
        folder = waiting.pop()
        files = set()
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name, reverse=True):
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(folder / entry.name)
                    continue
                plain = entry.is_file(follow_symlinks=False)
                inside = str(Path(entry.path).relative_to(path))
                require("a file of the directory", inside, plain, "plain files, no links")
                files.add(entry.name)
        yield folder, files
