"""Several output files of a command: those that can be written are, whatever befalls the others."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from core.capture import Capture, CaptureInfo
from core.checks import require, shown
from core.cli.results import Incomplete
from core.estimators import RangeImage
from core.geometry import WHOLE, Box
from core.inference import fit_p_values, range_intervals
from core.io.writers import CLOUD_SUFFIXES, RangeColors, save_image
from core.io.writers.product import guessed_view
from core.io.writers.whole import writing

Refused = Mapping[Path, Exception]
"""Files that cannot be written, and why."""


def add_further_values(command: argparse.ArgumentParser) -> None:
    """Add the options for what `save_ranges` writes in addition to the ranges."""
    command.add_argument(
        "--intervals",
        action="store_true",
        help="write the 68 %% and 95 %% intervals of each range, too: in NPZ, netCDF, HDF5, Zarr, "
        "CSV and TIFF; in point clouds half the width of the former, range_sd_m",
    )
    command.add_argument(
        "--fit",
        action="store_true",
        help="write the p-value of the goodness of fit of each pixel, too: in NPZ, netCDF, HDF5, "
        "Zarr and CSV",
    )


def refuse_further_values(intervals: bool, fit: bool) -> None:
    """Raise ``ValueError`` if one of these options was given: they need the capture in memory."""
    for name, given in (("intervals", intervals), ("fit", fit)):
        require(name, given, not given, "False for a capture that is ranged in tiles")


def save_ranges(
    capture: CaptureInfo,
    image: RangeImage,
    least_confidence: float | None,
    overwrite: bool,
    colors: RangeColors | None,
    intervals: bool = False,
    fit: bool = False,
    box: Box = WHOLE,
) -> Callable[[Path], None]:
    """Return a function that writes a range image without estimates of little confidence.

    With `intervals` and `fit`, for which the capture must be in memory, the intervals of the ranges
    and the p-values of the goodness of fit are written, too.
    Point clouds hold only what is inside `box`.
    """
    kept = image if least_confidence is None else image.confident(least_confidence)
    view = guessed_view(capture, image)
    known: dict[str, Any] = {"colors": colors}
    if intervals and isinstance(capture, Capture):
        known["interval_68"], known["interval"] = range_intervals(capture, kept, (0.68, 0.95))
    if fit and isinstance(capture, Capture):
        known["p_value"] = fit_p_values(capture)

    def save(path: Path) -> None:
        is_cloud = path.suffix.lower() in CLOUD_SUFFIXES
        own = view if is_cloud else {}
        inside = kept.cropped(box) if is_cloud and box != WHOLE else kept
        save_image(capture, inside, path, overwrite=overwrite, **known, **own)

    return save


def refused_outputs(paths: Sequence[Path], suffixes: Sequence[str], overwrite: bool) -> Refused:
    """Return which files cannot be written, before anything is computed.

    Raises
    ------
    Exception
        If no file can be written: the error of the first.
    """
    found: dict[Path, Exception] = {}
    for path in paths:
        try:
            _require_writable(path, suffixes, overwrite)
        except (ValueError, OSError) as error:
            found[path] = error
    _require_some(paths, found)
    return found


def save_each(
    paths: Sequence[Path], refused: Refused, save: Callable[[Path], None]
) -> tuple[list[Path], Refused]:
    """Write files that have not been refused; return those written, and all others."""
    found, written = dict(refused), []
    for path in dict.fromkeys(paths):
        if path in found:
            continue
        try:
            save(path)
        except (ValueError, OSError) as error:
            found[path] = error
        else:
            written.append(path)
    return written, found


def require_all(paths: Sequence[Path], refused: Refused) -> None:
    """Raise `Incomplete` with a line for each file that is not written.

    Raises
    ------
    Exception
        If no file is written: the error of the first.
    """
    _require_some(paths, refused)
    if refused:
        reasons = (f"{shown(path)}: {error}" for path, error in refused.items())
        raise Incomplete("\n".join(["Not written, unlike the other files:", *reasons]))


def _require_some(paths: Sequence[Path], refused: Refused) -> None:
    if paths and refused.keys() >= set(paths):
        raise refused[paths[0]]


def _require_writable(path: Path, suffixes: Sequence[str], overwrite: bool) -> None:
    known = path.suffix.lower() in suffixes
    require("suffix", path.suffix, known, "one of " + ", ".join(suffixes))
    with writing(path):
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists: give another name, or --overwrite.")
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{shown(path.parent)} is not a folder: create it first.")
