"""Frames of the Princeton Lightwave camera, ``.bin``: 32 x 32 Geiger-mode pixels.

A frame is one pulse: a header row of 32 numbers, then 32 rows of 32, all little-endian uint16. 0
stands where nothing fired, any other number is the bin plus 4. The gate has 153 bins, of 250 ps
by default. Frames are counted as they are read, see `core.io.readers.frames`: the file may be
larger than memory. It has no signature: only its suffix identifies the format.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from core.capture import Capture
from core.checks import require
from core.io.readers.frames import AXES, STRETCH, Stretch, frames_capture
from core.io.readers.guards import decoding
from core.io.readers.options import ReadOptions

N_BINS = 153
BIN_WIDTH_S = 250e-12
FIRST_BIN = 4  # the number that stands for it
SIZE = 32

_FRAME = (SIZE + 1, SIZE)
_FRAME_BYTES = _FRAME[0] * _FRAME[1] * 2
_NO_TRIGGER = 0


def read(path: Path, request: ReadOptions) -> Capture:
    """Read the frames of a camera."""
    request.refuse(["variable"], "a .bin file holds frames alone")
    request.refuse(["no_trigger"], "0 stands where nothing fired")
    order = request.order(AXES) or (0, 1, 2)
    pulses_first = "the pulse first, 'pulse row col' or 'pulse col row'"
    require("axes", request.axes, order[0] == 0, pulses_first)
    size = path.stat().st_size
    whole = f"a multiple of {_FRAME_BYTES}, whole frames of a 32 x 32 camera with a header row each"
    require("bytes of the file", size, size > 0 and size % _FRAME_BYTES == 0, whole)
    n_pulses = size // _FRAME_BYTES
    return frames_capture(
        _stretches(path, order, n_pulses),
        (n_pulses, SIZE, SIZE),
        _NO_TRIGGER,
        "the frames",
        path.name,
        replace(request, n_bins=request.n_bins or N_BINS),
        first_bin=FIRST_BIN,
        bin_width_s=BIN_WIDTH_S,
    )


def _stretches(path: Path, order: tuple[int, ...], n_pulses: int) -> Iterator[Stretch]:
    most = max(1, STRETCH // (_FRAME[0] * _FRAME[1]))
    with path.open("rb") as file:
        for pulse in range(0, n_pulses, most):
            n_frames = min(most, n_pulses - pulse)
            with decoding("a frame"):
                data = np.frombuffer(file.read(n_frames * _FRAME_BYTES), "<u2")
                frames = data.reshape(n_frames, *_FRAME)[:, 1:]
            yield (pulse, 0, 0), frames.transpose(order)
