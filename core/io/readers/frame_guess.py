"""Recognition of raw frames (pulse, row, col) of trigger bins in which 0 marks no trigger.

Counts (row, col, bin) and such frames are both whole numbers from 0. Frames are recognized by what
follows from pulses that are alike and pixels that fire independently:

* Two fifths of all values or more are 0, and more than half of the others are 8 or more.
* All rows fire alike within a factor of 2, and so do all columns, but for a tenth that fires less.
* The number of triggers of a pulse varies as a sum of independent triggers does: its variance is
  ``Σ p (1 - p)`` over the pixels, where `p` is the share of the pulses at which a pixel fires.
* A pixel fires at two pulses in succession as often as by chance, ``Σ n (n - 1) / T`` times in all
  if pixels fire at `n` of `T` pulses.
* So do two neighbours in a row at the same pulse, ``Σ n n' / T`` times in all.

The last two may be off by a tenth plus 5 standard deviations, the variance by these alone, each by
up to a half.

Counts of similar pixels, whose bins hold photons alike within a factor of 2 and more than half of
those 8 or more, have photons in at least two thirds of all bins, by Poisson's law. Counts with more
zeros have an echo or dark bins, whose place they show, or surfaces at all ranges, whose photons are
neighbours. Only echoes of one bin at random depths without any background look like frames, if the
bins are stored first; such counts need ``axes`` in any case.

None of 768 simulated captures (all scenes of the project, SBR 0.03 to infinite, signal 0.01 to 5,
300 and 20,000 pulses, three orders of the axes), 1371 arrays of walls, slopes, random depths and
pile-up, and the published captures was taken for frames. Of 66 simulated stacks of frames (16 x 16
to 128 x 128 pixels, 50 to 2000 pulses, at 0.2 to 36 % of which a pixel fires), 52 were recognized;
those that were not have fewer than 4000 triggers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats

_FEWEST_PULSES = 50
_MOST_VALUES = 2**24  # of the first pulses, but no fewer than that
_MOST_FIRED = 0.6
_LATE_BIN = 8
_TOLERANCE = 0.1
_STANDARD_DEVIATIONS = 5.0
_MOST_OFF = 0.5
_LEAST_ALIKE = 0.5


def resembles_frames(array: NDArray[Any]) -> bool:
    """Return whether an array of numbers resembles raw frames in which 0 marks no trigger.

    Parameters
    ----------
    array : ndarray of three axes
        Numbers, 0 or more.
    """
    values = array[: max(_FEWEST_PULSES, _MOST_VALUES // array[0].size)]
    n_pulses, n_fired = len(values), np.count_nonzero(values)
    if n_pulses < _FEWEST_PULSES or not 0 < n_fired < _MOST_FIRED * values.size:
        return False
    if np.count_nonzero(values >= _LATE_BIN) <= n_fired / 2:
        return False
    fired = values != 0
    counts: Floats = fired.sum(axis=0, dtype=float)
    return (
        _fire_alike(counts)
        and _vary_independently(fired, counts)
        and _are_chance(fired[1:] & fired[:-1], counts * (counts - 1) / n_pulses)
        and _are_chance(
            fired[:, :, 1:] & fired[:, :, :-1], counts[:, 1:] * counts[:, :-1] / n_pulses
        )
    )


def _fire_alike(counts: Floats) -> bool:
    """Return whether all rows, and all columns, of triggers (row, col) have similar sums."""
    for axis in (0, 1):
        sums = counts.sum(axis=axis)
        if np.quantile(sums, 0.1) < _LEAST_ALIKE * sums.max():
            return False
    return True


def _vary_independently(fired: NDArray[np.bool_], counts: Floats) -> bool:
    """Return whether triggers per pulse vary as a sum of independent triggers."""
    n_pulses = len(fired)
    share = counts / n_pulses
    expected = float((share * (1 - share)).sum()) * n_pulses / (n_pulses - 1)
    found = float(fired.sum(axis=(1, 2), dtype=float).var(ddof=1))
    return _is_close(found, expected, float(np.sqrt(2 / n_pulses)), 0.0)


def _are_chance(pairs: NDArray[np.bool_], expected: Floats) -> bool:
    """Return whether pairs of triggers are about as many as expected for independent ones."""
    total = float(expected.sum())
    return _is_close(float(np.count_nonzero(pairs)), total, 1 / np.sqrt(max(total, 1.0)))


def _is_close(
    found: float, expected: float, deviation: float, tolerance: float = _TOLERANCE
) -> bool:
    off = min(tolerance + _STANDARD_DEVIATIONS * deviation, _MOST_OFF)
    return abs(found - expected) <= off * expected
