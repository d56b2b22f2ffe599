"""Verdicts on parts and corrections, of scenes and of captures; and the models that they spare."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.cli import ACCEPTED, REFUSED, main
from core.corrections import moments_s, without_correction
from core.effects import Backscatter, FaultyPixels, Motion, SecondSurface
from core.estimators import ESTIMATORS
from core.estimators.base import Calibration
from core.inference.flux import detailed_flux_prior_of, flux_prior_of
from core.inference.limits import cramer_rao_bins
from core.inference.resolution import HIDDEN, TOLD, Difference
from core.metrics import Interval
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.ablation import corrections, plain
from core.studies.ablation import study as requires
from core.studies.ablation.criterion import UNKNOWN, Requirement, judged
from core.studies.ablation.study import requirements

GATE = Acquisition(n_bins=100, n_pulses=1000)
NIGHT, DAY = Flux(0.02, 2.0), Flux(0.1041, 0.06)


def wall(size: int = 32, **parts: object) -> Scene:
    """Depths that change from pixel to pixel, within mid-gate."""
    onset_bin = np.random.default_rng(0).uniform(30, 70, (size, size))
    return Scene(GATE.bin_to_range_m(onset_bin), acquisition=GATE, **parts)  # type: ignore[arg-type]


@cache
def seen(flux: Flux = NIGHT, n_pulses: int = 1000, size: int = 32, seed: int = 0) -> Capture:
    return simulate(wall(size), replace(GATE, n_pulses=n_pulses), flux, seed=seed)


def by_part(rows: tuple[Requirement, ...]) -> dict[str, Requirement]:
    return {row.part: row for row in rows}


# -- the rule --------------------------------------------------------------------------------------

STAY, WIDE = Interval(0.0, -1e-3, 1e-3), Interval(0.0, -0.5, 0.5)
MORE, LESS = Interval(0.2, 0.1, 0.3), Interval(-0.2, -0.3, -0.1)


@pytest.mark.parametrize(
    ("part", "evidence", "rd", "rmse_m", "verdict"),
    [
        ("motion", TOLD, STAY, STAY, "needed"),
        ("motion", TOLD / 2, STAY, STAY, "not needed"),
        ("motion", TOLD / 2, LESS, STAY, "needed"),
        ("motion", TOLD / 2, STAY, MORE, "needed"),
        ("motion", TOLD / 2, WIDE, STAY, "cannot tell"),
        ("motion", HIDDEN / 2, WIDE, WIDE, "not needed"),
        ("motion", TOLD, UNKNOWN, UNKNOWN, "needed"),
        ("motion", TOLD / 2, UNKNOWN, UNKNOWN, "cannot tell"),
        ("motion", HIDDEN / 2, UNKNOWN, UNKNOWN, "not needed"),
        ("pile_up", TOLD, MORE, STAY, "needed"),
        ("pile_up", TOLD, STAY, LESS, "needed"),
        ("pile_up", TOLD, LESS, STAY, "not needed"),  # it does harm
        ("pile_up", TOLD, STAY, STAY, "not needed"),
        ("pile_up", TOLD, WIDE, STAY, "cannot tell"),
        ("pile_up", TOLD, UNKNOWN, UNKNOWN, "needed"),
    ],
)
def test_the_rule(part: str, evidence: float, rd: Interval, rmse_m: Interval, verdict: str) -> None:
    apart = Difference(np.full(50, 0.1), np.full(50, evidence))
    found = judged(part, apart, 0.15, rd, rmse_m)
    assert found.verdict == verdict
    assert found.why
    assert found.told_share == (evidence >= TOLD)


# -- scenes ----------------------------------------------------------------------------------------


@pytest.mark.compiled
def test_a_scenes_parts_are_judged_by_what_they_move() -> None:
    fast = requirements(wall(motion=Motion(30.0, 20e3)), Flux(0.1, 2.0), seeds=range(4))
    slow = requirements(wall(motion=Motion(1e-4, 20e3)), Flux(0.1, 2.0), seeds=range(4))
    assert [row.part for row in fast] == ["pile_up", "pulse_shape", "signal_levels", "motion"]
    moved, still = (by_part(rows)["motion"] for rows in (fast, slow))
    assert moved.verdict == "needed"
    assert moved.told_share == 1
    assert moved.total_variation > 3 * moved.resolvable
    assert moved.worst >= moved.total_variation
    assert moved.rd_change.high < 0
    assert 0 < moved.time_ratio.low <= moved.time_ratio.value <= moved.time_ratio.high < np.inf
    assert still.verdict == "not needed"
    assert still.total_variation < 1e-6
    assert str(pickle.loads(pickle.dumps(fast))) == str(fast)  # NaN is not itself


@pytest.mark.compiled
def test_pile_up_needs_a_correction_by_day_and_none_by_night() -> None:
    day, night = (
        by_part(requirements(wall(), flux, seeds=range(4)))["pile_up"] for flux in (DAY, NIGHT)
    )
    assert day.verdict == "needed"
    assert day.rd_change.low > 0.1
    assert day.total_variation > day.resolvable
    assert night.verdict == "not needed"
    assert night.told_share == 0
    table = requires.table((day, night), "day and night")
    assert [row[1] for row in table.rows] == ["needed", "not needed"]


@pytest.mark.compiled
def test_rows_come_one_by_one_and_stop_when_told() -> None:
    told: list[tuple[int, int]] = []
    small = Scene(
        GATE.bin_to_range_m(np.full((3, 3), 40.0)), acquisition=replace(GATE, n_pulses=20)
    )
    found = requirements(
        small,
        seeds=range(2),
        progress=lambda done, of: told.append((done, of)),
        cancelled=lambda: len(told) == 2,
    )
    assert told == [(1, 3), (2, 3)]
    assert len(found) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [({"method": "magic"}, "method = 'magic'"), ({"seeds": range(1)}, "at least 2")],
)
def test_bad_questions_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        requirements(wall(), **options)  # type: ignore[arg-type]


def test_absent_parts_cost_no_bit() -> None:
    ((_, ratio, same),) = plain.table(wall(8), GATE, DAY, Pulse()).rows
    assert same == "yes"
    assert "[" in ratio


@pytest.mark.parametrize("pulse", [Pulse(), Pulse.gaussian(2e-9), Pulse.measured([1, 3, 1], 1e-9)])
def test_moments_of_a_pulse(pulse: Pulse) -> None:
    mean_s, sigma_s = moments_s(pulse)
    expected = {
        "gamma": (2e-9, math.sqrt(2) * 1e-9),
        "gaussian": (0.0, 2e-9),
        "measured": (1.5e-9, math.sqrt(0.4 + 1 / 12) * 1e-9),
    }[pulse.shape]
    assert (mean_s, sigma_s) == pytest.approx(expected, abs=1e-13)


@pytest.mark.compiled
def test_a_gaussian_of_the_same_mean_finds_the_same_place() -> None:
    capture = seen(Flux(0.5, 5.0))
    other = without_correction(capture, "pulse_shape")
    assert other.pulse.shape == "gaussian"
    one_m, other_m = (corrections.answers_m(each, "likelihood") for each in (capture, other))
    assert abs(np.median(other_m - one_m)) < 0.1 * GATE.bin_length_m


# -- captures --------------------------------------------------------------------------------------


def judged_capture(capture: Capture) -> dict[str, str]:
    return {row.part: row.verdict for row in requirements(capture)}


@pytest.mark.compiled
def test_a_capture_of_nothing_but_echoes_needs_no_more() -> None:
    told = judged_capture(replace(seen(Flux(0.1, 2.0), size=64), truth_range_m=None, signal=None))
    for part in ("second_surface", "backscatter", "faulty_pixels"):
        assert told[part] == "not needed"
    assert told["pulse_shape"] != "needed"
    assert told["motion"] == told["jitter"] == "cannot tell"


@pytest.mark.compiled
def test_a_capture_tells_of_what_it_holds() -> None:
    clear = wall()
    hot = np.zeros(clear.range_m.shape)
    hot[5::8, 5::8] = 5e7
    dead = np.zeros(hot.shape, bool)
    dead[2::8, 2::8] = True
    other = SecondSurface(clear.range_m + 3.0, np.where(np.eye(32) > 0, 0.5, 0.0))
    flux = Flux(0.3, 3.0)
    for part, scene in {
        "backscatter": replace(clear, backscatter=Backscatter(0.02, reference_m=600.0)),
        "faulty_pixels": replace(clear, faulty_pixels=FaultyPixels(hot, dead)),
        "second_surface": replace(clear, second_surface=other),
        "pulse_shape": replace(clear, motion=Motion(20.0, 20e3)),
    }.items():
        told = judged_capture(simulate(scene, GATE, flux, seed=3))
        assert told[part] == "needed", (part, told)


@pytest.mark.compiled
def test_all_photons_are_no_pile_up_and_unknown_pulses_hide_it() -> None:
    photons = replace(seen(), detection="all", signal=None, background=None)
    assert judged_capture(photons)["pile_up"] == "not needed"
    unknown = replace(seen(), acquisition=replace(GATE, n_pulses=None))
    assert judged_capture(unknown)["pile_up"] == "cannot tell"


@pytest.mark.compiled
def test_a_capture_without_sure_pixels_cannot_tell_of_them() -> None:
    noise = np.random.default_rng(0).poisson(0.02, (2, 40, 100)).astype(np.uint16)
    told = judged_capture(Capture(noise, GATE))
    for part in ("pulse_shape", "second_surface", "backscatter", "faulty_pixels"):
        assert told[part] == "cannot tell"


# -- the models that are spared --------------------------------------------------------------------


@pytest.mark.compiled
def test_one_level_of_signal_is_taken_where_no_pixel_tells_its_own() -> None:
    merged = 0
    for seed in range(4):
        capture = seen(Flux(0.05, 1.0), size=64, seed=seed)
        flux_prior, detailed = flux_prior_of(capture), detailed_flux_prior_of(capture)
        assert flux_prior.levels.size == 2
        merged += detailed.levels.size > 2
        spares = ESTIMATORS["likelihood"].remark(capture)
        assert ("one level of signal" in spares) == (detailed.levels.size > 2)
        assert flux_prior.share.sum() == pytest.approx(1)
        assert flux_prior.share @ flux_prior.levels == pytest.approx(
            detailed.share @ detailed.levels
        )
        _stays_within_its_uncertainty(
            capture,
            "likelihood",
            corrections.with_correction(capture, "signal_levels"),
            without_correction(capture, "signal_levels"),
        )
    assert merged


def _stays_within_its_uncertainty(
    capture: Capture, method: str, exact: Capture, spared: Capture
) -> None:
    """Paired: the cheaper model's answers differ by less than answers scatter."""
    truth_bin = GATE.range_m_to_bin(capture.truth_range_m)  # type: ignore[arg-type]
    one, other = (corrections.delays(each, method) for each in (exact, spared))
    right = np.abs(one - truth_bin) <= 3
    assert capture.signal is not None
    assert capture.background is not None
    scatter = cramer_rao_bins(
        truth_bin, capture.signal, capture.background, capture.pulse, capture.acquisition
    )
    assert np.mean((np.abs(one - other) <= scatter)[right]) > 0.98
    assert abs(np.mean(np.abs(other - truth_bin) <= 3) - right.mean()) < 0.005


@pytest.mark.compiled
def test_levels_that_pixels_tell_are_kept() -> None:
    reflectivity = np.where(np.arange(32) % 2 == 0, 0.2, 2.0) * np.ones((32, 1))
    capture = simulate(wall(reflectivity=reflectivity), GATE, Flux(0.1, 1.0))
    assert flux_prior_of(capture).levels.size > 2
    assert ESTIMATORS["likelihood"].remark(capture) == ""


@pytest.mark.compiled
def test_coates_undoes_no_pile_up_that_pulses_hide() -> None:
    for seed in range(3):
        faint = seen(size=64, seed=seed)
        assert not flux_prior_of(faint).pile_up
        assert "Coates undoes no pile-up" in ESTIMATORS["coates"].remark(faint)
        exact = corrections.with_correction(faint, "pile_up")
        assert flux_prior_of(exact).pile_up
        _stays_within_its_uncertainty(faint, "coates", exact, faint)
    bright = seen(DAY)
    assert flux_prior_of(bright).pile_up
    assert ESTIMATORS["coates"].remark(bright) == ""


@pytest.mark.compiled
@pytest.mark.parametrize("method", ["likelihood", "coates"])
def test_parts_of_an_image_spare_what_the_whole_does(method: str) -> None:
    whole, estimator = seen(), ESTIMATORS[method]
    assert estimator.remark(whole) or method == "likelihood"
    settings = estimator.parameters()
    calibration: Calibration = estimator.calibration(whole, settings)
    expected = estimator.ranged(whole, settings, calibration)
    for rows in (slice(0, 5), slice(5, 32)):
        part = replace(whole, cube=whole.cube[rows].copy(), truth_range_m=None, signal=None)
        part = replace(part, flux_prior=flux_prior_of(whole))
        found = estimator.ranged(part, settings, calibration)
        np.testing.assert_array_equal(found.bin, expected.bin[rows])
        np.testing.assert_array_equal(found.confidence, expected.confidence[rows])


# -- the command -----------------------------------------------------------------------------------


@pytest.mark.compiled
def test_the_command_judges_a_scene_and_writes_a_page(
    tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page"
    arguments = ["requires", "--scene", "car", "--pulses", "50", "--seeds", "2"]
    assert main([*arguments, "--folder", str(page)]) == ACCEPTED
    told = capsys.readouterr().out
    assert "| part or correction | verdict |" in told
    assert "Absent parts cost nothing" in told
    assert {path.name for path in page.iterdir()} >= {"index.html", "requirements.csv"}


@pytest.mark.compiled
def test_the_command_judges_a_capture(capsys: pytest.CaptureFixture[str]) -> None:
    sample = str(plain.__file__).rsplit("core", 1)[0] + "assets/sample_capture.npz"
    assert main(["requires", "--capture", sample, "--json"]) == ACCEPTED
    told = json.loads(capsys.readouterr().out)
    assert told["pile_up"]["verdict"] == "needed"
    assert told["motion"]["total_variation"] is None
    assert main(["requires", "--capture", sample, "--sbr", "1"]) == REFUSED
    assert main(["requires", "--scene", "car", "--bins", "7"]) == REFUSED


def test_every_scene_has_a_name_to_ask_for() -> None:
    assert {"car", "edges", "fog", "approach", "worn"} <= set(scenes)
