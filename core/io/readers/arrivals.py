"""Histogram cubes from photon arrival times; settings that are not given are guessed.

Time unit. Whole numbers of which the largest exceeds 100,000 are picoseconds; other whole numbers
are bins of the instrument, 8 ps as in published captures. Fractions below 0.001 are seconds. Other
fractions are refused, since microseconds and nanoseconds cannot be distinguished.

Bin width. 1 ns (the nearest multiple of the unit) if that gives 100 to 65,536 bins from the opening
of the gate to the last photon. Otherwise the smallest power-of-two multiple of the unit that gives
at most 1024 bins for a shorter gate, at most 65,536 for a longer one. Both must fit in ``n_bins``
where it is given. The width is a multiple of the unit, since otherwise some bins would hold more
units than others; for fractions the unit is 1 ps here.

Gate. From the first photon, rounded down to a multiple of the bin width, to the last. All photons
count as long as the gate has at most 65,536 bins of 1 ns, 10 km (of ``bin_width_s`` where that is
longer; ``n_bins`` where that is more). For a longer gate, the stretch of that length with the most
photons is found. If it holds at least nine tenths of all photons, the gate covers only this
stretch, and the source gives the number of dropped photons. Otherwise the gate covers all photons,
in wider bins.

Pulse. The one that `core.io.readers.pulse_guess` estimates, or a Gaussian of one bin. The number of
pulses stays unknown.

Times of a common-stop instrument count backwards from ``stop_s``. A time in whole units covers all
of its unit, so the last one before the stop becomes the first after the pulse.
"""

from __future__ import annotations

from math import floor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import LONGEST_S, MOST_BINS, Floats
from core.capture import Capture
from core.checks import require
from core.io.readers.dense import capture_of, description_of, with_guesses
from core.io.readers.guards import require_fits
from core.io.readers.options import IN_ORDER, TRUTH_HINT, ReadOptions
from core.io.readers.quantities import time_text
from core.trigger import count_dtype

NATIVE_BIN_S = 8e-12
PICOSECONDS_ABOVE = 100_000
SECONDS_BELOW = 1e-3
FEWEST_BINS_OF_1_NS = 100
MOST_SHORT_BINS = 1024
MOST_BINS_OF_1_NS = 2**16
MOST_DROPPED = 0.1
"""Largest share of the photons that a guessed gate leaves out."""

BYTES_A_PHOTON = 64  # of working memory: its time, pixel, bin and place, before and after sorting
_LARGEST_TICK = 2**53  # beyond, a float skips whole numbers


def arrivals_capture(
    times: NDArray[Any],
    pixel: NDArray[np.int64],
    shape: tuple[int, int],
    name: str,
    origin: str,
    request: ReadOptions,
) -> Capture:
    """Return a capture from the arrival time of each photon.

    Parameters
    ----------
    times : ndarray, shape (photon,)
        Arrival times in any unit.
    pixel : ndarray, shape (photon,)
        Index of each photon's pixel, row by row.
    shape : tuple of int
        Rows and columns.
    name, origin : str
        Name of the times in errors, and origin of the capture in its source.

    Raises
    ------
    ValueError
        If a time is invalid, a setting cannot be guessed, or no photon lies in the gate.
    """
    _require_times(times, pixel, shape, name)
    request.refuse(["shape", "no_trigger"], "lists of photons lie in pixels already")
    request.refuse(["records"], "lists of photons are no sequence of records")
    request.refuse(IN_ORDER, "lists of photons keep no order of the pulses")
    if request.first_detections is not None:
        kept = _rank(pixel) < request.first_detections
        times, pixel = times[kept], pixel[kept]
    if request.order(("row", "col")) == (1, 0):
        row, col = np.divmod(pixel, shape[1])
        pixel, shape = col * shape[0] + row, (shape[1], shape[0])
    times = times.astype(np.float64)
    whole = bool(np.all(times == np.floor(times)))
    unit_s = request.time_unit_s or _guess_time_unit(times, whole, name)
    tick_s = unit_s if whole else 1e-12
    ticks = times if whole else _snapped(times * (unit_s / tick_s))
    last = float(ticks.max())
    below = f"times below {_LARGEST_TICK * tick_s:.3g} s, or another time_unit_s"
    require(f"largest time of {name}", last * tick_s, last < _LARGEST_TICK, below)
    if request.stop_s is not None:
        ticks = _from_stop(ticks, float(_snapped(request.stop_s / tick_s)), whole, tick_s)

    per_bin, opening, n_bins = _gate(ticks, tick_s, request)
    remedy = f"up to {MOST_BINS:,}: a larger bin_width_s, or a gate_delay_s and n_bins"
    require(f"bins of {name}", n_bins, n_bins <= MOST_BINS, remedy)
    gate_s = n_bins * per_bin * tick_s
    closer = f"times no more than {LONGEST_S:g} s apart, or another time_unit_s"
    require(f"gate of {name}", time_text(gate_s), gate_s <= LONGEST_S, closer)
    bins = np.floor((ticks - opening) / per_bin)
    inside = (bins >= 0) & (bins < n_bins)
    n_dropped = inside.size - int(np.count_nonzero(inside))
    found = " to ".join(time_text(time * tick_s) for time in (ticks.min(), ticks.max()))
    remedy = "a gate_delay_s, n_bins, bin_width_s and time_unit_s that take in some of them"
    require(name, f"photons from {found}", n_dropped < inside.size, remedy)
    cube = _cube(bins[inside].astype(np.int64), pixel[inside], shape, n_bins, name)
    dropped = f"dropped: {n_dropped:,} of {inside.size:,} photons, outside the gate"
    known = description_of(
        request,
        n_bins,
        lambda: cube,
        origin,
        time_unit_s=unit_s,
        bin_width_s=per_bin * tick_s,
        gate_delay_s=opening * tick_s,
        remark=dropped if n_dropped else "",
    )
    return with_guesses(capture_of(cube, known), time_unit_s=unit_s)


def _require_times(
    times: NDArray[Any], pixel: NDArray[np.int64], shape: tuple[int, int], name: str
) -> None:
    kind = times.dtype
    require(f"type of {name}", str(kind), kind.kind in "biuf", "real numbers")
    require(f"photons of {name}", times.size, times.size > 0, "at least one photon")
    require_fits(f"{times.size:,} photons", times.size * BYTES_A_PHOTON)
    odd = np.flatnonzero(~((times >= 0) & (times < np.inf)))
    if odd.size:
        row, col = divmod(int(pixel[odd[0]]), shape[1])
        value = times[odd[0]].item()
        require(f"{name} in pixel ({row}, {col})", value, False, "arrival times, 0 or more")


def _rank(pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many photons of the same pixel come before each, in the order of the file."""
    order = np.argsort(pixel, kind="stable")
    _, begin, n_photons = np.unique(pixel[order], return_index=True, return_counts=True)
    rank = np.empty(pixel.size, np.int64)
    rank[order] = np.arange(pixel.size) - np.repeat(begin, n_photons)
    return rank


def _guess_time_unit(times: Floats, whole: bool, name: str) -> float:
    """Return the unit of arrival times in seconds, by the rules above."""
    if whole:
        return 1e-12 if times.max() > PICOSECONDS_ABOVE else NATIVE_BIN_S
    fraction = float(times[times != np.floor(times)].max())
    accepted = (
        f"whole numbers, seconds below {SECONDS_BELOW}, or time_unit_s (1e-9 for ns); {TRUTH_HINT}"
    )
    require(f"a time of {name}", fraction, bool(times.max() < SECONDS_BELOW), accepted)
    return 1.0


def _from_stop(ticks: Floats, stop: float, whole: bool, tick_s: float) -> Floats:
    """Return times after the pulse, in ticks, from times before a stop that comes `stop` after."""
    after = stop - ticks - (1.0 if whole else 0.0)
    least = f"the stop's time after the pulse, at least the largest time, {ticks.max() * tick_s} s"
    require("stop_s", stop * tick_s, bool(after.min() >= 0), least)
    return np.asarray(after)


def _gate(ticks: Floats, tick_s: float, request: ReadOptions) -> tuple[float, float, int]:
    """Return the width of a bin and the opening of the gate in ticks, and the number of bins."""
    delay_s, width_s, n_bins = request.gate_delay_s, request.bin_width_s, request.n_bins
    delay = None if delay_s is None else float(_snapped(delay_s / tick_s))
    width = None if width_s is None else float(_snapped(width_s / tick_s))
    wider = f"a width that is not far below the unit of the times, {time_text(tick_s)}"
    require("bin_width_s", width_s, width is None or width > 0, wider)
    nanosecond = max(1, round(1e-9 / tick_s))
    longest = max(MOST_BINS_OF_1_NS, n_bins or 0) * max(nanosecond, width or 0)
    first, last = _bulk(ticks, delay, longest)

    def opening(per_bin: float) -> float:
        return floor(first / per_bin) * per_bin if delay is None else delay

    def bins_of(per_bin: float) -> int:
        return floor((last - opening(per_bin)) / per_bin) + 1

    per_bin = width
    if per_bin is None:  # guessed by the rules above
        is_long = bins_of(nanosecond) >= FEWEST_BINS_OF_1_NS
        most = n_bins or (MOST_BINS_OF_1_NS if is_long else MOST_SHORT_BINS)
        per_bin = nanosecond if is_long and bins_of(nanosecond) <= most else 1
        while bins_of(per_bin) > most:
            per_bin *= 2
    return per_bin, opening(per_bin), n_bins or max(1, bins_of(per_bin))


def _bulk(ticks: Floats, delay: float | None, longest: float) -> tuple[float, float]:
    """Return first and last photon of the gate, without strays that would make it too long.

    Parameters
    ----------
    ticks : ndarray, shape (photon,)
        Arrival times.
    delay : float or None
        Opening of the gate, if given: earlier photons are left out.
    longest : float
        Length of a gate that takes all photons, however far apart, in ticks.
    """
    first, last = float(ticks.min()), float(ticks.max())
    if last - (first if delay is None else delay) < longest:
        return first, last
    ordered = np.sort(ticks if delay is None else ticks[ticks >= delay])
    if not ordered.size:
        return first, last
    begins = np.arange(ordered.size)
    ends = np.searchsorted(ordered, ordered + longest)
    begin = int(np.argmax(ends - begins))
    end = int(ends[begin])
    if end - begin < (1 - MOST_DROPPED) * ordered.size:
        begin, end = 0, ordered.size
    return float(ordered[begin]), float(ordered[end - 1])


def _snapped(ticks: ArrayLike) -> Floats:
    """Return `ticks`; where a quotient of floats missed a whole number by rounding, that number."""
    nearest = np.rint(ticks)
    is_near = np.abs(np.subtract(ticks, nearest)) <= 1e-9 * np.maximum(1.0, np.abs(ticks))
    return np.where(is_near, nearest, ticks)


def _cube(
    bins: NDArray[np.int64],
    pixel: NDArray[np.int64],
    shape: tuple[int, int],
    n_bins: int,
    name: str,
) -> NDArray[np.unsignedinteger]:
    """Count the photons of each pixel and bin.

    Photons are few compared with the cube: sorting them is faster than a histogram of 8-byte
    counts, and needs a quarter of the memory.
    """
    size = shape[0] * shape[1] * n_bins
    remedy = "a larger bin_width_s, or a narrower gate by gate_delay_s and n_bins"
    what = f"the cube of {name}, {n_bins:,} bins"
    require_fits(what, size * count_dtype(0).itemsize, remedy)
    filled, counts = np.unique(pixel * n_bins + bins, return_counts=True)
    dtype = count_dtype(int(counts.max()))
    require_fits(what, size * dtype.itemsize, remedy)
    cube = np.zeros(size, dtype)
    cube[filled] = counts
    return cube.reshape(*shape, n_bins)
