"""Ablation: verdicts on parts and corrections of scenes and captures, and simplified models."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.cli import ACCEPTED, REFUSED, main
from core.corrections import moments_s, without_correction
from core.effects import Backscatter, FaultyPixels, Motion, SecondSurface
from core.estimators import ESTIMATORS
from core.inference.fit import Deviation
from core.inference.flux import detailed_flux_prior_of, flux_prior_of
from core.inference.limits import cramer_rao_bins
from core.inference.resolution import FEW, HIDDEN, RESOLVED, Difference
from core.metrics import Interval
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.ablation import corrections, extensions, plain, power, study
from core.studies.ablation.criterion import UNKNOWN, improved, judged
from core.studies.ablation.evidence import (
    POWER,
    SIZE,
    Evidence,
    evidence_of_deviation,
    evidence_of_share,
)
from core.studies.ablation.study import requirements, requirements_table

GATE = Acquisition(n_bins=100, n_pulses=1000)
NIGHT, DAY = Flux(0.02, 2.0), Flux(0.1041, 0.06)


def wall(size: int = 32, **parts: object) -> Scene:
    """Depths that change from pixel to pixel, within mid-gate."""
    onset_bin = np.random.default_rng(0).uniform(30, 70, (size, size))
    return Scene(GATE.bin_to_range_m(onset_bin), acquisition=GATE, **parts)  # type: ignore[arg-type]


@cache
def seen(flux: Flux = NIGHT, n_pulses: int = 1000, size: int = 32, seed: int = 0) -> Capture:
    return simulate(wall(size), replace(GATE, n_pulses=n_pulses), flux, seed=seed)


# -- The rule --------------------------------------------------------------------------------------

STAY, WIDE = Interval(0.0, -1e-3, 1e-3), Interval(0.0, -0.5, 0.5)
MORE, LESS = Interval(0.2, 0.1, 0.3), Interval(-0.2, -0.3, -0.1)


@pytest.mark.parametrize(
    ("part", "evidence", "rd", "rmse_m", "verdict"),
    [
        ("motion", RESOLVED, STAY, STAY, "needed"),
        ("motion", RESOLVED / 2, STAY, STAY, "not needed"),
        ("motion", RESOLVED / 2, LESS, STAY, "needed"),
        ("motion", RESOLVED / 2, STAY, MORE, "needed"),
        ("motion", RESOLVED / 2, WIDE, STAY, "cannot tell"),
        ("motion", HIDDEN / 2, WIDE, WIDE, "not needed"),
        ("motion", RESOLVED, UNKNOWN, UNKNOWN, "needed"),
        ("motion", RESOLVED / 2, UNKNOWN, UNKNOWN, "cannot tell"),
        ("motion", HIDDEN / 2, UNKNOWN, UNKNOWN, "not needed"),
        ("pile_up", RESOLVED, MORE, STAY, "needed"),
        ("pile_up", RESOLVED, STAY, LESS, "needed"),
        ("pile_up", RESOLVED, LESS, STAY, "not needed"),  # it harms
        ("pile_up", RESOLVED, STAY, STAY, "not needed"),
        ("pile_up", RESOLVED, WIDE, STAY, "cannot tell"),
        ("pile_up", RESOLVED, UNKNOWN, UNKNOWN, "needed"),
    ],
)
def test_the_rule(part: str, evidence: float, rd: Interval, rmse_m: Interval, verdict: str) -> None:
    found = judged(part, Difference(np.full(50, 0.1), np.full(50, evidence)), 0.15, rd, rmse_m)
    assert found.verdict == verdict
    assert found.why
    assert found.detectable_share == (evidence >= RESOLVED)


@pytest.mark.parametrize(
    ("rd", "rmse_m", "verdict"),
    [
        (MORE, UNKNOWN, "needed"),
        (STAY, LESS, "needed"),
        (STAY, UNKNOWN, "not needed"),
        (LESS, STAY, "not needed"),  # it harms
        (WIDE, UNKNOWN, "cannot tell"),
        (STAY, WIDE, "cannot tell"),
    ],
)
def test_an_extension_is_judged_by_its_estimates(
    rd: Interval, rmse_m: Interval, verdict: str
) -> None:
    found = improved("neighbours", 0.15, rd, rmse_m, note="in a note")
    assert found.verdict == verdict
    assert found.why.endswith("; in a note")
    assert math.isnan(found.total_variation)


# -- Scenes ----------------------------------------------------------------------------------------


@pytest.fixture
def without_extensions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the rows that take longest, which have tests of their own."""
    monkeypatch.setattr(study, "EXTENSIONS", {})
    monkeypatch.setattr(extensions, "rows", lambda *_: [])


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_the_parts_of_a_scene_are_judged_by_their_effect() -> None:
    fast, slow = (
        requirements(wall(size, motion=Motion(speed, 20e3)), Flux(0.1, 2.0), seeds=range(3))
        for size, speed in ((32, 30.0), (8, 1e-4))
    )
    assert [row.part for row in fast] == ["pile_up", "pulse_shape", "signal_levels", "motion"]
    moved, still = fast[-1], slow[-1]
    assert moved.verdict == "needed"
    assert moved.detectable_share == 1
    assert moved.total_variation > 3 * moved.resolvable
    assert moved.worst >= moved.total_variation
    assert moved.rd_change.high < 0
    assert 0 < moved.time_ratio.low <= moved.time_ratio.value <= moved.time_ratio.high < np.inf
    assert still.verdict == "not needed"
    assert still.total_variation < 1e-6
    assert str(pickle.loads(pickle.dumps(fast))) == str(fast)  # NaN is not equal to itself


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_pile_up_needs_a_correction_by_day_and_none_by_night() -> None:
    day, night = (requirements(wall(), flux, seeds=range(2))[0] for flux in (DAY, NIGHT))
    assert day.verdict == "needed"
    assert day.rd_change.low > 0.1
    assert day.total_variation > day.resolvable
    assert night.verdict == "not needed"
    assert night.detectable_share == 0
    table = requirements_table((day, night), "day and night")
    assert [row[1] for row in table.rows] == ["needed", "not needed"]


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_rows_are_reported_one_by_one_and_can_be_cancelled() -> None:
    calls: list[tuple[int, int]] = []

    def cancelled(done: int, of: int) -> None:
        calls.append((done, of))
        if done == 2:
            raise InterruptedError

    scene = Scene(
        GATE.bin_to_range_m(np.full((3, 3), 40.0)), acquisition=replace(GATE, n_pulses=20)
    )
    with pytest.raises(InterruptedError):
        requirements(scene, seeds=range(2), progress=cancelled)
    assert calls == [(0, 3), (1, 3), (2, 3)]


@pytest.mark.parametrize(
    ("options", "message"),
    [({"method": "magic"}, "method = 'magic'"), ({"seeds": range(1)}, "at least 2")],
)
def test_unknown_methods_and_single_seeds_are_refused(
    options: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        requirements(wall(), **options)  # type: ignore[arg-type]


def test_absent_parts_change_no_bit() -> None:
    ((_, ratio, same),) = plain.table(wall(8), GATE, DAY, Pulse()).rows
    assert same == "yes"
    assert ratio.low > 0


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
def test_a_gaussian_of_the_same_mean_gives_the_same_ranges() -> None:
    capture = seen(Flux(0.5, 5.0))
    other = without_correction(capture, "pulse_shape")
    assert other.pulse.shape == "gaussian"
    one_m, other_m = (corrections.ranges_m(each, "likelihood") for each in (capture, other))
    assert abs(np.median(other_m - one_m)) < 0.1 * GATE.bin_length_m


# -- Extensions ------------------------------------------------------------------------------------


def captures_of(scene: Scene, flux: Flux, n_groups: int | None = None) -> list[Capture]:
    return [
        simulate(scene, scene.acquisition, flux, seed=seed, n_groups=n_groups) for seed in (0, 1)
    ]


def blind(capture: Capture) -> Capture:
    """Return the capture without what an instrument does not know."""
    return replace(capture, truth_range_m=None, signal=None, background=None)


@pytest.mark.compiled
def test_neighbours_are_needed_where_they_agree_and_pixels_are_dark() -> None:
    smooth = scenes["wall"](20)
    truth_m = smooth.range_m[np.newaxis]
    captures = captures_of(smooth, Flux(sbr=0.03))
    measured = extensions.judged_on_scene("neighbours", captures, truth_m, "likelihood")
    assert measured.verdict == "needed"
    assert measured.rd_change.low > 0.1
    expected = extensions.neighbours(blind(captures[0]))
    assert expected.verdict == "needed"
    assert expected.rd_change.overlaps(measured.rd_change)
    random = simulate(wall(20), GATE, Flux(0.1, 2.0))
    alone = extensions.neighbours(blind(random))
    assert (alone.verdict, alone.why[:15]) == ("not needed", "neighbours agre")
    few = extensions.neighbours(Capture(random.cube[:2, :2].copy(), GATE))
    assert few.verdict == "cannot tell"


@pytest.mark.compiled
def test_a_second_return_is_needed_where_pixels_see_two_surfaces() -> None:
    two = scenes["net"](16, separation_bins=12.0, share=0.5)
    captures = captures_of(two, Flux(0.3, 2.0))
    both_m, one_m = (
        each(captures[0]) for each in extensions.rangings("second_return", "likelihood")
    )
    rd = [corrections.score(each, two.surfaces_m, captures[0])[0] for each in (both_m, one_m)]
    assert rd == pytest.approx([1.0, 0.5], abs=0.05)
    assert extensions.second_return(blind(captures[0]), "likelihood").verdict == "needed"


@pytest.mark.compiled
def test_a_velocity_is_needed_where_surfaces_move() -> None:
    moving = wall(16, motion=Motion(30.0, 20e3))
    (capture, _) = captures_of(moving, Flux(0.1, 0.2), n_groups=40)
    for each in (capture, blind(capture)):
        assert extensions.velocity(each).verdict == "needed"
    still = simulate(wall(16), GATE, Flux(0.1, 0.2), n_groups=40)
    assert extensions.velocity(blind(still)).verdict == "not needed"
    unordered = extensions.velocity(replace(still, groups=None))
    assert unordered.verdict == "cannot tell"
    assert unordered.why == "the capture keeps no order of pulses"


# -- Captures --------------------------------------------------------------------------------------


def verdicts(capture: Capture) -> dict[str, str]:
    return {row.part: row.verdict for row in requirements(capture)}


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_a_capture_with_echoes_alone_needs_no_parts() -> None:
    found = verdicts(replace(seen(Flux(0.1, 2.0)), truth_range_m=None, signal=None))
    assert set(found.values()) == {"not needed"}


def parts_of_walls() -> dict[str, Scene]:
    clear = wall()
    hot = np.zeros(clear.range_m.shape)
    hot[5::8, 5::8] = 5e7
    dead = np.zeros(hot.shape, bool)
    dead[2::8, 2::8] = True
    other = SecondSurface(clear.range_m + 3.0, np.where(np.eye(32) > 0, 0.5, 0.0))
    return {
        "backscatter": replace(clear, backscatter=Backscatter(0.02, reference_m=600.0)),
        "faulty_pixels": replace(clear, faulty_pixels=FaultyPixels(hot, dead)),
        "second_surface": replace(clear, second_surface=other),
        "pulse_shape": replace(clear, motion=Motion(20.0, 20e3)),
    }


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
@pytest.mark.parametrize("part", parts_of_walls())
def test_a_capture_reveals_its_parts(part: str) -> None:
    assert (
        verdicts(simulate(parts_of_walls()[part], GATE, Flux(0.3, 3.0), seed=3))[part] == "needed"
    )


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_pile_up_depends_on_detection_and_pulses() -> None:
    photons = replace(seen(), detection="all", signal=None, background=None)
    assert verdicts(photons)["pile_up"] == "not needed"
    unknown = replace(seen(), acquisition=replace(GATE, n_pulses=None))
    assert verdicts(unknown)["pile_up"] == "cannot tell"


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_without_certain_pixels_parts_are_unknown() -> None:
    noise = np.random.default_rng(0).poisson(0.02, (2, 40, 100)).astype(np.uint16)
    found = verdicts(Capture(noise, GATE))
    for part in ("pulse_shape", "second_surface", "backscatter", "faulty_pixels"):
        assert found[part] == "cannot tell"


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("second_surface", 1.0),  # in every pixel, as strong as the first
        ("pulse_shape", 0.5),
        ("pulse_shape", 3.0),
        ("backscatter", 0.5),
        ("signal_levels", 0.5),
        ("pile_up", 0.5),
    ],
)
def test_pixels_together_reveal_what_single_ones_do_not(part: str, value: float) -> None:
    capture = power.Case(part, value, 0.06).capture(0)
    found = {row.part: row for row in requirements(capture)}
    assert found[part].verdict == "needed"
    assert found[part].p_value < SIZE
    assert found[part].effect > found[part].smallest_effect or value == 1
    if part in ("second_surface", "pulse_shape"):
        others = {"second_surface", "pulse_shape"} - {part}
        assert "needed" not in {found[each].verdict for each in others}


@pytest.mark.usefixtures("without_extensions")
@pytest.mark.compiled
def test_a_part_that_could_not_have_been_seen_is_not_excluded() -> None:
    bright, faint = (power.Case("second_surface", 0.0, sbr).capture(0) for sbr in (0.3, 0.03))
    assert verdicts(bright)["second_surface"] == "not needed"
    found = {row.part: row for row in requirements(faint)}
    assert found["second_surface"].verdict == "cannot tell"
    assert found["second_surface"].smallest_effect > FEW
    assert found["signal_levels"].verdict == "cannot tell"  # few pixels are certain


@pytest.mark.parametrize(
    ("p_value", "effect", "smallest", "largest", "verdict"),
    [
        (0.001, 0.3, 0.05, 0.4, "needed"),
        (0.001, 0.05, 0.02, 0.08, "not needed"),  # seen, but too small to matter
        (0.001, 0.08, 0.08, 0.12, "cannot tell"),
        (0.3, 0.01, 0.08, 0.05, "not needed"),
        (0.3, 0.01, 0.2, 0.05, "cannot tell"),  # an effect that matters may have been missed
        (0.3, 0.3, 0.5, 0.8, "cannot tell"),
    ],
)
def test_a_verdict_needs_an_effect_that_was_or_would_have_been_seen(
    p_value: float, effect: float, smallest: float, largest: float, verdict: str
) -> None:
    evidence = Evidence(p_value, effect, smallest, largest)
    assert evidence.verdict(margin=0.1) == verdict
    if verdict == "needed":
        assert evidence.verdict(margin=0.1, explained=0.25) == "cannot tell"


@pytest.mark.parametrize("freedom", [1, 20])
def test_the_smallest_deviation_is_seen_with_the_stated_probability(freedom: int) -> None:
    unit = 40.0
    smallest = evidence_of_deviation(Deviation(0.0, freedom, unit)).smallest
    squares = stats.ncx2(freedom, (smallest * unit) ** 2).rvs(4000, random_state=0)
    seen = [evidence_of_deviation(Deviation(each, freedom, unit)).is_seen for each in squares]
    assert np.mean(seen) == pytest.approx(POWER, abs=0.03)


@pytest.mark.parametrize(
    ("n_pixels", "false_alarm", "chance"), [(256, 0.001, 0.9), (2000, 0.01, 0.3)]
)
def test_the_smallest_share_is_seen_with_the_stated_probability(
    n_pixels: int, false_alarm: float, chance: float
) -> None:
    evidence = [evidence_of_share(found, n_pixels, false_alarm, chance) for found in range(200)]
    seen = np.array([each.is_seen for each in evidence])
    found = np.arange(seen.size)
    absent, smallest = (
        stats.binom.pmf(found, n_pixels, false_alarm + share * (chance - false_alarm)) @ seen
        for share in (0.0, evidence[0].smallest)
    )
    assert absent <= SIZE
    assert smallest == pytest.approx(POWER, abs=0.01)
    assert evidence_of_share(0, n_pixels, 0.01, 0.005).smallest == math.inf


# -- Simplified models -----------------------------------------------------------------------------


def assert_within_uncertainty(
    capture: Capture, method: str, exact: Capture, other: Capture
) -> None:
    """The simpler model's estimates differ by less than their scatter; paired."""
    truth_bin = GATE.range_m_to_bin(capture.truth_range_m)  # type: ignore[arg-type]
    found, simplified = (corrections.delays(each, method) for each in (exact, other))
    right = np.abs(found - truth_bin) <= 3
    scatter = cramer_rao_bins(
        truth_bin, capture.signal, capture.background, capture.pulse, capture.acquisition
    )  # type: ignore[arg-type]
    assert np.mean((np.abs(found - simplified) <= scatter)[right]) > 0.98
    assert abs(np.mean(np.abs(simplified - truth_bin) <= 3) - right.mean()) < 0.005


@pytest.mark.compiled
def test_one_signal_level_is_used_where_pixels_do_not_reveal_their_own() -> None:
    merged = 0
    for seed in range(4):
        capture = seen(Flux(0.05, 1.0), size=64, seed=seed)
        flux_prior, detailed = flux_prior_of(capture), detailed_flux_prior_of(capture)
        assert flux_prior.levels.size == 2
        merged += detailed.levels.size > 2
        remark = ESTIMATORS["likelihood"].remark(capture)
        assert bool(remark) == (detailed.levels.size > 2)
        assert flux_prior.share.sum() == pytest.approx(1)
        mean = detailed.share[1:] @ detailed.levels[1:] / detailed.share[1:].sum()
        assert flux_prior.levels[1] == pytest.approx(mean)
        exact = corrections.with_correction(capture, "signal_levels")
        other = without_correction(capture, "signal_levels")
        assert_within_uncertainty(capture, "likelihood", exact, other)
    assert merged


@pytest.mark.compiled
def test_levels_that_pixels_reveal_are_kept() -> None:
    reflectivity = np.where(np.arange(32) % 2 == 0, 0.2, 2.0) * np.ones((32, 1))
    capture = simulate(wall(reflectivity=reflectivity), GATE, Flux(0.1, 1.0))
    assert flux_prior_of(capture).levels.size > 2
    assert ESTIMATORS["likelihood"].remark(capture) == ""


@pytest.mark.compiled
def test_coates_corrects_pile_up_only_where_it_is_detectable() -> None:
    for seed in range(3):
        faint = seen(size=64, seed=seed)
        assert not flux_prior_of(faint).pile_up
        assert ESTIMATORS["coates"].remark(faint)
        exact = corrections.with_correction(faint, "pile_up")
        assert flux_prior_of(exact).pile_up
        assert_within_uncertainty(faint, "coates", exact, faint)
    bright = seen(DAY)
    assert flux_prior_of(bright).pile_up
    assert ESTIMATORS["coates"].remark(bright) == ""


# -- The command -----------------------------------------------------------------------------------


@pytest.mark.compiled
@pytest.mark.usefixtures("blank_figures")
def test_the_command_judges_a_scene_and_writes_a_page(
    tmp_path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(scenes, "car", partial(wall, 8))
    page = tmp_path / "page"
    arguments = ["requires", "--scene", "car", "--pulses", "50", "--seeds", "2", "--falloff"]
    assert main([*arguments, "--folder", str(page)]) == ACCEPTED
    out = capsys.readouterr().out
    assert "| part, correction or extension | verdict |" in out
    assert "| fall of the signal with range | " in out
    assert "| search for a velocity | not needed | " in out
    assert "Cost of absent parts" in out
    assert {path.name for path in page.iterdir()} >= {"index.html", "requirements.csv"}


@pytest.mark.compiled
@pytest.mark.usefixtures("without_extensions")
def test_the_command_judges_a_capture(capsys: pytest.CaptureFixture[str]) -> None:
    sample = str(plain.__file__).rsplit("core", 1)[0] + "assets/sample_capture.npz"
    assert main(["requires", "--capture", sample, "--json"]) == ACCEPTED
    found = json.loads(capsys.readouterr().out)
    assert found["pile_up"]["verdict"] == "needed"
    assert found["motion"]["total_variation"] is None
    assert main(["requires", "--capture", sample, "--sbr", "1"]) == REFUSED
    assert main(["requires", "--capture", sample, "--falloff"]) == REFUSED
    assert main(["requires", "--scene", "car", "--bins", "7"]) == REFUSED


@pytest.mark.parametrize(("n_seen", "holds"), [(11, True), (12, False)])
def test_an_absent_property_is_seen_in_one_of_twenty_captures_but_for_chance(
    n_seen: int, holds: bool
) -> None:
    """12 of 100 or more have a probability of 0.4 %."""
    verdicts = (SimpleNamespace(verdict="not needed", p_value=p) for p in (0.01, 0.5))
    seen, unseen = verdicts
    found = (seen,) * n_seen + (unseen,) * (100 - n_seen)
    assert power.Outcome(power.Case("pulse_shape", 1.0, 0.06), found).holds == holds
    assert power.Outcome(power.Case("pulse_shape", 2.0, 0.06), found).holds


@pytest.mark.compiled
def test_the_command_measures_size_and_power(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = (power.Case("pulse_shape", 1.0, 0.06), power.Case("pulse_shape", 2.0, 0.06))
    monkeypatch.setattr(power, "CASES", cases)
    assert main(["requires", "--power", "2", "--processes", "1"]) == ACCEPTED
    absent, wide = capsys.readouterr().out.splitlines()[-3:-1]
    assert absent.startswith("| shape of the pulse | 1 (absent) | 0.06 | 2 | 0.00")
    assert wide.startswith("| shape of the pulse | 2 | 0.06 | 2 | 1.00")
    assert main(["requires", "--power", "2", "--sbr", "1"]) == REFUSED
