"""True ranges of a capture that another file holds, as an image (row, col).

The image is an array of a ``.npy``, ``.npz``, ``.mat``, HDF5, netCDF or Zarr file, or a page of a
TIFF; range images and captures that this project writes are among them. ``truth_range_m``, else
``range_m``, else the only image of the capture's shape is taken.

The unit is the one that the file states, or the last part of the name: ``depth_m`` is in metres.
Bins must be stated by the caller, since nothing tells their origin: they count from the opening of
the gate, where the first bin begins at 0.

A pixel has no target where the number is not finite, or is 0 and not a bin.

The file may be that of the capture itself: `possible_truths` lists its images that may be true
ranges, by name and content.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import SPEED_OF_LIGHT_M_S, Acquisition, Floats
from core.capture import IMAGES, Capture, CaptureError
from core.checks import printable, refusing, require, shown
from core.io.readers import guards, labelled, matlab, npy, npz, stored
from core.io.readers.content import decompressed, start_of
from core.io.readers.guards import FileVersion
from core.io.readers.isolation import isolated
from core.io.readers.labelled import UNITS_S
from core.io.readers.layout import require_image
from core.io.readers.maps import Map, are_in_gate, gate_m
from core.io.readers.sequence import files_of

TRUTH_UNITS = ("m", "bins", "ns")
"""Units that a caller may state."""

TRUTH_OPTIONS = {
    "truth": "Add a truth",
    "truth_unit": "Unit of the truth",
    "truth_variable": "Array of the truth",
}
"""Names of the options of `add_truth_options`, and their labels in a form."""

_OWN_NAMES = ("truth_range_m", "range_m")
_LIKELY_NAMES = ("truth", "depth", "range", "dist", "true", "gt", "bin", "delay", "tof")
_MOST_POSSIBLE = 6
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
_BYTES_A_PIXEL = 32  # of memory, while a number becomes a range


def read_truth(
    path: str | os.PathLike[str],
    capture: Capture,
    *,
    truth_unit: str | None = None,
    truth_variable: str | None = None,
) -> Capture:
    """Return a capture with the true ranges that a file holds.

    Parameters
    ----------
    path : path-like
        A file as the module describes, compressed by gzip or not.
    capture : Capture
    truth_unit : {"m", "bins", "ns"}, optional
        Unit of the numbers: metres, bins after the opening of the gate, or nanoseconds after the
        pulse. None takes the unit that the file states.
    truth_variable : str, optional
        Name of the array, or of the page; None chooses as the module describes.

    Returns
    -------
    Capture
        With `truth_range_m`, NaN without a target; its source names the file.

    Raises
    ------
    CaptureError
        If the file cannot be read, its image is not of the capture's shape, the unit is not known,
        or no target lies within the gate.
    """
    truth_m, origin = truth_of(
        path,
        capture.shape,
        capture.acquisition,
        truth_unit=truth_unit,
        truth_variable=truth_variable,
    )
    source = "; ".join(filter(None, (capture.source, origin)))
    return replace(capture, truth_range_m=truth_m, source=source)


def truth_of(
    path: str | os.PathLike[str],
    shape: tuple[int, ...],
    acquisition: Acquisition,
    *,
    truth_unit: str | None = None,
    truth_variable: str | None = None,
) -> tuple[Floats, str]:
    """Return true ranges in metres, shape (row, col), and where they come from.

    Parameters are those of `read_truth`, which raises the same.
    """
    path = Path(path)
    with refusing(path, CaptureError):
        known = truth_unit is None or truth_unit in TRUTH_UNITS
        require("truth_unit", truth_unit, known, " or ".join(map(repr, TRUTH_UNITS)))
        require("path", shown(path), path.is_file() or path.is_dir(), "an existing file")
        with FileVersion.of(path).unchanged(), decompressed(path) as plain:
            found = _choose(_maps(plain), truth_variable, shape)
            require_image(found.name or "the image", found.shape, shape)
            unit = truth_unit or _unit_of(found)
            values = found.load()
        truth_m = _ranges_m(values, unit, acquisition)
        _require_in_gate(truth_m, acquisition)
    name = f", variable {found.name}" if found.name else ""
    return truth_m, f"truth: {printable(path.name)}{name}, in {unit}"


class PossibleTruth(NamedTuple):
    """Image in the file of a capture that may be its true ranges."""

    name: str
    units: tuple[str, ...]
    """Units in which most targets are within the gate, or the one that is stated."""
    is_unit_stated: bool
    """Whether file or name state the unit."""


def possible_truths(path: str | os.PathLike[str], capture: Capture) -> list[PossibleTruth]:
    """Return the images of a capture's own file that may be its truth, the likeliest first.

    Such an image has the capture's shape, a name like ``depth`` or ``bin``, and most of its targets
    within the gate. It is used only if `read_truth` is called with its name.

    Parameters
    ----------
    path : path-like
        The file.
    capture : Capture
        As read from it.

    Raises
    ------
    CaptureError
        If the file cannot be read.
    """
    path = Path(path)
    if files_of(path):
        return []  # a sequence has no file of its own
    with refusing(path, CaptureError), decompressed(path) as plain:
        list_maps = _lister(plain)
        maps = [] if list_maps is None else list_maps(plain)
        fitting = [each for each in maps if each.shape == capture.shape]
        others = [each for each in fitting if each.name not in IMAGES]
        likely = [each for each in sorted(others, key=_rank) if _rank(each) < len(_LIKELY_NAMES)]
        found = [
            PossibleTruth(
                each.name, _units(each, capture.acquisition), _stated_unit(each) is not None
            )
            for each in likely[:_MOST_POSSIBLE]
        ]
    return [each for each in found if each.units]


def _rank(image: Map) -> int:
    """Return the first of the likely names that an image's name contains, by its place."""
    name = image.name.lower()
    places = (n for n, part in enumerate(_LIKELY_NAMES) if part in name)
    return next(places, len(_LIKELY_NAMES))


def _units(image: Map, acquisition: Acquisition) -> tuple[str, ...]:
    """Return the units in which most targets are within the gate, of a stated one that alone."""
    try:
        values = image.load()
    except ValueError:
        return ()
    stated = _stated_unit(image)
    units = TRUTH_UNITS if stated is None else (stated,)
    return tuple(unit for unit in units if _are_mostly_in_gate(values, unit, acquisition))


def _are_mostly_in_gate(values: NDArray[Any], unit: str, acquisition: Acquisition) -> bool:
    try:
        truth_m = _ranges_m(values, unit, acquisition)
    except ValueError:
        return False
    inside = are_in_gate(truth_m, acquisition)
    return bool(inside.any() and inside.mean() >= 0.5)


def add_truth_options(parser: Any) -> None:
    """Add the options for the true ranges of a capture to a parser of `argparse`."""
    group = parser.add_argument_group("truth of a capture, to compare the estimates with")
    group.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="true ranges as an image of the capture's shape: .npy, .npz, .mat, .tif, .nc, .h5 or "
        ".zarr, such as a result of `estimate` or a simulated capture",
    )
    group.add_argument(
        "--truth-unit",
        choices=TRUTH_UNITS,
        help="of these: metres, bins after the opening of the gate, or nanoseconds after the "
        "pulse; by default the unit that the file states",
    )
    group.add_argument(
        "--truth-variable",
        metavar="NAME",
        help="of the array or page; without --truth, of the capture's own file",
    )


def truth_options_from(chosen: argparse.Namespace, capture: Path | None) -> dict[str, Any]:
    """Return the arguments of `read_truth` that were chosen, its capture aside; empty without any.

    Parameters
    ----------
    chosen : Namespace
        As parsed with the options of `add_truth_options`.
    capture : Path or None
        File of the capture; None for a scene, which has its own truth.

    Raises
    ------
    ValueError
        If the options contradict each other.
    """
    given = {name: getattr(chosen, name) for name in TRUTH_OPTIONS}
    is_sequence = capture is not None and bool(files_of(capture))
    own = None if is_sequence else capture
    path = given.pop("truth") or (own if given["truth_variable"] else None)
    if capture is not None and path is not None:
        return {"path": path, **given}
    without_file = "a sequence has no file of its own; give --truth"
    missing = without_file if is_sequence else "there is no --truth"
    why = "a scene has its own truth" if capture is None else missing
    for name in TRUTH_OPTIONS:
        value = getattr(chosen, name)
        require(name, value, value is None, f"None: {why}")
    return {}


def _maps(path: Path) -> list[Map]:
    """List the images of a file."""
    list_maps = _lister(path)
    accepted = "a .npy, .npz, .mat, .tif, .nc, .h5 or .zarr with an image (row, col)"
    if list_maps is None:
        raise ValueError(f"format = {path.suffix!r} is not accepted: give {accepted}.")
    return list_maps(path)


def _lister(path: Path) -> Callable[[Path], list[Map]] | None:
    """Return the function that lists the images of a file; its content determines the format."""
    start = b"" if path.is_dir() else start_of(path)
    if npy.recognizes(start):
        return npy.maps
    if npz.recognizes(start):
        return npz.maps
    if start.startswith(_TIFF_SIGNATURES):
        return _pages
    is_matlab = path.suffix.lower() == ".mat" or start.startswith(b"MATLAB")
    if is_matlab and matlab.recognizes(start):
        return matlab.maps
    is_labelled = path.is_dir() or labelled.recognizes(start)
    return stored.maps if is_labelled else None


def _pages(path: Path) -> list[Map]:
    """List the pages of a TIFF."""
    listed, _ = isolated(path, "the image", "list_tiff", working_bytes=0)
    most = guards.MAX_CUBE_BYTES // _BYTES_A_PIXEL

    def load(page: int) -> NDArray[Any]:
        _, (found,) = isolated(path, "the image", "read_tiff", page=page, most_pixels=most)
        return found

    return [
        Map(name, tuple(shape), partial(load, page))
        for page, (name, shape) in enumerate(listed["pages"])
    ]


def _choose(maps: Sequence[Map], variable: str | None, shape: tuple[int, ...]) -> Map:
    """Return the requested image, else that of our own name, else the only one that fits."""
    named: dict[str, Map] = {each.name: each for each in reversed(maps)}  # of equal names the first
    fitting = [name for name, each in named.items() if each.shape == shape]
    own = [name for name in _OWN_NAMES if name in named]
    likely = own[:1] or (fitting if fitting else list(named))
    chosen = likely[0] if variable is None and len(likely) == 1 else variable
    listed = ", ".join(map(str, maps[:20])) + ", ..." * (len(maps) > 20) or "none"
    accepted = f"the name of an image of {shape[0]} x {shape[1]}; the file has {listed}"
    require("truth_variable", chosen, chosen in named, accepted)
    return named[str(chosen or "")]


def _unit_of(found: Map) -> str:
    """Return the stated unit, which there must be."""
    unit, name = _stated_unit(found), found.name or "the image"
    what = f"{' or '.join(map(repr, TRUTH_UNITS))}: neither the file nor the name of {name} "
    require("truth_unit", None, unit is not None, f"{what}states a unit")
    return unit or ""


def _stated_unit(found: Map) -> str | None:
    """Return the unit that a file states, else that of the name of its array, if any."""
    _, underscore, last = found.name.rpartition("_")
    stated = (unit for unit in (found.unit, last if underscore else "") if unit in UNITS_S)
    return next(stated, None)


def _ranges_m(values: NDArray[Any], unit: str, acquisition: Acquisition) -> Floats:
    """Convert an image to ranges in metres, NaN without a target."""
    is_real = values.dtype.kind in "biuf"
    require("true ranges", f"array of {values.dtype}", is_real, "real numbers")
    numbers = values.astype(np.float64)
    numbers[~np.isfinite(numbers)] = np.nan
    below = numbers < 0
    if below.any():
        row, col = np.argwhere(below)[0].tolist()
        what = "0 or more, or NaN without a target"
        require(f"truth of pixel ({row}, {col})", float(numbers[row, col]), False, what)
    if unit == "bins":
        return acquisition.bin_to_range_m(numbers)
    numbers[numbers == 0] = np.nan
    return np.asarray(numbers * (UNITS_S[unit] * SPEED_OF_LIGHT_M_S / 2))


def _require_in_gate(truth_m: Floats, acquisition: Acquisition) -> None:
    """Raise ``ValueError`` if no target lies within the gate, as in a wrong unit."""
    known = truth_m[np.isfinite(truth_m)]
    low_m, high_m = gate_m(acquisition)
    found = f"{known.min():.6g} to {known.max():.6g} m" if known.size else "no target"
    accepted = f"targets within the gate, {low_m:.6g} to {high_m:.6g} m, in another unit perhaps"
    require("true ranges", found, bool(are_in_gate(truth_m, acquisition).any()), accepted)
