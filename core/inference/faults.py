"""Hot and dead pixels: those that detect more, or less, than all their neighbours by no chance."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture

NEIGHBOURS = 3
"""Rows and columns that an image needs for a pixel to have any."""

BY_CHANCE = 1e-6
"""Probability of counts that are taken for no chance."""

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)

Health = Literal["ordinary", "hot", "dead", "cannot tell"]


class StandingOut(NamedTuple):
    """Which pixels stand out, and from what; each of shape (row, col)."""

    hot: NDArray[np.bool_]
    """More counts than any neighbour, by more than chance."""
    dead: NDArray[np.bool_]
    """Fewer than any, likewise."""
    most: NDArray[np.int64]
    """Counts of the neighbour that has most of them."""
    least: NDArray[np.int64]
    """Counts of the neighbour that has fewest."""


class Verdict(NamedTuple):
    """What is to be thought of a pixel."""

    health: Health
    why: str
    """One sentence."""


@cached_per_capture
def standing_out(capture: Capture) -> StandingOut | None:
    """Pixels that stand out among their eight neighbours; None where an image has no neighbours.

    Beyond the image's edge neighbours are those on the other side, mirrored.
    """
    if min(capture.shape) < NEIGHBOURS:
        return None
    counts, n_pulses = capture.counts, capture.gated_pulses
    of_neighbours = (scipy.ndimage.maximum_filter, scipy.ndimage.minimum_filter)
    most, least = (find(counts, footprint=_AROUND, mode="mirror") for find in of_neighbours)
    hot, dead = counts > most, counts < least
    hot[hot] = more_by_chance(counts[hot], most[hot], n_pulses) < BY_CHANCE
    dead[dead] = fewer_by_chance(counts[dead], least[dead], n_pulses) < BY_CHANCE
    return StandingOut(hot, dead, most, least)


def usual_counts(capture: Capture) -> NDArray[np.int64]:
    """Median of each pixel's neighbours, shape (row, col)."""
    found = scipy.ndimage.median_filter(capture.counts, footprint=_AROUND, mode="mirror")
    return np.asarray(found)


def verdict(capture: Capture, row: int, col: int) -> Verdict:
    """Whether a pixel is hot or dead, as far as its neighbours tell.

    A hot pixel beside another one does not stand out, and a bright surface that fills a single
    pixel does: its photons are an echo's, those of a hot pixel are spread over the gate.
    """
    found = standing_out(capture)
    if found is None:
        return Verdict("cannot tell", "An image so narrow has no neighbours to compare it with.")
    counts, n_pulses = int(capture.counts[row, col]), capture.gated_pulses
    most, least = int(found.most[row, col]), int(found.least[row, col])
    seen = f"It detected {counts:,}, its eight neighbours {least:,} to {most:,}"
    if found.hot[row, col]:
        return Verdict("hot", f"{seen}: more than any of them, and by more than chance.")
    if found.dead[row, col]:
        return Verdict("dead", f"{seen}: fewer than any of them, and by more than chance.")
    if counts == 0:
        return Verdict("cannot tell", f"{seen}: too few to tell a dead pixel from a dark one.")
    if n_pulses is not None and more_by_chance(n_pulses, most, n_pulses) > BY_CHANCE:
        return Verdict("cannot tell", f"{seen}: nearly every pulse fires there, hot or not.")
    return Verdict("ordinary", f"{seen}: nothing beyond chance.")


def more_by_chance(
    counts: NDArray[np.int64] | int, expected: NDArray[np.int64] | int, n_pulses: int | None
) -> Floats:
    """Probability of so many counts, or more."""
    if n_pulses is None:
        return np.asarray(scipy.special.pdtrc(np.subtract(counts, 1), np.maximum(expected, 1)))
    share = np.clip(np.divide(expected, n_pulses), 1 / n_pulses, 1 - 1 / n_pulses)
    return np.asarray(scipy.special.bdtrc(np.subtract(counts, 1), n_pulses, share))


def fewer_by_chance(
    counts: NDArray[np.int64] | int, expected: NDArray[np.int64] | int, n_pulses: int | None
) -> Floats:
    """Probability of so few counts, or fewer."""
    if n_pulses is None:
        return np.asarray(scipy.special.pdtr(counts, expected))
    return np.asarray(scipy.special.bdtr(counts, n_pulses, np.divide(expected, n_pulses)))
