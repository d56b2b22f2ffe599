"""Raw frames of a Geiger-mode camera: for each pulse and pixel the bin that triggered, or none.

Frames are counted as they are read, a stretch of the file at a time. So only the cube must fit in
`core.io.readers.guards.MAX_CUBE_BYTES`, never the frames: besides the cube, and a second one while
the number of bins is still being found, a stretch of `STRETCH` values takes some 40 bytes for each.

Each frame is one pulse, and each pixel triggers once in it or never: these are first photons, as
many pulses as frames. Without ``n_bins`` the gate ends with the last trigger, which may lie in one
of the first 65,536 bins: a larger number more likely stands for no trigger.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from math import prod
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import count_dtype, dense_capture
from core.io.readers.guards import decoding, require_fits
from core.io.readers.options import ReadOptions

AXES = ("pulse", "row", "col")
STRETCH = 2**20
MOST_GUESSED_BINS = 2**16

Stretch = tuple[tuple[int, int, int], NDArray[Any]]
"""Frames (pulse, row, col), and the pulse, row and column of the first of them."""


def frames_capture(
    stretches: Iterable[Stretch],
    shape: tuple[int, int, int],
    no_trigger: int,
    name: str,
    origin: str,
    request: ReadOptions,
    first_bin: int | None = None,
    bin_width_s: float | None = None,
    also_guessed: Sequence[str] = (),
) -> Capture:
    """A capture from frames of trigger bins.

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
    also_guessed : sequence of str
        What was guessed before.

    Raises
    ------
    ValueError
        If a value is neither a bin nor `no_trigger`, the number of pulses told is not that of the
        frames, or nothing triggered and ``n_bins`` is not given.
    """
    n_pulses = shape[0]
    require(f"frames of {name}", shape, min(shape) > 0, "pulses, rows and columns, none of them 0")
    request.refuse(["time_unit_s"], "frames hold bins: bin_width_s is their unit")
    request.refuse(["first_detections"], "frames hold one detection of a pulse")
    request.refuse(["shape"], "frames tell their pixels")
    asked = request.n_pulses
    require(
        "n_pulses", asked, asked in (None, n_pulses), f"{n_pulses}, one for each frame, or None"
    )
    if first_bin is None and no_trigger == 0:
        first_bin, also_guessed = 1, [*also_guessed, "1 stands for the first bin"]
    cube = count_triggers(stretches, shape, no_trigger, name, request.n_bins, first_bin or 0)
    told = replace(
        request, n_pulses=n_pulses, no_trigger=None, detection=request.detection or "first"
    )
    return dense_capture(
        cube, origin, told, also_guessed=also_guessed, guessed_bin_width_s=bin_width_s
    )


def count_triggers(
    stretches: Iterable[Stretch],
    shape: tuple[int, int, int],
    no_trigger: int,
    name: str,
    n_bins: int | None = None,
    first_bin: int = 0,
) -> NDArray[np.unsignedinteger]:
    """Histograms (row, col, bin) of the trigger bins of all frames.

    Parameters are those of `frames_capture`; without `n_bins` there are as many as triggered.
    """
    n_pulses, n_rows, n_cols = shape
    dtype = count_dtype(n_pulses)
    cube = _more_bins(np.zeros((n_rows, n_cols, 0), dtype), n_bins or 0, name)
    end = first_bin + (n_bins or MOST_GUESSED_BINS)
    for start, frames in stretches:
        fired = frames != no_trigger
        numbers = frames[fired]
        odd = (numbers < first_bin) | (numbers >= end) | (numbers != np.floor(numbers))
        if odd.any():
            place = np.argwhere(fired)[np.argmax(odd)]
            pulse, row, col = (int(first + k) for first, k in zip(start, place, strict=True))
            what = f"{name} in pulse {pulse}, pixel ({row}, {col})"
            limited = "(more with n_bins)" if n_bins is None else f"for n_bins = {n_bins}"
            accepted = f"{first_bin} to {end - 1} {limited}, or {no_trigger} where nothing fired"
            require(what, numbers[odd][0].item(), False, accepted)
        if not numbers.size:
            continue
        last = int(numbers.max()) - first_bin
        if last >= cube.shape[2]:
            cube = _more_bins(cube, last + 1, name)
        rows, cols = (k + np.arange(n) for k, n in zip(start[1:], frames.shape[1:], strict=True))
        lowest = (rows[:, None] * n_cols + cols) * cube.shape[2]
        place = np.broadcast_to(lowest, frames.shape)[fired] + numbers.astype(np.int64) - first_bin
        np.add.at(cube.reshape(-1), place, dtype.type(1))
    require(f"triggers of {name}", 0, cube.shape[2] > 0, "n_bins, or frames in which a pixel fired")
    return cube


def stretches_of(
    file: IO[bytes],
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    request: ReadOptions,
    fortran_order: bool = False,
) -> tuple[Iterable[Stretch], tuple[int, int, int]]:
    """Frames from an open file, and their number, rows and columns.

    Parameters
    ----------
    file : file
        At the first number of an array, of which all the rest is read.
    shape : tuple of int
        Of that array.
    dtype : dtype
    request : ReadOptions
        May give the order of the axes.
    fortran_order : bool
        Whether the first axis of the array is the fastest.
    """
    order = request.order(AXES) or (0, 1, 2)
    n_pulses, n_rows, n_cols = (shape[axis] for axis in order)
    if fortran_order:
        shape, order = shape[::-1], tuple(2 - axis for axis in order)

    def read() -> Iterable[Stretch]:
        for box in boxes(shape, STRETCH):
            size = [part.stop - part.start for part in box]
            n_bytes = int(np.prod(size)) * dtype.itemsize
            with decoding("a frame"):
                frames = np.frombuffer(file.read(n_bytes), dtype).reshape(size)
            pulse, row, col = (box[axis].start for axis in order)
            yield (pulse, row, col), frames.transpose(order)

    return read(), (n_pulses, n_rows, n_cols)


def require_frames(shape: tuple[int, ...], dtype: np.dtype[Any], name: str) -> None:
    """Raise ``ValueError`` unless an array of that shape and type can be frames."""
    fits = len(shape) == 3 and min(shape) > 0 and dtype.kind in "iuf"
    wanted = "numbers of shape (pulse, row, col), none of them 0"
    require(name, f"{dtype} array of shape {shape}", fits, wanted)


def _more_bins(
    cube: NDArray[np.unsignedinteger], n_bins: int, name: str
) -> NDArray[np.unsignedinteger]:
    n_rows, n_cols, before = cube.shape
    remedy = "as no_trigger the value that stands where nothing fired"
    what = f"the cube of {name}, {n_bins:,} bins"
    require_fits(what, n_rows * n_cols * n_bins * cube.dtype.itemsize, remedy)
    wider = np.zeros((n_rows, n_cols, n_bins), cube.dtype)
    wider[:, :, :before] = cube
    return wider


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
