"""The speed study in miniature: what it measures and what it reports; no time is judged here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.cli import main
from core.scene import scenes
from core.simulation import simulate
from core.studies.performance import speed, start
from core.studies.performance.reference_implementations import (
    numpy_over_bins,
    plain_loop,
    take_roots,
)
from core.studies.performance.speed import (
    MOVE,
    NEW,
    ONE_SHOT,
    PLAIN,
    PUBLIC,
    SIMULATION,
    regressions,
)
from core.tracking import TrackingParameters, tracking_signals

ROUNDS = 6


@pytest.mark.compiled
def test_reference_implementations_agree_with_the_signals() -> None:
    scene = scenes["uniform"](size=16)
    counts = simulate(scene, scene.acquisition, speed.FLUX, seed=2).cube.reshape(256, -1)
    without_echo = np.array([[0], [7]], np.uint16).repeat(100, axis=1)
    counts = np.concatenate([counts, without_echo])
    recommended, at_rest = TrackingParameters(), TrackingParameters(l=0.0)
    for settings in (recommended, TrackingParameters(l=0.05, n=30.0, m=2.2, h=0.5), at_rest):
        expected = tracking_signals(counts, settings).position_bin
        for implementation in (numpy_over_bins, plain_loop):
            found = implementation(counts.astype(float), settings)
            # Sums in another order may break ties differently.
            same = np.isclose(found, expected, rtol=0, atol=0, equal_nan=True)
            assert same.mean() >= 0.99, (implementation.__name__, settings)
        assert np.isnan(expected[-2:]).all()


def times(**ms: float) -> dict[str, np.ndarray]:
    spread = np.linspace(0.9, 1.1, 21)
    known = {PLAIN: 14.0, ONE_SHOT: 0.4, PUBLIC: 1.1, MOVE: 0.3, NEW: 2.0, SIMULATION: 8.0} | ms
    return {name: 1e-3 * each * spread for name, each in known.items()}


@pytest.mark.parametrize("name", [ONE_SHOT, PUBLIC])
def test_a_lost_speed_up_is_reported(name: str) -> None:
    assert regressions(times()) == []
    (sentence,) = regressions(times(**{name: 2.0}))
    assert sentence.startswith(f"{name}: 7.0 times faster")


def test_noise_is_not_a_regression() -> None:
    seconds = times()
    seconds[ONE_SHOT] = seconds[PLAIN] / np.where(np.arange(21) % 2, 20.0, 40.0)
    assert regressions(seconds) == []


def test_targets_are_judged_by_the_median() -> None:
    starts = np.full((7, len(start.STAGES)), 0.15)
    verdict = {row[0]: row[-1] for row in speed.targets_table(times(), starts).rows}
    assert verdict[ONE_SHOT] == verdict[SIMULATION] == verdict[speed.FIRST_IMAGE] == "met"
    assert verdict[MOVE] == "missed"


@pytest.mark.compiled
def test_the_command_measures_and_fails_where_a_speed_up_is_lost(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(speed, "first_image", lambda cache: np.full(len(start.STAGES), 0.1))
    monkeypatch.setattr(speed, "MIN_SPEEDUP", {PUBLIC: 1e9})
    small = speed.Extent(ROUNDS, ROUNDS, 16, 40, ((8, 40), (16, 20)), ((8, 40),))
    monkeypatch.setattr(speed, "Extent", lambda rounds: small)
    assert main(["speed", "--rounds", "6", "--folder", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert f"{PUBLIC}: " in printed.err and "5 of 5 pieces" in printed.err
    tables = ("targets", "variants", "sizes", "fresh", "start", "machine")
    assert all((tmp_path / f"{key}.csv").exists() for key in tables)
    assert "| 16 x 16 x 20 |" in printed.out
    assert "nan" not in printed.out


def test_too_few_rounds_for_an_interval_are_refused() -> None:
    with pytest.raises(ValueError, match="starts = 2 is not accepted: give at least 6"):
        speed.Extent(starts=2)


def test_the_roofline_takes_square_roots() -> None:
    numbers = np.arange(2.0, 8.0, dtype=np.float32)
    expected = np.sqrt(np.sqrt(numbers))
    take_roots(numbers, 2)
    np.testing.assert_allclose(numbers, expected, rtol=1e-6)


def test_a_start_is_timed_stage_by_stage(tmp_path: Path) -> None:
    script = "import os, time; open(os.environ['NUMBA_CACHE_DIR'] + '/x', 'w')\n"
    script += f"now = time.time(); print([now + i for i in range({len(start.STAGES)})])"
    seconds = start.first_image(tmp_path, script)
    assert seconds[0] > 0
    np.testing.assert_allclose(seconds[1:], 1.0, atol=1e-3)
    assert (tmp_path / "x").exists()


@pytest.mark.compiled
def test_the_first_image_passes_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    exec(start.FIRST_IMAGE, {})
    marks = np.array(capsys.readouterr().out.strip("[]\n").split(","), float)
    assert marks.shape == (len(start.STAGES),)
    assert (np.diff(marks) > 0).all()
