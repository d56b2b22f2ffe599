"""Records of a file that holds a sequence in time, of which some or all are added up."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.checks import require
from core.io.readers.dense import Counts, whole_counts
from core.io.readers.options import ReadOptions


def span_of(request: ReadOptions) -> tuple[int, int] | None:
    """Return the first and the last requested record; None for all."""
    records = request.records
    if records is None:
        return None
    first, last = records if isinstance(records, tuple) else (records, records)
    return int(first), int(last)


def chosen_records(request: ReadOptions, n_records: int) -> range:
    """Return the numbers of the records that are added up.

    Raises
    ------
    ValueError
        If one of them is not in the file.
    """
    first, last = span_of(request) or (0, n_records - 1)
    accepted = f"one of 0 to {n_records - 1}, the first and the last of them, or None for all"
    require("records", request.records, last < n_records, accepted)
    return range(first, last + 1)


def described(chosen: range, n_records: int, noun: str = "record") -> str:
    """Return which records of a file are added up, as text for the source of a capture."""
    if len(chosen) == 1:
        return f"{noun} {chosen[0]} of {n_records}"
    if len(chosen) == n_records:
        return f"all {n_records} {noun}s added"
    return f"{noun}s {chosen[0]} to {chosen[-1]} of {n_records} added"


def added(records: NDArray[Any], name: str) -> Counts:
    """Return the sum of counts (record, row, col, bin) over the records.

    Raises
    ------
    ValueError
        If a number or a sum is no count.
    """
    n_records, n_rows, n_cols, n_bins = records.shape
    counts = whole_counts(records.reshape(n_records * n_rows, n_cols, n_bins), name)
    return whole_counts(counts.reshape(records.shape).sum(axis=0, dtype=np.uint64), name)


def median_m(records_m: NDArray[Any]) -> Floats:
    """Return the median of the known ranges (record, ...) over the records; NaN without any."""
    known = np.ma.masked_invalid(records_m)
    median = np.ma.median(known, axis=0)  # type: ignore[no-untyped-call]
    return np.asarray(median.filled(np.nan), np.float64)
