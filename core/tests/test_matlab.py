"""MATLAB files: sparse matrices of both versions, and version 7.3."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.sparse import csc_array

from core.capture import CaptureError
from core.io.readers import guards, read_capture
from core.tests.formats import list_of, matlab73
from core.tests.labelled_files import Matlab73
from core.tests.samples import CUBE, arrival_cells, cells_of, mat_bytes

pytestmark = pytest.mark.files

Save = Callable[..., bytes]
Write = Callable[[bytes], Path]

SQUARE = np.random.default_rng(6).poisson(0.1, (8, 8, 64)).astype(np.uint16)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(content: bytes) -> Path:
        path = tmp_path / "a.mat"
        path.write_bytes(content)
        return path

    return written


WRITERS: dict[str, Save] = {"5": mat_bytes, "7.3": matlab73}


@pytest.fixture(params=WRITERS)
def save(request: pytest.FixtureRequest) -> Save:
    return WRITERS[request.param]


# -- sparse matrices -------------------------------------------------------------------------------


def test_a_square_image_is_guessed(save: Save, write: Write) -> None:
    path = write(save(spad=list_of(SQUARE), bin_size=80e-12, rates=np.ones((8, 7))))
    capture = read_capture(path)
    np.testing.assert_array_equal(capture.cube, SQUARE)
    assert capture.acquisition.bin_width_s == pytest.approx(80e-12)
    assert capture.source.startswith(
        "a.mat, variable spad; guessed: shape 8 x 8, pixels column by column, bin width 80 ps"
    )
    given = read_capture(path, shape=(8, 8), axes="col row", bin_width_s=1e-10, n_pulses=100)
    assert given.source.split("guessed: ")[1].startswith("gate")
    assert given.acquisition.bin_width_s == 1e-10 and given.detection == "first"


def test_shape_and_order_of_the_pixels(save: Save, write: Write) -> None:
    by_row = csc_array(CUBE.reshape(12, 100).astype(float))
    by_col = write(save(spad=list_of(CUBE)))
    np.testing.assert_array_equal(read_capture(by_col, shape=(3, 4)).cube, CUBE)
    path = write(save(spad=by_row))
    capture = read_capture(path, shape=(3, 4), axes="row col")
    np.testing.assert_array_equal(capture.cube, CUBE)
    assert "column" not in capture.source
    with pytest.raises(CaptureError, match=r"shape = None .*rows and columns of 12 pixels"):
        read_capture(path)
    with pytest.raises(CaptureError, match=r"shape = \(5, 2\) .*of 12 pixels"):
        read_capture(path, shape=(5, 2))
    with pytest.raises(CaptureError, match="axes = 'row col bin'"):
        read_capture(path, shape=(3, 4), axes="row col bin")


@pytest.mark.parametrize(
    ("value", "message"), [(-1.0, "= -1.0"), (0.5, "= 0.5"), (np.nan, "= nan")]
)
def test_other_numbers_than_counts_are_refused(
    value: float, message: str, save: Save, write: Write
) -> None:
    odd = list_of(SQUARE)
    odd.data[7] = value
    with pytest.raises(CaptureError, match=f"a.mat: spad {message}.* whole counts"):
        read_capture(write(save(spad=odd)))


@pytest.mark.parametrize(
    ("part", "values", "message"),
    [
        ("ir", [0, 9, 1], "rows of spad = 'out of order' .*below 4"),
        ("ir", [2, 0, 1], "rows of spad"),
        ("ir", [2, 2, 1], "rows of spad"),
        ("ir", [0, 2], "entries of spad = 3 .*up to 2"),
        ("jc", [0, 2, 9], "entries of spad"),
        ("jc", [0, 5, 3], "entries of spad"),
        ("jc", [1, 2, 3], "entries of spad"),
        ("data", [5.0, 6.0], "entries of spad"),
    ],
)
def test_damaged_sparse_matrices(
    part: str, values: list[float], message: str, write: Write
) -> None:
    file = Matlab73()
    group = file.sparse("spad", csc_array([[5.0, 0], [0, 7], [6, 0], [0, 0]]))
    kind = group[part].dtype
    del group[part]
    group[part] = np.array(values, kind)
    with pytest.raises(CaptureError, match=message):
        read_capture(write(file.bytes()), axes="row col")


def test_a_sparse_matrix_of_version_5_is_checked(write: Write) -> None:
    content = bytearray(mat_bytes(spad=csc_array([[5.0, 0], [0, 7], [6, 0], [0, 0]])))
    rows = content.index(np.array([0, 2, 1], "<i4").tobytes())
    content[rows : rows + 4] = (9).to_bytes(4, "little")
    with pytest.raises(CaptureError, match=r"rows of spad = 'out of order' .*below 4"):
        read_capture(write(bytes(content)), axes="row col")


def test_a_sparse_matrix_must_fit(
    save: Save, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(save(spad=csc_array(([1.0], ([0], [0])), shape=(1024, 1024))))
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2**20)
    with pytest.raises(CaptureError, match="bytes of the cube of spad = 2097152 "):
        read_capture(path)


def test_a_list_of_pixels_has_the_shape_of_another_array(save: Save, write: Write) -> None:
    wide = SQUARE.reshape(4, 16, 64)
    path = write(save(spad=list_of(wide), depth=np.ones((4, 16)), column=np.ones((64, 1))))
    capture = read_capture(path)
    np.testing.assert_array_equal(capture.cube, wide)
    assert "guessed: shape 4 x 16, that of depth, pixels" in capture.source
    # Arrays that contradict each other tell nothing.
    path = write(save(spad=list_of(SQUARE), a=np.ones((4, 16)), b=np.ones((16, 4))))
    assert "guessed: shape 8 x 8, pixels" in read_capture(path).source


@pytest.mark.parametrize("shape", [(8, 8, 64), (4, 16, 64)])
def test_where_counts_and_rates_fit_the_refusal_names_counts_first(
    shape: tuple[int, int, int], save: Save, write: Write
) -> None:
    counts = SQUARE.reshape(shape)
    path = write(save(rates=counts / 7.0, spad=list_of(counts)))
    with pytest.raises(CaptureError, match=r"variable = None .* give spad or rates") as refused:
        read_capture(path)
    assert list(refused.value.choices.items()) == [
        (name, {"variable": name}) for name in ("spad", "rates")
    ]
    capture = read_capture(path, variable="spad")
    np.testing.assert_array_equal(capture.cube, counts)
    assert CaptureError("other").choices == {}


# -- the width of a bin in another variable --------------------------------------------------------


@pytest.mark.parametrize(
    ("others", "width_s", "left_out"),
    [
        ({"binWidth": 4e-12}, 4e-12, []),
        ({"resolution": 4e-12, "bin_size": 4e-12}, 4e-12, []),
        ({"bin_size": 1e-9, "resolution": 1e-8}, 1e-9, ["bin_size = 1e-09", "resolution = 1e-08"]),
        ({"resolution": 4.0}, 1e-9, ["resolution = 4"]),  # in picoseconds, perhaps
        ({"resolution": np.nan}, 1e-9, []),
        ({"width": 4e-12}, 1e-9, []),
    ],
)
def test_bin_width_in_another_variable(
    others: dict[str, float], width_s: float, left_out: list[str], save: Save, write: Write
) -> None:
    capture = read_capture(write(save(counts=CUBE, **others)))
    assert capture.acquisition.bin_width_s == width_s
    remarks = "".join(f"{each}, without a unit, left out, " for each in left_out)
    assert f"guessed: axes (row, col, bin), {remarks}bin width" in capture.source


def test_numbers_of_the_own_layout_are_used(save: Save, write: Write) -> None:
    known = {"bin_width_s": 2e-9, "gate_delay_s": 1e-7, "n_pulses": 500.0, "pixel_angle_rad": 1e-3}
    path = write(save(counts=CUBE, resolution=4e-12, **known))
    capture = read_capture(path)
    assert vars(capture.acquisition) == known | {"n_bins": 100}
    assert capture.detection == "first"
    assert "bin width" not in capture.source and "gate" not in capture.source
    assert read_capture(path, n_pulses=900).acquisition.n_pulses == 900
    with pytest.raises(CaptureError, match=r"n_pulses = .*0\.5.* whole number"):
        read_capture(write(save(counts=CUBE, n_pulses=0.5)))


# -- version 7.3 -----------------------------------------------------------------------------------


def test_cells_of_every_kind(write: Write) -> None:
    """Rows, columns, numbers alone, and empty cells, which are stored as their size."""
    cells = np.empty((2, 3), object)
    cells[:] = [
        [np.array([[10, 11]]), np.array([[]]), np.array([[12], [10]])],
        [np.array(12), np.zeros((0, 0)), np.zeros((1, 0))],
    ]
    capture = read_capture(write(matlab73(Ts=cells)))
    np.testing.assert_array_equal(capture.counts, [[2, 0, 2], [1, 0, 0]])
    assert capture.cube[0, 2, 0] == capture.cube[0, 2, 2] == 1
    limited = read_capture(write(matlab73(Ts=cells)), first_detections=1)
    np.testing.assert_array_equal(limited.counts, [[1, 0, 1], [1, 0, 0]])
    assert limited.cube[0, 2, -1] == 1  # the 12 came first


def test_axes_are_turned(write: Write) -> None:
    options = {"bin_width_s": 1e-9, "gate_delay_s": 1e-6, "n_bins": 100}
    turned = matlab73(Ts=arrival_cells(CUBE.transpose(1, 0, 2)))
    np.testing.assert_array_equal(read_capture(write(turned), axes="col row", **options).cube, CUBE)
    turned = matlab73(counts=CUBE.transpose(2, 1, 0))
    np.testing.assert_array_equal(read_capture(write(turned), axes="bin col row").cube, CUBE)


def test_packed_cells_and_cubes(write: Write) -> None:
    file = Matlab73()
    file.cells("Ts", arrival_cells(CUBE), chunks=(1, 1), compression="gzip")
    file.number("counts", CUBE, chunks=(50, 4, 3), compression="gzip", shuffle=True)
    path = write(file.bytes())
    with pytest.raises(CaptureError, match=r"variable = None .* give Ts or counts"):
        read_capture(path)
    np.testing.assert_array_equal(read_capture(path, variable="counts").cube, CUBE)
    capture = read_capture(path, variable="Ts", n_bins=100, gate_delay_s=1e-6)
    np.testing.assert_array_equal(capture.cube, CUBE)


def test_other_variables_do_not_fit(write: Write) -> None:
    file = Matlab73()
    file.text("note", "hello")
    file.number("empty", np.zeros((0, 3, 4)))
    file.number("depth", np.ones((3, 3)))
    path = write(file.bytes())
    listed = r"depth \(double, 3 x 3\), empty .*not numbers.*, note .*not numbers"
    with pytest.raises(CaptureError, match=f"variable = None .*{listed}"):
        read_capture(path)


def cell_with(change: Callable[[Matlab73, h5py.Dataset], Any]) -> bytes:
    """A row of three cells, of which the second was changed."""
    file = Matlab73()
    array = file.cells("Ts", cells_of([[5], [6], [7]], (1, 3)))
    change(file, array)
    return file.bytes()


def refers(name: str) -> Callable[[Matlab73, h5py.Dataset], Any]:
    def change(_: Matlab73, array: h5py.Dataset) -> None:
        references = array[()]
        references[1, 0] = array.file[name].ref
        array[...] = references

    return change


def text(_: Matlab73, array: h5py.Dataset) -> None:
    array.file["#refs#/c1"].attrs["MATLAB_int_decode"] = np.int32(2)


def square(file: Matlab73, array: h5py.Dataset) -> None:
    file.number("#refs#/square", np.ones((2, 3)))
    refers("#refs#/square")(file, array)


def outside(file: Matlab73, array: h5py.Dataset) -> None:
    array.file.create_dataset("#refs#/out", (1, 4), "u2", external=[("/etc/passwd", 0, 8)])
    refers("#refs#/out")(file, array)


def nowhere(_: Matlab73, array: h5py.Dataset) -> None:
    references = array[()]
    references[1, 0] = h5py.Reference()
    array[...] = references


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (refers("Ts"), r"Ts in pixel \(0, 1\) = no numbers"),
        (refers("#refs#"), r"Ts in pixel \(0, 1\) = no array"),
        (text, r"Ts in pixel \(0, 1\) = text"),
        (square, r"Ts in pixel \(0, 1\) = array of shape \(2, 3\) .*give a vector"),
        (outside, r"Ts in pixel \(0, 1\) = an array kept in other files"),
        (nowhere, "Ts"),
    ],
)
def test_cells_refused(
    change: Callable[[Matlab73, h5py.Dataset], Any], message: str, write: Write
) -> None:
    with pytest.raises(CaptureError, match=message) as caught:
        read_capture(write(cell_with(change)))
    assert str(caught.value).startswith("a.mat: ")
