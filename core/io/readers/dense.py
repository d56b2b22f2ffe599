"""Histogram cubes of any number type, and the description of counts.

By default the axes are in the order of `guess_axes`, bins are 1 ns wide, the gate opens with the
pulse, and `core.io.readers.pulse_guess` estimates the echo from the counts. A common-stop
instrument's bins (``stop_s``) are reversed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import MOST_BINS, Acquisition, Pulse
from core.capture import COUNT_TYPES, Capture, Detection
from core.checks import printable, require
from core.io.readers.guards import require_fits
from core.io.readers.options import IN_ORDER, TRUTH_HINT, ReadOptions
from core.io.readers.pulse_guess import guessed_pulse
from core.io.readers.quantities import time_text
from core.trigger import count_dtype

if TYPE_CHECKING:
    from core.inference.flux_model import FluxPrior

AXES = ("row", "col", "bin")
LARGEST_COUNT = 2**32 - 1

_FEWEST_BINS = 8  # of a cube whose bins come first

Counts = NDArray[np.unsignedinteger]


class Description(NamedTuple):
    """Metadata of an array of counts, without the counts themselves."""

    acquisition: Acquisition
    pulse: Pulse
    detection: Detection
    source: str


def description_of(
    request: ReadOptions,
    n_bins: int,
    sample: Callable[[], Counts],
    origin: str,
    *,
    guessed: Sequence[str] = (),
    time_unit_s: float | None = None,
    bin_width_s: float = 1e-9,
    gate_delay_s: float = 0.0,
    remark: str = "",
) -> Description:
    """Describe counts by a request, and guess what it leaves open.

    Parameters
    ----------
    sample : callable
        Returns counts (row, col, bin) from which pulse or detection are guessed, if needed.
    origin : str
        Origin of the capture for its source.
    guessed : sequence of str
        Guesses made before.
    time_unit_s : float, optional
        Unit taken for arrival times; None for a file that holds none.
    bin_width_s, gate_delay_s : float
        Used where the request specifies none.
    remark : str
        Appended to the source.
    """
    acquisition = Acquisition(
        n_bins=n_bins,
        bin_width_s=request.bin_width_s or bin_width_s,
        gate_delay_s=gate_delay_s if request.gate_delay_s is None else request.gate_delay_s,
        n_pulses=request.n_pulses,
        pixel_angle_rad=request.pixel_angle_rad,
    )
    pulse, detection = request.pulse, request.detection
    interval = ""
    if pulse is None or detection is None:
        counts = sample()
        detection = detection or guess_detection(counts, acquisition.n_pulses)
        if pulse is None:
            first_of = acquisition.n_pulses if detection == "first" else None
            pulse, interval = guessed_pulse(counts, acquisition.bin_width_s, first_of)
            if detection == "first" and first_of is None:
                interval += ", as shortened by pile-up: the number of pulses is not known"
    found = list(guessed)
    if time_unit_s is not None and request.time_unit_s is None:
        found.append(f"time unit {time_text(time_unit_s)}")
    if request.bin_width_s is None:
        found.append(f"bin width {time_text(acquisition.bin_width_s)}")
    if request.gate_delay_s is None:
        opens_ns = acquisition.gate_delay_s * 1e9
        closes_ns = opens_ns + n_bins * acquisition.bin_width_s * 1e9
        found.append(f"gate {opens_ns:.6g}-{closes_ns:.6g} ns")
    elif request.n_bins is None:
        found.append(f"{n_bins} bins")
    if request.pulse is None:
        shape = "Gaussian" if pulse.shape == "gaussian" else pulse.shape
        certainty = f" ({interval})" if interval else ""
        found.append(f"pulse {shape} of {time_text(pulse.tau_s)}{certainty}")
    if request.detection is None:
        found.append("first photons only" if detection == "first" else "all photons of a pulse")
        if detection == "all" and acquisition.n_pulses is not None:
            most = counts.sum(axis=2, dtype=np.int64).max()
            found[-1] += f" (as a pixel has {most:,} in {acquisition.n_pulses:,} pulses)"
    listed = f"guessed: {', '.join(found)}" if found else ""
    source = "; ".join(filter(None, (origin, listed, remark)))
    return Description(acquisition, pulse, detection, printable(source))


def guess_detection(cube: Counts, n_pulses: int | None) -> Detection:
    """First photons where pulses are known and no pixel of a cube has more photons."""
    if n_pulses is None:
        return "all"
    return "first" if cube.sum(axis=2, dtype=np.int64).max() <= n_pulses else "all"


def cube_capture(
    cube: NDArray[Any],
    name: str,
    origin: str,
    request: ReadOptions,
    *,
    axes: str | None = None,
    guessed: Sequence[str] = (),
    **more: Any,
) -> Capture:
    """Build a capture from an array of counts, its axes in the given or the usual order.

    Parameters
    ----------
    cube : ndarray of three axes
    name, origin : str
        Name of the array in errors, and origin of the capture in its source.
    axes : str, optional
        Order of the file's own axes, if known.
    guessed : sequence of str
        Guesses made before.
    **more
        As `dense_capture` takes them.
    """
    require_cube(cube, name)
    found = guess_axes(cube.shape)
    is_guessed = (request.axes or axes) is None
    order = replace(request, axes=request.axes or axes or " ".join(found)).order(AXES)
    cube = cube.transpose(order)
    guessed = [*([f"axes ({', '.join(found)})"] if is_guessed else []), *guessed]
    capture = dense_capture(whole_counts(cube, name), origin, request, guessed=guessed, **more)
    return with_guesses(capture, axes=" ".join(found)) if is_guessed else capture


def guess_axes(shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the likely order of a cube's axes: bins last, or first if the other two are as long.

    Images are often square, while a row rarely has as many pixels as a pixel has bins.
    """
    is_first = shape[1] == shape[2] != shape[0] >= _FEWEST_BINS
    return ("bin", "row", "col") if is_first else AXES


def dense_capture(
    counts: Counts,
    origin: str,
    request: ReadOptions,
    *,
    guessed: Sequence[str] = (),
    bin_width_s: float | None = None,
) -> Capture:
    """Build a capture from counts (row, col, bin), which are reversed for a common stop.

    Parameters are those of `description_of`.
    """
    n_bins = counts.shape[2]
    require_sums(counts.shape)
    request.refuse(["time_unit_s"], "a histogram cube takes bin_width_s alone")
    request.refuse(["first_detections"], "a histogram cube keeps no order of its photons")
    request.refuse(["shape", "no_trigger"], "a histogram cube has its own pixels")
    request.refuse(["records"], "the file holds no sequence of records")
    request.refuse(IN_ORDER, "a histogram cube keeps no order of its pulses")
    agrees = request.n_bins in (None, n_bins)
    require("n_bins", request.n_bins, agrees, f"{n_bins}, the cube's last axis, or None")
    bin_width_s = request.bin_width_s or bin_width_s or 1e-9
    opens_s = 0.0
    if request.stop_s is not None:
        counts, opens_s = counts[:, :, ::-1].copy(), request.stop_s - n_bins * bin_width_s
    known = description_of(
        replace(request, n_bins=n_bins),
        n_bins,
        lambda: counts,
        origin,
        guessed=guessed,
        bin_width_s=bin_width_s,
        gate_delay_s=opens_s,
    )
    return capture_of(counts, known)


def capture_of(counts: Counts, known: Description, flux_prior: FluxPrior | None = None) -> Capture:
    """Return counts as a capture of that description."""
    acquisition, pulse, detection, source = known
    return Capture(
        counts, acquisition, pulse, source=source, detection=detection, flux_prior=flux_prior
    )


def with_guesses(capture: Capture, **options: Any) -> Capture:
    """Return a capture with further `Capture.guesses`."""
    return replace(capture, guesses={**capture.guesses, **options})


def whole_counts(
    cube: NDArray[Any], name: str, dtype: np.dtype[np.unsignedinteger] | None = None
) -> Counts:
    """Return the cube as `dtype`, never a view of it.

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


def stored_counts(cube: NDArray[Any], name: str) -> Counts:
    """Return the cube in its own type where that is one for counts, else as `whole_counts`."""
    if cube.dtype.newbyteorder("=") not in COUNT_TYPES:
        return whole_counts(cube, name)
    require_cube(cube, name)
    return np.ascontiguousarray(cube, cube.dtype.newbyteorder("="))


def require_cube(cube: NDArray[Any], name: str) -> None:
    """Raise ``ValueError`` unless `cube` is numbers of shape (row, col, bin), none of them 0."""
    fits = cube.ndim == 3 and cube.size > 0 and cube.dtype.kind in "biuf"
    accepted = "real numbers of shape (row, col, bin), none of them 0"
    if cube.ndim == 2:
        accepted += f"; {TRUTH_HINT}"
    require(name, f"{cube.dtype} array of shape {cube.shape}", fits, accepted)
    require(f"bins of {name}", n_bins := cube.shape[2], n_bins <= MOST_BINS, f"up to {MOST_BINS:,}")


def require_sums(shape: tuple[int, ...]) -> None:
    """Raise ``ValueError`` if the sums of a cube's pixels, of 8 bytes each, would not fit."""
    require_fits("the sums of all pixels", 8 * shape[0] * shape[1])
