"""The commands for captures, as a shell calls them."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.cli import main
from core.estimators import estimate
from core.geometry import Box, guessed_field_of_view_deg, pixel_angle_of
from core.inference import fit_p_values, range_intervals
from core.io import readers
from core.io.readers import Reader, read_capture
from core.io.writers import CAPTURE_SUFFIXES, WRITERS, save_capture
from core.out_of_core.tiles import IMAGES
from core.scene import scenes
from core.simulation import simulate

pytestmark = pytest.mark.files

ROOT = Path(__file__).resolve().parents[2]


def ran(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Return exit code, standard output and standard error."""
    code = main([str(each) for each in arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def facts(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Return what a successful command prints as JSON."""
    code, out, err = ran(capsys, *arguments, "--json")
    assert code == 0, err
    return dict(json.loads(out))


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A file of counts without metadata: 4 x 5 pixels, 30 bins, bins first."""
    counts = np.random.default_rng(0).poisson(0.3, (30, 4, 5)).astype(np.uint16)
    path = tmp_path / "counts.npy"
    np.save(path, counts)
    return path


READING = ("--axes", "bin row col")


def test_info_shows_contents_and_assumptions(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = facts(capsys, "info", frames, *READING, "--bin-width", "500ps")
    assert (found["rows"], found["cols"], found["bins"]) == (4, 5, 30)
    assert found["bin_width_s"] == 5e-10
    assert found["photons"] == np.load(frames).sum()
    assert found["n_pulses"] is None
    assert found["detection"] == "all"
    assert "500 ps" in found["source"]
    code, out, _ = ran(capsys, "info", frames)
    assert code == 0
    assert "axes (row, col, bin), bin width 1 ns" in out


def test_info_lists_hot_and_dead_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    counts = np.full((9, 15, 10), 20, np.uint16)
    counts[1::3, 1:14:2] = 90  # no two beside each other
    counts[4, 4] = 0
    path = tmp_path / "worn.npz"
    save_capture(Capture(counts, Acquisition(10, n_pulses=200_000)), path)
    found = facts(capsys, "info", path)
    assert found["hot_pixels"] == len(found["hot_pixels_at"]) == 21
    assert found["dead_pixels_at"] == [
        {
            "row": 4,
            "col": 4,
            "health": "dead",
            "counts": 0,
            "neighbours_least": 200,
            "neighbours_most": 900,
        }
    ]
    _, out, _ = ran(capsys, "info", path)
    lines = [line.strip() for line in out.splitlines()]
    assert sum("health hot, counts 900" in line for line in lines) == 10
    assert "and 11 more: --json has all" in lines
    assert any(line.startswith("dead_pixels_at") and "row 4, col 4" in line for line in lines)


def test_info_reports_on_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = scenes["staircase"](8)
    capture = simulate(scene, Acquisition(n_pulses=200), Flux(0.3, sbr=1.0), seed=3)
    assert capture.truth_range_m is not None
    only_here = np.arange(64).reshape(8, 8) == 2 * 8 + 3
    reported_m = np.where(only_here, capture.truth_range_m - 1.0, np.nan)
    capture = replace(capture, reported_range_m=reported_m)
    path = tmp_path / "stairs.npz"
    save_capture(capture, path)
    found = facts(capsys, "info", path)
    assert found["reported_range_compared_with"] == "likelihood"
    assert found["reported_range_pixels_compared"] == 1
    assert found["reported_range_median_difference_m"] == pytest.approx(1.0, abs=0.1)
    assert found["reported_range_difference_spread_m"] == 0
    assert found["signal_low"] < 0.3 < found["signal_high"]
    assert found["sbr_low"] <= found["sbr"] <= found["sbr_high"]
    for name in ("target_signal", "target_sbr"):
        assert found[f"{name}_low"] <= found[name] <= found[f"{name}_high"]
    assert "empty" in found["flux_mean_over"] and "target" in found["target_flux_mean_over"]
    assert "background" in found["flux_remark"]
    assert found["hot_pixels"] == found["dead_pixels"] == 0
    assert found["suggested_gate_first_bin"] < found["suggested_gate_end_bin"] <= 100
    pixel = facts(capsys, "info", path, "--pixel", 2, 3)
    assert pixel["method"] == "tracking"
    assert pixel["photons"] == capture.counts[2, 3]
    assert pixel["candidate_1_range_m"] == pixel["range_m"]
    assert pixel["candidate_1_probability"] == pixel["confidence"]
    assert pixel["range_low_m"] < pixel["range_low_68_m"] < pixel["range_high_68_m"]
    half_m = (pixel["range_high_m"] - pixel["range_low_m"]) / 2
    assert pixel["interval"].endswith(f" ± {half_m:.3f} m (95 %)")
    assert pixel["verdict"] == "ordinary"
    assert pixel["reported_range_m"] == pytest.approx(reported_m[2, 3])
    difference_m = pixel["range_m"] - reported_m[2, 3]
    assert pixel["reported_range_difference_m"] == pytest.approx(difference_m)
    code, _, err = ran(capsys, "info", path, "--pixel", 8, 0)
    assert code == 2 and "row, col = (8, 0)" in err
    save_capture(replace(capture, detection="all"), path, overwrite=True)
    assert facts(capsys, "info", path, "--pixel", 2, 3)["method"] == "likelihood"


@pytest.mark.parametrize("suffix", CAPTURE_SUFFIXES)
def test_a_simulated_capture_is_written_and_read_back(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"car{suffix}"
    arguments = ("simulate", "--scene", "staircase", "--size", 8, "--sbr", 0.5, "--pulses", 50)
    found = facts(capsys, *arguments, "--seed", 3, "--out", path)
    scene = scenes["staircase"](8)
    expected = simulate(
        scene, Acquisition(n_pulses=50, pixel_angle_rad=0.016), Flux(sbr=0.5), seed=3
    )
    capture = read_capture(path)
    np.testing.assert_array_equal(capture.cube, expected.cube)
    assert capture.acquisition == expected.acquisition
    assert (capture.pulse, capture.detection) == (expected.pulse, expected.detection)
    np.testing.assert_allclose(capture.truth_range_m, expected.truth_range_m)
    assert capture.source == found["source"] == f"staircase, {expected.source}"
    assert expected.source == "simulated, seed 3, SBR 0.5, PPP 0.1041"
    assert found["photons"] == expected.counts.sum()
    code, _, err = ran(capsys, *arguments, "--out", path)
    assert code == 2
    assert "exists: give another name, or --overwrite" in err
    assert ran(capsys, *arguments, "--out", path, "--overwrite")[0] == 0
    assert not np.array_equal(read_capture(path).cube, expected.cube)  # another seed


@pytest.fixture
def car() -> Capture:
    scene = scenes["car"]()
    return simulate(scene, scene.acquisition, Flux(sbr=0.2), seed=1)


@pytest.mark.compiled
def test_estimate_writes_what_it_reports(
    car: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, tif, las = tmp_path / "car.npz", tmp_path / "car.tif", tmp_path / "car.las"
    npz = tmp_path / "image.npz"
    save_capture(car, path)
    outputs = ("--out", tif, "--out", las, "--out", npz, "--intervals", "--fit")
    arguments = ("--capture", path, "--false-alarm", 0.01, *outputs)
    found = facts(capsys, "estimate", "cfar", *arguments, "--guard-bins", 4)
    image = estimate(car, "cfar", false_alarm=0.01, guard_bins=4)
    assert found["pixels_estimated"] == image.valid.sum()
    assert found["rd_3_bins"] > 0.9
    assert "guard_bins=4" in found["settings"]
    np.testing.assert_allclose(tifffile.imread(tif)[0], image.range_m, rtol=1e-6)
    assert las.stat().st_size > 20 * image.valid.sum()
    with np.load(npz) as archive:
        inner, outer = range_intervals(car, image)
        np.testing.assert_array_equal(archive["range_low_m"], outer.low_m)
        np.testing.assert_array_equal(archive["range_high_68_m"], inner.high_m)
        np.testing.assert_array_equal(archive["fit_p_value"], fit_p_values(car))
    sure, given = tmp_path / "sure.npz", ("--least-confidence", 0.99, "--overwrite")
    cloud, crop = tmp_path / "cropped.ply", ("--crop", 50, "-", "--crop-pixels", "0,0 0,63 63,0")
    files = ("--out", sure, "--out", cloud)
    more = facts(capsys, "estimate", "peak", *arguments[:2], *given, *crop, *files)
    peak = estimate(car, "peak")
    assert more["pixels_estimated"] == peak.valid.sum()
    with np.load(sure) as archive:
        np.testing.assert_array_equal(archive["valid"], peak.confident(0.99).valid)
        assert (archive["method"], archive["settings"]) == ("peak", "{}")
    inside = peak.confident(0.99).cropped(Box(((0, 0), (0, 63), (63, 0)), 50.0)).valid
    assert 0 < inside.sum() < peak.confident(0.99).valid.sum()
    assert f"element vertex {inside.sum()}\n".encode() in cloud.read_bytes()
    arguments = ("--t-n", 30, "--weight", "none", "--sbr", 0.2, "--seed", 1)
    found = facts(capsys, "estimate", "tracking", *arguments)
    image = estimate(car, "tracking", t_n=30, weight="none")
    assert found["pixels_estimated"] == image.valid.sum()
    assert found["median_range_m"] == pytest.approx(np.median(image.range_m[image.valid]))


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (("coates",), "remark"),
        (("coates", "--detection", "first"), "remark"),
        (("coates", "--pulses", 500), "remark"),
        (("tracking", "--m", 0.7), "in_doubt"),
        (("coates", "--pulses", 40), None),
        (("peak",), None),
        (("tracking",), None),
    ],
)
def test_estimate_remarks_on_pile_up_and_doubtful_settings(
    arguments: tuple[object, ...], key: str, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    method, *options = arguments
    found = facts(capsys, "estimate", method, "--capture", frames, *READING, *options)
    assert {"remark", "in_doubt"} & set(found) == ({key} if key else set())


@pytest.mark.compiled
def test_what_exceeds_memory_is_ranged_in_tiles(
    car: Capture,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "car.zarr"
    save_capture(car, path)
    whole = facts(capsys, "estimate", "tracking", "--capture", path, "--out", tmp_path / "w.npz")
    monkeypatch.setattr("core.cli.captures.MAX_CUBE_BYTES", 1000)
    tiles = facts(capsys, "estimate", "tracking", "--capture", path, "--out", tmp_path / "t.npz")
    assert tiles["pixels_estimated"] == whole["pixels_estimated"]
    assert "rd_3_bins" in whole and "rd_3_bins" not in tiles  # ranged without its truth
    assert "photons" not in facts(capsys, "info", path)
    with np.load(tmp_path / "w.npz") as one, np.load(tmp_path / "t.npz") as other:
        for name in IMAGES:
            np.testing.assert_array_equal(one[name], other[name])


def test_a_pixel_or_a_capture_is_exported(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    counts = np.load(frames)
    out, *captures = (frames.with_name(name) for name in ("pixel.csv", "a.nc", "a.npz"))
    assert ran(capsys, "export", frames, out, "--pixel", 1, 2, *READING)[0] == 0
    comments, lines = (
        [line for line in out.read_text().splitlines() if line.startswith("#") == marked]
        for marked in (True, False)
    )
    assert comments[0] == "# method: tracking"
    assert comments[-1].startswith("# source: counts.npy")
    assert lines[0].split(",")[:4] == ["bin", "time_s", "range_m", "counts"]
    assert [int(line.split(",")[3]) for line in lines[1:]] == counts[:, 1, 2].tolist()
    code, _, err = ran(capsys, "export", frames, captures[1], "--pixel", 1, 2, *READING)
    assert code == 2 and ".csv" in err
    assert ran(capsys, "export", frames, *captures, *READING)[0] == 0
    for path in captures:
        np.testing.assert_array_equal(read_capture(path).cube, counts.transpose(1, 2, 0))


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("info", "absent.npz"), 2, "absent.npz: path = "),
        (("info", "{frames}", "--axes", "a b c"), 2, "axes = 'a b c'"),
        (("estimate", "peak", "--capture", "{frames}", "--out", "a.doc"), 2, "suffix = '.doc'"),
        (("estimate", "peak", "--out", "nowhere/a.npz"), 1, "nowhere is not a folder"),
        (("estimate", "cfar", "--guard-bins", "-1"), 2, "guard_bins = -1"),
        (("estimate", "peak", "--scheduler", "tcp://a:1"), 2, "needs a --capture"),
        (("estimate", "peak", "--scheduler", "a", "--intervals"), 2, "intervals = True"),
        (("estimate", "peak", "--scheduler", "a", "--fit"), 2, "fit = True"),
        (("export", "{frames}", "{frames}"), 2, "suffix = '.npy'"),
        (("simulate", "--scene", "absent.stl", "--out", "a.npz"), 2, "absent.stl"),
        (("simulate", "--sbr", "0", "--out", "a.npz"), 2, "sbr = 0"),
        (("simulate", "--scene", "cars", "--out", "a.npz"), 2, "car or building or"),
        (("simulate", "--distance", "3", "--out", "a.npz"), 2, "a view of its own"),
        (("estimate", "peak", "--pulses", "7"), 2, "a scene is not read from a file"),
        (
            ("estimate", "peak", "--capture", "{frames}", "--sbr", "1"),
            2,
            "a capture has its own flux",
        ),
        (
            ("info", "{frames}", "--gate-delay=5ns", "--first-detections", "3"),
            2,
            "--first-detections",
        ),
        (("info", "{frames}", "--records", "0"), 2, "leave it out: the file holds no sequence"),
        (("info", "{frames}", "--bin-width", "64"), 2, "give a time such as 64ps"),
        (("info", "{frames}", "--pixel-angle", "20 km"), 2, "give an angle such as 20urad"),
        (("field", "nowhere"), 2, "data_face.mat"),
    ],
)
def test_errors_are_one_line(
    arguments: tuple[str, ...],
    code: int,
    message: str,
    frames: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(frames.parent)
    found, out, err = ran(capsys, *(each.format(frames=frames) for each in arguments))
    assert (found, out) == (code, "")
    assert message in err.strip().splitlines()[-1]
    assert "Traceback" not in err
    assert [path.name for path in frames.parent.iterdir()] == ["counts.npy"]


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (OSError(28, "No space left on device"), 1, "No space left"),
        (MemoryError("3 GB"), 1, "not enough memory: 3 GB"),
        (KeyboardInterrupt(), 130, "Interrupted"),
    ],
    ids=["disk", "memory", "interrupt"],
)
def test_failures_of_the_machine_and_interrupts_have_their_own_codes(
    error: BaseException,
    code: int,
    message: str,
    frames: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("core.cli.captures.save_capture", fail)
    found, _, err = ran(capsys, "export", frames, frames.with_name("a.npz"))
    assert (found, message in err) == (code, True)


@pytest.mark.parametrize("command", ["estimate", "export", "simulate"])
def test_outputs_that_can_be_written_are_written(
    command: str, frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(frames.parent)
    frames.with_name("there.nc").write_bytes(b"older")
    names = ("a.npz", "there.nc", "c.xyz", "nowhere/a.nc", "d.h5")
    arguments = {
        "estimate": ("estimate", "peak", "--capture", frames, *READING),
        "simulate": ("simulate", "--scene", "staircase", "--size", 8),
        "export": ("export", frames, *READING),
    }[command]
    flag = ["--out"] if command != "export" else []
    outputs = [each for name in names for each in (*flag, name)]
    code, out, err = ran(capsys, *arguments, *outputs)
    assert code == 1
    assert out.splitlines()[-1].split() == ["written", "a.npz,", "d.h5"]
    reasons = err.strip().splitlines()[-4:]
    assert reasons[0] == "Not written, unlike the other files:"
    assert [each.partition(": ")[0] for each in reasons[1:]] == list(names[1:4])
    for reason, words in zip(reasons[1:], ("exists", "suffix = '.xyz'", "no"), strict=True):
        assert words in reason
    assert frames.with_name("there.nc").read_bytes() == b"older"
    with np.load("a.npz") as archive:
        assert "source" in archive


def test_a_cloud_states_that_its_width_is_guessed(
    frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(frames.parent)
    given = ("estimate", "peak", "--capture", frames, *READING, "--out", "a.ply", "--out", "a.npz")
    found = facts(capsys, *given)
    capture = read_capture(frames, axes="bin row col")
    image = estimate(capture, "peak")
    width_deg = guessed_field_of_view_deg(image.range_m, image.confidence, capture.acquisition)
    text = f"a field of view of {width_deg:g} degrees, which the capture does not state"
    assert found["cloud"].endswith(text)
    header = Path("a.ply").read_bytes().partition(b"end_header")[0].decode()
    assert text in header
    assert f"pixel_angle_rad: {pixel_angle_of(width_deg, 5)!r}" in header
    with np.load("a.npz") as archive:
        assert "pixel_angle_rad" not in archive  # only clouds need the guess
    found = facts(capsys, *given, "--overwrite", "--pixel-angle", "1mrad")
    assert "cloud" not in found
    header = Path("a.ply").read_bytes().partition(b"end_header")[0].decode()
    assert "pixel_angle_rad: 0.001\n" in header and "guess:" not in header


def test_a_full_disk_costs_one_output_and_not_the_others(
    frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.chdir(frames.parent)
    monkeypatch.setitem(WRITERS, ".tif", full)
    given = ("estimate", "peak", "--capture", frames, *READING)
    code, out, err = ran(capsys, *given, "--out", "a.tif", "--out", "b.npz")
    assert code == 1
    assert out.splitlines()[-1].split() == ["written", "b.npz"]
    assert "a.tif: a.tif cannot be written (No space left on device)" in err
    assert sorted(path.name for path in frames.parent.iterdir()) == ["b.npz", frames.name]


def test_a_file_that_the_machine_cannot_read_is_no_bad_input(
    frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(readers, "READERS", (Reader("", (".npy",), broken),))
    code, _, err = ran(capsys, "info", frames)
    assert code == 1 and "counts.npy" in err and "Input/output error" in err


EACH = """
import sys
from core.__main__ import main
for command in sys.argv[1:]:
    try:
        code = main(command.split("\\n"))
    except SystemExit as refusal:
        code = refusal.code
    print(end=f"\\0{code}\\0", flush=True)
"""
"""Run one command after the other, and print its exit code between NUL characters."""


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_outputs_show_names_that_are_no_text(
    encoding: str, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = io.TextIOWrapper(io.BytesIO(), encoding, errors="strict")
    monkeypatch.setattr(sys, "stdout", shown)
    assert main(["info", str(frames.rename(frames.with_name("n\udcff\xe4.npy"))), *READING]) == 0
    assert isinstance(shown.buffer, io.BytesIO)
    assert b"n\\xff" in shown.buffer.getvalue()


def test_names_that_the_terminal_cannot_show(frames: Path) -> None:
    locale, name = "C", "gr\u00f6\u00dfe".encode() + b"\xff"
    known = {key: value for key, value in os.environ.items() if not key.startswith("PYTHONIO")}
    plain = {**known, "LC_ALL": locale, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    folder = os.fsencode(frames.parent)
    path, out = (os.path.join(folder, name + suffix) for suffix in (b".npy", b"_out.tif"))
    os.rename(frames, path)

    nc, absent = os.path.join(folder, name + b".nc"), path + b".npz"
    commands = [
        (b"info", path),
        (b"info", path, b"--json"),
        (b"estimate", b"peak", b"--capture", path, b"--out", out),
        (b"export", path, nc),
        (b"estimate", b"peak", b"--capture", path, b"--out", out),
        (b"info", absent),
    ]
    joined = [b"\n".join(each) for each in commands]
    command = [sys.executable, "-c", EACH, *joined]
    done = subprocess.run(command, cwd=ROOT, env=plain, capture_output=True, check=True)
    assert b"Traceback" not in done.stderr
    assert b"exists" in done.stderr and b"an existing file" in done.stderr
    shown = done.stdout.split(b"\x00")
    assert [int(each) for each in shown[1::2]] == [0, 0, 0, 0, 2, 2]
    assert json.loads(shown[2])["source"].endswith("all photons of a pulse")
    assert os.path.exists(out) and os.path.exists(nc)


def test_names_that_are_too_long(
    frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    long = frames.with_name("a" * 300 + ".npz")
    for arguments in (("info", long), ("export", frames, long), ("simulate", "--out", long)):
        code, _, err = ran(capsys, *arguments)
        assert code == 1 and "File name too long" in err and "aaa...aaa" in err
        assert len(err) < 500


def test_a_pipe_that_closes_early_is_no_error(frames: Path) -> None:
    command = f"{sys.executable} -m core info {frames} | head -c 1"
    done = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_a_second_capture_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["estimate", "peak", "--capture", "a.npz", "--capture", "b.npz"])
    assert "--capture is given twice, a.npz and b.npz" in capsys.readouterr().err


def test_a_share_of_false_returns_needs_several_returns(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ("estimate", "peak", "--capture", frames, *READING, "--false-return", "0.05")
    code, _, err = ran(capsys, *command)
    assert code == 2
    assert "--false-return 0.05 has no effect on one return: give --returns 2 or more" in err
    assert "pixels_with_several_returns" in facts(capsys, *command, "--returns", "2")
