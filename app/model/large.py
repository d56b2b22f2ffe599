"""Files larger than memory: a preview of all of it, then windows, in memory one at a time."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import psutil
from numpy.typing import NDArray

from core import Capture, Window, open_capture, sampled_flux_prior
from core.checks import require
from core.inference import FluxPrior
from core.io import bytes_of
from core.out_of_core import WindowReader
from core.studies.tradeoff import Cancelled

if TYPE_CHECKING:
    import xarray as xr

PREVIEW_COUNTS = 2**23
"""Of the preview's pixels and bins: ranged in some tenths of a second, each time more is read."""

WINDOW_COUNTS = 2**24
"""Of a window's: a slider still answers at once."""

PREVIEW_PIXELS, WINDOW_PIXELS = 2**20, 2**21
"""Pixels of either: with few bins, the images of a pixel take more memory than its counts."""

AT_ONCE_S = 1.0
"""Spent reading before a preview is first shown, whatever it holds by then."""

WHOLE_BYTES = 2**28  # of counts: ranged in some seconds
WHOLE_SHARE = (
    1 / 8
)  # of the memory that is free; a capture and its posterior take five times as much
LIMIT = "FIRSTPHOTON_WHOLE_BYTES"
"""Variable of the environment that overrides both."""

Progress = Callable[[int, int], None]
At = TypeVar("At", int, float, NDArray[np.int_])


def most_whole_bytes() -> int:
    """Counts of a file that are held as a whole, in bytes; of a larger one, windows are."""
    told = os.environ.get(LIMIT)
    free = psutil.virtual_memory().available
    return min(WHOLE_BYTES, int(WHOLE_SHARE * free)) if told is None else int(told)


def require_small(path: Path, n_bytes: int) -> None:
    """Refuse counts that are too many to be held as a whole, of a format that knows no windows."""
    most = most_whole_bytes()
    remedy = (
        f"at most {most:,} to this page. A .zarr may be of any size, for it is read in parts: "
        f"python -m core export {path.name} {path.stem}.zarr"
    )
    require(f"bytes of counts of {path.name}", n_bytes, n_bytes <= most, remedy)


@dataclass(frozen=True, eq=False)
class Cutout:
    """What is in memory of a file."""

    file: LargeFile
    window: Window
    capture: Capture
    read: float
    """Share of the window's pixels that have been read; others have no counts."""
    is_final: bool
    """Whether all of them have been, and are seen in the light of the whole file."""

    @property
    def is_preview(self) -> bool:
        """Whether it is all of the file."""
        return self.window == self.file.whole


class LargeFile:
    """A file of which windows are read; any number of sessions may look at it.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `core.open_capture` gives them.
    """

    def __init__(self, counts: xr.DataArray) -> None:
        self._counts = counts
        rows, cols, self._n_bins = counts.shape
        most = min(PREVIEW_COUNTS // self._n_bins, PREVIEW_PIXELS)
        self.whole = Window.fitting((0, rows), (0, cols), most)
        self._preview: Cutout | None = None
        self._latest: Cutout | None = None
        self._reading, self._preparing_prior = Lock(), Lock()

    def fitting(self, rows: tuple[int, int], cols: tuple[int, int]) -> Window:
        """The window of the finest step that may be read."""
        return Window.fitting(rows, cols, self._most_pixels)

    @property
    def _most_pixels(self) -> int:
        """Largest number of pixels in a window."""
        return min(WINDOW_COUNTS // self._n_bins, WINDOW_PIXELS)

    @cached_property
    def _reader(self) -> WindowReader:
        return WindowReader(self._counts, self.whole)

    @property
    def preview(self) -> Cutout:
        """All of the file, as far as it has been read; a little of it is read the first time."""
        with self._reading:
            if self._preview is None:
                started = perf_counter()
                self._reader.read_some()
                while not self._reader.is_complete and perf_counter() - started < AT_ONCE_S:
                    self._reader.read_some()
                self._preview = self._look()
            return self._preview

    def read_on(self, progress: Progress, cancelled: Callable[[], bool]) -> bool:
        """Read more of the preview, about as much again as there is; whether it is final then.

        Raises
        ------
        Cancelled
            If `cancelled` said so.
        CaptureError
            If a part of the file cannot be read.
        """
        reader = self._reader
        enough = 2 * reader.done
        while not reader.is_complete and reader.done < enough:
            _go_on(cancelled)
            with self._reading:
                reader.read_some()
            progress(reader.done, reader.of + 1)
        flux_prior = self._flux_prior if reader.is_complete else None
        with self._reading:
            self._preview = self._look(flux_prior)
            return self._preview.is_final

    def _look(self, flux_prior: FluxPrior | None = None) -> Cutout:
        read, capture = float(self._reader.seen.mean()), self._reader.capture(flux_prior)
        return Cutout(self, self.whole, capture, read, is_final=flux_prior is not None)

    def cutout(
        self,
        window: Window | None,
        progress: Progress = lambda done, of: None,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Cutout:
        """The preview, or a window; the latest one is kept.

        Raises
        ------
        Cancelled
            If `cancelled` said so.
        CaptureError
            If a part of the file cannot be read.
        ValueError
            If the window does not lie in the image, or holds too much.
        """
        if window is None:
            return self.preview
        kept = self._latest
        if kept is not None and kept.window == window:
            return kept
        most = self._most_pixels
        n_pixels = math.prod(window.shape)
        require("pixels of a window", n_pixels, n_pixels <= max(most, 1), f"at most {most:,}")
        reader = WindowReader(self._counts, window)
        while not reader.is_complete:
            _go_on(cancelled)
            reader.read_some()
            progress(reader.done, reader.of + 1)
        _go_on(cancelled)
        capture = reader.capture(self._flux_prior)
        self._latest = Cutout(self, window, capture, read=1.0, is_final=True)
        return self._latest

    @property
    def _flux_prior(self) -> FluxPrior:
        """Learned when it is first needed, while others wait."""
        with self._preparing_prior:
            return self._sampled_flux_prior

    @cached_property
    def _sampled_flux_prior(self) -> FluxPrior:
        return sampled_flux_prior(self._counts)


def _go_on(cancelled: Callable[[], bool]) -> None:
    if cancelled():
        raise Cancelled


def open_large(path: Path, options: dict[str, Any]) -> LargeFile | None:
    """A file too large to be held as a whole; None if it is not, or knows no windows."""
    n_bytes = bytes_of(path, **options)
    if n_bytes is None or n_bytes <= most_whole_bytes():
        return None
    return LargeFile(open_capture(path, **options))


@dataclass(frozen=True)
class Grid:
    """Which rows and columns of a file the pixels of an image are."""

    first: tuple[int, int] = (0, 0)
    step: int = 1

    def place(self, row: At, col: At) -> tuple[At, At]:
        """Row and column in the file of a pixel of the image, or of a place between pixels."""
        return self.first[0] + self.step * row, self.first[1] + self.step * col

    def index(self, row: float, col: float) -> tuple[float, float]:
        """Where in the image a row and a column of the file are, inside of it or not."""
        return (row - self.first[0]) / self.step, (col - self.first[1]) / self.step

    def pixel(self, row: float, col: float) -> tuple[int, int]:
        """The nearest pixel to that."""
        down, across = self.index(row, col)
        return round(down), round(across)

    def thinned(self, skip: int, pool: int) -> Grid:
        """The same once pixels are left out and added (`core.reductions.Reduction`)."""
        shift = (skip - 1) // 2 + skip * (pool - 1) // 2
        return Grid(self.place(shift, shift), self.step * skip * pool)
