"""Speed against accuracy: choices among points, measuring points, how to acquire."""

from __future__ import annotations

import csv
import json
import math
import pickle
import tracemalloc
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from core import estimators
from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.cli import main
from core.effects import Jitter
from core.estimators import ESTIMATORS
from core.io.writers import save_capture
from core.metrics import Interval
from core.parameters import Number, spec_of
from core.reductions import Reduction
from core.scene import PAPER_GATE, Scene, scenes
from core.simulation import simulate
from core.studies import trials
from core.studies.outputs import Plot, Table
from core.studies.tradeoff import acquisition as acquiring
from core.studies.tradeoff import measure
from core.studies.tradeoff import plan as plans
from core.studies.tradeoff.acquisition import Sweep
from core.studies.tradeoff.measure import (
    Candidate,
    Piece,
    Point,
    applicable,
    candidates,
    scored,
    study,
    variations,
)
from core.studies.tradeoff.page import acquisition_items, acquisition_sweeps
from core.studies.tradeoff.pareto import (
    best_within,
    by_condition,
    cheapest_reaching,
    including_flux_time,
    pareto_front,
)
from core.studies.tradeoff.surrogate import Simulation, surrogate_of, window
from core.studies.trials import Condition, Method, Score, default_methods

TARGETS = 100


def method(name: str) -> Method:
    return Method(name, name, ESTIMATORS[name].parameters())


def a_point(
    hits: Sequence[int], milliseconds: Sequence[float], name: str = "peak", source: str = "x"
) -> Point:
    scores = tuple(
        Score((0, 0, n), TARGETS, TARGETS, 1.0, 0.0, 1.0, 0.1, 0.001, 15.0) for n in hits
    )  # fmt: skip
    seconds = tuple(1e-3 * each for each in milliseconds)
    flux_s = (0.01,) * len(seconds)
    shape = (10, 10, 100)
    candidate = Candidate(method(name))
    return Point(source, 0.06, 0.1, 1000, shape, candidate, scores, seconds, flux_s, 0)


def steady(hits: int, milliseconds: float, name: str = "peak") -> Point:
    """A point that varies neither with seeds nor with rounds."""
    return a_point([hits] * 4, [milliseconds] * 6, name)


def beats(one: Point, other: Point) -> bool:
    mine, theirs = ((p.milliseconds.value, -p.rd().value) for p in (one, other))
    return mine != theirs and mine[0] <= theirs[0] and mine[1] <= theirs[1]


PLACES = st.lists(st.tuples(st.integers(0, 8), st.integers(1, 8)), max_size=12)


@given(PLACES)
def test_the_front_is_what_nothing_beats(places: list[tuple[int, int]]) -> None:
    points = [steady(10 * hits, milliseconds) for hits, milliseconds in places]
    chosen = pareto_front([*points, steady(100, 0.5, "oracle")])  # never eligible
    for point in points:
        on_front = any(point is each for each in chosen)
        assert on_front != any(beats(other, point) for other in points)
        assert on_front or any(beats(other, point) for other in chosen)
    assert len(chosen) <= len(points)
    speeds = [point.milliseconds.value for point in chosen]
    degrees = [point.rd().value for point in chosen]
    assert (speeds, degrees) == (sorted(speeds), sorted(degrees))


def test_a_gate_cut_to_the_true_ranges_is_never_chosen() -> None:
    cut = [each for each in variations((15, 99)) if each.reduction.gate]
    assert cut and all(each.is_bound for each in cut)
    assert not any(each.is_bound for each in variations())
    honest = steady(50, 4)
    informed = [replace(steady(99, 1), candidate=each) for each in cut]
    assert pareto_front([honest, *informed]) == [honest]
    best = best_within([honest, *informed], 10)
    assert best is not None and best.point is honest


def test_every_method_is_measured_with_each_number_of_merged_bins() -> None:
    found = measure.candidates()
    tried = [(each.method.name, each.reduction.merge) for each in found if each.returns == 1]
    methods = default_methods(with_motion=True)
    assert sorted(tried) == sorted((each.name, n) for each in methods for n in measure.MERGES)
    two = {each.method.name for each in found if each.returns == 2}
    assert two == {"likelihood", "image_posterior"}


def test_a_clear_choice_is_certain() -> None:
    points = [steady(50, 1), steady(90, 4), steady(95, 9), steady(99, 2, "oracle")]
    best = best_within(points, 5)
    assert best is not None
    assert best.point is points[1]
    assert (best.is_best, best.keeps, best.runners_up, best.optimism) == (1, 1, (), 0)
    cheapest = cheapest_reaching(points, 0.91)
    assert cheapest is not None
    assert cheapest.point is points[2]
    assert best_within(points, 0.5) is None
    assert cheapest_reaching(points, 0.99) is None
    assert best_within([], 5) is None
    equals = [steady(90, 4), steady(90, 3), steady(90, 5)]
    fastest = best_within(equals, 10)
    assert fastest is not None
    assert (fastest.point, fastest.is_best) == (equals[1], 1)


def test_equal_points_cannot_be_distinguished() -> None:
    rng = np.random.default_rng(0)
    points = [a_point([80] * 4, rng.normal(5, 1, 15)) for _ in range(2)]
    found = cheapest_reaching(points, 0.7)
    assert found is not None
    assert [point for point, _ in found.runners_up] == [p for p in points if p is not found.point]
    assert 0.05 < found.is_best < 0.95
    assert found.is_best + found.runners_up[0][1] == pytest.approx(1)


def test_seeds_are_paired() -> None:
    """One more hit on every seed is better for certain, however much seeds differ."""
    hits = np.random.default_rng(1).integers(20, 80, 12)
    points = [a_point(hits, [1] * 6), a_point(hits + 1, [2] * 6)]
    found = best_within(points, 5)
    assert found is not None
    assert (found.point, found.is_best) == (points[1], 1)


def test_the_certainty_of_a_choice_follows_the_normal_law() -> None:
    """A mean difference of one standard error: better with a probability of Φ(1)."""
    n = 400
    noise = np.random.default_rng(2).normal(0, 5, n)
    noise -= noise.mean()
    difference = np.round(noise + noise.std(ddof=0) / math.sqrt(n)).astype(int)
    shift = difference.mean() / (difference.std() / math.sqrt(n))
    points = [a_point([50] * n, [1] * 6), a_point(50 + difference, [2] * 6)]
    found = best_within(points, 5)
    assert found is not None
    # Four standard deviations of a share of 1000 draws, and two ends of whole counts.
    expected = stats.norm.cdf(shift)
    assert found.is_best == pytest.approx(expected, abs=4 * math.sqrt(0.25 / 1000) + 0.01)
    # The winner gains where the difference is above 0: in standard errors, E[z; z > -1] = φ(1).
    error = difference.std() / math.sqrt(n) / 100
    assert found.optimism == pytest.approx(
        stats.norm.pdf(shift) * error, abs=(4 / math.sqrt(1000) + 0.01) * error
    )


def test_a_limit_that_is_barely_kept_is_uncertain() -> None:
    seconds = [4, 4.5, 4.9, 5.1, 5.5, 6, 4.8]
    points = [a_point([90] * 4, seconds), a_point([50] * 4, [1] * 7)]
    found = best_within(points, 5)
    assert found is not None
    assert found.point is points[0]
    assert found.keeps == found.is_best
    assert 0.4 < found.keeps < 0.9
    assert found.runners_up == ((points[1], pytest.approx(1 - found.keeps)),)


def test_the_time_of_the_flux_model_can_be_included() -> None:
    (whole,) = including_flux_time([steady(90, 4)])
    assert whole.milliseconds.value == pytest.approx(14)
    assert whole.flux_ms.value == 0
    assert best_within([whole], 5) is None


def test_only_points_of_one_condition_are_compared() -> None:
    points = [steady(90, 4), replace(steady(90, 4), source="y")]
    assert len(by_condition(points)) == 2
    with pytest.raises(ValueError, match="points of one condition"):
        best_within(points, 5)
    with pytest.raises(ValueError, match="a positive time"):
        best_within(points[:1], 0)
    with pytest.raises(ValueError, match="a share of the pixels"):
        cheapest_reaching(points[:1], 1.5)


# -- Measuring -------------------------------------------------------------------------------------


@pytest.fixture
def stairs() -> Simulation:
    """A few pixels with a high SBR."""
    scene = scenes["staircase"](16)
    acquisition = replace(scene.acquisition, n_pulses=200)
    return Simulation("stairs", scene, acquisition, Flux(0.3, 1.0))


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure memory in this process; starting another takes seconds."""
    monkeypatch.setattr(
        measure, "mapped", lambda call, pieces, *_, **__: trials.mapped(call, pieces, 1)
    )


CONFIGURATIONS = [
    Candidate(method("peak")),
    Candidate(method("tracking"), threads=1),
    Candidate(method("tracking"), Reduction(merge=2, gate=(4, 96))),
    Candidate(method("tracking"), kernel="float64, signals kept"),
    Candidate(method("tracking"), kernel="float64, by rows"),
    Candidate(method("likelihood"), Reduction(skip=2)),
    Candidate(method("oracle"), Reduction(pool=2)),
    Candidate(method("peak"), Reduction(skip=17)),  # more than there is
]


@pytest.mark.compiled
def test_a_study_measures_every_applicable_candidate(
    stairs: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracemalloc, "start", lambda: pytest.fail("traced in this process"))
    calls: list[tuple[int, int]] = []
    points = study(
        [(stairs, CONFIGURATIONS), (stairs.with_pulses(50), CONFIGURATIONS[:1])],
        seeds=(5, 6),
        repeats=6,
        progress=lambda done, of: calls.append((done, of)),
    )
    expected = [*map(str, CONFIGURATIONS[:-1]), "peak"]
    assert [str(point.candidate) for point in points] == expected
    assert calls[0][0] == 0
    assert calls[-1][0] == calls[-1][1]
    assert calls == sorted(calls)
    first, tracked = points[0], points[1]
    assert first.condition == ("stairs", 1.0, 200)
    assert points[-1].condition == ("stairs", 1.0, 50)
    assert (len(first.scores), len(first.seconds), len(first.flux_s)) == (2, 6, 6)
    assert 0 < first.milliseconds.low <= first.milliseconds.value <= first.milliseconds.high
    assert first.ns_per_pixel_bin == pytest.approx(first.milliseconds.value * 1e6 / 16**2 / 100)
    assert first.peak_bytes > 16**2 * 8  # its estimates, at least
    # Other kernels find the same.
    assert [s.restored for s in points[3].scores] == [s.restored for s in tracked.scores]
    assert [s.restored for s in points[4].scores] == [s.restored for s in tracked.scores]
    # Kept signals take memory: the raw one, both scales, residual and enhanced in float64.
    assert points[3].peak_bytes > 5 * 16**2 * 100 * 8 > tracked.peak_bytes
    # One pixel of each 2 x 2 stands for all four.
    assert points[5].rd().value > 0.9
    assert pickle.loads(pickle.dumps(points))[2].rd() == points[2].rd()
    # The settings of a point reproduce it.
    known = json.loads(json.dumps(points[2].settings))
    assert (known["source"], known["sbr"], known["n_pulses"]) == ("stairs", 1, 200)
    reduction = Reduction(known["merge"], tuple(known["gate"]), known["skip"], known["pool"])
    capture = stairs.capture(6)
    image = estimators.estimate(reduction.of(capture), known["method"], **known["parameters"])
    truth_m = np.asarray(capture.truth_range_m)
    found_m = reduction.spread(image.range_m, capture.shape)
    again = trials.compare(found_m[np.newaxis], truth_m[np.newaxis], capture.acquisition, 0.0)
    assert replace(points[2].scores[1], seconds=0.0) == again


@pytest.mark.compiled
def test_a_score_equals_that_of_trials() -> None:
    simulation = plans.simulated("car", 0.06, 0.1041)
    (found,) = scored(Piece(0, simulation, (CONFIGURATIONS[1],), 3))
    expected = trials.score(Condition("car", 0.06).capture(3), method("tracking"))
    assert [replace(each, seconds=0.0) for each in found] == [replace(expected, seconds=0.0)]


@pytest.mark.compiled
def test_two_returns_and_velocities_are_measured_where_scenes_have_them() -> None:
    two, moving = scenes["net"](16, separation_bins=20.0, share=0.5), scenes["approach"]()
    moving = replace(moving, range_m=moving.range_m[24:32, 24:32])
    found = {}
    for name, scene in (("two", two), ("moving", moving)):
        source = Simulation(name, scene, replace(PAPER_GATE, n_pulses=500), Flux(0.3, 1.0))
        _, chosen = applicable(source, candidates(merges=(1,)))
        found[name] = {str(each) for each in chosen}
    assert found["two"] - found["moving"] == {"likelihood, 2 returns", "image_posterior, 2 returns"}
    assert found["moving"] - found["two"] == {"velocity"}
    source = Simulation("two", two, PAPER_GATE, Flux(0.3, 1.0))
    chosen = tuple(Candidate(method("likelihood"), returns=n) for n in (1, 2))
    (one,), (both,) = scored(Piece(0, source, chosen, 0))
    assert one.targets == 2 * 16 * 16
    assert one.restored[2] / one.targets == pytest.approx(0.5, abs=0.02)
    assert both.restored[2] / both.targets > 0.97


@pytest.mark.compiled
def test_rescaled_tracking_loses_little_where_bins_are_merged() -> None:
    capture = Condition("uniform", 0.06).capture(1)

    def rd(range_m: np.ndarray) -> float:
        error = np.abs(range_m - np.asarray(capture.truth_range_m))
        return float((error <= 3 * capture.acquisition.bin_length_m).mean())

    merged = Candidate(method("tracking"), Reduction(merge=4))
    reduced = merged.reduction.of(capture)
    full = rd(CONFIGURATIONS[1].range_m(capture, capture.shape))
    found = rd(merged.range_m(reduced, capture.shape))
    assert full - 0.1 < found < full
    assert rd(estimators.estimate(reduced, "tracking", t_n=5).range_m) < 0.5 * found  # with l kept


BOTH = Reduction(merge=2, gate=(7, 90))
KEPT = {
    ("tracking", "h"),
    ("kde", "bandwidth_bins"),
    ("chi", "bandwidth_bins"),
    ("shi", "width_bins"),
}
"""Settings in bins that reductions leave as they are."""


def test_settings_are_rescaled_to_the_reduced_bins() -> None:
    tracking = measure.rescaled(ESTIMATORS["tracking"].parameters(l=0.004, t_n=20), BOTH)
    assert (tracking.l, tracking.t_n) == (pytest.approx(0.016), 7)
    cfar = measure.rescaled(ESTIMATORS["cfar"].parameters(), BOTH)
    assert (cfar.smoothing_bins, cfar.guard_bins, cfar.training_bins) == (0.5, 2, 4)
    unmixing = measure.rescaled(ESTIMATORS["unmixing"].parameters(smoothness=0.5), BOTH)
    assert unmixing.smoothness == 1.0


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_setting_in_bins_is_rescaled_or_declared_kept(name: str) -> None:
    settings = ESTIMATORS[name].parameters()
    found = measure.rescaled(settings, BOTH)
    for each in fields(settings):
        spec = spec_of(each)
        if each.name.endswith("_bins"):
            assert isinstance(spec, Number) and spec.unit == "bins", each.name
        in_bins = isinstance(spec, Number) and bool("bin" in spec.unit or spec.merge_power)
        changed = getattr(found, each.name) != getattr(settings, each.name)
        assert changed == (in_bins and (name, each.name) not in KEPT), each.name


def test_a_study_can_be_cancelled_and_refuses_what_it_cannot_measure(stairs: Simulation) -> None:
    calls: list[int] = []

    def cancelled(done: int, of: int) -> None:
        calls.append(done)
        if done:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        study([(stairs, CONFIGURATIONS[:1])], seeds=(1, 2), progress=cancelled)
    assert len(calls) == 2
    with pytest.raises(ValueError, match="seeds = 1 is not accepted"):
        study([(stairs, CONFIGURATIONS)], seeds=(1,))
    with pytest.raises(ValueError, match="repeats = 5 is not accepted"):
        study([(stairs, CONFIGURATIONS)], repeats=5)
    sky = replace(stairs, scene=Scene(np.full((4, 4), np.nan)))
    with pytest.raises(ValueError, match="targets = 0 is not accepted"):
        study([(sky, CONFIGURATIONS[:1])])
    with pytest.raises(ValueError, match="kernel = 'float64, by rows' is not accepted"):
        Candidate(method("peak"), kernel="float64, by rows")


# -- Captures and their surrogates -----------------------------------------------------------------


@pytest.mark.compiled
@pytest.mark.usefixtures("one_process")
def test_a_capture_with_a_truth_is_scored_by_parts(
    stairs: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = replace(stairs.capture(1), signal=None, source="mine")
    (point,) = study([(capture, [CONFIGURATIONS[1], Candidate(method("oracle"))])], repeats=6)
    assert (point.source, point.sbr, len(point.scores)) == ("mine", None, measure.TILES)
    assert {score.targets for score in point.scores} == {16}
    expected = trials.score(capture, method("tracking"))
    assert sum(score.restored[2] for score in point.scores) == expected.restored[2]
    monkeypatch.setattr("core.studies.middle.MAX_COUNTS", capture.cube.size // 4)
    middle = measure.studied(capture)
    assert isinstance(middle, Capture)
    assert middle.cube.shape == (8, 8, 100)
    assert "the middle 8 x 8 pixels" in middle.source


@pytest.mark.compiled
@pytest.mark.usefixtures("one_process")
def test_a_capture_without_a_truth_is_replaced_by_its_surrogate(stairs: Simulation) -> None:
    capture = stairs.capture(1)
    bare = Capture(capture.cube, capture.acquisition, source="mine")
    (point,) = study([(bare, CONFIGURATIONS[:1])], seeds=(1, 2), repeats=6)
    assert point.note == "the capture has no truth: errors are those of a simulated scene like it"
    assert point.sbr == pytest.approx(1, rel=0.1)
    (known,) = study([(stairs, CONFIGURATIONS[:1])], seeds=(1, 2), repeats=6)
    # 512 pixels: four standard deviations, and a twentieth for the surrogate.
    assert point.rd().value == pytest.approx(known.rd().value, abs=4 * 0.5 / 512**0.5 + 0.05)


@pytest.mark.compiled
def test_a_surrogate_has_flux_and_ranges_of_its_capture() -> None:
    scene = scenes["staircase"](32)
    reflectivity = np.where(np.arange(32) < 16, 0.5, 1.5)[:, np.newaxis] * np.ones(32)
    range_m = np.array(scene.range_m)
    range_m[:, :4] = np.nan
    capture = simulate(Scene(range_m, reflectivity), scene.acquisition, Flux(0.1, 0.4), seed=3)
    found = surrogate_of(Capture(capture.cube, capture.acquisition), "mine")
    target = np.isfinite(range_m)
    assert (np.isfinite(found.scene.range_m) == target).mean() > 0.99
    both = target & np.isfinite(found.scene.range_m)
    error_m = np.abs(found.scene.range_m - range_m)[both]
    assert np.median(error_m) < 0.5 * capture.acquisition.bin_length_m
    assert found.flux.signal == pytest.approx(0.1, rel=0.1)
    assert found.flux.background == pytest.approx(0.25, rel=0.05)
    brightness = np.asarray(found.scene.reflectivity)
    assert brightness[:16, 4:].mean() == pytest.approx(0.5, rel=0.2)
    assert brightness[16:, 4:].mean() == pytest.approx(1.5, rel=0.1)
    assert found.window == window(range_m, capture.pulse, capture.acquisition) == (0, 100)
    dark = Capture(np.zeros((4, 4, 30), np.uint16), Acquisition(n_bins=30))
    with pytest.raises(ValueError, match=r"confidence = 0\.00 at most is not accepted"):
        surrogate_of(dark, "dark")


def test_multi_detection_data_are_simulated_as_poisson_counts() -> None:
    acquisition = Acquisition(n_bins=10, n_pulses=None)
    scene = Scene(np.full((60, 60), acquisition.bin_to_range_m(3.5)), np.full((60, 60), 0.5))
    simulation = Simulation("wall", scene, acquisition, Flux(8.0, 4.0), detection="all")
    with pytest.raises(ValueError, match=r"of wall = .* first photons of a known number of pulses"):
        acquisition_sweeps([simulation], (1, 2))
    capture = simulation.capture(1)
    assert capture.detection == "all"
    expected = 0.2 + 4.0 * capture.pulse.bin_probability(3.5, 10, 1e-9)
    counts = capture.cube.reshape(-1, 10)
    spread = np.sqrt(expected / 3600)
    np.testing.assert_array_less(np.abs(counts.mean(axis=0) - expected), 5 * spread)
    # The variance of n draws has a relative error of about sqrt(2/n), thrice that for rare counts.
    np.testing.assert_allclose(counts.var(axis=0), expected, rtol=5 * 3 * math.sqrt(2 / 3600))


# -- How to acquire --------------------------------------------------------------------------------


@pytest.fixture
def car() -> Simulation:
    """Every fourth pixel of the car."""
    built = scenes["car"]()
    scene = Scene(built.range_m[::4, ::4], acquisition=built.acquisition)
    return Simulation("car", scene, scene.acquisition, Flux(sbr=0.06))


@pytest.mark.compiled
def test_theory_and_simulation_agree_where_theory_is_accurate(car: Simulation) -> None:
    varied = [
        ((200, 1000), acquiring.simulated_over_pulses(car, (200, 1000))),
        ((0.5, 1.0), acquiring.over_exposures(car, (0.5, 1.0))),
    ]
    pulses, exposures = acquiring.sweeps(varied, seeds=range(3))
    assert pulses.theory[1] == exposures.theory[1]
    assert pulses.simulated["oracle"][1] == exposures.simulated["oracle"][1]
    assert pulses.theory[0] < pulses.theory[1]
    for found in (pulses, exposures):
        for at in np.flatnonzero(found.theory > 0.95):
            # The accuracy that `right_bin_probability` states, and chance.
            interval = found.simulated["oracle"][at]
            assert interval.low - 0.01 < found.theory[at] < interval.high + 0.01
    assert pulses.simulated["likelihood"][0].value < pulses.simulated["likelihood"][1].value


def test_pulses_by_theory_reach_the_degree(car: Simulation) -> None:
    n_pulses = acquiring.pulses_by_theory(car, 0.95)
    assert acquiring.theory(car.with_pulses(round(n_pulses))) == pytest.approx(0.95, abs=1e-3)
    assert 300 < n_pulses < 700
    assert acquiring.pulses_by_theory(car, 0.01) == 1
    # Targets outside the gate are found by chance alone.
    away = replace(car, scene=Scene(np.full((2, 2), 500.0)))
    assert acquiring.pulses_by_theory(away, 0.95) == math.inf


def test_pulses_by_simulation_are_interpolated() -> None:
    x = np.array([100.0, 1000.0, 10_000.0])

    def degree(n_pulses: float, shift: float) -> float:
        return 1 / (1 + math.exp(-2 * (math.log(n_pulses / 1000) + shift)))

    ends = [(degree(n, 0.0), degree(n, -0.1), degree(n, 0.1)) for n in x]
    found = Sweep(x, np.zeros(3), {"likelihood": tuple(Interval(*each) for each in ends)})
    reached = acquiring.pulses_by_simulation(found, "likelihood", degree(2000, 0.0))
    # A line in log odds over log pulses is interpolated exactly.
    assert reached.value == pytest.approx(2000)
    expected = 2000 * math.exp(-0.1), 2000 * math.exp(0.1)
    assert (reached.low, reached.high) == pytest.approx(expected)
    assert acquiring.pulses_by_simulation(found, "likelihood", 0.001).value == 0
    assert acquiring.pulses_by_simulation(found, "likelihood", 0.9999).value == math.inf


def test_gates_hold_the_targets_and_keep_the_background_per_bin(car: Simulation) -> None:
    onset_m = car.scene.range_m[np.isfinite(car.scene.range_m)]
    gates = acquiring.over_gates(car)
    sizes = [each.acquisition.n_bins for each in gates]
    assert sizes == sorted(sizes)
    assert sizes[-1] == pytest.approx(acquiring.MAX_GATE * sizes[0], abs=1)
    for each in gates:
        onset = each.acquisition.range_m_to_bin(onset_m)
        assert 0 <= onset.min() <= onset.max() < each.acquisition.n_bins
        assert each.acquisition.gate_delay_s >= 0
        per_bin = each.flux.background / each.acquisition.n_bins
        assert per_bin == pytest.approx(car.flux.background / 100)
        assert each.flux.signal == car.flux.signal


@pytest.mark.compiled
def test_the_oracle_is_left_out_where_the_fluxes_are_not_known(
    monkeypatch: pytest.MonkeyPatch, car: Simulation
) -> None:
    monkeypatch.setattr(acquiring, "PULSES", (50, 500))
    monkeypatch.setattr(acquiring, "EXPOSURES", (0.5, 1.0))
    monkeypatch.setattr(acquiring, "GATES", 2)
    worn = replace(car, name="worn", scene=replace(car.scene, jitter=Jitter(1e-9)))
    assert worn.capture(0).signal is None
    sweeps = acquisition_sweeps([car, worn], (0, 1))
    assert [[*each.gate.simulated] for each in sweeps] == [["oracle", "likelihood"], ["likelihood"]]
    *plots, required = acquisition_items(sweeps)
    assert isinstance(required, Table)
    at = required.columns.index("oracle, simulated [95 %]")
    assert {bool(row[at]) for row in required.rows if row[0] == "worn"} == {False}
    assert all(row[at] for row in required.rows if row[0] == "car")
    for item in plots[3:]:
        assert isinstance(item, Plot)
        assert [*item.curves] == ["theory, flux known", "likelihood, simulated"]
        assert "It leaves out: timing jitter." in item.note
    *_, alone = acquisition_items(sweeps[1:])
    assert isinstance(alone, Table)
    assert not any("oracle" in name for name in alone.columns)


def test_the_best_exposure_is_the_best_by_theory(car: Simulation) -> None:
    bright = replace(car, flux=Flux(0.4, 0.06))
    factor = acquiring.exposure(bright)
    assert 0.1 < factor < 0.5
    varied = acquiring.over_exposures(bright, acquiring.EXPOSURES)
    (best,) = acquiring.over_exposures(bright, [factor])
    assert acquiring.theory(best) > max(map(acquiring.theory, varied)) - 0.01


# -- The command -----------------------------------------------------------------------------------


@pytest.fixture
def small_car(monkeypatch: pytest.MonkeyPatch, car: Simulation) -> None:
    """Little to measure: each scene, method and setting once."""
    few = [method(name) for name in ("peak", "tracking", "oracle")]
    monkeypatch.setattr(measure, "default_methods", lambda **_: few)
    monkeypatch.setitem(scenes, "car", lambda: car.scene)
    monkeypatch.setattr(acquiring, "PULSES", (50, 500))
    monkeypatch.setattr(acquiring, "EXPOSURES", (0.5, 1.0))
    monkeypatch.setattr(acquiring, "GATES", 2)
    monkeypatch.setattr(measure, "VARIED", ("tracking",))


@pytest.mark.compiled
@pytest.mark.usefixtures("small_car", "one_process", "blank_figures")
def test_the_command_recommends_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["tradeoff", "--short", "--processes", "1", "--seeds", "2", "--within", "50"]
    assert main([*arguments, "--reach", "0.5", "--folder", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "| car | 0.06 | 1000 | best within 50 ms |" in out
    assert "| car | 0.06 | 1000 | fastest with RD ≥ 0.5 |" in out
    assert "Pulses required" in out
    assert (tmp_path / "index.html").exists()
    known = json.loads((tmp_path / "points.json").read_text(encoding="utf-8"))
    with (tmp_path / "points.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["configuration"] for row in rows] == [each["configuration"] for each in known]
    assert [float(row["ms, low"]) for row in rows] == [each["milliseconds"][1] for each in known]
    assert {each["method"] for each in known} == {"peak", "tracking", "oracle"}
    for key in ("front_car_0.06_1000", "pulses_car_0.06", "exposure_car_0.06", "gate_car_0.06"):
        assert (tmp_path / f"{key}.csv").exists()
        assert (tmp_path / f"{key}.png").exists() and (tmp_path / f"{key}.svg").exists()


@pytest.mark.compiled
@pytest.mark.usefixtures("small_car", "one_process", "blank_figures")
def test_the_command_studies_a_capture(
    stairs: Simulation,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "stairs.npz"
    save_capture(replace(stairs.capture(1), truth_range_m=None, signal=None), path)
    arguments = ["tradeoff", "--short", "--processes", "1", "--seeds", "2", "--capture", str(path)]
    assert main([*arguments, "--with-light", "--folder", str(tmp_path / "out")]) == 0
    assert "| stairs.npz |" in capsys.readouterr().out
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "stairs.npz: the capture has no truth: errors are those of a simulated scene" in page
    assert "Times include the estimation of the flux model" in page
    assert "pulses_stairs.npz" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "car", "--bin-width", "1ns"], "--bin-width = 1e-09 is not accepted"),
        (["--capture", "x.npz", "--sbr", "0.1"], "sbr = [0.1] is not accepted"),
        (["--sbr", "-1"], "sbr = -1.0 is not accepted"),
        (["--within", "0"], "within = 0.0 is not accepted"),
        (["--reach", "1.2"], "reach = 1.2 is not accepted"),
    ],
)
def test_the_command_refuses_contradictions(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tradeoff", "--folder", str(tmp_path), *arguments]) == 2
    assert message in capsys.readouterr().err
