"""Windows of captures larger than memory: some rows and columns, read without the rest.

A window is a `Capture` of one pixel of each ``step`` x ``step``, with all its bins. The flux that
its pixels share with the whole image is learned from a sample of the whole, so that the estimates
in a window equal those of the whole. A preview is a window of the whole image with a large step;
its pieces are read from all over the image, so that it can be shown before it is complete.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from numbers import Integral
from typing import TYPE_CHECKING

import numpy as np

from core.capture import Capture
from core.checks import require
from core.inference.flux import flux_prior_of
from core.inference.flux_model import FluxPrior
from core.io.readers.labelled import describe
from core.io.readers.options import ReadOptions
from core.io.readers.sample import sample_of
from core.out_of_core.tiles import captured
from core.reductions import coarser

if TYPE_CHECKING:
    import xarray as xr

_AT_ONCE = 4  # pieces that are read in parallel; each takes the memory of a chunk or two


@dataclass(frozen=True)
class Window:
    """Rows and columns of an image, and the share of their pixels that is read.

    Parameters
    ----------
    rows, cols : tuple of int
        First row or column, and one after the last.
    step : int
        One pixel of each ``step`` x ``step`` is kept, the middle one (left and up of it where
        even).

    Raises
    ------
    ValueError
        If the window is empty, or a number is not whole.
    """

    rows: tuple[int, int]
    cols: tuple[int, int]
    step: int = 1

    def __post_init__(self) -> None:
        for name in ("rows", "cols"):
            bounds = getattr(self, name)
            whole = len(bounds) == 2 and all(isinstance(each, Integral) for each in bounds)
            require(name, bounds, whole and 0 <= bounds[0] < bounds[1], "two integers, rising")
        whole = isinstance(self.step, Integral) and self.step >= 1
        require("step", self.step, whole, "an integer, 1 or more")

    @classmethod
    def fitting(cls, rows: tuple[int, int], cols: tuple[int, int], most_pixels: int) -> Window:
        """Return the window of the finest step that keeps at most `most_pixels`, at least 1."""
        n_pixels = (rows[1] - rows[0]) * (cols[1] - cols[0])
        # Start from half of the step that would fit without edges.
        step = max(1, math.isqrt(n_pixels // max(most_pixels, 1)) // 2)
        window = cls(rows, cols, step)
        while math.prod(window.shape) > max(most_pixels, 1):
            step += 1
            window = cls(rows, cols, step)
        return window

    @property
    def picked(self) -> tuple[range, range]:
        """Rows and columns that are kept."""
        middle = (self.step - 1) // 2
        return tuple(  # type: ignore[return-value]
            range(first + min(middle, (end - first - 1) // 2), end, self.step)
            for first, end in (self.rows, self.cols)
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of what is kept."""
        rows, cols = self.picked
        return len(rows), len(cols)

    def __str__(self) -> str:
        (top, bottom), (left, right) = self.rows, self.cols
        place = f"rows {top} to {bottom - 1}, columns {left} to {right - 1}"
        return place if self.step == 1 else f"{place}, 1 pixel of each {self.step} x {self.step}"


class WindowReader:
    """Reads a window of a capture piece by piece, from all over it.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `core.open_capture` gives them, in Dask's chunks or in memory.
    window : Window

    Attributes
    ----------
    seen : ndarray of bool, shape (row, col)
        Pixels of the window that have been read.
    done, of : int
        Number of pieces that have been read, and of all pieces.

    Raises
    ------
    ValueError
        If the window does not lie in the image.
    """

    def __init__(self, counts: xr.DataArray, window: Window) -> None:
        import dask.array as da  # noqa: PLC0415 - half a second that others should not pay

        for name, size in zip(("rows", "cols"), counts.shape[:2], strict=True):
            bounds = getattr(window, name)
            require(name, bounds, bounds[1] <= size, f"some of 0 to {size}")
        self.window = window
        self._description = describe(counts, ReadOptions())
        self._shape = counts.shape[:2]
        data = da.from_array(counts.data, name=False) if counts.chunks is None else counts.data
        rows, cols = (slice(each.start, each.stop, each.step) for each in window.picked)
        self._part = data[rows, cols].rechunk({2: -1})
        self._cube = np.zeros(self._part.shape, self._part.dtype)
        self.seen = np.zeros(window.shape, bool)
        self._left = _spread(self._part.chunks[:2])
        self.of = len(self._left)

    @property
    def done(self) -> int:
        """Number of pieces that have been read."""
        return self.of - len(self._left)

    @property
    def is_complete(self) -> bool:
        """Whether nothing is left to read."""
        return not self._left

    def read_some(self) -> None:
        """Read a few more pieces.

        Raises
        ------
        CaptureError
            If a piece cannot be read, or holds a number that is no count. Calling again retries.
        """
        import dask  # noqa: PLC0415

        pieces = self._left[:_AT_ONCE]
        cubes = dask.compute(*(self._part[piece] for piece in pieces))
        for piece, cube in zip(pieces, cubes, strict=True):
            self._cube[piece] = cube
            self.seen[piece] = True
        self._left = self._left[_AT_ONCE:]

    def capture(self, flux_prior: FluxPrior | None = None) -> Capture:
        """Return the pixels read so far; the others have no counts.

        Parameters
        ----------
        flux_prior : FluxPrior, optional
            That of the whole image (`sampled_flux_prior`); learned from the pixels read where None.
        """
        source = f"{self._description.source}; {self.window} of {' x '.join(map(str, self._shape))}"
        acquisition = coarser(self._description.acquisition, self.window.step)
        known = self._description._replace(acquisition=acquisition, source=source)
        found = captured(self._cube, known)
        if flux_prior is None and not self.is_complete and self.seen.any():
            flux_prior = flux_prior_of(replace(found, cube=found.cube[np.newaxis, self.seen]))
        return found if flux_prior is None else replace(found, flux_prior=flux_prior)


def read_window(
    counts: xr.DataArray,
    window: Window,
    *,
    flux_prior: FluxPrior | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
    lighting: FluxPrior | None = None,
) -> Capture:
    """Read a window of an opened capture.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `core.open_capture` gives them.
    window : Window
        Rows and columns.
    flux_prior : FluxPrior, optional
        That of the whole image, where it is known already.
    progress : callable
        Called with the numbers of pieces read and of all pieces.
    lighting : FluxPrior, optional
        Deprecated name of `flux_prior`.

    Raises
    ------
    ValueError
        If the window does not lie in the image.
    CaptureError
        If it cannot be read.
    """
    reader = WindowReader(counts, window)
    while not reader.is_complete:
        reader.read_some()
        progress(reader.done, reader.of)
    return reader.capture(flux_prior or lighting or sampled_flux_prior(counts))


def sampled_flux_prior(counts: xr.DataArray) -> FluxPrior:
    """Return the flux prior of an image, as `core.estimate_large` learns it."""
    return flux_prior_of(captured(sample_of(counts.data), describe(counts, ReadOptions())))


def _spread(chunks: tuple[tuple[int, ...], ...]) -> list[tuple[slice, slice]]:
    """Return boxes of an image cut into chunks: first a coarse grid, then those in between."""
    across = [np.cumsum((0, *sizes)).tolist() for sizes in chunks]
    boxes = [
        (slice(top, bottom), slice(left, right), _coarseness(row, col))
        for row, (top, bottom) in enumerate(zip(across[0], across[0][1:], strict=False))
        for col, (left, right) in enumerate(zip(across[1], across[1][1:], strict=False))
    ]
    order = np.random.default_rng(0).permutation(len(boxes))  # spreads boxes of equal coarseness
    ordered = sorted((boxes[k] for k in order), key=lambda box: -box[2])
    return [(rows, cols) for rows, cols, _ in ordered]


def _coarseness(row: int, col: int) -> int:
    """Return the largest power of two that divides both, 2**62 if both are 0."""
    both = row | col
    return both & -both if both else 2**62
