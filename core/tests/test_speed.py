"""The speed study in miniature: what it shows and what it warns of; no time is judged here."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from core.cli import main
from core.scene import scenes
from core.simulation import simulate
from core.studies.outputs import Plot, Table
from core.studies.performance import roofline as floors
from core.studies.performance import speed, start
from core.studies.performance.reference_implementations import (
    fused_loop,
    numpy_over_bins,
    plain_loop,
)
from core.studies.performance.speed import (
    ONE_SHOT,
    PLAIN,
    PUBLIC,
    Extent,
    Study,
    exponent,
    regressions,
)
from core.studies.report import write
from core.tracking import TrackingParameters, tracking_signals

ROUNDS = 6


@pytest.mark.compiled
@pytest.mark.parametrize(
    "changed",
    [{}, {"l": 0.05, "n": 30.0, "m": 2.2, "h": 0.5}, {"l": 0.0}],
    ids=["recommended", "other", "at rest"],
)
def test_yardsticks_find_what_the_signals_show(changed: dict[str, float]) -> None:
    settings = TrackingParameters(**changed)
    scene = scenes["uniform"](size=16)
    counts = simulate(scene, scene.acquisition, speed.FLUX, seed=2).cube.reshape(256, -1)
    without_echo = np.array([[0], [7]], np.uint16).repeat(100, axis=1)
    counts = np.concatenate([counts, without_echo])
    expected = tracking_signals(counts, settings).position_bin
    for yardstick in (numpy_over_bins, plain_loop, fused_loop):
        found = yardstick(counts.astype(float), settings)
        # Sums that are added in another order may settle a tie otherwise.
        same = np.isclose(found, expected, rtol=0, atol=0, equal_nan=True)
        assert same.mean() >= 0.99, yardstick.__name__
    assert np.isnan(expected[-2:]).all()


@pytest.mark.parametrize("power", [-1.0, 0.0, 1.0, 1.3])
def test_an_exponent_is_found_again(power: float) -> None:
    sizes = np.array([64, 128, 256, 512]) ** 2
    noise = np.random.default_rng(3).normal(0, 0.01, (4, 21))
    found, departure = exponent(sizes, 1e-7 * sizes[:, np.newaxis] ** power * np.exp(noise))
    assert found.low <= power <= found.high
    assert found.high - found.low < 0.01
    assert departure < 0.02


def test_an_exponent_tells_how_little_it_is_one() -> None:
    sizes = np.array([1, 10, 100])
    seconds = np.repeat([[1.0], [10.0], [400.0]], ROUNDS, axis=1)
    found, departure = exponent(sizes, seconds)
    assert found.value == pytest.approx(np.log10(400) / 2)
    # The line through three logarithms lies a third of the middle's own distance from it.
    assert departure == pytest.approx(2 ** (2 / 3) - 1)


def doctored(**ms: float) -> dict[str, np.ndarray]:
    spread = np.linspace(0.9, 1.1, 21)
    known = {PLAIN: 14.0, ONE_SHOT: 0.4, PUBLIC: 1.1} | ms
    return {name: 1e-3 * each * spread for name, each in known.items()}


def test_the_guard_is_silent_where_ratios_hold() -> None:
    assert regressions(doctored()) == []


@pytest.mark.parametrize("name", [ONE_SHOT, PUBLIC])
def test_the_guard_names_a_ratio_that_is_lost(name: str) -> None:
    (sentence,) = regressions(doctored(**{name: 2.0}))
    assert sentence.startswith(f"{name}: 7.0 times faster")


def test_the_guard_bears_with_noise() -> None:
    seconds = doctored()
    seconds[ONE_SHOT] = seconds[PLAIN] / np.where(np.arange(21) % 2, 20.0, 40.0)
    assert regressions(seconds) == []


def test_the_command_fails_where_a_ratio_is_lost(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lost = ["one shot: too slow."]
    table = Table("asked", "Asked", ("what",), (("one shot",),))
    monkeypatch.setattr(speed, "study", lambda extent, progress: Study([table], lost))
    with pytest.raises(SystemExit, match="one shot: too slow"):
        main(["speed", "--folder", str(tmp_path)])
    lost.clear()
    assert main(["speed", "--folder", str(tmp_path)]) == 0
    assert "| one shot |" in capsys.readouterr().out
    assert (tmp_path / "index.html").exists()


def test_what_is_asked_is_judged_by_the_median() -> None:
    seconds = doctored() | {speed.MOVE: np.full(21, 3e-4), speed.SIMULATION: np.full(21, 8e-3)}
    starts = np.full((7, len(start.STAGES)), 0.15)
    verdict = {row[0]: row[-1] for row in speed.asked_table(seconds, starts).rows}
    assert verdict[ONE_SHOT] == verdict[speed.SIMULATION] == verdict[speed.IMAGE] == "reached"
    assert verdict[speed.MOVE] == "missed"
    assert len(verdict) == 6


@pytest.mark.compiled
def test_a_study_in_miniature_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(speed, "first_image", lambda cache: np.full(len(start.STAGES), 0.1))
    small = Extent(ROUNDS, ROUNDS, ROUNDS, 16, 40, (8, 16), (20, 40), 16, 2**22)
    told: list[tuple[int, int]] = []
    found = speed.study(small, lambda done, of: told.append((done, of)))
    assert told[0][0] == 0
    assert told[-1][0] == told[-1][1] == len(told) - 1
    assert len({item.key + type(item).__name__ for item in found.items}) == len(found.items)
    for item in found.items:
        if isinstance(item, Plot):
            assert all((curve > 0).all() for curve in item.curves.values())
        elif isinstance(item, Table):
            assert all(len(row) == len(item.columns) for row in item.rows)
            numbers = [x for row in item.rows for x in row if isinstance(x, float)]
            assert np.isfinite(numbers).all()
    write(found.items, tmp_path, "Speed", speed.INTRODUCTION)
    assert (tmp_path / "variants.csv").exists()


def test_rounds_too_few_for_an_interval_are_refused() -> None:
    with pytest.raises(ValueError, match="starts = 2 is not accepted: give at least 6"):
        Extent(starts=2)


def test_floors_are_measured_by_the_work_they_name() -> None:
    numbers = np.arange(6.0, dtype=np.float32).reshape(2, 3) + 2
    expected = np.sqrt(np.sqrt(numbers))
    floors._take_roots(numbers, 2)
    np.testing.assert_allclose(numbers, expected, rtol=1e-6)
    source = np.arange(6, dtype=np.uint64).reshape(2, 3)
    target, sums = np.zeros_like(source), np.empty(2, np.uint64)
    floors._copy(source, target)
    floors._read(source, sums)
    np.testing.assert_array_equal(target, source)
    np.testing.assert_array_equal(sums, source.sum(axis=1))


def test_threads_are_given_back() -> None:
    before = numba.get_num_threads()

    def fails() -> None:
        assert numba.get_num_threads() == 1
        raise ValueError

    with pytest.raises(ValueError):
        floors.on_threads(1, fails)()
    assert numba.get_num_threads() == before


def test_a_start_is_told_stage_by_stage(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    script = "import os, time; open(os.environ['NUMBA_CACHE_DIR'] + '/x', 'w')\n"
    script += f"now = time.time(); print([now + i for i in range({len(start.STAGES)})])"
    monkeypatch.setattr(start, "_FIRST_IMAGE", script)
    seconds = start.first_image(tmp_path)
    assert seconds[0] > 0
    np.testing.assert_allclose(seconds[1:], 1.0, atol=1e-3)
    assert (tmp_path / "x").exists()


@pytest.mark.compiled
def test_the_first_image_passes_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    exec(start._FIRST_IMAGE, {})
    marks = np.array(capsys.readouterr().out.strip("[]\n").split(","), float)
    assert marks.shape == (len(start.STAGES),)
    assert (np.diff(marks) > 0).all()
