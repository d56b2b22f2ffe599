"""Captures from files: one format a module, one function for all.

A new format is a module with a ``read(path, request) -> Capture`` and a line in `READERS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from core.acquisition import Pulse
from core.capture import Capture, CaptureError, Detection
from core.checks import refusing, require, shown
from core.io.readers import gmapd, labelled, matlab, npy, npz, ptu, sdt, tmf8820
from core.io.readers.guards import MAX_CUBE_BYTES, FileVersion
from core.io.readers.request import Request

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MAX_CUBE_BYTES", "READERS", "bytes_of", "open_capture", "read_capture"]

READERS: dict[str, Callable[[Path, Request], Capture]] = {
    ".npz": npz.read,
    ".npy": npy.read,
    ".mat": matlab.read,
    ".h5": labelled.read,
    ".hdf5": labelled.read,
    ".nc": labelled.read,
    ".zarr": labelled.read,
    ".bin": gmapd.read,
    ".ptu": ptu.read,
    ".sdt": sdt.read,
    ".json": tmf8820.read,
}


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
    """Read a capture from a file; its suffix tells the format.

    What is None comes from the file, or is guessed where the file does not say; ``.source`` of the
    answer tells every guess. The modules of `core.io.readers` describe the formats,
    `core.io.readers.arrivals` the rules for guessing.

    Parameters
    ----------
    path : path-like
        A file with one of the suffixes in `READERS`, or a ``.zarr`` directory.
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
        For raw frames (pulse, row, col) of trigger bins: what stands where nothing fired. Tells the
        array of a ``.npy`` or ``.npz`` file to be such frames.
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
        As of `read_capture`. HDF5, netCDF-4 and Zarr are read as they are asked for, whatever their
        size; other files are read at once.
    **options
        As of `read_capture`.

    Returns
    -------
    DataArray, shape (row, col, bin)
        Counts of type uint8, uint16 or uint32 with the attributes and coordinates of
        `core.io.readers.labelled`, so that `core.io.readers.labelled.describe` has nothing left to
        guess: its ``source`` tells what was guessed here. Where the number of pulses is known, all
        of it is taken for first photons unless ``detection`` is told: nobody counted. A number that
        is no count raises `CaptureError` when it is read.

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
        if _suffix(path) in labelled.LAZY:
            return labelled.open_counts(path, request)
        return labelled.dataset(_read(path, request))["counts"]


def bytes_of(path: str | os.PathLike[str], **options: Any) -> int | None:
    """Bytes of all counts of a file, of which none is read; None where they would have to be.

    Parameters
    ----------
    path, **options
        As of `open_capture`, which raises the same.
    """
    if Path(path).suffix.lower() not in labelled.LAZY:
        return None
    # With nothing left to guess, nothing is read.
    return int(open_capture(path, **options | {"pulse": Pulse(), "detection": "all"}).nbytes)


def _read(path: Path, request: Request) -> Capture:
    """Read a file that does not change meanwhile."""
    read = READERS[_suffix(path)]
    with FileVersion.of(path).unchanged():
        return read(path, request)


def _suffix(path: Path) -> str:
    """The suffix of a file that exists, in small letters, if it is known."""
    suffix = path.suffix.lower()
    there = path.is_file() or (suffix == ".zarr" and path.is_dir())
    require("path", shown(path), there, "an existing file")
    require("suffix", path.suffix, suffix in READERS, "one of " + ", ".join(READERS))
    return suffix
