"""One contract for every reader; guesses; refusals; and captures written and read back."""

from __future__ import annotations

import gzip
import io
import os
import random
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.special import ndtr

from core.acquisition import Acquisition, Pulse
from core.capture import Capture, CaptureError
from core.io import ReadOptions
from core.io.readers import MAX_CUBE_BYTES, SUFFIXES, guards, open_capture, read_capture
from core.io.readers.labelled import describe
from core.io.writers import save_capture
from core.tests.formats import FORMATS, Format, damaged, put
from core.tests.labelled_files import hdf5_bytes
from core.tests.refusing import assert_refused, count_refused, with_peak
from core.tests.samples import (
    ACQUISITION,
    CELL,
    CUBE,
    MATRIX,
    OWN_FIELDS,
    PHOTON_CELL,
    UINT16_CLASS,
    arrival_cells,
    cells_of,
    element,
    mat_bytes,
    mat_file,
    matrix,
    npy_bytes,
    npz_bytes,
)

pytestmark = pytest.mark.files

Write = Callable[[str, bytes], Path]


def cell_bytes(values: list[Any]) -> bytes:
    """A file with one row of cells, one photon each."""
    return mat_bytes(Ts=cells_of([[value] for value in values], (1, len(values))))


# -- the contract ----------------------------------------------------------------------------------

every_format = pytest.mark.parametrize("kept", FORMATS.values(), ids=FORMATS)


def saved(kept: Format, folder: Path) -> Path:
    return put(folder / kept.name, kept.build())


def test_every_reader_is_under_the_contract() -> None:
    tested = {Path(kept.name).suffix.lower() for kept in FORMATS.values()}
    assert tested | {".gz"} == set(SUFFIXES)
    assert all(SUFFIXES.values())


@every_format
def test_contract_nothing_to_guess(kept: Format, tmp_path: Path) -> None:
    pulse = Pulse.gaussian(2e-9)
    given = vars(kept.acquisition) | {"detection": "first", "pulse": pulse}
    capture = read_capture(saved(kept, tmp_path), **given | kept.needs | kept.given)
    np.testing.assert_array_equal(capture.cube, kept.cube)
    assert capture.cube.dtype == np.uint16 and capture.cube.dtype.isnative
    assert capture.cube.flags.c_contiguous and not capture.cube.flags.writeable
    assert (capture.acquisition, capture.pulse) == (kept.acquisition, pulse)
    assert capture.detection == "first"
    assert capture.source.startswith(kept.name) and "guessed" not in capture.source


@every_format
def test_contract_everything_guessed(kept: Format, tmp_path: Path) -> None:
    path = saved(kept, tmp_path)
    capture, opened = read_capture(path, **kept.needs), open_capture(path, **kept.needs)
    np.testing.assert_array_equal(capture.cube, kept.cube)
    np.testing.assert_array_equal(opened, kept.cube)
    known = capture.acquisition, capture.pulse, capture.detection, capture.source
    assert describe(opened, ReadOptions()) == known
    assert capture.acquisition.bin_width_s == pytest.approx(kept.acquisition.bin_width_s)
    assert ("guessed: " in capture.source) == bool(kept.guesses)
    for guessed in kept.guesses:
        assert guessed in capture.source


@every_format
def test_contract_content_determines_the_format(kept: Format, tmp_path: Path) -> None:
    content = kept.build()
    paths = [] if kept.name.endswith(".bin") else [put(tmp_path / "other.name", content)]
    if isinstance(content, bytes):
        paths.append(put(tmp_path / f"{kept.name}.gz", gzip.compress(content)))
    for path in paths:
        np.testing.assert_array_equal(read_capture(path, **kept.needs).cube, kept.cube)


@every_format
def test_contract_arguments_that_do_not_fit(kept: Format, tmp_path: Path) -> None:
    path = saved(kept, tmp_path)
    refused: list[dict[str, Any]] = [
        {"variable": "absent"},
        {"bin_width_s": 0.0},
        {"gate_delay_s": np.nan},
        {"n_bins": 1.5},
        {"n_pulses": -1},
        {"bin_width_s": "64ps"},
        {"pixel_angle_rad": 2.0},
        {"pixel_angle_rad": "1mrad"},
        {"pulse_rate_hz": "20 kHz"},
        {"time_unit_s": -1.0},
        {"stop_s": np.inf},
        {"detection": "some"},
        {"axes": "row col row"},
        {"first_detections": 0},
        {"no_trigger": 0.5},
        {"shape": (3, 0)},
        {"records": -1},
        {"records": (2, 1)},
        *kept.refuses,
    ]
    for arguments in refused:
        (field, value), *_ = arguments.items()
        with pytest.raises(CaptureError, match=rf"^{kept.name}: .*{field}") as caught:
            read_capture(path, **{**kept.needs, **arguments})
        assert str(value) in str(caught.value)
        assert "cannot be read" not in str(caught.value)  # the file is not to blame


@every_format
def test_contract_common_stop(kept: Format, tmp_path: Path) -> None:
    """Bins of a cube are reversed; arrival times are the time left to a stop."""
    path = saved(kept, tmp_path)
    acquisition = kept.acquisition
    stop_s = 2 * acquisition.gate_delay_s + acquisition.n_bins * acquisition.bin_width_s
    given = vars(acquisition) | {"detection": "first"} | kept.needs | kept.given
    if not kept.guesses:  # our own layouts, with a gate of their own
        with pytest.raises(CaptureError, match=r"stop_s = .* None"):
            read_capture(path, **given, stop_s=stop_s)
        return
    capture = read_capture(path, **given, stop_s=stop_s)
    np.testing.assert_array_equal(capture.cube, kept.cube[:, :, ::-1])
    assert capture.acquisition == acquisition


@every_format
def test_contract_content_beyond_the_limit_is_refused(
    kept: Format, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(kept, tmp_path)
    limit = kept.cube.nbytes // 2
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", limit)
    message = rf"bytes of .* at most {limit:,} bytes are read| photons .*, the rest of the limit"
    with pytest.raises(CaptureError, match=message):
        read_capture(path, **kept.needs)


@every_format
def test_contract_cut_files_are_refused(kept: Format, tmp_path: Path) -> None:
    content = kept.build()
    if isinstance(content, bytes):
        for n_bytes in (0, len(content) // 2 + 1):
            with pytest.raises(CaptureError, match=f"^{kept.name}: "):
                read_capture(put(tmp_path / kept.name, content[:n_bytes]), **kept.needs)


@pytest.mark.uncounted
@pytest.mark.filterwarnings("ignore")
@every_format
def test_contract_damaged_bytes_give_nothing_but_a_capture_error(
    kept: Format, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = 2**22
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", limit)
    content, path, rng = kept.build(), tmp_path / kept.name, random.Random(str(kept.needs))
    read = partial(read_capture, **kept.needs)
    read(put(path, content))  # loads the library
    contents = (damaged(content, rng) for _ in range(kept.n_damaged))
    n_refused, peak = with_peak(lambda: count_refused(read, path, contents, CaptureError))
    assert n_refused > kept.n_damaged / 10
    assert peak < 4 * limit


# -- fields and variables --------------------------------------------------------------------------


def test_own_layout_keeps_every_field(write: Write) -> None:
    capture = read_capture(write("capture.npz", npz_bytes(**OWN_FIELDS)))
    assert capture.acquisition == ACQUISITION
    assert capture.pulse == Pulse.measured([1, 2, 1], 1e-9)
    assert capture.truth_range_m is not None and capture.signal is None
    assert capture.source == "capture.npz, variable cube"


def test_own_layout_lists_guesses_for_missing_fields(write: Write) -> None:
    path = write("a.npz", npz_bytes(cube=CUBE, bin_width_s=5e-10, n_pulses=0, source="a wall"))
    capture = read_capture(path, gate_delay_s=2e-7)
    assert capture.acquisition.n_pulses is None and capture.pulse == Pulse.gaussian(5e-10)
    guessed = "pulse Gaussian of 500 ps (one bin: width not determined), all photons of a pulse"
    assert capture.source == f"a wall; guessed: {guessed}"


def test_more_photons_than_pulses_are_given_as_the_reason_to_count_all(write: Write) -> None:
    counts = np.zeros((2, 2, 20), np.uint16)
    counts[0, 1, 7:9] = 600, 700
    named = {"bin_width_s": 5e-10, "pulse": "gaussian", "pulse_width_s": 1e-9}
    capture = read_capture(write("a.npz", npz_bytes(cube=counts, n_pulses=1000, **named)))
    assert capture.detection == "all"
    assert "all photons of a pulse (as a pixel has 1,300 in 1,000 pulses)" in capture.source


def test_own_layout_without_a_pulse_has_the_one_of_its_counts(write: Write) -> None:
    """As for other files, and stated in the same words."""
    slope = 30 + np.arange(20) / 2 + np.zeros((20, 1))
    echo = 3.0 * ndtr((np.arange(81) - slope[..., np.newaxis]) / 2)
    shares = np.diff(-np.expm1(-echo), append=1.0)
    shares[..., -1] = 1 - shares[..., :-1].sum(axis=-1)
    cube = np.random.default_rng(0).multinomial(300, shares)[..., :-1].astype(np.uint16)
    own = read_capture(write("a.npz", npz_bytes(cube=cube, n_pulses=300)))
    other = read_capture(write("b.npz", npz_bytes(counts=cube, n_pulses=300)), axes="row col bin")
    assert own.pulse == other.pulse and own.pulse.shape == "gaussian"
    assert own.pulse.tau_s == pytest.approx(2e-9, rel=0.05)  # 11 % less with pile-up
    assert own.source.partition("; ")[2] == other.source.partition("; ")[2]


@pytest.mark.parametrize("name", ["cube", "counts"])
def test_bin_width_and_pulses_may_have_other_names(name: str, write: Write) -> None:
    content = npz_bytes(**{name: CUBE}, bin_width_ps=100, shots=500)
    acquisition = read_capture(write("a.npz", content)).acquisition
    assert (acquisition.bin_width_s, acquisition.n_pulses) == (1e-10, 500)


def test_numbers_of_the_own_layout_accompany_counts_of_another_name(write: Write) -> None:
    known = {"bin_width_s": 2e-9, "gate_delay_s": 1e-7, "n_pulses": 500}
    others = {"background": CUBE[0], "pixel_angle_rad": np.ones((3, 4)), "source": "?"}
    path = write("a.npz", npz_bytes(counts=CUBE, **known, **others))
    capture = read_capture(path)
    assert vars(capture.acquisition) == known | {"n_bins": 100, "pixel_angle_rad": None}
    assert capture.detection == "first" and capture.background is None
    assert read_capture(path, bin_width_s=1e-9).acquisition.bin_width_s == 1e-9


@pytest.mark.parametrize("content", [npz_bytes, mat_bytes], ids=["a.npz", "a.mat"])
def test_variable_chooses(content: Callable[..., bytes], write: Write) -> None:
    path = write("two", content(night=CUBE, day=2 * CUBE))
    with pytest.raises(CaptureError, match=r"give night or day, each of which"):
        read_capture(path)
    capture = read_capture(path, variable="day")
    np.testing.assert_array_equal(capture.cube, 2 * CUBE)
    assert "variable day" in capture.source


def test_large_counts_widen_the_cube(write: Write) -> None:
    many = CUBE.astype(np.uint32) * 40_000
    capture = read_capture(write("many.npy", npy_bytes(many)))
    assert capture.cube.dtype == np.uint32
    np.testing.assert_array_equal(capture.cube, many)
    photons = cells_of([[200_000] * 70_000, [300_000]], (1, 2))
    capture = read_capture(write("many.mat", mat_bytes(Ts=photons)))
    assert capture.cube.dtype == np.uint32 and capture.cube[0, 0, 0] == 70_000


# -- guesses for arrival times ---------------------------------------------------------------------

PS = [4_430_001, 4_629_999]
NS_OF_PS = "time unit 1 ps, bin width 1 ns"


@pytest.mark.parametrize(
    ("values", "unit_s", "options", "acquisition", "guessed"),
    [
        # 200 ns of picoseconds: 1 ns bins, the gate rounded down to one of them.
        (PS, 1e-12, {}, (200, 1e-9, 4.43e-6), f"{NS_OF_PS}, gate 4430-4630 ns, pulse Gaussian"),
        # Native bins: 7001 of 8 ps need 64 ps for at most 1024.
        (
            [1000, 8000],
            8e-12,
            {},
            (876, 64e-12, 8e-9),
            "time unit 8 ps, bin width 64 ps, gate 8-64.064 ns, pulse Gaussian of 64 ps",
        ),
        ([4.43e-6, 4.6295e-6], 1.0, {}, (200, 1e-9, 4.43e-6), "time unit 1 s, bin width 1 ns"),
        # A unit that 1 ns is no multiple of.
        ([0, 1999], 3e-10, {"time_unit_s": 3e-10}, (667, 9e-10, 0.0), "bin width 900 ps"),
        # All in one bin.
        ([7, 7], 8e-12, {}, (1, 8e-12, 56e-12), "time unit 8 ps, bin width 8 ps"),
        (
            PS,
            1e-12,
            {"gate_delay_s": 4.4e-6, "pulse": Pulse()},
            (230, 1e-9, 4.4e-6),
            f"{NS_OF_PS}, 230 bins",
        ),
        # 1 ns would need 200 bins.
        (
            PS,
            1e-12,
            {"n_bins": 100, "time_unit_s": 1e-12},
            (100, 2048e-12, 2163 * 2048e-12),
            "bin width 2.048 ns, gate 4429.82-4634.62 ns",
        ),
        (
            [279.5, 281.25],
            1e-9,
            {"time_unit_s": 1e-9, "bin_width_s": 0.5e-9, "gate_delay_s": 279e-9},
            (5, 0.5e-9, 279e-9),
            "5 bins, pulse Gaussian of 500 ps",
        ),
    ],
)
def test_guesses(
    values: list[float],
    unit_s: float,
    options: dict[str, Any],
    acquisition: tuple[int, float, float],
    guessed: str,
    write: Write,
) -> None:
    capture = read_capture(write("t.mat", cell_bytes(values)), **options)
    assert f"; guessed: {guessed}" in capture.source
    found = capture.acquisition
    assert (found.n_bins, found.bin_width_s, found.gate_delay_s) == pytest.approx(
        acquisition, rel=1e-12
    )
    # Each photon lies in the bin that covers its time.
    assert capture.cube.sum() == len(values)
    bins = capture.cube.argmax(axis=2).ravel()
    late = (np.array(values) * unit_s - found.gate_delay_s) / found.bin_width_s - bins
    assert np.all(late > -1e-6) and np.all(late < 1 + 1e-6)


def test_rounding_of_seconds_moves_no_photon(write: Write) -> None:
    """Times that fall on the edges of bins stay in the bin that they open."""
    seconds = [k * 1e-9 for k in range(1, 301)]
    capture = read_capture(write("s.mat", cell_bytes(seconds)))
    np.testing.assert_array_equal(capture.cube[0].argmax(axis=1), np.arange(300))


def test_photons_outside_a_given_gate_are_dropped(write: Write) -> None:
    path = write("d.mat", cell_bytes([200_000, 250_000, 260_999, 261_000, 300_000]))
    capture = read_capture(path, gate_delay_s=250e-9, n_bins=11, bin_width_s=1e-9)
    assert capture.cube.sum() == 2
    assert capture.cube[0, 1, 0] == 1 and capture.cube[0, 2, 10] == 1
    assert "dropped: 3 of 5 photons, outside the gate" in capture.source
    with pytest.raises(CaptureError, match=r"200 ns to 300 ns.* gate_delay_s"):
        read_capture(path, gate_delay_s=1e-6)


ECHO = [*range(4_430_000, 4_630_000, 1000)]
"""Picoseconds: 200 photons in a gate of 200 ns, 4.43 µs after the pulse."""
LATE_ECHO = [time + 10**9 for time in ECHO]


@pytest.mark.parametrize(
    ("values", "options", "gate", "n_dropped"),
    [
        # A stray photon does not stretch the gate,
        *(
            ([*ECHO, stray], {}, (200, 1.0, 4430.0), 1)
            for stray in (10**9, 10**12, 4_430_000 + 2**16 * 1000, 2**52)
        ),
        # nor does one before the others open it.
        ([1, *LATE_ECHO], {}, (200, 1.0, 1_004_430.0), 1),
        ([1, *LATE_ECHO], {"n_bins": 100}, (100, 2.048, 1_004_429.312), 1),
        # A sparse far echo stays in the gate.
        ([*ECHO * 5, 4_430_000 + 60_000_000], {}, (60_001, 1.0, 4430.0), 0),  # 9 km behind
        ([*ECHO * 99, *[t + 30_000_000 for t in ECHO]], {}, (30_200, 1.0, 4430.0), 0),
        ([0, 65_535_999], {}, (65_536, 1.0, 0.0), 0),
        # Half of the photons are no strays: a wide gate has wider bins.
        ([1e-3 - 1e-9, 1e-12], {}, (61_036, 16.384, 0.0), 0),
        ([1e8, 1], {}, (48_829, 2.048, 0.0), 0),
        (list(range(0, 10**8, 10**6)), {}, (48_340, 2.048, 0.0), 0),
        # Options are taken as they are.
        ([1e8, 1], {"n_bins": 200_000}, (200_000, 1.0, 0.0), 0),
        ([1e8, 1], {"bin_width_s": 1e-9}, (100_001, 1.0, 0.0), 0),
        ([*ECHO, 10**9], {"bin_width_s": 1e-6}, (997, 1000.0, 4000.0), 0),
        ([*ECHO, 10**9], {"gate_delay_s": 4e-6}, (630, 1.0, 4000.0), 1),
        ([1, *ECHO], {"gate_delay_s": 4e-6}, (630, 1.0, 4000.0), 1),
    ],
)
def test_gate(
    values: list[float],
    options: dict[str, Any],
    gate: tuple[int, float, float],
    n_dropped: int,
    write: Write,
) -> None:
    content = mat_bytes(Ts=cells_of([values], (1, 1)))
    capture = read_capture(write("g.mat", content), **options)
    found = capture.acquisition
    width_ns, opens_ns = round(found.bin_width_s * 1e9, 6), round(found.gate_delay_s * 1e9, 6)
    assert (found.n_bins, width_ns, opens_ns) == gate
    assert capture.cube.sum() == len(values) - n_dropped
    assert (f"dropped: {n_dropped} of {len(values):,}" in capture.source) == bool(n_dropped)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_bins": 10**9}, r"n_bins = 1000000000 .*1 to 16,777,216"),
        ({"bin_width_s": 1e-15}, r"bins of Ts = 99999999001 .*larger bin_width_s"),
        ({"time_unit_s": 1e-9, "bin_width_s": 1e-18}, r"bin_width_s = 1e-18 .*unit .* 1 ns"),
        ({"time_unit_s": 1e-6}, r"gate of Ts = '100\.\d* s' .*another time_unit_s"),
    ],
)
def test_gates_of_too_many_bins_are_refused(
    options: dict[str, Any], message: str, write: Write
) -> None:
    path = write("g.mat", cell_bytes([10**8, 1]))
    assert_refused(lambda path: read_capture(path, **options), path, message, CaptureError, 2**22)


def test_bins_come_first_if_only_the_other_axes_are_as_long(write: Write, tmp_path: Path) -> None:
    cube = np.arange(10 * 4 * 4).reshape(10, 4, 4)
    files = (
        write("f.npy", npy_bytes(cube)),
        write("f.npz", npz_bytes(counts=cube)),
        write("f.mat", mat_bytes(counts=cube)),
        put(tmp_path / "f.h5", hdf5_bytes(counts=cube)),
    )
    for path in files:
        capture = read_capture(path)
        np.testing.assert_array_equal(capture.cube, cube.transpose(1, 2, 0))
        assert "guessed: axes (bin, row, col)" in capture.source
        assert capture.guesses["axes"] == "bin row col"
        np.testing.assert_array_equal(read_capture(path, axes="row col bin").cube, cube)
    np.testing.assert_array_equal(open_capture(files[-1]), cube.transpose(1, 2, 0))
    for shape in ((4, 4, 4), (10, 4, 5), (10, 10, 4), (7, 4, 4), (1, 4, 4)):
        assert read_capture(write("g.npy", npy_bytes(np.ones(shape, int)))).cube.shape == shape


def test_axes_are_turned(write: Write) -> None:
    turned = read_capture(write("t.npy", npy_bytes(CUBE.transpose(2, 1, 0))), axes="bin, col row")
    np.testing.assert_array_equal(turned.cube, CUBE)
    options = {"bin_width_s": 1e-9, "gate_delay_s": 1e-6, "n_bins": 100}
    cells = arrival_cells(CUBE.transpose(1, 0, 2))
    turned = read_capture(write("t.mat", mat_bytes(Ts=cells)), axes="col row", **options)
    np.testing.assert_array_equal(turned.cube, CUBE)


def test_the_gate_of_a_cube_ends_at_the_common_stop(write: Write) -> None:
    backwards = read_capture(write("b.npy", npy_bytes(CUBE[:, :, ::-1])), stop_s=1.1e-6)
    np.testing.assert_array_equal(backwards.cube, CUBE)
    assert backwards.acquisition.gate_delay_s == pytest.approx(1e-6, rel=1e-12)


def test_the_common_stop_comes_after_all_arrival_times(write: Write) -> None:
    path = write("t.mat", mat_bytes(Ts=arrival_cells(CUBE)))
    with pytest.raises(CaptureError, match=r"stop_s = 5e-08 .*at least the largest time"):
        read_capture(path, stop_s=5e-8)


def test_first_detections_are_those_first_in_the_file(write: Write) -> None:
    cells = cells_of([[5, 3, 9, 3], [], [7]], (1, 3))
    capture = read_capture(write("f.mat", mat_bytes(Ts=cells)), first_detections=2, n_bins=10)
    np.testing.assert_array_equal(capture.counts, [[2, 0, 1]])
    assert set(np.flatnonzero(capture.cube[0, 0])) == {0, 2}  # the gate opens at 3


def test_first_photons_are_guessed_where_pulses_allow(write: Write) -> None:
    path = write("d.npy", npy_bytes(CUBE))
    most = int(CUBE.sum(axis=2).max())
    assert read_capture(path).detection == "all"
    assert "first photons only" in read_capture(path, n_pulses=most).source
    assert read_capture(path, n_pulses=most - 1).detection == "all"
    with pytest.raises(CaptureError, match=f"counts = {most} "):
        read_capture(path, n_pulses=most - 1, detection="first")


# -- what must be refused --------------------------------------------------------------------------


def npy_header(shape: Any, descr: str = "<u2") -> bytes:
    header = io.BytesIO()
    fields = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, fields)
    return header.getvalue()


def zipped(content: bytes, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An archive with a cube."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr("cube.npy", content)
    return file.getvalue()


def claims_more_inflated() -> bytes:
    """A compressed variable of MATLAB's that claims 3 GiB."""
    start = struct.pack("<II", MATRIX, 3 << 30) + matrix(CELL, (1, 1), b"Ts", b"")[8:]
    packed = zlib.compress(start)
    return mat_file(struct.pack("<II", 15, len(packed)) + packed)


def nested_cells(depth: int) -> bytes:
    """A cell in a cell in a cell: SciPy alone ends the process at some ten thousand of them."""
    outer = matrix(CELL, (1, 1), b"", b"")
    inner = len(PHOTON_CELL)
    sizes = inner + len(outer) * np.arange(depth)
    layers = (outer[:4] + struct.pack("<I", size + len(outer) - 8) + outer[8:] for size in sizes)
    return b"".join(reversed(list(layers))) + PHOTON_CELL


def cell_file(shape: tuple[int, int], body: bytes) -> bytes:
    return mat_file(matrix(CELL, shape, b"Ts", body))


def own(**fields: Any) -> bytes:
    return npz_bytes(**OWN_FIELDS | fields)


def with_value(value: float) -> bytes:
    cube = CUBE.astype(float)
    cube[1, 1, 1] = value
    return npy_bytes(cube)


def cells_with(value: Any) -> bytes:
    return mat_bytes(Ts=cells_of([[5], [6], value, [7]], (2, 2)))


PICKLED = np.array([{"a": 1}], object)
MATRICES = np.empty((1, 2), object)
MATRICES[0, 0], MATRICES[0, 1] = np.ones(2), np.ones((3, 2))
WITHOUT_TAU = npz_bytes(**{k: v for k, v in OWN_FIELDS.items() if k != "pulse_tau_s"})

REFUSED: tuple[tuple[str, bytes, str], ...] = (
    # The format
    ("a.csv", b"1,2", r"suffix = '.csv' .*like text: .*\.npz, \.npy, "),
    ("a.x", b"", "like an empty file"),
    ("a.x", bytes(99), "like binary data of an unknown format"),
    ("a.mat", b"\x89PNG\r\n".ljust(200), "header .*MATLAB file: give .*-v7"),
    ("a.npy.gz", gzip.compress(npy_bytes(CUBE))[:-9], "gzip file .*damaged"),
    ("a.gz", gzip.compress(gzip.compress(b"")), "like binary data"),
    ("a.npz", bytes(200), "archive cannot be read.*damaged"),
    ("a.mat", bytes(200), "header.*-v7"),
    ("a.mat", b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF", "saved with -v"),
    ("a.mat", bytes(512) + b"\x89HDF\r\n\x1a\n", "file cannot be read"),
    # A map of ranges
    ("a.npy", npy_bytes(np.eye(3)), "shape \\(row, col, bin\\).*; a map .* as its truth"),
    ("a.npz", npz_bytes(range_m=np.eye(3)), "the file has range_m; a map .* as its truth"),
    ("a.mat", mat_bytes(D=cells_of([[5.5], [6.0]], (1, 2))), "or time_unit_s .*; a map .* as its"),
    ("a.tif", b"II*\0", "like .*; a map .* as its truth"),
    # NumPy
    ("a.npy", npy_bytes(CUBE)[:-10], "bytes of the array = 2390 .*claims 2400"),
    ("a.npy", npy_bytes(PICKLED), "object.*pickled objects are refused"),
    ("a.npz", npz_bytes(cube=PICKLED), "object.*pickled"),
    ("a.npy", npy_header((10**4,) * 3), "bytes of the array = 2000000000000 .*2,147,483,648"),
    ("a.npz", zipped(npy_header((1, 1, 10**12), "|u1")), "bytes of cube = 1000000000000 "),
    ("a.npy", npy_header((-1, 1, 1)) + b"\xfe\xff", "bytes of the array"),
    ("a.npy", npy_header((2**40, 2**40, 0)), "bytes|shape"),
    ("a.npy", npy_header((1, 1, 1), "<M8[s]") + bytes(8), "datetime64"),
    ("a.npz", zipped(npy_bytes(CUBE), zipfile.ZIP_LZMA), "compression method of cube = 14"),
    ("a.npz", npz_bytes(), "variable = None.*none"),
    ("a.npz", npz_bytes(a=np.ones(3)), "variable = None.*file has a"),
    # Counts
    ("a.npy", npy_bytes(np.ones((3, 4))), r"shape \(3, 4\).*\(row, col, bin\)"),
    ("a.npy", npy_bytes(CUBE[:0]), r"shape \(0, 4, 100\)"),
    ("a.npy", npy_bytes(np.zeros((1, 1, 2**24 + 1), np.uint8)), "bins of the array = 16777217 "),
    ("a.npy", npy_bytes(CUBE * 1j), "complex128"),
    ("a.npy", with_value(np.nan), "= nan .*counts"),
    ("a.npy", with_value(-2), r"= -2.0 .*0 or more"),
    ("a.npy", with_value(1.5), "= 1.5 .*whole counts"),
    ("a.npy", with_value(2.0**40), "= 1099511627776.0 .*up to"),
    # Fields of our own layout
    ("a.npz", own(cube=CUBE + 0.5), r"cube = \d\.5"),
    ("a.npz", own(format="firstphoton-capture-2"), "format = .*-2.*-capture-1"),
    ("a.npz", own(bin_width_s=0.0), "bin_width_s = 0.0 .*a time from 1e-18 to 10 s"),
    ("a.npz", own(bin_width_s=5e-324), "bin_width_s = 5e-324 .*1e-18 to 10"),
    ("a.npz", own(bin_width_s="1 ns"), "bin_width_s = '1 ns' .*one number"),
    ("a.npz", own(bin_width_s=[1.0, 2.0]), r"bin_width_s = array\(\[1\., 2\.\]\) .*one number"),
    ("a.npz", own(bin_width_s=1.0), "gate, .* = 100.0 .*at most 10"),
    ("a.npz", own(gate_delay_s=np.nan), "gate_delay_s = nan"),
    ("a.npz", own(gate_delay_s=1e9), "gate_delay_s = 1000000000.0"),
    ("a.npz", own(n_pulses=0.5), "n_pulses = 0.5 .*whole"),
    ("a.npz", own(n_pulses=-3), "n_pulses = -3"),
    ("a.npz", own(n_pulses=np.nan), "n_pulses = nan"),
    ("a.npz", own(n_pulses=2.0**63), "n_pulses = 9223372036854775808"),
    ("a.npz", WITHOUT_TAU, "pulse_tau_s = None"),
    ("a.npz", own(pulse_shape="square"), "shape = 'square' .*gamma"),
    ("a.npz", own(pulse_tau_s=1e300), r"pulse_tau_s = 1e\+300 .*to 10 s"),
    ("a.npz", own(pulse_tau_s=5e-324), "pulse_tau_s = 5e-324 .*1e-21"),
    ("a.npz", own(pulse_samples=[-1.0, 2.0]), "samples = .*-1.0"),
    ("a.npz", own(pulse_samples=np.zeros(2**21)), r"bytes of pulse_samples = 16777\d+ "),
    ("a.npz", own(source="a" * 2**20), r"bytes of source = 4194\d+ .*65,536"),
    ("a.npz", own(background="low"), "background"),
    ("a.npz", own(truth_range_m=np.zeros((2000, 2000), "u1")), r"truth_range_m .*\(2000, 2000\)"),
    ("a.npz", own(truth_range_m=PICKLED), "truth_range_m.*object"),
    # Arrival times
    ("a.mat", cells_with([np.nan]), r"Ts in pixel \(1, 0\) = nan"),
    ("a.mat", cells_with([8, -4]), r"pixel \(1, 0\) = -4"),
    ("a.mat", cells_with([279.5]), "= 279.5 .*time_unit_s"),
    ("a.mat", mat_bytes(Ts=MATRICES), r"\(0, 1\) = .*\(3, 2\).*vector"),
    ("a.mat", mat_bytes(Ts=np.array([["a", "b"]], object)), "content of Ts = .*non-numeric"),
    ("a.mat", cells_with([1j]), "content of Ts = .*complex"),
    ("a.mat", mat_bytes(Ts=cells_of([[], []], (1, 2))), "photons of Ts = 0"),
    ("a.mat", mat_bytes(Ts=np.empty((0, 3), object)), "variable = None.*Ts"),
    ("a.mat", mat_bytes(SBR=1.0, D=np.ones((3, 3))), r"D \(double, 3 x 3\)"),
    ("a.mat", cell_bytes([0, 1e15]), "gate of Ts = '1000.*another time_unit_s"),
    ("a.mat", cell_bytes([0, 1e300]), r"largest time of Ts = 1e\+288"),
    # Files that crash SciPy or exhaust its memory
    ("a.mat", cell_file((1, 1), nested_cells(20_000)), "Ts cannot be read"),
    ("a.mat", cell_file((10**6, 10**6), PHOTON_CELL), "more memory"),
    ("a.mat", cell_file((1000, 1000), PHOTON_CELL), "Ts cannot be read"),
    ("a.mat", claims_more_inflated(), "Ts cannot be read"),
    (
        "a.mat",
        mat_file(matrix(UINT16_CLASS, (1, 1, 2), b"Ts", element(2000, b"abcd"))),
        "Ts cannot be read",
    ),
)


@pytest.mark.parametrize(("name", "content", "message"), REFUSED, ids=[each[2] for each in REFUSED])
def test_refused(name: str, content: bytes, message: str, write: Write) -> None:
    path = write(name, content)
    assert_refused(read_capture, path, message, CaptureError, 2**20 + 10 * len(content))


def test_long_pulses_need_a_long_gate(write: Write) -> None:
    """Up to 2**16 samples may last longer than a gate that was cut; more must fit in it."""
    for n_samples, spacing_s in ((2**16, 1e-9), (2**16 + 1, 1e-12)):
        kept = own(pulse_samples=np.ones(n_samples), pulse_tau_s=spacing_s)
        capture = read_capture(write("a.npz", kept))
        assert capture.pulse == Pulse.measured(np.ones(n_samples), spacing_s)
    path = write("a.npz", own(pulse_samples=np.ones(2**16 + 1)))
    with pytest.raises(CaptureError, match=r"pulse_samples = '65,537 of them, 65.537 µs' .*100 ns"):
        read_capture(path)
    assert read_capture(path, pulse=Pulse()).pulse == Pulse()
    path = write("a.npz", own(pulse_samples=np.ones(2**20 + 1, np.uint8)))
    with pytest.raises(CaptureError, match="pulse_samples = '1,048,577 of them'"):
        read_capture(path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"absent.mat: path = .*an existing file"):
        read_capture(tmp_path / "absent.mat")
    with pytest.raises(CaptureError, match="an existing file"):
        read_capture(tmp_path)
    with pytest.raises(CaptureError, match=r"^a+\.\.\.a+\.npz: .*File name too long") as caught:
        read_capture(tmp_path / ("a" * 300 + ".npz"))
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_names_that_are_no_text_are_kept_as_text(suffix: str, tmp_path: Path) -> None:
    """Bytes of a name that are no UTF-8 come as surrogates, which no file could hold as text."""
    path = tmp_path / "n\udcff\udcc3\udcb6.npz"
    path.write_bytes(npz_bytes(cube=CUBE))
    capture = read_capture(path)
    assert capture.source.startswith("n\\xff\u00f6.npz, variable cube")
    save_capture(capture, tmp_path / f"kept{suffix}")
    assert read_capture(tmp_path / f"kept{suffix}").source.startswith(capture.source)
    path.write_bytes(b"")
    with pytest.raises(CaptureError, match=r"^n\\xff\u00f6\.npz: "):
        read_capture(path)


BOMB = np.zeros((1, 1, 2**22), np.uint8)
BEYOND_1_MIB: dict[str, bytes] = {
    "bomb.npz": npz_bytes(cube=BOMB),
    "pixels.npz": npz_bytes(cube=np.zeros((512, 512, 1), np.uint8)),  # and their sums of int64
    "bomb.npy": npy_bytes(BOMB),
    "bomb.gz": gzip.compress(npy_bytes(BOMB)),
    "bomb.mat": mat_bytes(True, cube=BOMB),
    "cells.mat": mat_bytes(True, Ts=cells_of([np.ones(2**22, np.uint8)], (1, 1))),
    "wide.npy": npy_bytes(BOMB[:, :, : 2**20 - 200]),  # uint8 that would double
    "photons.mat": mat_bytes(True, Ts=cells_of([np.ones(2**19, np.uint8)], (1, 1))),
}


@pytest.mark.parametrize("name", BEYOND_1_MIB)
def test_content_beyond_the_limit_is_refused(
    name: str, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MAX_CUBE_BYTES == 2**31
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2**20)
    with pytest.raises(CaptureError, match=r"bytes of .* at most 1,048,576 bytes are read"):
        read_capture(write(name, BEYOND_1_MIB[name]))


# -- published captures ----------------------------------------------------------------------------


def test_building_at_21_km(real_capture: Callable[[str], Path]) -> None:
    capture = read_capture(real_capture("21km_K11_night.mat"))
    assert capture.cube.shape == (256, 256, 200)
    assert capture.counts.sum() == 640_952
    assert capture.acquisition == Acquisition(
        200, 1e-9, capture.acquisition.gate_delay_s, None, None
    )
    assert capture.acquisition.gate_delay_s == pytest.approx(4.43e-6, rel=1e-12)
    assert capture.source == (
        "21km_K11_night.mat, variable Ts_gated; guessed: time unit 1 ps, bin width 1 ns, "
        "gate 4430-4630 ns, pulse Gaussian of 450 ps (430 ps to 490 ps), all photons of a pulse"
    )


def test_mannequin_face(real_capture: Callable[[str], Path]) -> None:
    capture = read_capture(real_capture("data_face.mat"))
    assert capture.cube.shape == (340, 340, 876)
    assert (capture.counts.sum(), capture.counts.max()) == (955_670, 49)
    assert np.mean(capture.counts == 0) == pytest.approx(0.016, abs=5e-4)
    assert capture.acquisition.bin_width_s == pytest.approx(64e-12, rel=1e-12)
    assert capture.acquisition.gate_delay_s == pytest.approx(8e-9, rel=1e-12)
    # The pulse rises within 50 ps and has a tail of half a nanosecond.
    assert capture.pulse.shape == "gamma"
    assert capture.pulse.tau_s == pytest.approx(160e-12, rel=0.05)
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


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    dtype = draw(st.sampled_from([np.uint8, np.uint16, np.uint32]))
    cube = draw(hnp.arrays(dtype, hnp.array_shapes(min_dims=3, max_dims=3, max_side=5)))
    images = st.none() | hnp.arrays(np.float64, cube.shape[:2])
    photons = st.none() | hnp.arrays(np.float64, cube.shape[:2], elements=st.floats(0, 1e6))
    n_pulses = draw(st.none() | st.integers(1, 10**9))
    fits = n_pulses is None or cube.sum(axis=2, dtype=np.int64).max() <= n_pulses
    return Capture(
        cube,
        Acquisition(
            cube.shape[2],
            draw(times_s),
            draw(st.floats(-1e-3, 1e-3)),
            n_pulses,
            draw(st.floats(1e-9, 0.9)),
        ),
        draw(pulses),
        truth_range_m=draw(images),
        reported_range_m=draw(images),
        signal=draw(photons),
        background=draw(st.none() | st.floats(0, 1e6)),
        source=draw(st.text(st.characters(exclude_characters="\0", codec="utf-8"))),
        detection=draw(st.sampled_from(["first", "all"] if fits else ["all"])),
    )


@pytest.mark.uncounted
@settings(max_examples=30)
@given(captures())
def test_round_trip(capture: Capture) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "saved.npz"
        save_capture(capture, path)
        read = read_capture(path)
    assert read.cube.dtype == capture.cube.dtype
    np.testing.assert_array_equal(read.cube, capture.cube)
    for name in ("acquisition", "pulse", "background", "detection"):
        assert getattr(read, name) == getattr(capture, name)
    for image in ("truth_range_m", "reported_range_m", "signal"):
        kept, original = getattr(read, image), getattr(capture, image)
        assert (kept is None) == (original is None)
        assert kept is None or np.array_equal(kept, original, equal_nan=True)
    source, remark = (
        capture.source or "saved.npz, variable cube",
        "; truth: no target within the gate",
    )
    assert read.source == source or read.source.startswith(source + remark)


def test_an_existing_file_is_replaced_on_request_only(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    save_capture(Capture(CUBE, ACQUISITION), path)
    doubled = Capture(2 * CUBE, ACQUISITION)
    with pytest.raises(FileExistsError, match=r"kept.npz exists: .*overwrite"):
        save_capture(doubled, path)
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)
    save_capture(doubled, path, overwrite=True)
    np.testing.assert_array_equal(read_capture(path).cube, 2 * CUBE)
    with pytest.raises(ValueError, match=r"suffix = '\.mat' .*\.npz"):
        save_capture(doubled, tmp_path / "a.mat")
    assert os.listdir(tmp_path) == ["kept.npz"]
