"""CSV (RFC 4180, UTF-8): a range image, one line a pixel, or a pixel's signals, one line a bin.

Lines that begin with ``#`` come first, one for each fact: acquisition, method, settings (JSON),
version and source. `pandas.read_csv` skips them with ``comment="#"``.

Numbers have a point and as many digits as give the same number back; NaN is an empty field.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.capture import Capture
from core.estimators import ESTIMATORS, Provenance
from core.io.writers.product import Product, plain
from core.labels import software
from core.tracking import tracking_signals

ROWS_AT_ONCE = 2**11
"""Rows converted to text together: memory stays bounded, and other threads get their turn."""


def write(product: Product, file: BinaryIO) -> None:
    """Write row, col, range_m, confidence, counts and valid (1 or 0) of each pixel.

    If the product has intervals, range_low_m, range_high_m and those with 68 follow range_m; if it
    has p-values, fit_p_value is the last column.
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
        **product.p_value_columns,
    }
    write_columns(columns, file, product.lines)


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
    about = Provenance(method, settings).facts
    about |= {"software": software(), "source": plain(capture.source)}
    write_columns(columns, file, [f"{name}: {fact}" for name, fact in about.items()])


def write_columns(
    columns: Mapping[str, ArrayLike], file: BinaryIO, comments: Sequence[str] = ()
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
    """
    arrays = [np.asarray(values).ravel() for values in columns.values()]
    length = len(arrays[0])
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    text.writelines(f"# {comment}\r\n" for comment in comments)
    writer = csv.writer(text)
    writer.writerow(columns)
    for start in range(0, length, ROWS_AT_ONCE):
        cells = (_cells(values[start : start + ROWS_AT_ONCE]) for values in arrays)
        writer.writerows(zip(*cells, strict=True))
    text.detach()  # flushed, and `file` stays open


def _cells(values: NDArray[Any]) -> list[object]:
    if values.dtype.kind != "f":
        return list(values.tolist())
    # 32-bit floats with their own digits, not those of the equal double.
    numbers = values.tolist() if values.itemsize > 4 else values.astype(str).tolist()
    missing = np.isnan(values).tolist()
    return ["" if is_nan else cell for cell, is_nan in zip(numbers, missing, strict=True)]
