"""Files larger than memory: a preview of the whole file, then windows, one at a time in memory."""

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

if TYPE_CHECKING:
    import xarray as xr

PREVIEW_COUNTS = 2**23
"""Most pixels times bins of a preview, whose estimate is computed again as more is read."""

WINDOW_COUNTS = 2**24
"""Most pixels times bins of a window: sliders still respond at once."""

PREVIEW_PIXELS, WINDOW_PIXELS = 2**20, 2**21
"""Most pixels: with few bins, the images take more memory than the counts."""

FIRST_READ_S = 1.0
"""Reading time before a preview is first shown."""

WHOLE_BYTES = 2**28
"""Most bytes of counts that are held as a whole: some seconds per estimate."""

WHOLE_SHARE = 1 / 8
"""The same as a share of free memory; a capture with its posterior takes five times its counts."""

LIMIT = "FIRSTPHOTON_WHOLE_BYTES"
"""Environment variable that overrides both."""

Progress = Callable[[int, int], None]
At = TypeVar("At", int, float, NDArray[np.int_])


def most_whole_bytes() -> int:
    """Return the most bytes of counts that are held as a whole."""
    override = os.environ.get(LIMIT)
    free = psutil.virtual_memory().available
    return min(WHOLE_BYTES, int(WHOLE_SHARE * free)) if override is None else int(override)


def require_small(path: Path, n_bytes: int) -> None:
    """Refuse a capture too large for memory, of a format that cannot be read in windows."""
    most = most_whole_bytes()
    remedy = (
        f"at most {most:,}. A .zarr may have any size, since it is read in parts: "
        f"python -m core export {path.name} {path.stem}.zarr"
    )
    require(f"bytes of counts of {path.name}", n_bytes, n_bytes <= most, remedy)


@dataclass(frozen=True, eq=False)
class Cutout:
    """The part of a file that is in memory."""

    file: LargeFile
    window: Window
    capture: Capture
    read: float
    """Share of the window's pixels that have been read; the others have no counts."""
    is_final: bool
    """Whether all pixels have been read and the flux prior of the whole file is known."""

    @property
    def is_preview(self) -> bool:
        """Whether the window is the whole file."""
        return self.window == self.file.whole


class LargeFile:
    """A file that is read in windows, for any number of sessions.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `core.open_capture` returns it.
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
        """Return the window of the finest step that may be read."""
        return Window.fitting(rows, cols, self._most_pixels)

    @property
    def _most_pixels(self) -> int:
        """Most pixels of a window."""
        return min(WINDOW_COUNTS // self._n_bins, WINDOW_PIXELS)

    @cached_property
    def _reader(self) -> WindowReader:
        return WindowReader(self._counts, self.whole)

    @property
    def preview(self) -> Cutout:
        """The whole file as far as it has been read, at first for `FIRST_READ_S`."""
        with self._reading:
            if self._preview is None:
                started = perf_counter()
                self._reader.read_some()
                while not self._reader.is_complete and perf_counter() - started < FIRST_READ_S:
                    self._reader.read_some()
                self._preview = self._whole_cutout()
            return self._preview

    def read_on(self, progress: Progress) -> bool:
        """Double what the preview has read; return whether it is final.

        `progress` is called before each read and after the last; it may raise.

        Raises
        ------
        CaptureError
            If a part of the file cannot be read.
        """
        reader = self._reader
        enough = 2 * reader.done
        while not reader.is_complete and reader.done < enough:
            progress(reader.done, reader.of + 1)
            with self._reading:
                reader.read_some()
        progress(reader.done, reader.of + 1)
        flux_prior = self._flux_prior if reader.is_complete else None
        with self._reading:
            self._preview = self._whole_cutout(flux_prior)
            return self._preview.is_final

    def _whole_cutout(self, flux_prior: FluxPrior | None = None) -> Cutout:
        read, capture = float(self._reader.seen.mean()), self._reader.capture(flux_prior)
        return Cutout(self, self.whole, capture, read, is_final=flux_prior is not None)

    def cutout(self, window: Window | None, progress: Progress = lambda done, of: None) -> Cutout:
        """Return the preview, or a window; the latest window is kept.

        `progress` is called before each read and after the last; it may raise.

        Raises
        ------
        CaptureError
            If a part of the file cannot be read.
        ValueError
            If the window is outside the image or too large.
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
            progress(reader.done, reader.of + 1)
            reader.read_some()
        progress(reader.done, reader.of + 1)
        capture = reader.capture(self._flux_prior)
        self._latest = Cutout(self, window, capture, read=1.0, is_final=True)
        return self._latest

    @property
    def _flux_prior(self) -> FluxPrior:
        """The flux prior of the whole file; computed once, while other sessions wait."""
        with self._preparing_prior:
            return self._sampled_flux_prior

    @cached_property
    def _sampled_flux_prior(self) -> FluxPrior:
        return sampled_flux_prior(self._counts)


def open_large(path: Path, options: dict[str, Any]) -> LargeFile | None:
    """Open a file too large for memory; None for others, and for formats without windows."""
    n_bytes = bytes_of(path, **options)
    if n_bytes is None or n_bytes <= most_whole_bytes():
        return None
    return LargeFile(open_capture(path, **options))


@dataclass(frozen=True)
class Grid:
    """Rows and columns in a file of the pixels of an image."""

    first: tuple[int, int] = (0, 0)
    step: int = 1

    def place(self, row: At, col: At) -> tuple[At, At]:
        """Convert a row and a column of the image, whole or not, to those of the file."""
        return self.first[0] + self.step * row, self.first[1] + self.step * col

    def index(self, row: float, col: float) -> tuple[float, float]:
        """Convert a row and a column of the file to those of the image, inside it or not."""
        return (row - self.first[0]) / self.step, (col - self.first[1]) / self.step

    def pixel(self, row: float, col: float) -> tuple[int, int]:
        """Return the pixel nearest to a row and a column of the file."""
        down, across = self.index(row, col)
        return round(down), round(across)

    def thinned(self, skip: int, pool: int) -> Grid:
        """Return the grid after pixels are skipped and pooled (`core.reductions.Reduction`)."""
        shift = (skip - 1) // 2 + skip * (pool - 1) // 2
        return Grid(self.place(shift, shift), self.step * skip * pool)
