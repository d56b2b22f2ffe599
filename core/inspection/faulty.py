"""Hot and dead pixels of a capture, those that differ most from their neighbours first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture, cached_per_capture
from core.inference.faults import Health, outlier_pixels


class FaultyPixel(NamedTuple):
    """A hot or dead pixel, with the counts by which it was found."""

    row: int
    col: int
    health: Health
    """``"hot"`` or ``"dead"``."""
    counts: int
    neighbours_least: int
    """Smallest counts of one of its eight neighbours."""
    neighbours_most: int
    """Largest counts of one of them."""


def faulty_pixels(capture: Capture) -> list[FaultyPixel]:
    """Return the hot pixels, then the dead ones; none if the image is too narrow to find them.

    Each kind is sorted by the difference from the nearest counts of a neighbour, the largest first.
    """
    return list(_faulty_pixels(capture))


@cached_per_capture
def _faulty_pixels(capture: Capture) -> tuple[FaultyPixel, ...]:
    found = outlier_pixels(capture)
    if found is None:
        return ()
    counts = capture.counts
    kinds: tuple[tuple[Health, NDArray[np.bool_], NDArray[np.int64]], ...] = (
        ("hot", found.hot, counts - found.most),
        ("dead", found.dead, found.least - counts),
    )
    faulty = []
    for health, mask, difference in kinds:
        rows, cols = np.nonzero(mask)
        for n in np.argsort(-difference[mask], kind="stable"):
            at = int(rows[n]), int(cols[n])
            values = (int(each[at]) for each in (counts, found.least, found.most))
            faulty.append(FaultyPixel(*at, health, *values))
    return tuple(faulty)
