"""CSV (RFC 4180, UTF-8): a range image, one line a pixel, or a pixel's signals, one line a bin.

Numbers have a point and as many digits as give the same number back; NaN is an empty field.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.export.product import Product
from core.tracking import TrackingParameters, tracking_signals


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
    _write(file, list(columns), [_cells(values) for values in columns.values()])


def write_pixel(
    capture: Capture, row: int, col: int, settings: TrackingParameters, file: BinaryIO
) -> None:
    """Write the signals of one pixel, see `core.export.save_pixel`."""
    acquisition, counts = capture.acquisition, capture.cube[row, col]
    signals = tracking_signals(counts, settings, capture.armed_pulses)
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
    _write(file, list(columns), [_cells(values) for values in columns.values()])


def _cells(values: NDArray[Any]) -> list[object]:
    return ["" if math.isnan(value) else value for value in values.ravel().tolist()]


def _write(file: BinaryIO, names: Sequence[str], columns: Iterable[Sequence[object]]) -> None:
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(names)
    writer.writerows(zip(*columns, strict=True))
    text.detach()  # flushed, and `file` stays open
