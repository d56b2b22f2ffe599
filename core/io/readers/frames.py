"""Raw frames of a Geiger-mode camera: for each pulse and pixel the bin that triggered, or none.

Frames are counted as they are read, a stretch of the file at a time. So only the cube must fit in
`core.io.readers.guards.MAX_CUBE_BYTES`, never the frames: in addition to the cube, and a second one
while the number of bins is still unknown, a stretch of `STRETCH` values takes 40 bytes for each.

Each frame is one pulse, and each pixel triggers once in it or never: these are first photons, as
many pulses as frames. Without ``n_bins`` the gate ends with the last trigger, which may lie in one
of the first 65,536 bins: a larger number more likely stands for no trigger. Each frame is a record:
``records`` counts some of them, in the gate of all. With ``pulse_groups`` the order of the pulses
is kept in so many groups, each with a cube of its own, all of which must fit. In frames of
floating-point numbers NaN marks no trigger, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import prod
from types import MappingProxyType
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import dense_capture, guess_axes, with_guesses
from core.io.readers.frame_guess import resembles_frames
from core.io.readers.guards import decoding, require_fits
from core.io.readers.options import AmbiguousError, ReadOptions
from core.io.readers.records import chosen_records, described
from core.pulse_groups import PulseGroups, group_sizes
from core.trigger import count_dtype

AXES = ("pulse", "row", "col")
STRETCH = 2**20
MOST_GUESSED_BINS = 2**16
_LARGEST_USUAL_COUNT = 255
_FEWEST_FRAMES = 50
_LEAST_MARK = 16  # beyond the bins of any gate
_MARKED = 0.01  # share of the array
_TIMES_AS_OFTEN = 10  # as the value below

Stretch = tuple[tuple[int, int, int], NDArray[Any]]
"""Pulse, row and column of the first of some frames, and the frames (pulse, row, col)."""


class Header(NamedTuple):
    """Header of an array in a file."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]


def frames_from(
    file: IO[bytes], header: Header, name: str, origin: str, request: ReadOptions
) -> Capture:
    """Return a capture from an array of frames in an open file, at its first number.

    Parameters are those of `frames_capture`; the request's ``no_trigger`` marks no trigger.
    """
    shape, is_fortran, dtype = header
    fits = len(shape) == 3 and min(shape) > 0 and dtype.kind in "iuf"
    accepted = "numbers of shape (pulse, row, col), none of them 0"
    require(name, f"{dtype} array of shape {shape}", fits, accepted)
    order = request.order(AXES) or (0, 1, 2)
    n_pulses, n_rows, n_cols = (shape[axis] for axis in order)
    if is_fortran:
        shape, order = shape[::-1], tuple(2 - axis for axis in order)

    def stretches() -> Iterator[Stretch]:
        for box in boxes(shape, STRETCH):
            size = [part.stop - part.start for part in box]
            with decoding("a frame"):
                data = file.read(prod(size) * dtype.itemsize)
                frames = np.frombuffer(data, dtype).reshape(size)
            pulse, row, col = (box[axis].start for axis in order)
            yield (pulse, row, col), frames.transpose(order)

    is_guessed = request.axes is None and name != "frames"
    guessed = [f"axes ({', '.join(AXES)})"] if is_guessed else []
    counted = n_pulses, n_rows, n_cols
    no_trigger = int(request.no_trigger or 0)
    capture = frames_capture(
        stretches(), counted, no_trigger, name, origin, request, guessed=guessed
    )
    return with_guesses(capture, axes=" ".join(AXES)) if is_guessed else capture


def frames_capture(
    stretches: Iterable[Stretch],
    shape: tuple[int, int, int],
    no_trigger: int,
    name: str,
    origin: str,
    request: ReadOptions,
    *,
    first_bin: int | None = None,
    bin_width_s: float | None = None,
    guessed: Sequence[str] = (),
) -> Capture:
    """Return a capture from frames of trigger bins.

    Parameters
    ----------
    stretches : iterable of (start, frames)
        All frames, in any order.
    shape : tuple of int
        Pulses, rows and columns of them all.
    no_trigger : int
        Value that marks no trigger.
    name, origin : str
        Name of the frames in errors, and origin of the capture in its source.
    first_bin : int, optional
        Value of the first bin; by default 0, or 1 if 0 marks no trigger.
    bin_width_s : float, optional
        Bin width of the camera, used if none is given.
    guessed : sequence of str
        Guesses made before.

    Raises
    ------
    ValueError
        If a value is neither a bin nor `no_trigger`, the requested number of pulses is not that of
        the frames, a requested record is not among them, or nothing triggered and ``n_bins`` is not
        given.
    """
    n_frames = shape[0]
    chosen = chosen_records(request, n_frames)
    request.refuse(["time_unit_s"], "frames hold bins: bin_width_s is their unit")
    request.refuse(["first_detections"], "frames hold one detection of a pulse")
    request.refuse(["shape"], "frames have rows and columns")
    agrees = request.n_pulses in (None, n_frames)
    require("n_pulses", request.n_pulses, agrees, f"{n_frames}, one for each frame, or None")
    if request.records is not None:
        origin = f"{origin}, {described(chosen, n_frames, 'frame')}"
    if first_bin is None and no_trigger == 0:
        first_bin, guessed = 1, [*guessed, "1 stands for the first bin"]
    size = shape[1], shape[2], request.n_bins
    if request.pulse_groups is None:
        request.refuse(["pulse_rate_hz"], "it needs pulse_groups")
    sizes = group_sizes(len(chosen), request.pulse_groups or 1)
    counts = _count_triggers(stretches, size, chosen, no_trigger, name, first_bin or 0, len(sizes))
    detection = request.detection or "first"
    known = replace(
        request,
        n_pulses=len(chosen),
        no_trigger=None,
        detection=detection,
        records=None,
        pulse_groups=None,
        pulse_rate_hz=None,
    )
    in_groups = None if request.pulse_groups is None else counts
    cube = counts[0] if in_groups is None else _sum_of_groups(counts)
    capture = dense_capture(cube, origin, known, guessed=guessed, bin_width_s=bin_width_s)
    if in_groups is None:
        return replace(capture, n_records=n_frames)
    if request.stop_s is not None:  # which reverses the bins
        in_groups = np.ascontiguousarray(in_groups[..., ::-1])
    groups = PulseGroups(in_groups, sizes, request.pulse_rate_hz)
    return replace(capture, n_records=n_frames, groups=groups)


def require_counts(array: NDArray[Any], name: str, axes: str | None) -> None:
    """Refuse an array that probably holds raw frames.

    Parameters
    ----------
    array : ndarray
    name : str
        Its name in errors.
    axes : str or None
        Order of the axes if it is given: those of counts.

    Raises
    ------
    AmbiguousError
        If one value hardly is a count, and thus probably marks the pulses without a trigger: NaN,
        the least one if that is negative, or the largest one if it is frequent everywhere. Without
        `axes` also if `core.io.readers.frame_guess` takes 0 for that value.
    """
    if array.ndim != 3 or not array.size or array.dtype.kind not in "iuf":
        return
    frames = f"raw frames ({', '.join(AXES)})"
    is_marked = array.dtype.kind == "f" and np.isnan(array).mean() > _MARKED
    if is_marked and "pulse" in (axes or AXES):
        why = f"if {name} holds {frames}, in which NaN marks no trigger"
        raise _are_frames(-1, why, mark="NaN")
    least, largest = array.min().item(), array.max().item()
    for value in (least, largest):
        if _hardly_counts(array, value):
            share = np.count_nonzero(array == value) / array.size
            raise _are_frames(
                value, f"if {name} holds {frames}: {share:.0%} of its values are {value}"
            )
    if axes is None and least == 0 and resembles_frames(array):
        order = " ".join(guess_axes(array.shape))
        counts = {"Counts": {"axes": order}}
        what = f"if {name} holds {frames}, as it seems, or axes = {order!r} if it holds counts"
        raise _are_frames(0, what, counts)


def _hardly_counts(array: NDArray[Any], value: float) -> bool:
    """Return whether the least or the largest value of an array is none, or too frequent a count.

    Of counts, the largest is rarer than the one below, or lies in a few bins.
    """
    here = array == value
    n_here, n_below = np.count_nonzero(here), np.count_nonzero(array == value - 1)
    if n_here > array.size / 2 and not 0 <= value <= _LARGEST_USUAL_COUNT:
        return True
    if len(array) < _FEWEST_FRAMES or n_here < _MARKED * array.size:
        return False
    if value < 0:
        return not np.any((array < 0) & ~here)
    is_everywhere = all(here.any(axis=tuple({0, 1, 2} - {axis})).mean() > 0.5 for axis in range(3))
    return bool(value >= _LEAST_MARK and n_here > _TIMES_AS_OFTEN * n_below and is_everywhere)


def _are_frames(
    no_trigger: float,
    why: str,
    others: Mapping[str, Mapping[str, str]] = MappingProxyType({}),
    mark: str | None = None,
) -> AmbiguousError:
    """Return the error that asks whether an array holds raw frames, or one of `others`.

    `mark` names what marks no trigger, by default `no_trigger`.
    """
    return AmbiguousError(
        f"no_trigger = None is not accepted: give {no_trigger:.0f} {why}.",
        "{file} seems to hold raw frames (" + ", ".join(AXES) + "), in which "
        f"{mark or format(no_trigger, '.0f')} marks no trigger. What does it hold?",
        {"Raw frames": {"no_trigger": f"{no_trigger:.0f}"}, **others},
    )


def _count_triggers(
    stretches: Iterable[Stretch],
    size: tuple[int, int, int | None],
    chosen: range,
    no_trigger: int,
    name: str,
    first_bin: int,
    n_groups: int,
) -> NDArray[np.unsignedinteger]:
    """Return histograms (group, row, col, bin) of groups of the chosen frames.

    Their `size` is that of the frames and the number of bins, by default up to the last trigger of
    all frames.
    """
    n_rows, n_cols, n_bins = size
    dtype = count_dtype(len(chosen))
    cube = _more_bins(np.zeros((n_groups, n_rows, n_cols, 0), dtype), n_bins or 0, name)
    end = first_bin + (n_bins or MOST_GUESSED_BINS)
    for start, frames in stretches:
        fired = frames != no_trigger
        if frames.dtype.kind == "f":
            fired &= ~np.isnan(frames)
        numbers = frames[fired]
        odd = (numbers < first_bin) | (numbers >= end) | (numbers != np.floor(numbers))
        if odd.any():
            place = np.argwhere(fired)[np.argmax(odd)]
            pulse, row, col = (int(first + k) for first, k in zip(start, place, strict=True))
            what = f"{name} in pulse {pulse}, pixel ({row}, {col})"
            limited = "(more with n_bins)" if n_bins is None else f"for n_bins = {n_bins}"
            accepted = f"{first_bin} to {end - 1} {limited}, or {no_trigger} where nothing fired"
            if (numbers != np.floor(numbers)).any():
                accepted += "; round times in bins down to whole ones"
            require(what, numbers[odd][0].item(), False, accepted)
        if not numbers.size:
            continue
        last = int(numbers.max()) - first_bin
        if last >= cube.shape[3]:
            cube = _more_bins(cube, last + 1, name)
        inside = slice(*(max(edge - start[0], 0) for edge in (chosen.start, chosen.stop)))
        fired = fired[inside]
        if len(fired) < len(frames):
            numbers = frames[inside][fired]
        rows, cols = (k + np.arange(n) for k, n in zip(start[1:], frames.shape[1:], strict=True))
        lowest = (rows[:, None] * n_cols + cols) * cube.shape[3]
        if n_groups > 1:
            order = start[0] + np.arange(len(frames))[inside] - chosen.start
            group = order * n_groups // len(chosen)
            lowest = group[:, None, None] * cube[0].size + lowest
        place = np.broadcast_to(lowest, fired.shape)[fired] + numbers.astype(np.int64) - first_bin
        np.add.at(cube.reshape(-1), place, dtype.type(1))
    require(f"triggers of {name}", 0, cube.shape[3] > 0, "n_bins, or frames in which a pixel fired")
    return cube


def _more_bins(
    cube: NDArray[np.unsignedinteger], n_bins: int, name: str
) -> NDArray[np.unsignedinteger]:
    *others, before = cube.shape
    remedy = "as no_trigger the value that stands where nothing fired"
    if others[0] > 1:
        remedy += ", or fewer pulse_groups"
    what = f"the cube of {name}, {n_bins:,} bins"
    require_fits(what, prod(others) * n_bins * cube.dtype.itemsize, remedy)
    wider = np.zeros((*others, n_bins), cube.dtype)
    wider[..., :before] = cube
    return wider


def _sum_of_groups(counts: NDArray[np.unsignedinteger]) -> NDArray[np.unsignedinteger]:
    """Return the counts (row, col, bin) of all groups."""
    return np.asarray(counts.sum(axis=0, dtype=counts.dtype))


def boxes(shape: tuple[int, ...], most: int) -> Iterator[tuple[slice, ...]]:
    """Cut an array into boxes of at most `most` elements, one after the other in memory.

    Each box is one stretch of an array in C order, and the next one begins where it ends.
    """
    if not shape:
        yield ()
        return
    first, *rest = shape
    inner = prod(rest)
    if inner > most:
        for k in range(first):
            for box in boxes(tuple(rest), most):
                yield (slice(k, k + 1), *box)
        return
    step = max(1, most // max(1, inner))
    for k in range(0, first, step):
        yield (slice(k, min(k + step, first)), *(slice(0, n) for n in rest))
