"""Captures from files: one format per module, one function for all.

A new format is a module with ``read(path, request) -> Capture`` and a line in `READERS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from inspect import Parameter, signature
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, TypeVar

from core.acquisition import Pulse
from core.capture import Capture, CaptureError
from core.checks import refusing, require, shown
from core.io.readers import gmapd, labelled, matlab, npy, npz, ptu, sdt, tmf8820, tmf8829
from core.io.readers.content import Reader, decompressed, is_gzip, reader_of, suffixes_of
from core.io.readers.guards import MAX_CUBE_BYTES, FileVersion
from core.io.readers.options import ReadOptions, reading_options
from core.io.readers.sequence import files_of, read_files
from core.io.readers.stored import ZARR_MARKS

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "MAX_CUBE_BYTES",
    "READERS",
    "SUFFIXES",
    "Reader",
    "bytes_of",
    "open_capture",
    "read_capture",
]

Function = TypeVar("Function", bound=Callable[..., Any])

_LABELLED = (labelled.read, labelled.recognizes, labelled.open_counts)

READERS: tuple[Reader, ...] = (
    Reader("NumPy archive, this project's own layout", (".npz",), npz.read, npz.recognizes),
    Reader("NumPy array: counts or raw frames", (".npy",), npy.read, npy.recognizes),
    Reader("HDF5 or netCDF", (".h5", ".hdf5", ".nc"), *_LABELLED),
    Reader("Zarr folder", (".zarr",), *_LABELLED, folder_marks=ZARR_MARKS),
    Reader("MATLAB", (".mat",), matlab.read, matlab.recognizes),
    Reader("Princeton Lightwave camera frames", (".bin",), gmapd.read),
    Reader("PicoQuant image", (".ptu",), ptu.read, ptu.recognizes),
    Reader("Becker & Hickl histograms", (".sdt",), sdt.read, sdt.recognizes),
    Reader("AMS TMF8820 records", (".json",), tmf8820.read, tmf8820.recognizes),
    Reader("AMS TMF8829 log", (".json",), tmf8829.read, tmf8829.recognizes),
)
"""All formats. Where several recognize a file and none has its suffix, the first one reads it."""

SUFFIXES: Mapping[str, str] = suffixes_of(READERS)
"""One-line description of the format of each suffix."""


def _with_options(function: Function) -> Function:
    """Add the fields of `ReadOptions` to the signature and the documentation of a function."""
    indent = " " * 8
    entries = []
    for name, option in reading_options().items():
        entries.append(f"    {name} : {option.kind.annotation}, optional")
        entries.append(fill(option.help, 92, initial_indent=indent, subsequent_indent=indent))
    function.__doc__ = str(function.__doc__).replace("    **given", "\n".join(entries), 1)
    given = signature(function)
    named = [
        Parameter(each.name, Parameter.KEYWORD_ONLY, default=None, annotation=each.type)
        for each in fields(ReadOptions)
    ]
    positional = [each for each in given.parameters.values() if each.name != "given"]
    function.__signature__ = given.replace(parameters=[*positional, *named])  # type: ignore[attr-defined]
    return function


@_with_options
def read_capture(path: str | os.PathLike[str], **given: Any) -> Capture:
    """Read a capture from a file; the content determines the format, and any may be gzipped.

    None takes a value from the file, or guesses it where the file does not specify it; ``.source``
    of the capture lists every guess. The modules of `core.io.readers` describe the formats,
    `core.io.readers.arrivals` the rules for guessing.

    Parameters
    ----------
    path : path-like
        A file of one of the `READERS`, or a Zarr directory. A pattern in the last part, such as
        ``runs/run_*.npz``, stands for a sequence of files (`core.io.readers.sequence`).
    **given

    Returns
    -------
    Capture

    Raises
    ------
    CaptureError
        If the file or an option is refused: names the file, the field, its value and the remedy.
    """
    path = Path(path)
    request = _request_of("read_capture", path, given)
    with refusing(path, CaptureError):
        return _read(path, request)


@_with_options
def open_capture(path: str | os.PathLike[str], **given: Any) -> xr.DataArray:
    """Open a capture without reading its counts, as one larger than memory must be.

    Parameters
    ----------
    path : path-like
        As for `read_capture`. Parts of HDF5, netCDF and Zarr are read when they are needed,
        whatever the size of the file; other files are read at once.
    **given

    Returns
    -------
    DataArray, shape (row, col, bin)
        Counts of type uint8, uint16 or uint32 with the attributes and coordinates of
        `core.io.readers.labelled`, so that `core.io.readers.labelled.describe` has nothing left to
        guess; the attribute ``source`` lists what was guessed here. A number that is not a count
        raises `CaptureError` when it is read.

    Raises
    ------
    CaptureError
        As `read_capture`.
    """
    path = Path(path)
    request = _request_of("open_capture", path, given)
    with refusing(path, CaptureError):
        open_counts = _opener(path)
        if open_counts is None:
            return _read(path, request).to_xarray()["counts"]
        return open_counts(path, request)


def bytes_of(path: str | os.PathLike[str], **options: Any) -> int | None:
    """Return the bytes of all counts of a file without reading them; None if it must be read.

    Parameters
    ----------
    path, **options
        As for `open_capture`, which raises the same.
    """
    path = Path(path)
    with refusing(path, CaptureError):
        if _opener(path) is None:
            return None
    # With pulse and detection given, no count is read to guess them.
    return int(open_capture(path, **options | {"pulse": Pulse(), "detection": "all"}).nbytes)


def _request_of(function: str, path: Path, given: Mapping[str, Any]) -> ReadOptions:
    """Return a request with the options given to a function."""
    if unknown := sorted(given.keys() - reading_options().keys()):
        raise TypeError(f"{function}() got unexpected arguments: {', '.join(unknown)}")
    with refusing(path, CaptureError):
        return ReadOptions(**given)


def _read(path: Path, request: ReadOptions) -> Capture:
    """Read a file, which must not change meanwhile, or a sequence of files."""
    if files := files_of(path):
        return read_files(files, request, _read)
    _require_exists(path)
    with FileVersion.of(path).unchanged(), decompressed(path) as plain:
        return reader_of(plain, READERS).read(plain, request)


def _opener(path: Path) -> Callable[[Path, ReadOptions], xr.DataArray] | None:
    """Return the function that opens a file without reading its counts, if there is one."""
    if files_of(path):
        return None
    _require_exists(path)
    return None if is_gzip(path) else reader_of(path, READERS).open_counts


def _require_exists(path: Path) -> None:
    require("path", shown(path), path.is_file() or path.is_dir(), "an existing file")
