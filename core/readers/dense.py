"""A histogram cube of any number type, and what is guessed where only the cube is known.

Unless told otherwise, bins are 1 ns wide, the gate opens with the pulse, and an echo is a Gaussian
of one bin.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Pulse
from core.capture import Capture
from core.checks import require
from core.readers.guards import require_fits
from core.readers.request import Request
from core.readers.wording import guesses, sentence

_LARGEST_COUNT = 2**32 - 1


def whole_counts(cube: NDArray[Any], name: str) -> NDArray[np.unsignedinteger]:
    """The cube as uint16, or uint32 where a count exceeds 65535; never a view of `cube`.

    Raises
    ------
    ValueError
        If `cube` is not a (row, col, bin) array of whole numbers from 0 to ``2**32 - 1``.
    """
    require_cube(cube, name)
    lowest, highest = cube.min().item(), cube.max().item()
    require(name, lowest, lowest >= 0, "counts, 0 or more")
    require(name, highest, highest <= _LARGEST_COUNT, f"counts up to {_LARGEST_COUNT:,}")
    dtype = count_dtype(highest)
    require_fits(name, cube.size * dtype.itemsize)
    counts = np.array(cube, dtype, order="C")
    if cube.dtype.kind == "f" and not np.array_equal(counts, cube):
        require(name, cube[counts != cube][0].item(), False, "whole counts")
    return counts


def require_cube(cube: NDArray[Any], name: str) -> None:
    """Raise ``ValueError`` unless `cube` is numbers of shape (row, col, bin), none of them 0."""
    fits = cube.ndim == 3 and cube.size > 0 and cube.dtype.kind in "biuf"
    wanted = "real numbers of shape (row, col, bin), none of them 0"
    require(name, f"{cube.dtype} array of shape {cube.shape}", fits, wanted)


def count_dtype(highest: float) -> np.dtype[np.unsignedinteger]:
    """The type of a cube whose largest count is `highest`."""
    return np.dtype(np.uint16 if highest < 2**16 else np.uint32)


def dense_capture(
    counts: NDArray[np.unsignedinteger],
    origin: str,
    request: Request,
    guessed_pulse: Pulse | None = None,
) -> Capture:
    """A capture from a histogram cube and what is known of it.

    Parameters
    ----------
    counts : ndarray, shape (row, col, bin)
    origin : str
        What to call the capture in its source.
    guessed_pulse : Pulse, optional
        Taken where none is given, in place of a Gaussian of one bin.
    """
    unit, asked, n_bins = request.time_unit_s, request.n_bins, counts.shape[2]
    require("time_unit_s", unit, unit is None, "None: a histogram cube takes bin_width_s alone")
    require("n_bins", asked, asked in (None, n_bins), f"{n_bins}, the cube's last axis, or None")
    acquisition = Acquisition(
        n_bins=n_bins,
        bin_width_s=1e-9 if request.bin_width_s is None else request.bin_width_s,
        gate_delay_s=0.0 if request.gate_delay_s is None else request.gate_delay_s,
        n_pulses=request.n_pulses,
        pixel_angle_rad=request.pixel_angle_rad,
    )
    pulse = request.pulse or guessed_pulse or Pulse.gaussian(acquisition.bin_width_s)
    guessed = guesses(replace(request, n_bins=n_bins), acquisition, pulse)
    return Capture(counts, acquisition, pulse, source=sentence(origin, guessed))
