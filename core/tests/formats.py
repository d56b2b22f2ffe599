"""The same counts in every file format: samples for the contract of the readers.

A new format is one entry of `FORMATS`; `test_readers.py` then checks it by the contract, damages
its bytes, and requires an entry for each suffix of `core.io.readers.READERS`.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, issparse

from core.acquisition import Acquisition, Pulse
from core.capture import Capture
from core.io.readers.labelled import dataset
from core.tests.instruments import (
    COMPRESSED,
    IMAGE,
    UINT32,
    ptu_bytes,
    sdt_bytes,
    split,
    tmf8820_bytes,
    tmf8829_bytes,
)
from core.tests.labelled_files import Matlab73, hdf5_bytes, netcdf_bytes, zarr_files
from core.tests.samples import (
    ACQUISITION,
    CAMERA_CUBE,
    CUBE,
    OWN_FIELDS,
    arrival_cells,
    frames_of,
    gmapd_bytes,
    mat_bytes,
    mutated,
    npy_bytes,
    npz_bytes,
)

Content = bytes | Mapping[str, bytes]
"""Content of a file; or, by their paths, of the files of a directory."""


CUBES_REFUSE = (
    {"n_bins": 99},
    {"time_unit_s": 1e-12},
    {"no_trigger": 0},
    {"shape": (3, 4)},
    {"first_detections": 7},
    {"records": 0},
)
ARRAYS_REFUSE = tuple(each for each in CUBES_REFUSE if "no_trigger" not in each)
SEQUENCES_REFUSE = tuple(each for each in CUBES_REFUSE if "records" not in each)
FRAMES_REFUSE = (
    {"n_bins": 50},
    {"n_pulses": 499},
    {"time_unit_s": 1e-12},
    {"shape": (3, 4)},
    {"first_detections": 7},
    {"records": 500},
    {"records": (3, 500)},
)
TIMES_REFUSE = ({"no_trigger": 0}, {"shape": (3, 4)}, {"records": 0})


@dataclass(frozen=True)
class Format:
    """A file that holds counts, and the expected result of reading it.

    Parameters
    ----------
    name : str
        Name of the file.
    build : callable
        Returns the file's content, or the contents of a directory's files.
    cube : ndarray, shape (row, col, bin)
        Expected counts.
    acquisition : Acquisition
        Passed to the reader so that nothing is left to guess; a guessed bin width must equal its.
    needs : dict
        Arguments without which the file cannot be read.
    given : dict
        Arguments that leave nothing to guess, with acquisition, pulse and ``detection="first"``.
    guesses : tuple of str
        Guesses that the source must list where only `needs` is passed; empty if there are none.
    refuses : tuple of dict
        Arguments that do not apply to this file; the first of each must be named.
    n_damaged : int
        Number of damaged copies that the test reads.
    """

    name: str
    build: Callable[[], Content]
    cube: NDArray[Any] = field(default_factory=lambda: CUBE)
    acquisition: Acquisition = ACQUISITION
    needs: Mapping[str, Any] = field(default_factory=dict)
    given: Mapping[str, Any] = field(default_factory=lambda: {"axes": "row col bin"})
    guesses: tuple[str, ...] = ("bin width 1 ns",)
    refuses: Sequence[Mapping[str, Any]] = CUBES_REFUSE
    n_damaged: int = 10


def put(path: Path, content: Content) -> Path:
    """Write a file, or a directory of files."""
    if isinstance(content, bytes):
        path.write_bytes(content)
        return path
    for name, part in content.items():
        file = path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(part)
    return path


def damaged(content: Content, rng: random.Random) -> Content:
    """Damage the content of a file, or one file of a directory, which may also be lost."""
    if isinstance(content, bytes):
        return mutated(content, rng)
    name = rng.choice(sorted(content))
    rest = {key: part for key, part in content.items() if key != name}
    return rest if rng.random() < 0.05 else {**rest, name: mutated(content[name], rng)}


CELLS: dict[str, Any] = {
    "given": {"axes": "row col", "time_unit_s": 1e-12},
    "guesses": ("time unit 1 ps", "bin width 1 ns"),
    "refuses": TIMES_REFUSE,
}

FRAMES: dict[str, Any] = {
    "given": {"axes": "pulse row col"},
    "refuses": FRAMES_REFUSE,
}

FORMATS: dict[str, Format] = {
    "own layout": Format(
        "capture.npz",
        lambda: npz_bytes(**OWN_FIELDS),
        guesses=(),
        refuses=(*CUBES_REFUSE, {"stop_s": 1e-6}),
    ),
    "npz with a bare cube": Format("c.npz", lambda: npz_bytes(cube=CUBE.astype(np.int64))),
    "npz of other names": Format(
        "c.npz", lambda: npz_bytes(counts=CUBE, depth=np.ones((3, 4))), refuses=ARRAYS_REFUSE
    ),
    "npy": Format("capture.NPY", lambda: npy_bytes(CUBE), refuses=ARRAYS_REFUSE),
    "npy of floats, Fortran order": Format(
        "c.npy", lambda: npy_bytes(np.asfortranarray(CUBE * 1.0)), refuses=ARRAYS_REFUSE
    ),
    "npy, big-endian bytes": Format(
        "c.npy", lambda: npy_bytes(CUBE.astype(">i4")), refuses=ARRAYS_REFUSE
    ),
    "npy of frames": Format(
        "c.npy", lambda: npy_bytes(frames_of(CUBE, 500, -1)), needs={"no_trigger": -1}, **FRAMES
    ),
    "npy of frames, Fortran order": Format(
        "c.npy",
        lambda: npy_bytes(np.asfortranarray(frames_of(CUBE, 500, 255).astype(np.uint8))),
        needs={"no_trigger": 255},
        **FRAMES,
    ),
    "npz of frames": Format(
        "c.npz", lambda: npz_bytes(frames=frames_of(CUBE, 500, -1), no_trigger=-1), **FRAMES
    ),
    "frames of a Princeton Lightwave camera": Format(
        "c.bin",
        lambda: gmapd_bytes(CAMERA_CUBE, 500),
        cube=CAMERA_CUBE,
        acquisition=Acquisition(153, 250e-12, 1e-6, 500, pixel_angle_rad=1e-3),
        given={"axes": "pulse row col"},
        guesses=("bin width 250 ps", "gate 0-38.25 ns"),
        refuses=(*FRAMES_REFUSE, {"no_trigger": 0}),
    ),
    "mat cells": Format("c.mat", lambda: mat_bytes(Ts=arrival_cells(CUBE), SBR=0.3), **CELLS),
    "mat cells, compressed": Format(
        "c.mat", lambda: mat_bytes(True, Ts=arrival_cells(CUBE)), **CELLS
    ),
    "mat cube": Format("c.mat", lambda: mat_bytes(note="a", counts=CUBE, SBR=0.3)),
    "mat cube of doubles": Format("c.mat", lambda: mat_bytes(True, counts=CUBE * 1.0)),
}

# Files of instruments give the bin width, except those of the TMF8820 and TMF8829.
GATE = {"guesses": ("gate 0-100 ns", "pulse Gaussian of 1 ns")}
ONE_FRAME = {"refuses": (*SEQUENCES_REFUSE, {"records": 1}, {"records": (0, 1)})}
TWO_FRAMES = {"refuses": (*SEQUENCES_REFUSE, {"records": 2}, {"records": (0, 2)})}
FORMATS |= {
    "ptu": Format("c.ptu", lambda: ptu_bytes(CUBE), **GATE, **ONE_FRAME),
    "ptu of frames and channels": Format(
        "c.ptu", lambda: ptu_bytes(split(CUBE)), guesses=("gate 0-100 ns",), **TWO_FRAMES
    ),
    "sdt": Format("c.sdt", lambda: sdt_bytes(CUBE), **GATE),
    "sdt, compressed": Format(
        "c.sdt", lambda: sdt_bytes(CUBE, kind=IMAGE | UINT32 | COMPRESSED), **GATE
    ),
    "tmf8820": Format(
        "c.json",
        lambda: tmf8820_bytes(CUBE),
        acquisition=replace(ACQUISITION, bin_width_s=91e-12),
        guesses=("bin width 91 ps", "zero range 1.1 ns after the first bin"),
        refuses=(*SEQUENCES_REFUSE, {"records": 3}, {"records": (0, 3)}),
    ),
    "tmf8829": Format(
        "c.json",
        lambda: tmf8829_bytes(CUBE),
        acquisition=replace(ACQUISITION, bin_width_s=820e-12),
        guesses=("bin width 820 ps", "zero range 2.87 ns after the first bin"),
        refuses=(*SEQUENCES_REFUSE, {"records": 3}, {"records": (0, 3)}),
    ),
}


def known() -> Any:
    """The counts with all metadata."""
    return dataset(Capture(CUBE.copy(), ACQUISITION, Pulse.gaussian(2e-9)))


def bare() -> Any:
    """The counts with names for their axes, and nothing else."""
    import xarray as xr  # noqa: PLC0415

    return xr.Dataset({"counts": (("row", "col", "bin"), CUBE)})


def matlab73(**variables: Any) -> bytes:
    """A file of MATLAB 7.3 with cells, sparse matrices and numbers."""
    file = Matlab73()
    for name, value in variables.items():
        if isinstance(value, str):
            file.text(name, value)
        elif issparse(value):
            file.sparse(name, value)
        elif np.asarray(value).dtype == object:
            file.cells(name, value)
        else:
            file.number(name, value)
    return file.bytes()


def list_of(cube: Any) -> Any:
    """A cube as a sparse matrix (pixel, bin) of doubles, the pixels column by column."""
    return csc_array(cube.transpose(1, 0, 2).reshape(-1, cube.shape[2]).astype(float))


SPARSE: dict[str, Any] = {
    "needs": {"shape": (3, 4)},
    "given": {"axes": "col row"},
    "guesses": ("pixels column by column", "bin width 1 ns"),
    "refuses": (
        {"n_bins": 99},
        {"time_unit_s": 1e-12},
        {"no_trigger": 0},
        {"shape": (4, 4)},
        {"first_detections": 7},
        {"records": 0},
    ),
}
OWN: dict[str, Any] = {"guesses": ()}
GZIP: dict[str, Any] = {"chunks": (2, 3, 64), "compression": "gzip", "shuffle": True}

# Damaged HDF5 often ends the process that reads it, which takes long: fewer copies.
FORMATS |= {
    "mat sparse": Format("c.mat", lambda: mat_bytes(spad=list_of(CUBE), bins=100.0), **SPARSE),
    "mat sparse, compressed": Format(
        "c.mat", lambda: mat_bytes(True, spad=list_of(CUBE)), **SPARSE
    ),
    "mat 7.3 cells": Format(
        "c.mat", lambda: matlab73(Ts=arrival_cells(CUBE), SBR=0.3, note="a"), **CELLS, n_damaged=2
    ),
    "mat 7.3 cube of doubles": Format("c.mat", lambda: matlab73(counts=CUBE * 1.0), n_damaged=2),
    "mat 7.3 sparse": Format("c.mat", lambda: matlab73(spad=list_of(CUBE)), **SPARSE, n_damaged=2),
    "hdf5": Format("c.h5", lambda: hdf5_bytes(cube=CUBE, note=np.ones(3)), n_damaged=2),
    "hdf5, compressed": Format(
        "c.hdf5", lambda: hdf5_bytes(c={"data": CUBE, "fletcher32": True, **GZIP}), n_damaged=2
    ),
    "hdf5 by LZF, behind a user block": Format(
        "c.hdf5",
        lambda: hdf5_bytes(1024, c={"data": CUBE, "chunks": (2, 3, 64), "compression": "lzf"}),
        n_damaged=2,
    ),
    "hdf5 of floats, big-endian": Format(
        "c.h5", lambda: hdf5_bytes(c=CUBE.astype(">f8")), n_damaged=2
    ),
    "netCDF": Format("c.nc", lambda: netcdf_bytes(bare()), n_damaged=2),
    "netCDF-3": Format(
        "c.nc", lambda: bytes(bare().astype("i4").to_netcdf(engine="scipy")), n_damaged=20
    ),
    "zarr 2": Format("c.zarr", lambda: zarr_files(bare(), 2, chunks=(2, 3, 64))),
    "zarr 3": Format("c.zarr", lambda: zarr_files(bare(), 3, chunks=(2, 3, 64))),
    "own layout in netCDF": Format("c.nc", lambda: netcdf_bytes(known()), **OWN, n_damaged=2),
    "own layout in Zarr": Format("c.zarr", lambda: zarr_files(known(), 3), **OWN),
}
