"""Slow float64 equations that fast kernels are compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def log_likelihood(
    counts: NDArray[np.float64], rate: NDArray[np.float64], n_pulses: int | None
) -> NDArray[np.float64]:
    """Log probability of counts (..., bin), without terms that no rate (..., bin) changes."""
    if n_pulses is None:
        return np.asarray((counts * np.log(rate) - rate).sum(axis=-1))
    unfired = n_pulses - np.cumsum(counts, axis=-1)
    return np.asarray((counts * np.log(-np.expm1(-rate)) - unfired * rate).sum(axis=-1))
