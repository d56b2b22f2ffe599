"""Becker & Hickl ``.sdt``: images of TCSPC histograms, as SPCM saves them.

A file holds one block or several, one for each detector or measurement; ``variable`` picks one,
such as ``"block 0"``. A block is an image (row, col, bin), or curves of one pixel each, which make
an image of one row; the images of several routing channels in one block are summed. The bin's width
follows from the measurement's TAC range and gain. The gate opens with the pulse by default.
All photons of a pulse count.

`sdtfile` reads the blocks in an isolated process (`core.io.readers.isolation`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, cube_capture, with_guesses
from core.io.readers.guards import require_fits
from core.io.readers.isolation import isolated
from core.io.readers.options import ReadOptions, choose_variable

_HISTOGRAMS = {0x00: "decay curves", 0x10: "pages", 0x60: "an image"}
_CONTENT = 0xF0
_VALID_AT, _VALID = 32, b"\x55\x55"


def recognizes(start: bytes) -> bool:
    """Return whether a file starts with a valid header of Becker & Hickl."""
    return start[_VALID_AT : _VALID_AT + 2] == _VALID


def read(path: Path, request: ReadOptions) -> Capture:
    """Read the histograms of a block."""
    listed, _ = isolated(path, "the list of blocks", "list_sdt")
    block = _choose(listed["types"], request.variable)
    name = f"block {block}"
    _, (histograms, times) = isolated(path, name, "read_sdt", block=block)
    # The format's numbers of 4 bytes: the shortest one in decimals is what was meant.
    bin_width_s = float(str(np.float32(times[1]))) if times.size > 1 else 0.0
    if request.bin_width_s is None:
        accepted = "a positive one, by bin_width_s"
        require(f"bin width of {name}", bin_width_s, 0 < bin_width_s < 1, accepted)
    known = replace(
        request,
        bin_width_s=request.bin_width_s or bin_width_s,
        detection=request.detection or "all",
    )
    cube = _image(histograms, name)
    capture = cube_capture(cube, name, f"{path.name}, {name}", known, axes=" ".join(AXES))
    return with_guesses(capture, variable=name)


def _choose(types: list[int], variable: str | None) -> int:
    """Return the number of the requested block, or of the only one that holds histograms."""
    kinds = [_HISTOGRAMS.get(kind & _CONTENT) for kind in types]
    fitting = {f"block {number}": number for number, kind in enumerate(kinds) if kind}
    listed = ", ".join(f"{name} ({kinds[number]})" for name, number in fitting.items()) or "none"
    whole = dict.fromkeys(fitting, True)
    return fitting[choose_variable(variable, fitting, whole, "a block with histograms", listed)]


def _image(data: NDArray[Any], name: str) -> NDArray[Any]:
    """Return counts (row, col, bin) of a block: curves as one row, routing channels summed."""
    fits = 2 <= data.ndim <= 5 and data.size > 0
    require(f"shape of {name}", data.shape, fits, "curves, or images of them")
    if data.ndim == 2:
        return data[np.newaxis]
    if data.ndim == 3:
        return data
    kind = np.float64 if data.dtype.kind == "f" else np.uint64
    require_fits(name, data[(0,) * (data.ndim - 3)].size * np.dtype(kind).itemsize)
    return np.asarray(data.sum(axis=tuple(range(data.ndim - 3)), dtype=kind))
