"""CSV (RFC 4180, UTF-8): an image, one line a pixel; a cloud, one a point; a pixel, one a bin.

Lines that begin with ``#`` come first, one for each fact: acquisition, method, settings (JSON),
version and source. `pandas.read_csv` skips them with ``comment="#"``.

Numbers have a point and as many digits as give the same number back; NaN is an empty field.
Ranges and points have the decimals that resolve `Product.range_step_m`.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.capture import Capture
from core.estimators import ESTIMATORS, Provenance
from core.io.writers.product import Product, plain
from core.labels import software
from core.tracking import tracking_signals

_FINEST_M = 1e-9

ROWS_AT_ONCE = 2**11
"""Rows converted to text together: memory stays bounded, and other threads get their turn."""


def write(product: Product, file: BinaryIO) -> None:
    """Write row, col, range_m, confidence, counts and valid (1 or 0) of each pixel.

    If the product has intervals, range_low_m, range_high_m and those with 68 follow range_m; radial
    velocities, if it has them, follow valid, and then fit_p_value, if it has p-values. If the image
    has returns, the last columns are returns, their number, and return_1_range_m and so on, with
    strength and confidence.
    """
    image = product.image
    row, col = map(np.asarray, np.indices(image.range_m.shape))
    columns = {
        "row": row,
        "col": col,
        "range_m": image.range_m,
        **product.interval_columns,
        "confidence": image.confidence,
        "counts": product.capture.counts,
        "valid": image.valid.astype(int),
        **product.velocity_columns,
        **product.p_value_columns,
        **{name: plane.values for name, plane in product.image.return_planes.items()},
    }
    ranges = [name for name in columns if name.startswith("range_") or name.endswith("_range_m")]
    decimals = dict.fromkeys(ranges, decimals_of(product.range_step_m))
    write_columns(columns, file, product.lines, decimals)


def write_points(product: Product, file: BinaryIO) -> None:
    """Write x_m, y_m and z_m of each point, and the columns that every cloud has.

    Raises
    ------
    ValueError
        As `Product.points`.
    """
    points = product.points()
    xyz_m = dict(zip(("x_m", "y_m", "z_m"), points.xyz_m.T, strict=True))
    columns = xyz_m | product.point_columns(points)
    step_m = product.range_step_m[points.row, points.col]
    # Neighbouring points must not fall together where pixels are finer than ranges.
    spacing_m = np.abs(columns["range_m"]) * (product.pixel_angle_rad or 1.0)
    decimals = dict.fromkeys(xyz_m, decimals_of(np.minimum(step_m, spacing_m / 10)))
    decimals |= dict.fromkeys(("range_m", "range_sd_m"), decimals_of(step_m))
    write_columns(columns, file, decimals=decimals)


def decimals_of(step_m: ArrayLike) -> NDArray[np.int_]:
    """Return the numbers of decimals that resolve steps."""
    fine = np.maximum(np.asarray(step_m, float), _FINEST_M)
    return np.asarray(np.maximum(np.ceil(-np.log10(fine)), 0), int)


def write_pixel(
    capture: Capture, row: int, col: int, method: str, settings: Any, file: BinaryIO
) -> None:
    """Write the signals of one pixel, see `core.io.writers.save_pixel`."""
    acquisition, counts = capture.acquisition, capture.cube[row, col]
    bins = np.arange(acquisition.n_bins)
    columns = {
        "bin": bins,
        "time_s": acquisition.gate_delay_s + bins * acquisition.bin_width_s,
        "range_m": acquisition.bin_to_range_m(bins),
        "counts": counts,
    }
    if method == "tracking":
        signals = tracking_signals(counts, settings, capture.gated_pulses)
        stages = ("raw", "small", "large", "residual", "enhanced")
        columns |= {stage: getattr(signals, stage) for stage in stages}
    else:
        columns["score"] = ESTIMATORS[method].curves(capture, row, col, settings)
        evidence = ESTIMATORS[method].evidence_at(capture, row, col)
        columns |= {} if evidence is None else evidence._asdict()
    about = Provenance(method, settings).facts
    about |= {"software": software(), "source": plain(capture.source)}
    write_columns(columns, file, [f"{name}: {fact}" for name, fact in about.items()])


def write_columns(
    columns: Mapping[str, ArrayLike],
    file: BinaryIO,
    comments: Sequence[str] = (),
    decimals: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write columns of one size as CSV, one line for each index.

    Parameters
    ----------
    columns : mapping of str to array_like
        Numbers or text, by the columns' names.
    file : file object
        Open for bytes.
    comments : sequence of str
        Lines before the table, which get a ``#``.
    decimals : mapping of str to array_like, optional
        Decimals of the values of some columns; others have all their digits.
    """
    arrays = {name: np.asarray(values).ravel() for name, values in columns.items()}
    places = {name: np.ravel(each) for name, each in (decimals or {}).items()}
    length = len(next(iter(arrays.values())))
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    text.writelines(f"# {comment}\r\n" for comment in comments)
    writer = csv.writer(text)
    writer.writerow(columns)
    for start in range(0, length, ROWS_AT_ONCE):
        some = slice(start, start + ROWS_AT_ONCE)
        cells = (
            _rounded(values[some], places[name][some]) if name in places else _cells(values[some])
            for name, values in arrays.items()
        )
        writer.writerows(zip(*cells, strict=True))
    text.detach()  # flushed, and `file` stays open


def _rounded(values: NDArray[Any], decimals: NDArray[Any]) -> list[object]:
    pairs = zip(values.tolist(), decimals.tolist(), strict=True)
    return ["" if math.isnan(value) else f"{value:z.{places}f}" for value, places in pairs]


def _cells(values: NDArray[Any]) -> list[object]:
    if values.dtype.kind != "f":
        return list(values.tolist())
    # 32-bit floats with their own digits, not those of the equal double.
    numbers = values.tolist() if values.itemsize > 4 else values.astype(str).tolist()
    missing = np.isnan(values).tolist()
    return ["" if is_nan else cell for cell, is_nan in zip(numbers, missing, strict=True)]
