"""The counts of all sample files, and builders of NumPy and MATLAB files."""

from __future__ import annotations

import io
import random
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from core.acquisition import Acquisition
from core.io.readers.npz import FORMAT


def small_cube() -> NDArray[np.uint16]:
    """A cube with photons in the first and last of its 100 bins, and one empty pixel."""
    cube = np.random.default_rng(0).poisson(0.1, (3, 4, 100)).astype(np.uint16)
    cube[0, 0, 0] = cube[2, 3, 99] = 3
    cube[1, 2] = 0
    return cube


CUBE = small_cube()
CAMERA_CUBE = np.random.default_rng(4).poisson(0.1, (32, 32, 153)).astype(np.uint16)
ACQUISITION = Acquisition(100, 1e-9, 1e-6, 500, pixel_angle_rad=1e-3)


def cells_of(times: Sequence[Any], shape: tuple[int, int]) -> NDArray[np.object_]:
    """A cell array of column vectors, as MATLAB users keep arrival times."""
    cells = np.empty(shape, object)
    for pixel, values in enumerate(times):
        cells.flat[pixel] = np.reshape(values, (-1, 1))
    return cells


def arrival_cells(cube: NDArray[Any]) -> NDArray[np.object_]:
    """The photons of a cube, of 1 ns bins behind 1 µs, as picoseconds somewhere in their bins."""
    jitter = np.random.default_rng(1)
    times = [
        1_000_000 + 1000 * np.repeat(np.arange(row.size), row) + jitter.integers(1000)
        for row in cube.reshape(-1, cube.shape[2])
    ]
    return cells_of([t.astype(np.int32) for t in times], cube.shape[:2])


def frames_of(cube: NDArray[Any], n_pulses: int, no_trigger: int) -> NDArray[np.int32]:
    """Trigger bins (pulse, row, col) whose histogram is `cube`, in an order of each pixel's own."""
    rng = np.random.default_rng(2)
    frames = np.full((*cube.shape[:2], n_pulses), no_trigger, np.int32)
    for pixel in np.ndindex(cube.shape[:2]):
        bins = np.repeat(np.arange(cube.shape[2]), cube[pixel])
        frames[pixel][rng.permutation(n_pulses)[: bins.size]] = bins
    return np.ascontiguousarray(frames.transpose(2, 0, 1))


def gmapd_bytes(cube: NDArray[Any], n_pulses: int) -> bytes:
    """Frames as a Princeton Lightwave camera writes them: a header row, then the bin plus 4."""
    numbers = np.full((n_pulses, 33, 32), 7, "<u2")
    numbers[:, 1:] = frames_of(cube, n_pulses, -4) + 4
    return numbers.tobytes()


def npy_bytes(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def npz_bytes(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def mat_bytes(compressed: bool = False, **arrays: Any) -> bytes:
    file = io.BytesIO()
    savemat(file, arrays, do_compression=compressed)
    return file.getvalue()


# MATLAB's own byte layout, for files that SciPy cannot write.

UINT16, INT32, UINT32, MATRIX = 4, 5, 6, 14
CELL, UINT16_CLASS = 1, 11


def element(kind: int, payload: bytes) -> bytes:
    return struct.pack("<II", kind, len(payload)) + payload + bytes(-len(payload) % 8)


def matrix(array_class: int, dims: tuple[int, ...], name: bytes, body: bytes) -> bytes:
    flags = element(UINT32, struct.pack("<II", array_class, 0))
    shape = element(INT32, struct.pack(f"<{len(dims)}i", *dims))
    return element(MATRIX, flags + shape + element(1, name) + body)


def mat_file(variable: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM" + variable


PHOTON_CELL = matrix(UINT16_CLASS, (1, 1), b"", element(UINT16, struct.pack("<H", 5)))


OWN_FIELDS = {
    "format": FORMAT,
    "detection": "first",
    "cube": CUBE,
    "bin_width_s": 1e-9,
    "gate_delay_s": 1e-6,
    "n_pulses": 500,
    "pixel_angle_rad": 1e-3,
    "pulse_shape": "measured",
    "pulse_tau_s": 1e-9,
    "pulse_samples": np.array([1.0, 2.0, 1.0]),
    "truth_range_m": np.full((3, 4), 150.0),
}


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content with a few bytes changed, taken out, put in, or its end cut off."""
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 4])):
        place = rng.randrange(len(changed))
        kind = rng.random()
        if kind < 0.6:
            changed[place] = rng.randrange(256)
        elif kind < 0.8:
            word = rng.choice([0, 1, 14, 2**16, 2**31 - 1, 2**31, 2**32 - 1])
            changed[place : place + 4] = word.to_bytes(4, "little")
        elif kind < 0.87:
            changed[place:place] = rng.randbytes(4)
        elif kind < 0.94 and len(changed) > 100:
            del changed[place : place + 4]
        else:
            changed = changed[: max(place, 1)]
    return bytes(changed)
