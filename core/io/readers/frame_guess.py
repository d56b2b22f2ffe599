"""Recognition of raw frames (pulse, row, col) of trigger bins in which 0 marks no trigger.

Counts (row, col, bin) and such frames are both whole numbers from 0. Frames are recognized by what
follows from pulses that are alike and pixels that fire independently:

* More than half of the values that are not 0 are 8 or more.
* In pixels that fire at all, more than twice as many values are 0 as among Poisson counts of the
  mean that those above 0 show.
* All rows fire alike within a factor of 2, and so do all columns, but for a tenth that fires less.
* The number of triggers of a pulse varies as a sum of independent triggers does: its variance is
  ``Σ p (1 - p)`` over the pixels, where `p` is the share of the pulses at which a pixel fires.
* A pixel fires at two pulses in succession as often as by chance, ``Σ n (n - 1) / T`` times in all
  if pixels fire at `n` of `T` pulses.
* So do two neighbours in a row at the same pulse, ``Σ n n' / T`` times in all.

Where more than half of the values are not 0, the last two compare pulses without a trigger instead:
these are rarer, and at least 10 pairs of them must be expected. The last two may be off by a tenth
plus 5 standard deviations, the variance by these alone, each by up to a half.

Counts with more zeros than Poisson's law predicts have an echo or dark bins, whose place they show,
or surfaces at all ranges, whose photons are neighbours. Only echoes of one bin at random depths
without any background look like frames, if the bins are stored first; such counts need ``axes`` in
any case.

None of 768 simulated captures (all scenes of the project, SBR 0.03 to infinite, signal 0.01 to 5,
300 and 20,000 pulses, three orders of the axes), 1371 arrays of walls, slopes, random depths and
pile-up, and the published captures was taken for frames, nor were 2999 of 3000 further arrays, with
dead pixels and bins and in all orders of the axes. Of 308 simulated stacks of frames (16 x 16 to
64 x 64 pixels, 60 to 1000 pulses) at 1 to 97 % of which a pixel fires, 296 were recognized; at
99 %, 15 of 22. Those that were not have fewer than 4000 triggers, only 60 pulses, few values that
are 0, or so strong a background in 30 bins that most triggers come in the first 7.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats

_FEWEST_PULSES = 50
_MOST_VALUES = 2**24  # of the first pulses, but no fewer than that
_LATE_BIN = 8
_ROUNDS = 20
_FEWEST_PAIRS = 10.0  # fewer show no independence
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
    if n_pulses < _FEWEST_PULSES or not 0 < n_fired < values.size:
        return False
    if np.count_nonzero(values >= _LATE_BIN) <= n_fired / 2:
        return False
    fired = values != 0
    counts: Floats = fired.sum(axis=0, dtype=float)
    if not (_have_more_zeros_than_counts(values, counts) and _fire_alike(counts)):
        return False
    rare, n_rare = (fired, counts) if 2 * n_fired <= values.size else (~fired, n_pulses - counts)
    in_succession = n_rare * (n_rare - 1) / n_pulses
    if rare is not fired and in_succession.sum() < _FEWEST_PAIRS:
        return False
    return (
        _vary_independently(fired, counts)
        and _are_chance(rare[1:] & rare[:-1], in_succession)
        and _are_chance(rare[:, :, 1:] & rare[:, :, :-1], n_rare[:, 1:] * n_rare[:, :-1] / n_pulses)
    )


def _have_more_zeros_than_counts(values: NDArray[Any], counts: Floats) -> bool:
    """Return whether pixels have more zeros than if their values were Poisson counts."""
    is_lit = counts > 0
    n_fired = counts[is_lit]
    of_fired = values.sum(axis=0, dtype=float)[is_lit] / n_fired
    mean = of_fired
    for _ in range(_ROUNDS):  # of all counts, by that of those above 0
        mean = -of_fired * np.expm1(-mean)
    expected = len(values) * float(np.exp(-mean).sum())
    found = float((len(values) - n_fired).sum())
    return bool(found > 2 * expected + _STANDARD_DEVIATIONS * np.sqrt(expected))


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
