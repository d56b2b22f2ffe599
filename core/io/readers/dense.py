"""A histogram cube of any number type, and what is guessed where only the cube is known.

By default the axes are (row, col, bin), bins are 1 ns wide, the gate opens with the
pulse, and the echo is what `core.io.readers.pulse_guess` makes of the counts. A common-stop
instrument's bins (``stop_s``) are reversed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import MOST_BINS, SHORTEST_PULSE_S, Acquisition, Pulse, require_time
from core.capture import COUNT_TYPES, Capture, Detection
from core.checks import require
from core.io.readers.guards import require_fits
from core.io.readers.options import ReadOptions
from core.io.readers.pulse_guess import guessed_pulse
from core.io.readers.times import time_text
from core.io.readers.wording import guesses, sentence

AXES = ("row", "col", "bin")

PULSE = ("pulse_shape", "pulse_tau_s", "pulse_samples")
"""Fields of our own layouts that define a pulse together."""

LARGEST_COUNT = 2**32 - 1
_MOST_SAMPLES = 2**20
_MOST_SAMPLES_BEYOND_GATE = 2**16


def whole_counts(
    cube: NDArray[Any], name: str, dtype: np.dtype[np.unsignedinteger] | None = None
) -> NDArray[np.unsignedinteger]:
    """The cube as `dtype`, never a view of it.

    Without `dtype` as uint16, or uint32 where a count exceeds 65535.

    Raises
    ------
    ValueError
        If `cube` is not a (row, col, bin) array of whole numbers from 0 to ``2**32 - 1``.
    """
    require_cube(cube, name)
    lowest, highest = cube.min().item(), cube.max().item()
    require(name, lowest, lowest >= 0, "counts, 0 or more")
    require(name, highest, highest <= LARGEST_COUNT, f"counts up to {LARGEST_COUNT:,}")
    dtype = dtype or count_dtype(highest)
    require_fits(name, cube.size * dtype.itemsize)
    counts = np.array(cube, dtype, order="C")
    if cube.dtype.kind == "f" and not np.array_equal(counts, cube):
        require(name, cube[counts != cube][0].item(), False, "whole counts")
    return counts


def stored_counts(cube: NDArray[Any], name: str) -> NDArray[np.unsignedinteger]:
    """The cube in its own type where that is one for counts, as of `whole_counts` elsewhere."""
    if cube.dtype.newbyteorder("=") not in COUNT_TYPES:
        return whole_counts(cube, name)
    require_cube(cube, name)
    return np.ascontiguousarray(cube, cube.dtype.newbyteorder("="))


def require_cube(cube: NDArray[Any], name: str) -> None:
    """Raise ``ValueError`` unless `cube` is numbers of shape (row, col, bin), none of them 0."""
    fits = cube.ndim == 3 and cube.size > 0 and cube.dtype.kind in "biuf"
    wanted = "real numbers of shape (row, col, bin), none of them 0"
    require(name, f"{cube.dtype} array of shape {cube.shape}", fits, wanted)
    require(f"bins of {name}", n_bins := cube.shape[2], n_bins <= MOST_BINS, f"up to {MOST_BINS:,}")


def require_sums(shape: tuple[int, ...]) -> None:
    """Raise ``ValueError`` if the sums of a cube's pixels, of 8 bytes each, would not fit."""
    require_fits("the sums of all pixels", 8 * shape[0] * shape[1])


def require_image(name: str, found: tuple[int, ...], shape: tuple[int, ...]) -> None:
    """Raise ``ValueError`` unless an image has the cube's rows and columns."""
    require(name, f"shape {found}", found == shape, f"shape {shape}, that of the cube")


def stored_pulse(tau_s: float | None, shape: str, samples: NDArray[Any]) -> Pulse:
    """Return the pulse of a file of our own layouts.

    Raises
    ------
    ValueError
        If the time is missing, or the pulse is invalid.
    """
    if tau_s is None:
        raise ValueError("pulse_tau_s = None is not accepted: give a time beside the shape.")
    require_time("pulse_tau_s", tau_s, SHORTEST_PULSE_S)
    fits = samples.size <= _MOST_SAMPLES
    require("pulse_samples", f"{samples.size:,} of them", fits, f"up to {_MOST_SAMPLES:,}")
    return Pulse(tau_s, shape=shape, samples=tuple(samples.astype(float).ravel().tolist()))  # type: ignore[arg-type]


def require_pulse_in_gate(pulse: Pulse, acquisition: Acquisition) -> None:
    """Raise ``ValueError`` if a file's pulse has many samples and lasts longer than the gate."""
    n_samples = len(pulse.samples)
    length_s, gate_s = n_samples * pulse.tau_s, acquisition.n_bins * acquisition.bin_width_s
    require(
        "pulse_samples",
        f"{n_samples:,} of them, {time_text(length_s)}",
        n_samples <= _MOST_SAMPLES_BEYOND_GATE or length_s <= gate_s,
        f"up to {_MOST_SAMPLES_BEYOND_GATE:,}, or no more than last {time_text(gate_s)}, the gate",
    )


def count_dtype(highest: float) -> np.dtype[np.unsignedinteger]:
    """The type of a cube whose largest count is `highest`."""
    return np.dtype(np.uint16 if highest < 2**16 else np.uint32)


def cube_capture(
    cube: NDArray[Any],
    name: str,
    origin: str,
    request: ReadOptions,
    axes: str | None = None,
    guessed_bin_width_s: float | None = None,
) -> Capture:
    """Build a capture from an array of counts, its axes in the given or the usual order.

    Parameters
    ----------
    cube : ndarray of three axes
    name, origin : str
        What to call the array in a refusal, and the capture in its source.
    axes : str, optional
        Order of the file's own axes, if known.
    guessed_bin_width_s : float, optional
        Used if none is given.
    """
    request = replace(request, axes=request.axes or axes)
    order = request.order(AXES)
    if order is not None:
        require_cube(cube, name)
        cube = cube.transpose(order)
    guessed = [] if order else [f"axes ({', '.join(AXES)})"]
    return dense_capture(
        whole_counts(cube, name),
        origin,
        request,
        also_guessed=guessed,
        guessed_bin_width_s=guessed_bin_width_s,
    )


def dense_capture(
    counts: NDArray[np.unsignedinteger],
    origin: str,
    request: ReadOptions,
    assumed_pulse: Pulse | None = None,
    also_guessed: Sequence[str] = (),
    guessed_bin_width_s: float | None = None,
) -> Capture:
    """A capture from a histogram cube and what is known of it.

    Parameters
    ----------
    counts : ndarray, shape (row, col, bin)
    origin : str
        Origin of the capture in its source.
    assumed_pulse : Pulse, optional
        Used if none is given, in place of one guessed from the counts.
    also_guessed : sequence of str
        Guesses made before.
    guessed_bin_width_s : float, optional
        Used if none is given, in place of 1 ns.
    """
    asked, n_bins = request.n_bins, counts.shape[2]
    require_sums(counts.shape)
    request.refuse(["time_unit_s"], "a histogram cube takes bin_width_s alone")
    request.refuse(["first_detections"], "a histogram cube keeps no order of its photons")
    request.refuse(["shape", "no_trigger"], "a histogram cube tells its pixels")
    require("n_bins", asked, asked in (None, n_bins), f"{n_bins}, the cube's last axis, or None")
    bin_width_s = request.bin_width_s or guessed_bin_width_s or 1e-9
    opens_s = 0.0
    if request.stop_s is not None:
        counts, opens_s = counts[:, :, ::-1].copy(), request.stop_s - n_bins * bin_width_s
    acquisition = Acquisition(
        n_bins=n_bins,
        bin_width_s=bin_width_s,
        gate_delay_s=opens_s if request.gate_delay_s is None else request.gate_delay_s,
        n_pulses=request.n_pulses,
        pixel_angle_rad=request.pixel_angle_rad,
    )
    pulse = request.pulse or assumed_pulse or guessed_pulse(counts, acquisition.bin_width_s)
    detection = request.detection or guess_detection(counts, request.n_pulses)
    guessed = guesses(replace(request, n_bins=n_bins), acquisition, pulse, detection)
    source = sentence(origin, [*also_guessed, *guessed])
    return Capture(counts, acquisition, pulse, source=source, detection=detection)


def guess_detection(cube: NDArray[np.unsignedinteger], n_pulses: int | None) -> Detection:
    """First photons where pulses are known and no pixel of a cube has more photons."""
    if n_pulses is None:
        return "all"
    return "first" if cube.sum(axis=2, dtype=np.int64).max() <= n_pulses else "all"
