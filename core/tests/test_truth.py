"""Tests of true ranges that a file beside the capture holds."""

from __future__ import annotations

import gzip
import json
import random
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from core import metrics
from core.acquisition import SPEED_OF_LIGHT_M_S, Acquisition
from core.capture import Capture, CaptureError
from core.cli import main
from core.estimators import estimate
from core.io import PossibleTruth, possible_truths, read_capture, read_truth
from core.io.writers import CAPTURE_SUFFIXES, save_capture, save_image
from core.tests.captures import real_capture_path
from core.tests.formats import put
from core.tests.labelled_files import Matlab73, hdf5_bytes
from core.tests.refusing import count_refused
from core.tests.samples import cells_of, mutated, npy_bytes, npz_bytes

pytestmark = pytest.mark.files

SHAPE = (3, 4)
ACQUISITION = Acquisition(100, 1e-9, 1e-6, 500)
CUBE = np.random.default_rng(0).poisson(0.1, (*SHAPE, 100)).astype(np.uint16)
CAPTURE = Capture(CUBE, ACQUISITION, source="wall")
BINS = np.arange(20.0, 32.0).reshape(SHAPE)
BINS[1, 2] = np.nan
TRUTH_M = ACQUISITION.bin_to_range_m(BINS)
BESIDE = np.zeros((9, 9))


def mat(path: Path, **variables: Any) -> None:
    savemat(path, variables)


def mat73(path: Path, **variables: Any) -> None:
    file = Matlab73()
    for name, values in variables.items():
        (file.cells if values.dtype == object else file.number)(name, values)
    path.write_bytes(file.bytes())


def cells(values: np.ndarray) -> np.ndarray:
    return cells_of([[value] for value in values.ravel()], values.shape)


WRITE: dict[str, Callable[[Path, np.ndarray], Any]] = {
    "a.npy": np.save,
    "a.npz": lambda path, values: np.savez(path, depth=values, other=BESIDE),
    "v5.mat": lambda path, values: mat(path, depth=values, other=BESIDE),
    "v73.mat": lambda path, values: mat73(path, depth=values, other=BESIDE),
    "cells5.mat": lambda path, values: mat(path, depth=cells(values)),
    "cells73.mat": lambda path, values: mat73(path, depth=cells(values)),
    "a.h5": lambda path, values: put(path, hdf5_bytes(depth=values, other=BESIDE)),
    "a.tif": lambda path, values: tifffile.imwrite(path, values.astype(np.float32)),
    "a.npy.gz": lambda path, values: path.write_bytes(gzip.compress(npy_bytes(values))),
}


@pytest.mark.parametrize("name", WRITE)
def test_a_truth_is_read_from_every_format(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    WRITE[name](path, TRUTH_M)
    found = read_truth(path, CAPTURE, truth_unit="m")
    np.testing.assert_allclose(found.truth_range_m, TRUTH_M, rtol=6e-8)  # 32-bit floats in a TIFF
    assert found.source.startswith(f"wall; truth: {name}")
    assert found.source.endswith(", in m")
    assert replace(found, truth_range_m=None, source="wall").cube is CUBE
    with pytest.raises(CaptureError, match=rf"{name}: truth_unit = None .*'m' or 'bins' or 'ns'"):
        read_truth(path, CAPTURE)


def test_bins_begin_with_the_gate_and_times_with_the_pulse(tmp_path: Path) -> None:
    path = tmp_path / "truth.npy"
    bins = BINS - 20  # the first pixel has its target in bin 0
    np.save(path, bins)
    found = np.asarray(read_truth(path, CAPTURE, truth_unit="bins").truth_range_m)
    np.testing.assert_array_equal(found, ACQUISITION.bin_to_range_m(bins))
    assert found[0, 0] == pytest.approx(1e-6 * SPEED_OF_LIGHT_M_S / 2, rel=1e-12)
    times_ns = 1000.0 + BINS
    times_ns[0, 0] = 0.0  # no target
    np.save(path, times_ns)
    found = np.asarray(read_truth(path, CAPTURE, truth_unit="ns").truth_range_m)
    assert np.isnan(found[0, 0]) and np.isnan(found[1, 2])
    np.testing.assert_allclose(found[1, 3], 1027e-9 * SPEED_OF_LIGHT_M_S / 2, rtol=1e-12)


@pytest.mark.parametrize("suffix", [".npz", ".nc", ".h5", ".zarr", ".tif"])
def test_our_own_results_are_metres(suffix: str, tmp_path: Path) -> None:
    image, path = estimate(CAPTURE, "peak"), tmp_path / f"result{suffix}"
    save_image(CAPTURE, image, path)
    found = read_truth(path, CAPTURE)
    np.testing.assert_allclose(found.truth_range_m, image.range_m, rtol=6e-8)
    assert metrics.rmse_m(image.range_m, found.truth_range_m) < 1e-4


@pytest.mark.parametrize("suffix", CAPTURE_SUFFIXES)
def test_the_truth_of_a_simulated_capture_is_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"simulated{suffix}"
    save_capture(replace(CAPTURE, truth_range_m=TRUTH_M), path)
    np.testing.assert_array_equal(read_truth(path, CAPTURE).truth_range_m, TRUTH_M)


@pytest.mark.parametrize("suffix", CAPTURE_SUFFIXES)
def test_a_truth_beside_the_counts_that_lies_beyond_the_gate_is_remarked_on(
    suffix: str, tmp_path: Path
) -> None:
    remark = "truth: no target within the gate, 41.9709 to 43.1701 m"
    acquisition = Acquisition(8, 1e-9, 280e-9, 100)
    for number, (truth_m, is_beyond) in enumerate(
        ((42.0, False), (np.nan, False), (41.9, True), (43.2, True))
    ):
        truth = np.full((3, 4), np.nan)
        truth[1, 2] = truth_m
        capture = Capture(np.ones((3, 4, 8), np.uint16), acquisition, truth_range_m=truth)
        path = tmp_path / f"{number}{suffix}"
        save_capture(capture, path)
        found = read_capture(path)
        assert (remark in found.source) is is_beyond
        np.testing.assert_array_equal(found.truth_range_m, truth)


def test_a_file_may_state_its_unit(tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    np.savez(path, depth_m=TRUTH_M)
    np.testing.assert_array_equal(read_truth(path, CAPTURE).truth_range_m, TRUTH_M)
    packed = {
        "data": np.where(np.isnan(BINS), -1, 10 * BINS).astype(np.int16),
        "attributes": {"units": "ns", "_FillValue": -1, "scale_factor": 0.1, "add_offset": 1000.0},
    }
    path = put(tmp_path / "truth.h5", hdf5_bytes(depth=packed))
    found = read_truth(path, CAPTURE)
    np.testing.assert_allclose(found.truth_range_m, TRUTH_M, rtol=1e-12)
    # What the caller states counts.
    with pytest.raises(CaptureError, match="targets within the gate"):
        read_truth(path, CAPTURE, truth_unit="m")


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        (npy_bytes(TRUTH_M.T), {"truth_unit": "m"}, r"shape \(4, 3\).*shape \(3, 4\)"),
        (npy_bytes(TRUTH_M[..., None]), {"truth_unit": "m"}, "truth_variable = None"),
        (npy_bytes(TRUTH_M), {"truth_unit": "mm"}, "truth_unit = 'mm'"),
        (npy_bytes(BINS), {"truth_unit": "m"}, "true ranges = '20 to 31 m' .*149.896 to 164.886 m"),
        (npy_bytes(BINS * np.nan), {"truth_unit": "bins"}, "no target"),
        (npy_bytes(-BINS), {"truth_unit": "bins"}, r"pixel \(0, 0\) = -20"),
        (npy_bytes(np.full(SHAPE, "a")), {"truth_unit": "m"}, "real numbers"),
        (npz_bytes(a=TRUTH_M, b=TRUTH_M), {}, r"truth_variable = None .*a \(3 x 4\), b \(3 x 4\)"),
        (npz_bytes(a=TRUTH_M), {"truth_variable": "c"}, "truth_variable = 'c'"),
        (b"no numbers", {}, "format = '.npy'"),
        (b"", {}, "format = '.npy'"),
    ],
)
def test_what_cannot_be_the_truth_is_refused(
    content: bytes, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = put(tmp_path / "truth.npy", content)
    with pytest.raises(CaptureError, match=rf"^truth\.npy: .*{message}"):
        read_truth(path, CAPTURE, **options)


def test_pickles_are_refused_and_absent_files_named(tmp_path: Path) -> None:
    objects = np.empty(SHAPE, object)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    with pytest.raises(CaptureError, match="pickled objects are refused"):
        read_truth(tmp_path / "a.npy", CAPTURE, truth_unit="m")
    with pytest.raises(CaptureError, match="an existing file"):
        read_truth(tmp_path / "b.npy", CAPTURE)


@pytest.mark.uncounted
@pytest.mark.parametrize("name", WRITE)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    path, rng = tmp_path / name, random.Random(1)
    WRITE[name](path, TRUTH_M)
    contents = [mutated(path.read_bytes(), rng) for _ in range(20)]
    read = partial(read_truth, capture=CAPTURE, truth_unit="m")
    assert count_refused(read, path, contents, CaptureError) > 0


def test_of_several_images_a_name_chooses(tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    np.savez(path, a_m=TRUTH_M, b_m=TRUTH_M + 1)
    found = read_truth(path, CAPTURE, truth_variable="b_m")
    np.testing.assert_array_equal(found.truth_range_m, TRUTH_M + 1)


def refuse(*_: object) -> None:
    """Raise, as for a file whose images cannot be listed."""
    raise CaptureError("no")


@pytest.mark.parametrize("write", [mat, mat73, np.savez])
def test_maps_beside_the_counts_may_be_the_truth(
    write: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / ("a.npz" if write is np.savez else "a.mat")
    nearer_m = TRUTH_M - ACQUISITION.gate_delay_s * SPEED_OF_LIGHT_M_S / 2
    beside = {"bin": BINS, "range_m": nearer_m, "depth": 1e6 * BINS, "albedo": BINS, "dist": BESIDE}
    write(path, counts=CUBE, bin_width_s=np.array(1e-9), **beside)
    found = possible_truths(path, read_capture(path))
    # Most of the bins would be metres beyond a gate of 15 m.
    assert found == [
        PossibleTruth("range_m", ("m",), is_unit_stated=True),
        PossibleTruth("bin", ("bins", "ns"), is_unit_stated=False),
    ]
    known = facts(capsys, "info", path)
    assert known["possible_truths"][1] == "--truth-variable bin --truth-unit bins or ns"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("core.cli.captures.possible_truths", refuse)
        assert "possible_truths" not in facts(capsys, "info", path)
    given = ("--capture", path, "--truth-variable", "range_m", "--bin-width", "1ns")
    known = facts(capsys, "estimate", "peak", *given)
    assert known["pixels_with_a_target"] == 11
    assert f"truth: {path.name}, variable range_m, in m" in known["source"]


def test_a_published_truth_is_read() -> None:
    """A cell array with a bin in each cell; the wall lies in bin 4000."""
    path = real_capture_path("data_mannequin_face_truth.mat")
    cube = np.broadcast_to(np.uint8(1), (350, 350, 5000))
    capture = Capture(cube, Acquisition(5000, 8e-12, n_pulses=None))
    found = read_truth(path, capture, truth_unit="bins", truth_variable="D_true")
    bins = capture.acquisition.range_m_to_bin(np.asarray(found.truth_range_m))
    values, occur = np.unique(bins.round(3), return_counts=True)
    assert values[occur.argmax()] == 4000


def facts(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert main([*map(str, arguments), "--json"]) == 0, capsys.readouterr().err
    return dict(json.loads(capsys.readouterr().out))


@pytest.mark.parametrize("most_bytes", [2**31, 100], ids=["at once", "in tiles"])
def test_a_capture_with_a_truth_gets_the_figures_of_a_simulated_one(
    most_bytes: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    capture, truth = tmp_path / "wall.nc", tmp_path / "truth.npy"
    save_capture(CAPTURE, capture)
    np.save(truth, BINS)
    monkeypatch.setattr("core.cli.captures.MAX_CUBE_BYTES", most_bytes)
    given = ("--truth", truth, "--truth-unit", "bins")
    found = facts(capsys, "estimate", "peak", "--capture", capture, *given)
    range_m = estimate(CAPTURE, "peak").range_m
    assert found["rmse_m"] == metrics.rmse_m(range_m, TRUTH_M)
    assert found["pixels_with_a_target"] == 11
    assert "truth: truth.npy, in bins" in found["source"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--capture", "wall.npz", "--truth", "truth.npy"), "--truth-unit is missing"),
        (("--capture", "wall.npz", "--truth-unit", "m"), "there is no --truth"),
        (("--truth", "truth.npy"), "a scene has its own truth"),
        (("--capture", "wal*.npz", "--truth-variable", "a"), "a sequence has no file of its own"),
        (("--capture", "wall.npz", "--truth", "truth.npy", "--truth-unit", "m"), ": true ranges ="),
        (("--capture", "wall.npz", "--truth", "no.npy"), "no.npy: path = "),
    ],
)
def test_options_for_a_truth_that_do_not_fit_are_refused(
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    save_capture(CAPTURE, "wall.npz")
    np.save("truth.npy", BINS)
    assert main(["estimate", "peak", *arguments]) == 2
    assert message in capsys.readouterr().err
