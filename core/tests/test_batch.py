"""Tests of the command that ranges many captures, and of the names of their files."""

from __future__ import annotations

import csv
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.cli import main
from core.cli.batch import Job, ranged
from core.estimators import ESTIMATORS, estimate
from core.estimators.base import NoParameters
from core.geometry import Box
from core.inspection import estimate_mean_flux
from core.io import MOST_LETTERS, distinct_names, file_name
from core.io.writers import save_capture
from core.scene import scenes
from core.simulation import simulate
from core.tracking import TrackingParameters

pytestmark = pytest.mark.files


def stairs(seed: int) -> Capture:
    scene = scenes["staircase"](8)
    return simulate(scene, Acquisition(n_pulses=200), Flux(0.3, sbr=1.0), seed=seed)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two captures of one name in two folders, and a file that is none."""
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("day/a.npz", "night/a.npz", "night/b.npz")):
        path = tmp_path / "runs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        save_capture(stairs(seed), path)
    (tmp_path / "runs/night/b.npz").write_bytes(b"no archive")
    return tmp_path / "runs"


def batch(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main(["batch", "tracking", *arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_failing_file_is_a_row_and_the_others_are_ranged(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("runs/**/*.npz", "--t-n", "12", "--out", "found", "--format", "npz", "--format", "tif")
    code, out, err = batch(capsys, *given)
    assert code == 1
    assert "3 of 3 files" in err and "1 of 3 files failed:\nb.npz: " in err
    table = csv.DictReader(Path("found/summary.csv").read_text("utf-8").splitlines())
    rows = {row["file"]: row for row in table}
    assert list(rows) == ["runs/day/a.npz", "runs/night/a.npz", "runs/night/b.npz"]
    for line, row in zip(out.splitlines()[2:5], rows.values(), strict=True):
        assert row["file"] in line and row["error"] in line
    remarks = {row["file"]: row["remark"] for row in rows.values() if row["remark"]}
    assert out.splitlines()[5:] == [f"{name}: {remark}." for name, remark in remarks.items()]
    for seed, name in enumerate(("day-a", "night-a")):
        capture = stairs(seed)
        image = estimate(capture, "tracking", t_n=12)
        row = list(rows.values())[seed]
        with np.load(f"found/{name}_tracking_Tn12_range-image.npz") as archive:
            np.testing.assert_array_equal(archive["range_m"], image.range_m)
        assert int(row["photons"]) == capture.counts.sum()
        assert [row[size] for size in ("rows", "cols", "bins")] == ["8", "8", "100"]
        assert float(row["valid_share"]) == image.valid.mean()
        assert float(row["mean_confidence"]) == image.confidence[image.valid].mean()
        assert float(row["sbr"]) == estimate_mean_flux(capture).sbr.value
        assert float(row["seconds"]) > 0
        assert row["error"] == "" and row["method"] == "tracking"
        assert json.loads(row["settings"]) == asdict(TrackingParameters(t_n=12))
        assert row["remark"] == ESTIMATORS["tracking"].remark(capture)
        assert row["software"].startswith("firstphoton ")
        assert capture.source in row["source"]
    failed = rows["runs/night/b.npz"]
    assert failed["error"].startswith("b.npz: ")
    assert failed["valid_share"] == failed["photons"] == ""
    assert files_in(Path("found")) == [
        "day-a_tracking_Tn12_range-image.npz",
        "day-a_tracking_Tn12_range-image.tif",
        "night-a_tracking_Tn12_range-image.npz",
        "night-a_tracking_Tn12_range-image.tif",
        "summary.csv",
    ]


def test_files_are_ranged_in_parallel(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pools: list[int] = []

    def threads(workers: int) -> ThreadPoolExecutor:
        """Return a pool that starts no process."""
        pools.append(workers)
        return ThreadPoolExecutor(workers)

    monkeypatch.setattr("core.cli.batch.process_pool", threads)
    given = ("runs/day/a.npz", "runs/night/*", "--json")
    one, both = (batch(capsys, *given, "--jobs", jobs) for jobs in ("1", "2"))
    assert one[0] == both[0] == 1 and pools == [2]
    without_times = [
        {file: {**row, "seconds": None} for file, row in json.loads(out).items()}
        for _, out, _ in (one, both)
    ]
    assert without_times[0] == without_times[1]
    assert list(without_times[1]) == ["runs/day/a.npz", "runs/night/a.npz", "runs/night/b.npz"]
    assert files_in(runs.parent) == ["runs"]


def test_files_are_replaced_on_request_only(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    filters = ("--least-confidence", "0.95", "--false-alarm", "0.1")
    more = ("--format", "npz", "--format", "ply", "--intervals", "--fit", "--crop", "45", "-")
    given = ("runs/day/a.npz", "runs/day/a.npz", "--out", "found", *filters, *more)
    assert batch(capsys, *given)[0] == 0
    stem = "a_tracking_false-alarm0.1_least-confidence0.95"
    name, cloud = f"{stem}_range-image.npz", f"{stem}_cloud.ply"
    assert files_in(Path("found")) == [cloud, name, "summary.csv"]
    image = estimate(stairs(0), "tracking", false_alarm=0.1).confident(0.95)
    with np.load(f"found/{name}") as archive:
        np.testing.assert_array_equal(archive["range_m"], image.range_m)
        assert archive["least_confidence"] == 0.95
        assert (archive["range_low_m"] <= image.range_m)[image.valid].all()
        assert archive["fit_p_value"].shape == image.range_m.shape
    inside = image.cropped(Box(from_m=45.0)).valid
    assert 0 < inside.sum() < image.valid.sum()
    assert f"element vertex {inside.sum()}\n".encode() in Path("found", cloud).read_bytes()
    code, _, err = batch(capsys, *given)
    assert code == 2 and "found/summary.csv exists: give another name, or --overwrite" in err
    code, _, err = batch(capsys, *given, "--summary", "other.csv")
    assert code == 1 and f"{name} exists: give another name, or --overwrite" in err
    assert batch(capsys, *given, "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("absent/*.npz",), 1, "an existing file"),
        (("runs/day/a.npz", "--format", "tif"), 2, "--out"),
        (("runs/day/a.npz", "--t-n", "-1"), 2, "t_n = -1"),
        (("runs/day/a.npz", "--bin-width", "7"), 2, "--bin-width = '7'"),
        (("runs/day/a.npz", "--axes", "bin col row"), 1, "axes"),
        (("runs/day/a.npz", "--first-detections", "2"), 1, "a.npz: --first-detections = 2"),
        (("runs/day/a.npz", "--summary", "nowhere/a.csv"), 1, "nowhere is not a folder"),
    ],
)
def test_errors(
    arguments: tuple[str, ...],
    code: int,
    message: str,
    runs: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found, _, err = batch(capsys, *arguments)
    assert (found, message in err) == (code, True), err


class EndsProcess:
    """Ends the process that it is sent to, as the system does where memory is lacking."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (9,)


def test_a_process_that_ends_costs_its_own_file_only(runs: Path) -> None:
    good = Job(runs / "day/a.npz", "peak", NoParameters(), {})
    bad = replace(good, path=runs / "night/a.npz", options={"variable": EndsProcess()})
    found = {job.path: row for job, row in ranged([bad, good], 2)}
    assert found.keys() == {bad.path, good.path}
    assert found[good.path].photons == stairs(0).counts.sum() and not found[good.path].error
    assert found[bad.path].error.startswith("a.npz: its process ended")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["x/a.mat", "x/b.mat"], ["a", "b"]),
        (["x/a.mat", "x/A.npz"], ["a.mat", "A.npz"]),
        (["x/a.mat", "y/a.mat"], ["x-a", "y-a"]),
        (["z/x/a.mat", "y/x/a.mat"], ["a-1", "a-2"]),
        (["x/名.mat", "x/前.mat"], ["capture-1", "capture-2"]),
        ([f"x/{'a' * 60}1.mat", f"x/{'a' * 60}2.mat"], [f"{'a' * 32}-1", f"{'a' * 32}-2"]),
    ],
)
def test_names_of_several_files_differ(paths: list[str], names: list[str]) -> None:
    assert distinct_names([Path(path) for path in paths]) == names


def test_a_name_holds_as_many_settings_as_fit() -> None:
    many = [f"setting{n}" for n in range(30)]
    name = file_name("range image", "tif", capture="../a b", estimator="cfar", settings=many)
    assert name.startswith("a-b_cfar_setting0_setting1_")
    assert name.endswith("_range-image.tif")
    assert MOST_LETTERS - len("_setting10") < len(name) <= MOST_LETTERS
