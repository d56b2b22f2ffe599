"""One contract for every reader; the guesses; what must be refused; and the way back to a file."""

from __future__ import annotations

import gzip
import io
import os
import random
import shutil
import struct
import tempfile
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from core.acquisition import Acquisition, Pulse
from core.capture import Capture, CaptureError
from core.io.readers import MAX_CUBE_BYTES, SUFFIXES, guards, read_capture
from core.io.writers import save_capture
from core.tests.formats import FORMATS, Format, damaged, put
from core.tests.refusing import assert_refused
from core.tests.samples import (
    ACQUISITION,
    CELL,
    CUBE,
    MATRIX,
    OWN_FIELDS,
    UINT16_CLASS,
    arrival_cells,
    cells_of,
    element,
    mat_bytes,
    mat_file,
    matrix,
    npy_bytes,
    npz_bytes,
    photon_cell,
)

pytestmark = pytest.mark.files

Builder = Callable[[], bytes]


def cell_bytes(values: list[Any]) -> bytes:
    """A file with one row of cells, one photon each."""
    return mat_bytes(Ts=cells_of([[value] for value in values], (1, len(values))))


def test_every_reader_is_under_the_contract() -> None:
    tested = {Path(kept.name).suffix.lower() for kept in FORMATS.values()}
    assert tested | {".gz"} == set(SUFFIXES)
    assert all(SUFFIXES.values())


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[Format], Path]:
    return lambda kept: put(tmp_path / kept.name, kept.build())


@pytest.mark.parametrize("kind", FORMATS)
def test_contract_nothing_to_guess(kind: str, saved: Callable[[Format], Path]) -> None:
    kept = FORMATS[kind]
    told: dict[str, Any] = {
        name: getattr(kept.acquisition, name)
        for name in ("bin_width_s", "gate_delay_s", "n_bins", "n_pulses", "pixel_angle_rad")
    }
    pulse = Pulse.gaussian(2e-9)
    told |= {"detection": "first", "pulse": pulse, **kept.needs, **kept.told}
    capture = read_capture(saved(kept), **told)
    np.testing.assert_array_equal(capture.cube, kept.cube)
    assert capture.cube.dtype == np.uint16 and capture.cube.dtype.isnative
    assert capture.cube.flags.c_contiguous and not capture.cube.flags.writeable
    assert capture.acquisition == kept.acquisition
    assert capture.pulse == pulse
    assert capture.detection == "first"
    assert capture.source.startswith(kept.name) and "guessed" not in capture.source


@pytest.mark.parametrize("kind", FORMATS)
def test_contract_everything_guessed(kind: str, saved: Callable[[Format], Path]) -> None:
    kept = FORMATS[kind]
    capture = read_capture(saved(kept), **kept.needs)
    np.testing.assert_array_equal(capture.cube, kept.cube)
    assert capture.acquisition.bin_width_s == pytest.approx(kept.acquisition.bin_width_s)
    assert ("guessed: " in capture.source) == bool(kept.guesses)
    for guessed in kept.guesses:
        assert guessed in capture.source


@pytest.mark.parametrize("kind", FORMATS)
def test_contract_content_determines_the_format(kind: str, tmp_path: Path) -> None:
    kept, content = FORMATS[kind], FORMATS[kind].build()
    if isinstance(content, bytes):
        (tmp_path / f"{kept.name}.gz").write_bytes(gzip.compress(content))
        capture = read_capture(tmp_path / f"{kept.name}.gz", **kept.needs)
        np.testing.assert_array_equal(capture.cube, kept.cube)
    if not kept.name.endswith(".bin"):  # which has no signature
        capture = read_capture(put(tmp_path / "other.name", content), **kept.needs)
        np.testing.assert_array_equal(capture.cube, kept.cube)


@pytest.mark.parametrize("kind", FORMATS)
def test_contract_arguments_that_do_not_fit(kind: str, saved: Callable[[Format], Path]) -> None:
    kept = FORMATS[kind]
    path = saved(kept)
    refused: list[Mapping[str, Any]] = [
        {"variable": "absent"},
        {"bin_width_s": 0.0},
        {"gate_delay_s": np.nan},
        {"n_bins": 0},
        {"n_bins": 1.5},
        {"n_pulses": -1},
        {"pixel_angle_rad": 2.0},
        {"time_unit_s": -1.0},
        {"stop_s": np.inf},
        {"detection": "some"},
        {"axes": "row col row"},
        {"first_detections": 0},
        {"no_trigger": 0.5},
        {"shape": (3, 0)},
        *kept.refuses,
    ]
    for arguments in refused:
        (field, value), *_ = arguments.items()
        with pytest.raises(CaptureError, match=field) as caught:
            read_capture(path, **{**kept.needs, **arguments})
        assert str(caught.value).startswith(f"{kept.name}: ")
        assert str(value) in str(caught.value)


def test_own_layout_keeps_every_field(write: Callable[[str, bytes], Path]) -> None:
    capture = read_capture(write("capture.npz", npz_bytes(**OWN_FIELDS)))
    assert capture.acquisition == ACQUISITION
    assert capture.pulse == Pulse.measured([1, 2, 1], 1e-9)
    assert capture.truth_range_m is not None and capture.signal is None
    assert capture.source == "capture.npz, variable cube"


def test_own_layout_says_what_it_lacks(write: Callable[[str, bytes], Path]) -> None:
    path = write("a.npz", npz_bytes(cube=CUBE, bin_width_s=5e-10, n_pulses=0, source="a wall"))
    capture = read_capture(path, gate_delay_s=2e-7)
    assert capture.acquisition.n_pulses is None
    assert capture.pulse == Pulse()
    assert capture.source == "a wall; guessed: pulse gamma of 1 ns, all photons of a pulse"


def test_variable_chooses(write: Callable[[str, bytes], Path]) -> None:
    for name, content in {
        "two.npz": npz_bytes(night=CUBE, day=2 * CUBE),
        "two.mat": mat_bytes(night=arrival_cells(CUBE), day=2 * CUBE),
    }.items():
        path = write(name, content)
        with pytest.raises(CaptureError, match=r"night, day.* variable .*night.*day"):
            read_capture(path)
        capture = read_capture(path, variable="day")
        np.testing.assert_array_equal(capture.cube, 2 * CUBE)
        assert "variable day" in capture.source


def test_large_counts_widen_the_cube(write: Callable[[str, bytes], Path]) -> None:
    many = CUBE.astype(np.uint32) * 40_000
    capture = read_capture(write("many.npy", npy_bytes(many)))
    assert capture.cube.dtype == np.uint32
    np.testing.assert_array_equal(capture.cube, many)
    photons = cells_of([[200_000] * 70_000, [300_000]], (1, 2))
    capture = read_capture(write("many.mat", mat_bytes(Ts=photons)))
    assert capture.cube.dtype == np.uint32 and capture.cube[0, 0, 0] == 70_000


# -- guesses for arrival times ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "unit_s", "told", "acquisition", "guessed"),
    [
        # 200 ns of picoseconds: 1 ns bins, the gate rounded down to one of them.
        (
            [4_430_001, 4_629_999],
            1e-12,
            {},
            Acquisition(200, 1e-9, 4.43e-6, None),
            "time unit 1 ps, bin width 1 ns, gate 4430-4630 ns, pulse Gaussian of 1 ns",
        ),
        # Native bins: 7001 of 8 ps need 64 ps for at most 1024.
        (
            [1000, 8000],
            8e-12,
            {},
            Acquisition(876, 64e-12, 8e-9, None),
            "time unit 8 ps, bin width 64 ps, gate 8-64.064 ns, pulse Gaussian of 64 ps",
        ),
        (
            [4.43e-6, 4.6295e-6],
            1.0,
            {},
            Acquisition(200, 1e-9, 4.43e-6, None),
            "time unit 1 s, bin width 1 ns, gate 4430-4630 ns, pulse Gaussian of 1 ns",
        ),
        # A unit that 1 ns is no multiple of.
        (
            [0, 1999],
            300e-12,
            {"time_unit_s": 300e-12},
            Acquisition(667, 900e-12, 0.0, None),
            "bin width 900 ps, gate 0-600.3 ns, pulse Gaussian of 900 ps",
        ),
        # All in one bin.
        (
            [7, 7],
            8e-12,
            {},
            Acquisition(1, 8e-12, 56e-12, None),
            "time unit 8 ps, bin width 8 ps, gate 0.056-0.064 ns, pulse Gaussian of 8 ps",
        ),
        (
            [4_430_001, 4_629_999],
            1e-12,
            {"gate_delay_s": 4.4e-6, "pulse": Pulse()},
            Acquisition(230, 1e-9, 4.4e-6, None),
            "time unit 1 ps, bin width 1 ns, 230 bins",
        ),
        # 1 ns would need 200 bins.
        (
            [4_430_001, 4_629_999],
            1e-12,
            {"n_bins": 100, "n_pulses": 9, "time_unit_s": 1e-12},
            Acquisition(100, 2048e-12, 2163 * 2048e-12, 9),
            "bin width 2.048 ns, gate 4429.82-4634.62 ns",
        ),
        (
            [279.5, 281.25],
            1e-9,
            {"time_unit_s": 1e-9, "bin_width_s": 0.5e-9, "gate_delay_s": 279e-9},
            Acquisition(5, 0.5e-9, 279e-9, None),
            "5 bins, pulse Gaussian of 500 ps",
        ),
    ],
)
def test_guesses(
    values: list[float],
    unit_s: float,
    told: dict[str, Any],
    acquisition: Acquisition,
    guessed: str,
    write: Callable[[str, bytes], Path],
) -> None:
    capture = read_capture(write("t.mat", cell_bytes(values)), **told)
    assert f"; guessed: {guessed}" in capture.source
    found = capture.acquisition
    assert (found.n_bins, found.n_pulses) == (acquisition.n_bins, acquisition.n_pulses)
    assert found.bin_width_s == pytest.approx(acquisition.bin_width_s, rel=1e-12)
    assert found.gate_delay_s == pytest.approx(acquisition.gate_delay_s, rel=1e-12)
    # Each photon lies in the bin that covers its time.
    assert capture.cube.sum() == len(values)
    bins = capture.cube.argmax(axis=2).ravel()
    late = (np.array(values) * unit_s - found.gate_delay_s) / found.bin_width_s - bins
    assert np.all(late > -1e-6) and np.all(late < 1 + 1e-6)


def test_rounding_of_seconds_moves_no_photon(write: Callable[[str, bytes], Path]) -> None:
    """Times that fall on the edges of bins stay in the bin that they open."""
    seconds = [k * 1e-9 for k in range(1, 301)]
    capture = read_capture(write("s.mat", cell_bytes(seconds)))
    np.testing.assert_array_equal(capture.cube[0].argmax(axis=1), np.arange(300))


def test_photons_outside_a_given_gate_are_dropped(write: Callable[[str, bytes], Path]) -> None:
    path = write("d.mat", cell_bytes([200_000, 250_000, 260_999, 261_000, 300_000]))
    capture = read_capture(path, gate_delay_s=250e-9, n_bins=11, bin_width_s=1e-9)
    assert capture.cube.sum() == 2
    assert capture.cube[0, 1, 0] == 1 and capture.cube[0, 2, 10] == 1
    assert "dropped: 3 of 5 photons, outside the gate" in capture.source
    with pytest.raises(CaptureError, match=r"200 ns to 300 ns.* gate_delay_s"):
        read_capture(path, gate_delay_s=1e-6)


FEW = [4_430_100, 4_430_200, 4_629_900]
ECHO = [*range(4_430_000, 4_630_000, 1000)]
"""Picoseconds: 3 and 200 photons in a gate of 200 ns, 4.43 µs after the pulse."""


def gate_of(capture: Capture) -> tuple[int, float, float]:
    """Bins, their width in nanoseconds, and the opening of the gate in nanoseconds."""
    found = capture.acquisition
    return found.n_bins, round(found.bin_width_s * 1e9, 6), round(found.gate_delay_s * 1e9, 6)


@pytest.mark.parametrize("stray", [10**9, 10**12, 4_430_000 + 2**16 * 1000, 2**52])
def test_a_stray_photon_does_not_stretch_the_gate(
    stray: int, write: Callable[[str, bytes], Path]
) -> None:
    capture = read_capture(write("s.mat", cell_bytes([*ECHO, stray])))
    assert gate_of(capture) == (200, 1.0, 4430.0)
    assert "; dropped: 1 of 201 photons, outside the gate" in capture.source
    np.testing.assert_array_equal(
        capture.cube[0, :-1], read_capture(write("e.mat", cell_bytes(ECHO))).cube[0]
    )


def test_a_stray_photon_before_the_others_does_not_open_the_gate(
    write: Callable[[str, bytes], Path],
) -> None:
    late = [time + 10**9 for time in ECHO]
    capture = read_capture(write("s.mat", cell_bytes([1, *late])))
    assert gate_of(capture) == (200, 1.0, 1_004_430.0)
    assert "dropped: 1 of 201" in capture.source
    with_bins = read_capture(write("s.mat", cell_bytes([1, *late])), n_bins=100)
    assert gate_of(with_bins)[:2] == (100, 2.048) and with_bins.cube.sum() == 200


@pytest.mark.parametrize(
    ("values", "n_bins"),
    [
        ([*ECHO * 5, 4_430_000 + 60_000_000], 60_001),  # one in a thousand, 9 km behind
        ([*ECHO * 99, *[time + 30_000_000 for time in ECHO]], 30_200),  # one pixel in a hundred
        ([*FEW, 4_430_000 + 60_000_000], 60_001),
        ([0, 65_535_999], 65_536),
    ],
)
def test_a_sparse_far_echo_stays_in_the_gate(
    values: list[int], n_bins: int, write: Callable[[str, bytes], Path]
) -> None:
    capture = read_capture(write("f.mat", mat_bytes(Ts=cells_of([values], (1, 1)))))
    assert gate_of(capture)[:2] == (n_bins, 1.0)
    assert capture.cube.sum() == len(values) and "dropped" not in capture.source


@pytest.mark.parametrize(
    ("values", "told", "gate"),
    [
        # Half of the photons are no strays.
        ([1e-3 - 1e-9, 1e-12], {}, (61_036, 16.384, 0.0)),
        ([1e8, 1], {}, (48_829, 2.048, 0.0)),
        # Everywhere in 100 µs.
        (list(range(0, 10**8, 10**6)), {}, (48_340, 2.048, 0.0)),
        # What is told is taken as it is.
        ([1e8, 1], {"n_bins": 200_000}, (200_000, 1.0, 0.0)),
        ([1e8, 1], {"bin_width_s": 1e-9}, (100_001, 1.0, 0.0)),
        ([*ECHO, 10**9], {"bin_width_s": 1e-6}, (997, 1000.0, 4000.0)),
        ([*ECHO, 10**9], {"gate_delay_s": 4e-6}, (630, 1.0, 4000.0)),
        ([1, *ECHO], {"gate_delay_s": 4e-6}, (630, 1.0, 4000.0)),
    ],
)
def test_wide_gates_have_wider_bins(
    values: list[float],
    told: dict[str, Any],
    gate: tuple[int, float, float],
    write: Callable[[str, bytes], Path],
) -> None:
    assert gate_of(read_capture(write("w.mat", cell_bytes(values)), **told)) == gate


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"n_bins": 10**9}, r"n_bins = 1000000000 .*1 to 16,777,216"),
        ({"bin_width_s": 1e-15}, r"bins of Ts = 99999999001 .*larger bin_width_s"),
        ({"time_unit_s": 1e-9, "bin_width_s": 1e-18}, r"bin_width_s = 1e-18 .*unit .* 1 ns"),
        ({"time_unit_s": 1e-6}, r"gate of Ts = '100\.\d* s' .*another time_unit_s"),
    ],
)
def test_gates_of_too_many_bins_are_refused(
    told: dict[str, Any], message: str, write: Callable[[str, bytes], Path]
) -> None:
    path = write("g.mat", cell_bytes([10**8, 1]))
    assert_refused(lambda path: read_capture(path, **told), path, message, CaptureError, 2**22)


def test_a_cube_of_too_many_bins_is_refused(write: Callable[[str, bytes], Path]) -> None:
    path = write("b.npy", npy_bytes(np.zeros((1, 1, 2**24 + 1), np.uint8)))
    with pytest.raises(CaptureError, match=r"bins of the array = 16777217 .*16,777,216"):
        read_capture(path)


def test_axes_are_turned_as_told(write: Callable[[str, bytes], Path]) -> None:
    turned = read_capture(write("t.npy", npy_bytes(CUBE.transpose(2, 1, 0))), axes="bin, col row")
    np.testing.assert_array_equal(turned.cube, CUBE)
    told = {"bin_width_s": 1e-9, "gate_delay_s": 1e-6, "n_bins": 100}
    cells = arrival_cells(CUBE.transpose(1, 0, 2))
    turned = read_capture(write("t.mat", mat_bytes(Ts=cells)), axes="col row", **told)
    np.testing.assert_array_equal(turned.cube, CUBE)
    guessed = read_capture(write("g.npy", npy_bytes(CUBE)))
    assert "guessed: axes (row, col, bin), bin width 1 ns" in guessed.source


def test_common_stop_counts_backwards(write: Callable[[str, bytes], Path]) -> None:
    """Recorded is the time left to a stop 1.1 µs after the pulse."""
    forwards = read_capture(write("f.npy", npy_bytes(CUBE)), gate_delay_s=1e-6)
    backwards = read_capture(write("b.npy", npy_bytes(CUBE[:, :, ::-1])), stop_s=1.1e-6)
    np.testing.assert_array_equal(backwards.cube, forwards.cube)
    assert backwards.acquisition.gate_delay_s == pytest.approx(1e-6, rel=1e-12)
    cells = arrival_cells(CUBE)
    for cell in np.ndindex(cells.shape):
        cells[cell] = 1_100_000 - 1 - cells[cell]
    told = {"time_unit_s": 1e-12, "bin_width_s": 1e-9, "n_bins": 100, "gate_delay_s": 1e-6}
    times = read_capture(write("t.mat", mat_bytes(Ts=cells)), stop_s=1.1e-6, **told)
    np.testing.assert_array_equal(times.cube, forwards.cube)
    with pytest.raises(CaptureError, match=r"stop_s = 5e-08 .*at least the largest time"):
        read_capture(write("t.mat", mat_bytes(Ts=cells)), stop_s=5e-8, **told)


def test_first_detections_are_those_first_in_the_file(write: Callable[[str, bytes], Path]) -> None:
    cells = cells_of([[5, 3, 9, 3], [], [7]], (1, 3))
    capture = read_capture(write("f.mat", mat_bytes(Ts=cells)), first_detections=2, n_bins=10)
    np.testing.assert_array_equal(capture.counts, [[2, 0, 1]])
    assert set(np.flatnonzero(capture.cube[0, 0])) == {0, 2}  # the gate opens at 3


def test_first_photons_are_guessed_where_pulses_allow(write: Callable[[str, bytes], Path]) -> None:
    path = write("d.npy", npy_bytes(CUBE))
    most = int(CUBE.sum(axis=2).max())
    assert read_capture(path).detection == "all"
    assert read_capture(path, n_pulses=most).detection == "first"
    assert read_capture(path, n_pulses=most - 1).detection == "all"
    assert "first photons only" in read_capture(path, n_pulses=most).source
    with pytest.raises(CaptureError, match=f"counts = {most} "):
        read_capture(path, n_pulses=most - 1, detection="first")


def test_row_vectors_scalars_and_empty_cells(write: Callable[[str, bytes], Path]) -> None:
    cells = np.empty((2, 2), object)
    cells[:] = [[np.array([[10, 11]]), np.array([[]])], [np.array(12), np.zeros((0, 0))]]
    capture = read_capture(write("v.mat", mat_bytes(Ts=cells)))
    np.testing.assert_array_equal(capture.counts, [[2, 0], [1, 0]])


# -- MATLAB's own byte layout, for what SciPy cannot write -----------------------------------------


def nested_cells(depth: int) -> bytes:
    """A cell in a cell in a cell: SciPy alone ends the process at some ten thousand of them."""
    outer = matrix("<", CELL, (1, 1), b"", b"")
    inner = len(photon_cell("<", 5))
    sizes = inner + len(outer) * np.arange(depth)
    layers = (outer[:4] + struct.pack("<I", size + len(outer) - 8) + outer[8:] for size in sizes)
    return b"".join(reversed(list(layers))) + photon_cell("<", 5)


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_byte_orders(order: str, write: Callable[[str, bytes], Path]) -> None:
    cells = photon_cell(order, 5, 7) + photon_cell(order, 6) + element(order, MATRIX, b"")
    content = mat_file(order, matrix(order, CELL, (1, 3), b"Ts", cells))
    capture = read_capture(write("order.mat", content))
    np.testing.assert_array_equal(capture.cube, [[[1, 0, 1], [0, 1, 0], [0, 0, 0]]])


# -- what must be refused --------------------------------------------------------------------------


def bomb_npz(n_bytes: int, claimed: int | None = None) -> bytes:
    """An archive whose cube unpacks to zeros; its directory may claim another size."""
    header = io.BytesIO()
    shape = (1, 1, claimed or n_bytes)
    fields = {"descr": "|u1", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, fields)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("cube.npy", header.getvalue() + bytes(n_bytes))
    return file.getvalue()


def npy_header(shape: Any, descr: str = "<u2") -> bytes:
    header = io.BytesIO()
    fields = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, fields)
    return header.getvalue()


def twice_npz() -> bytes:
    file = io.BytesIO()
    with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(file, "w") as archive:
        for _ in range(2):
            archive.writestr("cube.npy", npy_bytes(CUBE))
    return file.getvalue()


def lzma_npz() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("cube.npy", npy_bytes(CUBE))
    return file.getvalue()


def claims_more_inflated() -> bytes:
    """A compressed variable of MATLAB's that claims 3 GiB."""
    start = struct.pack("<II", MATRIX, 3 << 30) + matrix("<", CELL, (1, 1), b"Ts", b"")[8:]
    packed = zlib.compress(start)
    return mat_file("<", struct.pack("<II", 15, len(packed)) + packed)


def own(**fields: Any) -> Builder:
    return lambda: npz_bytes(**{**OWN_FIELDS, **fields})


def own_without(name: str) -> bytes:
    return npz_bytes(**{key: value for key, value in OWN_FIELDS.items() if key != name})


def with_value(value: float) -> np.ndarray:
    cube = CUBE.astype(float)
    cube[1, 1, 1] = value
    return cube


def cells_with(value: Any) -> Builder:
    return lambda: mat_bytes(Ts=cells_of([[5], [6], value, [7]], (2, 2)))


PICKLED = np.array([{"a": 1}], object)
MATRICES = np.empty((1, 2), object)
MATRICES[:] = [[np.ones(2), 0]]
MATRICES[0, 1] = np.ones((3, 2))
STRINGS = np.array([["one", "two"]], object)
DAMAGED = "damaged"

REFUSED: dict[str, tuple[str, Builder, str]] = {
    "unknown format": ("a.csv", lambda: b"1,2", r"suffix = '.csv' .*like text: .*\.npz, \.npy, "),
    "empty file of no format": ("a.x", lambda: b"", "like an empty file"),
    "bytes of no format": ("a.x", lambda: bytes(99), "like binary data of an unknown format"),
    "picture": ("a.mat", lambda: b"\x89PNG\r\n".ljust(99), "content = 'a PNG picture'"),
    "damaged gzip": (
        "a.npy.gz",
        lambda: gzip.compress(npy_bytes(CUBE))[:-9],
        "gzip file .*damaged",
    ),
    "gzip in gzip": ("a.gz", lambda: gzip.compress(gzip.compress(b"")), "like binary data"),
    "empty npz": ("a.npz", lambda: b"", DAMAGED),
    "empty npy": ("a.npy", lambda: b"", DAMAGED),
    "empty mat": ("a.mat", lambda: b"", "version"),
    "wrong magic in npy": ("a.npy", lambda: b"\x00" * 200, DAMAGED),
    "wrong magic in npz": ("a.npz", lambda: b"\x00" * 200, DAMAGED),
    "wrong magic in mat": ("a.mat", lambda: b"\x00" * 200, "version.*-v7"),
    "truncated npy": (
        "a.npy",
        lambda: npy_bytes(CUBE)[:-10],
        "bytes of the array = 2390 .*claims 2400",
    ),
    "truncated npz": ("a.npz", lambda: npz_bytes(cube=CUBE)[:-10], DAMAGED),
    "truncated mat": ("a.mat", lambda: mat_bytes(Ts=CUBE)[:-10], "cannot be read"),
    "truncated in a tag": ("a.mat", lambda: mat_bytes(Ts=CUBE) + b"\x0e\0", "cannot be read"),
    "no variables": ("a.mat", lambda: mat_file("<"), "the file has nothing"),
    "MATLAB 7.3": (
        "a.mat",
        lambda: b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF",
        "saved with -v",
    ),
    "MATLAB 7.3 magic": ("a.mat", lambda: bytes(512) + b"\x89HDF\r\n\x1a\n", "file cannot be read"),
    "pickled npy": ("a.npy", lambda: npy_bytes(PICKLED), "object.*pickled objects are refused"),
    "pickled npz": ("a.npz", lambda: npz_bytes(cube=PICKLED), "object.*pickled"),
    "ragged npy": ("a.npy", lambda: npy_bytes(np.array([[1], [2, 3]], object)), "object.*pickled"),
    "huge npy": (
        "a.npy",
        lambda: npy_header((10**4, 10**4, 10**4)),
        "bytes of the array = 2000000000000 .*2,147,483,648",
    ),
    "huge npz": ("a.npz", lambda: bomb_npz(10, 10**12), "bytes of cube = 1000000000000 "),
    "negative shape": ("a.npy", lambda: npy_header((-1, 1, 1)) + b"\xfe\xff", "bytes of the array"),
    "overflowing shape": ("a.npy", lambda: npy_header((2**40, 2**40, 0)), "bytes|shape"),
    "unknown type": ("a.npy", lambda: npy_header((1, 1, 1), "<M8[s]") + bytes(8), "datetime64"),
    "lzma": ("a.npz", lzma_npz, "compression method of cube = 14"),
    "array twice": ("a.npz", twice_npz, "arrays named 'cube.npy' = 2"),
    "no array": ("a.npz", npz_bytes, "variable = None.*nothing|none"),
    "no cube": ("a.npz", lambda: npz_bytes(a=np.ones(3)), "variable = None.*file has a"),
    "flat npy": ("a.npy", lambda: npy_bytes(np.ones((3, 4))), r"shape \(3, 4\).*\(row, col, bin\)"),
    "no pixels": ("a.npy", lambda: npy_bytes(CUBE[:0]), r"shape \(0, 4, 100\)"),
    "complex": ("a.npy", lambda: npy_bytes(CUBE * 1j), "complex128"),
    "not a number": ("a.npy", lambda: npy_bytes(with_value(np.nan)), "= nan .*counts"),
    "infinite": ("a.npy", lambda: npy_bytes(with_value(np.inf)), "= inf .*counts"),
    "negative": ("a.npy", lambda: npy_bytes(with_value(-2)), r"= -2.0 .*0 or more"),
    "no whole count": ("a.npy", lambda: npy_bytes(with_value(1.5)), "= 1.5 .*whole counts"),
    "too many": ("a.npy", lambda: npy_bytes(with_value(2.0**40)), "= 1099511627776.0 .*up to"),
    "no count in own layout": ("a.npz", own(cube=with_value(0.5)), "cube = 0.5"),
    "a later layout": ("a.npz", own(format="firstphoton-capture-2"), "format = .*-2.*-capture-1"),
    "layout of no text": ("a.npz", own(format=1), "format = .*int64.*unicode"),
    "no bin width": (
        "a.npz",
        own(bin_width_s=0.0),
        "bin_width_s = 0.0 .*a time from 1e-18 to 10 s",
    ),
    "bin width of text": ("a.npz", own(bin_width_s="1 ns"), "bin_width_s = .*<U4.*real numbers"),
    "two bin widths": ("a.npz", own(bin_width_s=[1.0, 2.0]), r"bin_width_s .*\(2,\).*one number"),
    "gate nowhere": ("a.npz", own(gate_delay_s=np.nan), "gate_delay_s = nan"),
    "half a pulse": ("a.npz", own(n_pulses=0.5), "n_pulses = 0.5 .*whole"),
    "negative pulses": ("a.npz", own(n_pulses=-3), "n_pulses = -3"),
    "pulses not a number": ("a.npz", own(n_pulses=np.nan), "n_pulses = nan"),
    "pulse of no time": ("a.npz", lambda: own_without("pulse_tau_s"), "pulse_tau_s = None"),
    "pulse of no shape": ("a.npz", own(pulse_shape="square"), "shape = 'square' .*gamma"),
    "negative pulse": ("a.npz", own(pulse_samples=[-1.0, 2.0]), "samples = .*-1.0"),
    "truth of other shape": (
        "a.npz",
        own(truth_range_m=np.ones((4, 3))),
        r"truth_range_m .*\(4, 3\)",
    ),
    "truth of many pixels": (
        "a.npz",
        own(truth_range_m=np.zeros((2000, 2000), np.uint8)),
        r"truth_range_m .*\(2000, 2000\)",
    ),
    "a pulse of many bytes": (
        "a.npz",
        own(pulse_samples=np.zeros(2**21)),
        r"bytes of pulse_samples = 16777\d+ ",
    ),
    "a long text": ("a.npz", own(source="a" * 2**20), r"bytes of source = 4194\d+ .*65,536"),
    "truth pickled": ("a.npz", own(truth_range_m=PICKLED), "truth_range_m.*object"),
    "pulses beyond all counts": ("a.npz", own(n_pulses=2.0**63), "n_pulses = 9223372036854775808"),
    "a bin of no width": ("a.npz", own(bin_width_s=5e-324), "bin_width_s = 5e-324 .*1e-18 to 10"),
    "a bin without end": ("a.npz", own(bin_width_s=1e300), r"bin_width_s = 1e\+300 .*1e-18 to 10"),
    "a gate behind the Moon": ("a.npz", own(gate_delay_s=1e9), "gate_delay_s = 1000000000.0"),
    "a gate of minutes": ("a.npz", own(bin_width_s=1.0), "gate, .* = 100.0 .*at most 10"),
    "a pulse without end": ("a.npz", own(pulse_tau_s=1e300), r"pulse_tau_s = 1e\+300 .*to 10 s"),
    "a pulse of no time": ("a.npz", own(pulse_tau_s=5e-324), "pulse_tau_s = 5e-324 .*1e-21"),
    "background of text": ("a.npz", own(background="low"), "background"),
    "no arrival time": ("a.mat", cells_with([np.nan]), r"Ts in pixel \(1, 0\) = nan"),
    "infinite arrival": ("a.mat", cells_with([np.inf]), r"pixel \(1, 0\) = inf"),
    "negative arrival": ("a.mat", cells_with([8, -4]), r"pixel \(1, 0\) = -4"),
    "fractions of what": ("a.mat", cells_with([279.5]), "= 279.5 .*time_unit_s"),
    "matrix in a cell": ("a.mat", lambda: mat_bytes(Ts=MATRICES), r"\(0, 1\) = .*\(3, 2\).*vector"),
    "text in a cell": ("a.mat", lambda: mat_bytes(Ts=STRINGS), "content of Ts = .*non-numeric"),
    "complex cells": ("a.mat", cells_with([1j]), "content of Ts = .*complex"),
    "no photons": ("a.mat", lambda: mat_bytes(Ts=cells_of([[], []], (1, 2))), "photons of Ts = 0"),
    "no cells": ("a.mat", lambda: mat_bytes(Ts=np.empty((0, 3), object)), "variable = None.*Ts"),
    "nothing fits": (
        "a.mat",
        lambda: mat_bytes(SBR=1.0, D=np.ones((3, 3))),
        r"D \(double, 3 x 3\)",
    ),
    "a span too wide": (
        "a.mat",
        lambda: cell_bytes([0, 1e15]),
        "gate of Ts = '1000.*another time_unit_s",
    ),
    "beyond whole floats": (
        "a.mat",
        lambda: cell_bytes([0, 1e300]),
        r"largest time of Ts = 1e\+288",
    ),
    "variable twice": (
        "a.mat",
        lambda: mat_bytes(Ts=CUBE) + mat_bytes(Ts=CUBE)[128:],
        "variables named 'Ts' = 2",
    ),
    "nested cells": (
        "a.mat",
        lambda: mat_file("<", matrix("<", CELL, (1, 1), b"Ts", nested_cells(50_000))),
        "Ts cannot be read",
    ),
    "type code out of the table": (
        "a.mat",
        lambda: mat_file(
            "<", matrix("<", UINT16_CLASS, (1, 1, 2), b"Ts", element("<", 2000, b"abcd"))
        ),
        "Ts cannot be read",
    ),
    "huge cell array": (
        "a.mat",
        lambda: mat_file("<", matrix("<", CELL, (10**6, 10**6), b"Ts", photon_cell("<", 5))),
        "more memory",
    ),
    "more cells than bytes": (
        "a.mat",
        lambda: mat_file("<", matrix("<", CELL, (1000, 1000), b"Ts", photon_cell("<", 5))),
        "Ts cannot be read",
    ),
    "more numbers than bytes": (
        "a.mat",
        lambda: mat_file("<", matrix("<", UINT16_CLASS, (10**4, 10**4, 10**4), b"Ts", b"")),
        "Ts cannot be read",
    ),
    "huge when inflated": ("a.mat", claims_more_inflated, "Ts cannot be read"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what: str, write: Callable[[str, bytes], Path]) -> None:
    name, build, message = REFUSED[what]
    path = write(name, build())
    assert_refused(read_capture, path, message, CaptureError, 2**20 + 10 * path.stat().st_size)


def test_a_pulse_of_too_many_samples(write: Callable[[str, bytes], Path]) -> None:
    content = own(pulse_samples=np.ones(2**20 + 1, np.uint8))()
    with pytest.raises(CaptureError, match="pulse_samples = '1,048,577 of them'"):
        read_capture(write("a.npz", content))


def test_long_pulses_need_a_long_gate(write: Callable[[str, bytes], Path]) -> None:
    """Up to 2**16 samples may last longer than a gate that was cut; more must fit in it."""
    for n_samples, spacing_s in ((2**16, 1e-9), (2**16 + 1, 1e-12)):
        kept = own(pulse_samples=np.ones(n_samples), pulse_tau_s=spacing_s)()
        capture = read_capture(write("a.npz", kept))
        assert capture.pulse == Pulse.measured(np.ones(n_samples), spacing_s)
    path = write("a.npz", own(pulse_samples=np.ones(2**16 + 1))())
    with pytest.raises(CaptureError, match=r"pulse_samples = '65,537 of them, 65.537 µs' .*100 ns"):
        read_capture(path)
    assert read_capture(path, pulse=Pulse()).pulse == Pulse()


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"absent.mat: path = .*an existing file"):
        read_capture(tmp_path / "absent.mat")
    with pytest.raises(CaptureError, match="an existing file"):
        read_capture(tmp_path)


def test_a_name_that_is_too_long_is_shortened(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"^a+\.\.\.a+\.npz: .*File name too long") as caught:
        read_capture(tmp_path / ("a" * 300 + ".npz"))
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_names_that_are_no_text_are_kept_as_text(suffix: str, tmp_path: Path) -> None:
    """Bytes of a name that are no UTF-8 come as surrogates, which no file could hold as text."""
    name = "n\udcff\udcc3\udcb6.npz"
    (tmp_path / name).write_bytes(npz_bytes(cube=CUBE))
    capture = read_capture(tmp_path / name)
    assert capture.source.startswith("n\\xff\u00f6.npz, variable cube")
    save_capture(capture, tmp_path / f"kept{suffix}")
    assert read_capture(tmp_path / f"kept{suffix}").source.startswith(capture.source)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(CaptureError, match=r"^n\\xff\u00f6\.npz: "):
        read_capture(tmp_path / name)


def test_what_unpacks_beyond_the_limit_is_refused(
    write: Callable[[str, bytes], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MAX_CUBE_BYTES == 2**31
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2**20)
    bomb = np.zeros((1, 1, 2**22), np.uint8)
    for name, content in {
        "bomb.npz": bomb_npz(2**22),
        "pixels.npz": npz_bytes(cube=np.zeros((512, 512, 1), np.uint8)),  # and their sums of int64
        "bomb.npy": npy_bytes(bomb),
        "bomb.gz": gzip.compress(npy_bytes(bomb)),
        "bomb.mat": mat_bytes(True, cube=bomb),
        "cells.mat": mat_bytes(True, Ts=cells_of([np.ones(2**22, np.uint8)], (1, 1))),
        "wide.npy": npy_bytes(bomb[:, :, : 2**20 - 200]),  # uint8 that would double
        "photons.mat": mat_bytes(True, Ts=cells_of([np.ones(2**19, np.uint8)], (1, 1))),
    }.items():
        with pytest.raises(CaptureError, match=r"bytes of .* at most 1,048,576 bytes are read"):
            read_capture(write(name, content))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_bytes_give_nothing_but_a_capture_error(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = 2**22
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", limit)
    kept = FORMATS[kind]
    content, path, rng = kept.build(), tmp_path / kept.name, random.Random(kind)
    n_refused = 0
    put(path, content)
    read_capture(path, **kept.needs)  # and its library, whose memory is not the file's
    tracemalloc.start()
    try:
        for _ in range(kept.n_damaged):
            shutil.rmtree(path, ignore_errors=True)
            put(path, damaged(content, rng))
            try:
                assert read_capture(path, **kept.needs).cube.ndim == 3
            except CaptureError as error:
                assert str(error).startswith(f"{kept.name}: ")
                n_refused += 1
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert n_refused > kept.n_damaged / 10
    assert peak < 4 * limit


# -- published captures ----------------------------------------------------------------------------


def test_building_at_21_km(real_capture: Callable[[str], Path]) -> None:
    capture = read_capture(real_capture("21km_K11_night.mat"))
    assert capture.cube.shape == (256, 256, 200)
    assert capture.counts.sum() == 640_952
    assert capture.acquisition.bin_width_s == 1e-9
    assert capture.acquisition.gate_delay_s == pytest.approx(4.43e-6, rel=1e-12)
    assert capture.acquisition.n_pulses is None
    assert capture.source == (
        "21km_K11_night.mat, variable Ts_gated; guessed: time unit 1 ps, bin width 1 ns, "
        "gate 4430-4630 ns, pulse Gaussian of 450 ps, all photons of a pulse"
    )


def test_mannequin_face(real_capture: Callable[[str], Path]) -> None:
    capture = read_capture(real_capture("data_face.mat"))
    assert capture.cube.shape == (340, 340, 876)
    assert capture.counts.sum() == 955_670
    assert capture.counts.max() == 49
    assert np.mean(capture.counts == 0) == pytest.approx(0.016, abs=5e-4)
    assert capture.acquisition.bin_width_s == pytest.approx(64e-12, rel=1e-12)
    assert capture.acquisition.gate_delay_s == pytest.approx(8e-9, rel=1e-12)
    # The face in the middle and the wall at the left, in native bins.
    assert 1000 + 8 * capture.cube.sum(axis=(0, 1)).argmax() == pytest.approx(3576, abs=40)
    assert 1000 + 8 * capture.cube[:, :20].sum(axis=(0, 1)).argmax() == pytest.approx(4080, abs=40)


def test_published_truth_is_no_capture(real_capture: Callable[[str], Path]) -> None:
    with pytest.raises(CaptureError, match=r"D_true.*time_unit_s"):
        read_capture(real_capture("data_mannequin_face_truth.mat"))


# -- and back to a file ----------------------------------------------------------------------------

times_s = st.floats(1e-13, 1e-5)
pulses = st.one_of(
    st.builds(Pulse, times_s),
    st.builds(Pulse.gaussian, times_s),
    st.builds(Pulse.measured, st.lists(st.floats(0.01, 1e6), min_size=1, max_size=9), times_s),
)
acquisitions = st.builds(
    Acquisition,
    bin_width_s=times_s,
    gate_delay_s=st.floats(-1e-3, 1e-3),
    n_pulses=st.none() | st.integers(1, 10**9),
    pixel_angle_rad=st.floats(1e-9, 0.9),
)


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    dtype = draw(st.sampled_from([np.uint8, np.uint16, np.uint32]))
    cube = draw(hnp.arrays(dtype, hnp.array_shapes(min_dims=3, max_dims=3, max_side=5)))
    images = st.none() | hnp.arrays(np.float64, cube.shape[:2])
    photons = st.none() | hnp.arrays(np.float64, cube.shape[:2], elements=st.floats(0, 1e6))
    acquisition = draw(acquisitions)
    n_pulses = acquisition.n_pulses
    fits = n_pulses is None or cube.sum(axis=2, dtype=np.int64).max() <= n_pulses
    return Capture(
        cube,
        Acquisition(
            cube.shape[2],
            acquisition.bin_width_s,
            acquisition.gate_delay_s,
            acquisition.n_pulses,
            acquisition.pixel_angle_rad,
        ),
        draw(pulses),
        truth_range_m=draw(images),
        signal=draw(photons),
        background=draw(st.none() | st.floats(0, 1e6)),
        source=draw(st.text(st.characters(exclude_characters="\0", codec="utf-8"))),
        detection=draw(st.sampled_from(["first", "all"] if fits else ["all"])),
    )


@settings(max_examples=60, deadline=None)
@given(captures())
def test_round_trip(capture: Capture) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "saved.npz"
        save_capture(capture, path)
        read = read_capture(path)
    assert read.cube.dtype == capture.cube.dtype
    np.testing.assert_array_equal(read.cube, capture.cube)
    assert read.acquisition == capture.acquisition
    assert read.pulse == capture.pulse
    assert (read.background, read.detection) == (capture.background, capture.detection)
    for image in ("truth_range_m", "signal"):
        kept, given_ = getattr(read, image), getattr(capture, image)
        assert (kept is None) == (given_ is None)
        assert kept is None or np.array_equal(kept, given_, equal_nan=True)
    assert read.source == (capture.source or "saved.npz, variable cube")


def test_existing_file_is_kept_unless_told(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    save_capture(Capture(CUBE, ACQUISITION), path)
    before = path.read_bytes()
    doubled = Capture(2 * CUBE, ACQUISITION)
    with pytest.raises(FileExistsError, match=r"kept.npz exists: .*overwrite"):
        save_capture(doubled, path)
    assert path.read_bytes() == before
    save_capture(doubled, path, overwrite=True)
    np.testing.assert_array_equal(read_capture(path).cube, 2 * CUBE)
    assert os.listdir(tmp_path) == ["kept.npz"]


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept.npz"
    path.write_bytes(b"older")

    def full(file: Any, **_: Any) -> None:
        file.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        save_capture(Capture(CUBE, ACQUISITION), path, overwrite=True)
    assert path.read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["kept.npz"]


def test_saved_name_must_tell_the_format(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"suffix = '\.mat' .*\.npz"):
        save_capture(Capture(CUBE, ACQUISITION), tmp_path / "a.mat")
    assert os.listdir(tmp_path) == []
