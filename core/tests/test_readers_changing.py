"""Files that change while they are read: old content, new content or a refusal, never a mixture."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.capture import CaptureError
from core.io import readers
from core.io.readers import READERS, Reader, open_capture, read_capture
from core.io.readers.content import reader_of
from core.tests.formats import FORMATS, bare, put
from core.tests.labelled_files import hdf5_bytes, zarr_files
from core.tests.samples import CUBE

pytestmark = pytest.mark.files

READ_AT_ONCE = (
    *("own layout", "npy of frames", "mat 7.3 cells", "frames of a Princeton Lightwave camera"),
    *("ptu", "hdf5"),
)
READ_LATER = ("hdf5", "hdf5, compressed", "netCDF", "zarr 2", "zarr 3")


def shorten(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def extend(file: Path) -> None:
    with file.open("ab") as end:
        end.write(bytes(33 * 32 * 2))  # a whole frame of a camera


def replace_content(file: Path) -> None:
    """Write other content of the same size."""
    file.write_bytes(bytes(file.stat().st_size))


CHANGES = (shorten, extend, replace_content, shutil.rmtree)
every_change = pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)


def apply(change: Callable[[Path], Any], path: Path) -> None:
    """Change a file or the files of a folder, with a later time of change."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    if change is shutil.rmtree:
        path.unlink() if path.is_file() else shutil.rmtree(path)
        return
    for file in files:
        change(file)
        set_later(file)


def set_later(path: Path) -> None:
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))


@every_change
@pytest.mark.parametrize("kind", READ_AT_ONCE)
@pytest.mark.parametrize("is_before", [True, False])
def test_a_file_that_changes_during_reading_is_refused(
    kind: str,
    is_before: bool,
    change: Callable[[Path], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = put(tmp_path / FORMATS[kind].name, FORMATS[kind].build())
    reader = reader_of(path, READERS)

    def changing(path: Path, request: Any) -> Any:
        if is_before:
            apply(change, path)
        found = reader.read(path, request)
        apply(change, path)
        return found

    monkeypatch.setattr(readers, "READERS", (Reader("", (path.suffix.lower(),), changing),))
    with pytest.raises(CaptureError, match=rf"^{path.name}: version of {path.name} = "):
        read_capture(path, **FORMATS[kind].needs)


@every_change
@pytest.mark.parametrize("kind", READ_LATER)
def test_a_file_that_changes_once_it_is_open_is_refused(
    kind: str, change: Callable[[Path], Any], tmp_path: Path
) -> None:
    path = put(tmp_path / FORMATS[kind].name, FORMATS[kind].build())
    counts = open_capture(path)
    np.testing.assert_array_equal(counts.compute().data, CUBE)
    apply(change, path)
    with pytest.raises(CaptureError, match=rf"^{path.name}: .*has not gone or changed"):
        counts.compute()


def test_a_file_that_is_replaced_once_it_is_open_is_refused(tmp_path: Path) -> None:
    path, new = tmp_path / "c.h5", tmp_path / "new.h5"
    put(path, hdf5_bytes(counts=CUBE))
    counts = open_capture(path)
    put(new, hdf5_bytes(counts=2 * CUBE))
    os.utime(new, (path.stat().st_atime, path.stat().st_mtime + 1))
    new.replace(path)
    with pytest.raises(CaptureError, match=r"version of c\.h5 = 'changed'"):
        counts.compute()
    np.testing.assert_array_equal(open_capture(path).compute().data, 2 * CUBE)


@pytest.mark.parametrize("version", [2, 3])
def test_a_deleted_chunk_is_not_filled(version: int, tmp_path: Path) -> None:
    path = put(tmp_path / "c.zarr", zarr_files(bare(), version, chunks=(2, 3, 64)))
    counts = open_capture(path)
    chunk = path / "counts" / ("0.0.0" if version == 2 else "c/0/0/0")
    chunk.unlink()
    set_later(chunk.parent)
    with pytest.raises(CaptureError, match="has not gone or changed"):
        counts.compute()
