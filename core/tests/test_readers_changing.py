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
    "own layout",
    "npy",
    "npy of frames",
    "npz of frames",
    "frames of a Princeton Lightwave camera",
    "mat cells",
    "mat 7.3 cells",
    "ptu",
    "sdt",
    "tmf8820",
    "netCDF-3",
    "hdf5",
)
READ_LATER = ("hdf5", "hdf5, compressed", "netCDF", "zarr 2", "zarr 3")


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else [one for one in path.rglob("*") if one.is_file()]


def later(path: Path) -> None:
    """Give all files a time of change that differs, whatever the clock's steps are."""
    for file in files_of(path):
        status = file.stat()
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))


def shorter(path: Path) -> None:
    for file in files_of(path):
        os.truncate(file, file.stat().st_size // 2)
    later(path)


def longer(path: Path) -> None:
    for file in files_of(path):
        with file.open("ab") as end:
            end.write(bytes(33 * 32 * 2))  # a whole frame of a camera
    later(path)


def other(path: Path) -> None:
    """Other content of the same size."""
    for file in files_of(path):
        file.write_bytes(bytes(len(file.read_bytes())))
    later(path)


def gone(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


CHANGES = (shorter, longer, other, gone)


def stored(kind: str, folder: Path) -> Path:
    path = folder / FORMATS[kind].name
    content = FORMATS[kind].build()
    if not isinstance(content, bytes):
        path.mkdir()
    return put(path, content)


@pytest.mark.parametrize("kind", READ_AT_ONCE)
@pytest.mark.parametrize("is_before", [True, False])
def test_a_file_that_changes_during_reading_is_refused(
    kind: str, is_before: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for change in CHANGES:
        path = stored(kind, tmp_path)
        reader = reader_of(path, READERS)

        def changing(
            path: Path,
            request: Any,
            reader: Reader = reader,
            change: Callable[[Path], None] = change,
        ) -> Any:
            if is_before:
                change(path)
                return reader.read(path, request)
            found = reader.read(path, request)
            change(path)
            return found

        with monkeypatch.context() as patched, pytest.raises(CaptureError) as caught:
            patched.setattr(readers, "READERS", (Reader("", (path.suffix.lower(),), changing),))
            read_capture(path, **FORMATS[kind].needs)
        assert str(caught.value).startswith(f"{path.name}: version of {path.name} = ")


@pytest.mark.parametrize("kind", READ_LATER)
@pytest.mark.parametrize("change", CHANGES)
def test_a_file_that_changes_once_it_is_open_is_refused(
    kind: str, change: Callable[[Path], None], tmp_path: Path
) -> None:
    path = stored(kind, tmp_path)
    counts = open_capture(path)
    np.testing.assert_array_equal(counts.compute().data, CUBE)
    change(path)
    with pytest.raises(CaptureError, match="has not gone or changed") as caught:
        counts.compute()
    assert str(caught.value).startswith(f"{path.name}: ")


def test_a_file_that_is_replaced_once_it_is_open_is_refused(tmp_path: Path) -> None:
    path, new = tmp_path / "c.h5", tmp_path / "new.h5"
    put(path, hdf5_bytes(counts=CUBE))
    counts = open_capture(path)
    later(put(new, hdf5_bytes(counts=2 * CUBE)))
    os.utime(new, (path.stat().st_atime, path.stat().st_mtime + 1))
    new.replace(path)
    with pytest.raises(CaptureError, match=r"version of c\.h5 = 'changed'"):
        counts.compute()
    np.testing.assert_array_equal(open_capture(path).compute().data, 2 * CUBE)


@pytest.mark.parametrize("version", [2, 3])
def test_a_chunk_that_is_gone_is_not_filled(version: int, tmp_path: Path) -> None:
    path = tmp_path / "c.zarr"
    path.mkdir()
    put(path, zarr_files(bare(), version, chunks=(2, 3, 64)))
    counts = open_capture(path)
    chunk = path / "counts" / ("0.0.0" if version == 2 else "c/0/0/0")
    status = chunk.parent.stat()
    chunk.unlink()
    os.utime(chunk.parent, ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))
    with pytest.raises(CaptureError, match="has not gone or changed"):
        counts.compute()
