"""Hot and dead pixels: significantly more or fewer detections than all neighbours.

Dead pixels may touch, as those of a dead column do: without any detection, a pixel is also dead if
the background of the others, even a tenth of it, would have fired it.

The excess of a hot pixel is spread over the gate. A pixel whose excess lies in an echo is not hot:
it sees a bright surface. So does one whose echo exceeds those of its neighbours by as large a
factor as its background: a surface that reflects more of the pulse reflects more sunlight. For the
same reason a pixel with counts is only dead if it has less than a tenth of any neighbour's.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.likelihood import rate_and_n_armed, windowed_sums

NEIGHBOURS = 3
"""Rows and columns that an image needs for pixels to have neighbours."""

SIGNIFICANCE = 1e-6
"""Probability below which counts are not explained by chance."""

_DIMMEST = 0.1  # background of a pixel relative to the mean, or its counts to a neighbour's
_CLEARLY_MORE = 3.0  # standard deviations
_DARKEST = 0.1  # share of the bins
_ECHO_LENGTHS = 3  # an echo, and as many bins before and behind it

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)

Health = Literal["ordinary", "hot", "dead", "cannot tell"]


class OutlierPixels(NamedTuple):
    """Pixels that differ significantly from their neighbours; each of shape (row, col)."""

    hot: NDArray[np.bool_]
    """Significantly more counts than any neighbour, spread over the gate."""
    bright: NDArray[np.bool_]
    """Significantly more counts than any neighbour, in an echo, or in proportion to it."""
    dead: NDArray[np.bool_]
    """No counts or less than a tenth of any neighbour's, and no echo; or none over a background."""
    dark: NDArray[np.bool_]
    """Significantly fewer counts than any neighbour, but not dead."""
    most: NDArray[np.int64]
    """Largest counts of a neighbour."""
    least: NDArray[np.int64]
    """Smallest counts of a neighbour."""


class PixelVerdict(NamedTuple):
    """Whether a pixel is hot or dead, and why."""

    health: Health
    why: str
    """One sentence."""


@cached_per_capture
def outlier_pixels(capture: Capture) -> OutlierPixels | None:
    """Find pixels that differ from their eight neighbours; None if the image is too narrow.

    Neighbours beyond the edge of the image are mirrored.
    """
    if min(capture.shape) < NEIGHBOURS:
        return None
    counts, n_pulses = capture.counts, capture.gated_pulses
    most, least = (
        extreme(counts, footprint=_AROUND, mode="mirror")
        for extreme in (scipy.ndimage.maximum_filter, scipy.ndimage.minimum_filter)
    )
    hot, dead = counts > most, counts < least
    hot[hot] = probability_of_more(counts[hot], most[hot], n_pulses) < SIGNIFICANCE
    dead[dead] = probability_of_fewer(counts[dead], least[dead], n_pulses) < SIGNIFICANCE
    width = _width(capture)
    bright, dark = np.zeros((2, *capture.shape), bool)
    has_echo, beside = _echoes(capture.cube[hot], width, n_pulses)
    # Their excess lies in the echo: the other bins do not hold significantly more.
    bright[hot] = has_echo & (probability_of_more(beside, most[hot], n_pulses) >= SIGNIFICANCE)
    for row, col in np.argwhere(hot)[has_echo]:
        bright[row, col] = bright[row, col] or _is_brighter(capture, row, col, width)
    has_echo, _ = _echoes(capture.cube[dead], width, n_pulses)
    is_dim = probability_of_fewer(counts[dead], _DIMMEST * least[dead], n_pulses) >= SIGNIFICANCE
    dark[dead] = has_echo | is_dim & (counts[dead] > 0)
    if math.exp(-_DIMMEST * _background_counts(capture)) < SIGNIFICANCE:
        dead |= counts == 0
    return OutlierPixels(hot & ~bright, bright, dead & ~dark, dark, most, least)


def _width(capture: Capture) -> int:
    """Bins of an echo and its surroundings."""
    return min(_ECHO_LENGTHS * capture.echo_bins, capture.acquisition.n_bins)


def _background_counts(capture: Capture) -> float:
    """Mean counts of a pixel that detects anything if all bins held as few as the darkest do."""
    lit = capture.counts > 0
    if lit.all() or not lit.any():
        return 0.0  # there is no pixel to compare, or none to compare with
    per_bin = capture.cube.sum(axis=(0, 1), dtype=np.int64) / np.count_nonzero(lit)
    return float(np.quantile(per_bin, _DARKEST) * per_bin.size)


def _echoes(
    pixels: NDArray[np.unsignedinteger], width: int, n_pulses: int | None
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return whether pixels (pixel, bin) have an echo, and their counts beside it, at least one.

    The `width` bins with the largest counts hold significantly more of them than a detector fires
    there that fires at a constant rate while it is armed.
    """
    if not len(pixels):
        return np.zeros(0, bool), np.zeros(0, np.int64)
    histograms = pixels.astype(float)
    _, armed = rate_and_n_armed(histograms, n_pulses)
    counts, inside = pixels.sum(axis=1, dtype=np.int64), windowed_sums(histograms, width)
    every, largest = np.arange(len(pixels)), inside.argmax(axis=1)
    echo, armed_in_echo = inside[every, largest], windowed_sums(armed, width)[every, largest]
    expected = counts * armed_in_echo / armed.sum(axis=1)
    has_echo = probability_of_more(echo, expected, np.maximum(counts, 1)) < SIGNIFICANCE
    return has_echo, np.maximum(counts - echo, 1).astype(np.int64)


def _is_brighter(capture: Capture, row: int, col: int, width: int) -> bool:
    """Return whether signal and background of a pixel exceed its neighbours' by the same factor.

    The background may exceed them by less: that of the detector does not depend on the surface.
    """
    rows, cols = (slice(max(at - 1, 0), at + 2) for at in (row, col))
    near = capture.cube[rows, cols]
    own = np.ravel_multi_index((row - rows.start, col - cols.start), near.shape[:2])
    histograms = near.reshape(-1, near.shape[2]).astype(float)
    rate, armed = rate_and_n_armed(histograms, capture.gated_pulses)
    each = np.arange(len(rate))
    inside = windowed_sums(rate, width)
    largest = inside.argmax(axis=1)
    echo, total = inside[each, largest], rate.sum(axis=1)
    variance = rate / np.maximum(armed, 1)
    spread = windowed_sums(variance, width)[each, largest]
    background = total - echo
    signal = echo - background * width / max(rate.shape[1] - width, 1)
    others = each != own
    most = signal[own] - _CLEARLY_MORE * np.sqrt(spread[own] + spread[others])
    if (signal[others] > most).any():
        return False
    s, b = signal[others].mean(), background[others].mean()
    excess = background[own] * s - b * signal[own]
    chance = background[own] ** 2 * spread[others].mean() / others.sum() + b**2 * spread[own]
    return bool(excess <= _CLEARLY_MORE * math.sqrt(chance))


def ordinary_pixels(capture: Capture) -> NDArray[np.bool_]:
    """Find the pixels that are neither hot nor dead, shape (row, col); all if there are none."""
    faulty = outlier_pixels(capture)
    ordinary = np.ones(capture.shape, bool) if faulty is None else ~(faulty.hot | faulty.dead)
    return ordinary if ordinary.any() else np.ones(capture.shape, bool)


def neighbour_median(capture: Capture) -> NDArray[np.int64]:
    """Median counts of each pixel's neighbours, shape (row, col)."""
    found = scipy.ndimage.median_filter(capture.counts, footprint=_AROUND, mode="mirror")
    return np.asarray(found)


def pixel_verdict(capture: Capture, row: int, col: int) -> PixelVerdict:
    """Compare a pixel with its neighbours.

    A hot pixel next to another one is not found.
    """
    found = outlier_pixels(capture)
    if found is None:
        return PixelVerdict("cannot tell", "The image is too narrow for a comparison.")
    counts, n_pulses = int(capture.counts[row, col]), capture.gated_pulses
    most, least = int(found.most[row, col]), int(found.least[row, col])
    health: Health = "ordinary"
    why = "the difference is not significant"
    if found.hot[row, col]:
        health, why = "hot", "significantly more than any of them, spread over the gate"
    elif found.bright[row, col]:
        why = "significantly more than any of them, with the echo of a bright surface"
    elif found.dark[row, col]:
        has_echo, _ = _echoes(capture.cube[row, col][np.newaxis], _width(capture), n_pulses)
        why = "significantly fewer than any of them, with the echo of a dark surface"
        if not has_echo[0]:
            health = "cannot tell"
            why = "significantly fewer than any of them, as on a dark surface or if less sensitive"
    elif found.dead[row, col]:
        why = "significantly fewer than any of them" if least > 0 else "no background fires it"
        health = "dead"
    elif counts == 0:
        health, why = "cannot tell", "too few to distinguish a dead pixel from a dark one"
    elif n_pulses is not None and probability_of_more(n_pulses, most, n_pulses) > SIGNIFICANCE:
        health, why = "cannot tell", "nearly every pulse triggers there, hot or not"
    return PixelVerdict(
        health, f"It detected {counts:,}, its eight neighbours {least:,} to {most:,}: {why}."
    )


def probability_of_more(
    counts: Floats | NDArray[np.int64] | int,
    expected: Floats | NDArray[np.int64] | int,
    n_pulses: NDArray[np.int64] | int | None,
) -> Floats:
    """Probability of `counts` or more detections if `expected` are expected."""
    if n_pulses is None:
        return np.asarray(scipy.special.pdtrc(np.subtract(counts, 1), np.maximum(expected, 1)))
    share = np.clip(np.divide(expected, n_pulses), 1 / n_pulses, 1 - 1 / n_pulses)
    return np.asarray(scipy.special.bdtrc(np.subtract(counts, 1), n_pulses, share))


def probability_of_fewer(
    counts: NDArray[np.int64] | int, expected: NDArray[np.int64] | int, n_pulses: int | None
) -> Floats:
    """Probability of `counts` or fewer detections if `expected` are expected."""
    if n_pulses is None:
        return np.asarray(scipy.special.pdtr(counts, expected))
    # Where all pulses of the neighbours fire, another pixel may miss a few.
    share = np.minimum(np.divide(expected, n_pulses), 1 - 1 / n_pulses)
    return np.asarray(scipy.special.bdtr(counts, n_pulses, share))
