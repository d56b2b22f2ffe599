"""Tests of files of one name pattern, read as a sequence in time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core import Acquisition, Capture, CaptureError, Pulse, read_capture, save_capture
from core.cli import main

pytestmark = pytest.mark.files

ACQUISITION = Acquisition(40, 1e-9, 1e-8, 100)
TRUTH_M = np.full((3, 4), 3.0)
CUBES = np.random.default_rng(4).poisson(0.2, (11, 3, 4, 40)).astype(np.uint16)
RUNS = [
    Capture(cube, ACQUISITION, Pulse(2e-9, shape="gaussian"), TRUTH_M, signal=TRUTH_M * (n > 3))
    for n, cube in enumerate(CUBES)
]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """The pattern of eleven files, whose numbers have one or two digits."""
    for n, run in enumerate(RUNS):
        save_capture(run, tmp_path / f"run_{n}.npz")
    return tmp_path / "run_*.npz"


def test_files_are_added_up_in_the_order_of_their_numbers(runs: Path) -> None:
    found = read_capture(runs)
    np.testing.assert_array_equal(found.cube, CUBES.sum(axis=0))
    assert found.acquisition == replace(ACQUISITION, n_pulses=1100)
    assert (found.n_records, found.detection, found.pulse) == (11, "first", RUNS[0].pulse)
    np.testing.assert_array_equal(found.truth_range_m, TRUTH_M)
    assert found.signal is None  # it differs
    assert found.source.startswith("all 11 files added; ")
    last = read_capture(runs, records=10)
    np.testing.assert_array_equal(last.cube, CUBES[10])
    assert last.acquisition == ACQUISITION and last.source.startswith("file 10 of 11")
    some = read_capture(runs, records=(4, 5))
    np.testing.assert_array_equal(some.cube, CUBES[4] + CUBES[5])
    np.testing.assert_array_equal(some.signal, TRUTH_M)


def test_a_sequence_is_ranged_from_the_command_line(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["info", str(runs)], ["estimate", "peak", "--capture", str(runs)]):
        assert main([*command, "--records", "2-3", "--json"]) == 0
        assert "files 2 to 3 of 11 added" in json.loads(capsys.readouterr().out)["source"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"cube": CUBES[0][:2], "truth_range_m": None, "signal": None},
            r"shape of the file = \(2, 4, 40\)",
        ),
        ({"detection": "all"}, "detections of the file = 'all'"),
        ({"acquisition": replace(ACQUISITION, bin_width_s=2e-9)}, "that of the files before"),
    ],
)
def test_files_that_do_not_belong_together_are_refused(
    change: dict[str, object], message: str, runs: Path
) -> None:
    save_capture(replace(RUNS[0], **change), runs.with_name("run_3.npz"), overwrite=True)
    with pytest.raises(CaptureError, match=rf"run_\*.npz: run_3.npz: .*{message}"):
        read_capture(runs)
    with pytest.raises(CaptureError, match="one of 0 to 10"):
        read_capture(runs, records=11)


def test_a_pattern_without_files_is_refused_and_a_name_may_look_like_one(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="an existing file"):
        read_capture(tmp_path / "run_*.npz")
    save_capture(RUNS[0], tmp_path / "run_[1].npz")
    assert read_capture(tmp_path / "run_[1].npz").n_records is None
