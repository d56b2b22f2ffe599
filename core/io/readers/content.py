"""Choice of the reader by the content of a file; the suffix decides where several or none fit."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from core.capture import Capture
from core.checks import require
from core.io.readers.guards import decoding, require_fits
from core.io.readers.options import TRUTH_HINT, ReadOptions

if TYPE_CHECKING:
    import xarray as xr

GZIP = ".gz"

_GZIP_MAGIC = b"\x1f\x8b"
_START_BYTES = 2**13  # the largest user block before an HDF5 signature that is recognized
_PIECE_BYTES = 2**18


def never(_: bytes) -> bool:
    """Recognize nothing: a format without a signature is chosen by its suffix."""
    return False


@dataclass(frozen=True)
class Reader:
    """A file format.

    Parameters
    ----------
    title : str
        One-line description.
    suffixes : tuple of str
        Usual endings of the file name, in lower case.
    read : callable
        Reads a whole capture.
    recognizes : callable
        Whether the first bytes of a file are of this format.
    open_counts : callable, optional
        Opens the counts without reading them.
    folder_marks : tuple of str
        For a format that is a folder: names, one of which the folder contains.
    """

    title: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, ReadOptions], Capture]
    recognizes: Callable[[bytes], bool] = never
    open_counts: Callable[[Path, ReadOptions], xr.DataArray] | None = None
    folder_marks: tuple[str, ...] = ()


def reader_of(path: Path, readers: Sequence[Reader]) -> Reader:
    """Choose the reader for an existing file or folder.

    Raises
    ------
    ValueError
        If no reader recognizes the content or has the suffix.
    """
    is_folder = path.is_dir()
    possible = [reader for reader in readers if bool(reader.folder_marks) == is_folder]
    of_suffix = [reader for reader in possible if path.suffix.lower() in reader.suffixes]
    start = b"" if is_folder else start_of(path)
    fitting = [
        reader
        for reader in possible
        if reader.recognizes(start) or any((path / name).exists() for name in reader.folder_marks)
    ]
    if fitting:
        return next((reader for reader in of_suffix if reader in fitting), fitting[0])
    if of_suffix:
        return of_suffix[0]
    require("path", str(path), not is_folder, "an existing file, or a Zarr folder")
    hint = f"; {TRUTH_HINT}" if path.suffix.lower() in (".tif", ".tiff") else ""
    raise ValueError(
        f"suffix = {path.suffix!r} is not accepted, and the content looks like "
        f"{_description(start)}: give one of {', '.join(suffixes_of(readers))}{hint}."
    )


def suffixes_of(readers: Sequence[Reader]) -> dict[str, str]:
    """One-line descriptions of all formats by their suffixes, gzip files included."""
    known: dict[str, str] = {}
    for suffix, title in ((each, reader.title) for reader in readers for each in reader.suffixes):
        known[suffix] = f"{known[suffix]}, or {title}" if suffix in known else title
    return known | {GZIP: "any of these files, compressed by gzip"}


def is_gzip(path: Path) -> bool:
    """Return whether a file is compressed by gzip, regardless of its name."""
    return path.is_file() and start_of(path).startswith(_GZIP_MAGIC)


@contextmanager
def decompressed(path: Path) -> Iterator[Path]:
    """Yield the file itself, or a temporary file with the content of a gzip file.

    Raises
    ------
    ValueError
        If the gzip file is damaged, or contains more than `core.io.readers.guards.MAX_CUBE_BYTES`.
    """
    if not is_gzip(path):
        yield path
        return
    with TemporaryDirectory(prefix="firstphoton-") as folder:
        content = Path(folder) / (path.stem if path.suffix.lower() == GZIP else path.name)
        with gzip.open(path) as packed, content.open("wb") as target:
            piece = b"start"
            while piece:
                with decoding("the gzip file"):
                    piece = packed.read(_PIECE_BYTES)
                target.write(piece)
                require_fits("the decompressed file", target.tell())
        yield content


def start_of(path: Path) -> bytes:
    """Return the first bytes of a file, as `Reader.recognizes` takes them."""
    with path.open("rb") as file:
        return file.read(_START_BYTES)


def _description(start: bytes) -> str:
    """Describe the content of a file that no reader recognizes."""
    if not start:
        return "an empty file"
    try:
        return "text" if "\0" not in start.decode() else "binary data of an unknown format"
    except UnicodeDecodeError:
        return "binary data of an unknown format"
