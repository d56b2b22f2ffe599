"""Captures from files: one format per module, one function for all.

A new format is a module with ``read(path, request) -> Capture`` and a line in `READERS`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from core.acquisition import Pulse
from core.capture import Capture, CaptureError, Detection
from core.checks import refusing, require, shown
from core.io.readers import gmapd, labelled, matlab, npy, npz, ptu, sdt, tmf8820, zarr
from core.io.readers.content import Reader, decompressed, is_gzip, reader_of, suffixes_of
from core.io.readers.guards import MAX_CUBE_BYTES, FileVersion
from core.io.readers.request import Request

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

_LABELLED = (labelled.read, labelled.recognizes, labelled.open_counts)

READERS: tuple[Reader, ...] = (
    Reader("NumPy archive, this project's own layout", (".npz",), npz.read, npz.recognizes),
    Reader("NumPy array: counts or raw frames", (".npy",), npy.read, npy.recognizes),
    Reader("HDF5 or netCDF", (".h5", ".hdf5", ".nc"), *_LABELLED),
    Reader("Zarr folder", (".zarr",), *_LABELLED, folder_marks=zarr.MARKS),
    Reader("MATLAB", (".mat",), matlab.read, matlab.recognizes),
    Reader("Princeton Lightwave camera frames", (".bin",), gmapd.read),
    Reader("PicoQuant image", (".ptu",), ptu.read, ptu.recognizes),
    Reader("Becker & Hickl histograms", (".sdt",), sdt.read, sdt.recognizes),
    Reader("AMS TMF8820 records", (".json",), tmf8820.read, tmf8820.recognizes),
)
"""All formats. Where several recognize a file and none has its suffix, the first one reads it."""

SUFFIXES: Mapping[str, str] = suffixes_of(READERS)
"""One-line description of the format of each suffix."""


def read_capture(
    path: str | os.PathLike[str],
    *,
    time_unit_s: float | None = None,
    bin_width_s: float | None = None,
    gate_delay_s: float | None = None,
    n_bins: int | None = None,
    n_pulses: int | None = None,
    variable: str | None = None,
    pulse: Pulse | None = None,
    pixel_angle_rad: float | None = None,
    detection: Detection | None = None,
    axes: str | None = None,
    shape: tuple[int, int] | None = None,
    stop_s: float | None = None,
    no_trigger: int | None = None,
    first_detections: int | None = None,
) -> Capture:
    """Read a capture from a file; the content determines the format, and any may be gzipped.

    None takes a value from the file, or guesses it where the file does not specify it; ``.source``
    of the capture lists every guess. The modules of `core.io.readers` describe the formats,
    `core.io.readers.arrivals` the rules for guessing.

    Parameters
    ----------
    path : path-like
        A file of one of the `READERS`, or a Zarr directory.
    time_unit_s : float, optional
        Unit of the arrival times in seconds; only for a file that holds such.
    bin_width_s : float, optional
        Width of a bin in seconds.
    gate_delay_s : float, optional
        Time from the pulse to the first bin in seconds. Photons before are dropped.
    n_bins : int, optional
        Bins in the gate. Photons after are dropped; a cube must have just as many.
    n_pulses : int, optional
        Pulses sent for each pixel. Never guessed.
    variable : str, optional
        Name of the array to read, where the file holds several.
    pulse : Pulse, optional
        Shape of an echo.
    pixel_angle_rad : float, optional
        Angle between neighbouring pixels in radians.
    detection : str, optional
        ``"first"`` or ``"all"``, see `Capture`. Guessed to be first photons where the number of
        pulses is known and no pixel has more photons.
    axes : str, optional
        Names of the file's axes in its own order, such as ``"bin row col"`` or, for raw frames,
        ``"pulse col row"``, or for lists of photons ``"col row"``.
    shape : tuple of int, optional
        Rows and columns of a file that lists its pixels one after the other.
    stop_s : float, optional
        For common-stop instruments: times count backwards from this time after the pulse, often
        the laser's period.
    no_trigger : int, optional
        For raw frames (pulse, row, col) of trigger bins: value that marks no
        trigger. Declares the array of a ``.npy`` or ``.npz`` file as such frames.
    first_detections : int, optional
        Keep so many detections of each pixel, in the order of the file; only for a file that lists
        photons.

    Returns
    -------
    Capture

    Raises
    ------
    CaptureError
        Whatever is wrong with the file or its description: names the file, the field, its value
        and the remedy.
    """
    path = Path(path)
    with refusing(path, CaptureError):
        request = Request(
            time_unit_s=time_unit_s,
            bin_width_s=bin_width_s,
            gate_delay_s=gate_delay_s,
            n_bins=n_bins,
            n_pulses=n_pulses,
            variable=variable,
            pulse=pulse,
            pixel_angle_rad=pixel_angle_rad,
            detection=detection,
            axes=axes,
            shape=shape,
            stop_s=stop_s,
            no_trigger=no_trigger,
            first_detections=first_detections,
        )
        return _read(path, request)


def open_capture(path: str | os.PathLike[str], **options: Any) -> xr.DataArray:
    """Open a capture without reading its counts, as one larger than memory must be.

    Parameters
    ----------
    path : path-like
        As for `read_capture`. Parts of HDF5, netCDF and Zarr are read when they are needed,
        whatever the size of the file; other files are read at once.
    **options
        As for `read_capture`.

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
    unknown = sorted(options.keys() - Request.__dataclass_fields__.keys())
    if unknown:
        raise TypeError(f"open_capture() got unexpected arguments: {', '.join(unknown)}")
    with refusing(path, CaptureError):
        request = Request(**options)
        _require_exists(path)
        open_counts = None if is_gzip(path) else reader_of(path, READERS).open_counts
        if open_counts is None:
            return labelled.dataset(_read(path, request))["counts"]
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
        _require_exists(path)
        if is_gzip(path) or reader_of(path, READERS).open_counts is None:
            return None
    # With pulse and detection given, no count is read to guess them.
    return int(open_capture(path, **options | {"pulse": Pulse(), "detection": "all"}).nbytes)


def _read(path: Path, request: Request) -> Capture:
    """Read a file, which must not change meanwhile."""
    _require_exists(path)
    with FileVersion.of(path).unchanged(), decompressed(path) as plain:
        return reader_of(plain, READERS).read(plain, request)


def _require_exists(path: Path) -> None:
    require("path", shown(path), path.is_file() or path.is_dir(), "an existing file")
