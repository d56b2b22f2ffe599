"""CSV (RFC 4180, UTF-8): a range image, one line a pixel, or a pixel's signals, one line a bin.

Numbers have a point and as many digits as give the same number back; NaN is an empty field.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.capture import Capture
from core.io.writers.product import Product
from core.tracking import TrackingParameters, tracking_signals

ROWS_AT_ONCE = 2**11
"""Rows converted to text together: memory stays bounded, and other threads get their turn."""


def write(product: Product, file: BinaryIO) -> None:
    """Write row, col, range_m, confidence, counts and valid (1 or 0) of each pixel."""
    image = product.image
    row, col = map(np.asarray, np.indices(image.range_m.shape))
    columns = {
        "row": row,
        "col": col,
        "range_m": image.range_m,
        "confidence": image.confidence,
        "counts": product.capture.counts,
        "valid": image.valid.astype(int),
    }
    write_columns(columns, file)


def write_pixel(
    capture: Capture, row: int, col: int, settings: TrackingParameters, file: BinaryIO
) -> None:
    """Write the signals of one pixel, see `core.io.writers.save_pixel`."""
    acquisition, counts = capture.acquisition, capture.cube[row, col]
    signals = tracking_signals(counts, settings, capture.gated_pulses)
    bins = np.arange(acquisition.n_bins)
    columns = {
        "bin": bins,
        "time_s": acquisition.gate_delay_s + bins * acquisition.bin_width_s,
        "range_m": acquisition.bin_to_range_m(bins),
        "counts": counts,
        "raw": signals.raw,
        "small": signals.small,
        "large": signals.large,
        "residual": signals.residual,
        "enhanced": signals.enhanced,
    }
    write_columns(columns, file)


def write_columns(columns: Mapping[str, ArrayLike], file: BinaryIO) -> None:
    """Write columns of one size as CSV, one line for each index.

    Parameters
    ----------
    columns : mapping of str to array_like
        Numbers or text, by the columns' names.
    file : file object
        Open for bytes.
    """
    arrays = [np.asarray(values).ravel() for values in columns.values()]
    length = len(arrays[0])
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
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
