"""Kernel that corrects pile-up."""

from __future__ import annotations

import math

from numba import njit

from core.kernels.parallel import COMPILED

_FEW = 10.0  # armed pulses per count, above which the series is exact


@njit(**COMPILED)
def fill_rates(counts, n_pulses, rate, armed):  # type: ignore[no-untyped-def]
    """Fill ``-ln(1 - n / A)`` and the armed pulses A of each bin; (row, bin) each.

    Mostly as ``2 atanh z``, ``z = n / (2 A - n)``, by its series: one that the compiler vectorises.
    """
    n_bins = counts.shape[1]
    for i in range(len(counts)):
        left, count, its_rate, its_armed = n_pulses, counts[i], rate[i], armed[i]
        for k in range(n_bins):
            its_armed[k] = left
            left -= count[k]
        for k in range(n_bins):
            z = count[k] / max(2.0 * its_armed[k] - count[k], 1.0)
            q = z * z
            p = (((q / 15.0 + 1.0 / 13.0) * q + 1.0 / 11.0) * q + 1.0 / 9.0) * q + 1.0 / 7.0
            its_rate[k] = 2.0 * z * (((p * q + 1.0 / 5.0) * q + 1.0 / 3.0) * q + 1.0)
        for k in range(n_bins):
            if not its_armed[k] > _FEW * count[k]:
                its_rate[k] = _rate(count[k], its_armed[k])
                its_armed[k] = max(its_armed[k], 0.0)


@njit(**COMPILED)
def _rate(count, armed):  # type: ignore[no-untyped-def]
    """Rate of a bin; half a count less where all armed pulses fire, 0 where none is armed."""
    if armed <= 0.0:
        return 0.0
    return -math.log1p(-min(count / armed, 1.0 - 0.5 / max(armed, 1.0)))
