"""Speed against accuracy: what is chosen of points, how points come about, how to acquire."""

from __future__ import annotations

import csv
import json
import math
import pickle
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from core import estimators
from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.cli import main
from core.estimators import ESTIMATORS
from core.io.writers import save_capture
from core.kernels.parallel import SERIAL_BELOW
from core.metrics import Interval
from core.reductions import Reduction
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies import trials
from core.studies.outputs import Plot, Scatter
from core.studies.report import write
from core.studies.tradeoff import acquisition as acquiring
from core.studies.tradeoff import measure as tradeoff
from core.studies.tradeoff import plan as tradeoff_plan
from core.studies.tradeoff.acquisition import Sweep
from core.studies.tradeoff.measure import Cancelled, Candidate, Piece, Point, scored, study
from core.studies.tradeoff.pareto import (
    best_within,
    by_condition,
    cheapest_reaching,
    front,
    with_light,
)
from core.studies.tradeoff.surrogate import Simulation, like, window
from core.studies.trials import Condition, Method, Score

TARGETS = 100


def method(name: str) -> Method:
    return Method(name, name, ESTIMATORS[name].parameters())


def a_point(
    hits: Sequence[int], milliseconds: Sequence[float], name: str = "peak", source: str = "x"
) -> Point:
    """A point of which only what choices look at is told."""
    scores = tuple(
        Score((0, 0, n), TARGETS, TARGETS, 1.0, 0.0, 1.0, 0.1, 0.001) for n in hits
    )  # fmt: skip
    seconds = tuple(1e-3 * each for each in milliseconds)
    light = (0.01,) * len(seconds)
    shape = (10, 10, 100)
    return Point(source, 0.06, 0.1, 1000, shape, Candidate(method(name)), scores, seconds, light, 0)


def steady(hits: int, milliseconds: float, name: str = "peak") -> Point:
    """A point that neither seeds nor rounds change."""
    return a_point([hits] * 4, [milliseconds] * 6, name)


def beats(one: Point, other: Point) -> bool:
    mine, theirs = ((p.milliseconds.value, -p.rd().value) for p in (one, other))
    return mine != theirs and mine[0] <= theirs[0] and mine[1] <= theirs[1]


PLACES = st.lists(st.tuples(st.integers(0, 8), st.integers(1, 8)), max_size=12)


@given(PLACES)
def test_the_front_is_what_nothing_beats(places: list[tuple[int, int]]) -> None:
    points = [steady(10 * hits, milliseconds) for hits, milliseconds in places]
    chosen = front([*points, steady(100, 0.5, "oracle")])  # which nobody can take
    for point in points:
        on_front = any(point is each for each in chosen)
        assert on_front != any(beats(other, point) for other in points)
        assert on_front or any(beats(other, point) for other in chosen)
    assert len(chosen) <= len(points)
    speeds = [point.milliseconds.value for point in chosen]
    degrees = [point.rd().value for point in chosen]
    assert (speeds, degrees) == (sorted(speeds), sorted(degrees))


def test_a_clear_choice_is_sure() -> None:
    points = [steady(50, 1), steady(90, 4), steady(95, 9), steady(99, 2, "oracle")]
    best = best_within(points, 5)
    assert best is not None
    assert best.point is points[1]
    assert (best.is_best, best.keeps, best.runners_up) == (1, 1, ())
    cheapest = cheapest_reaching(points, 0.91)
    assert cheapest is not None
    assert cheapest.point is points[2]
    assert best_within(points, 0.5) is None
    assert cheapest_reaching(points, 0.99) is None
    assert best_within([], 5) is None


def test_of_equals_the_fastest_is_chosen() -> None:
    points = [steady(90, 4), steady(90, 3), steady(90, 5)]
    best = best_within(points, 10)
    assert best is not None
    assert (best.point, best.is_best) == (points[1], 1)


def test_twins_cannot_be_told_apart() -> None:
    rng = np.random.default_rng(0)
    points = [a_point([80] * 4, rng.normal(5, 1, 15)) for _ in range(2)]
    found = cheapest_reaching(points, 0.7)
    assert found is not None
    assert [point for point, _ in found.runners_up] == [p for p in points if p is not found.point]
    assert 0.05 < found.is_best < 0.95
    assert found.is_best + found.runners_up[0][1] == pytest.approx(1)


def test_seeds_are_paired() -> None:
    """One more right on every seed is better for sure, however much seeds differ."""
    hits = np.random.default_rng(1).integers(20, 80, 12)
    points = [a_point(hits, [1] * 6), a_point(hits + 1, [2] * 6)]
    found = best_within(points, 5)
    assert found is not None
    assert (found.point, found.is_best) == (points[1], 1)


def test_how_sure_a_choice_is_follows_the_normal_law() -> None:
    """A mean difference of one standard error: better with a probability of Φ(1)."""
    n = 400
    noise = np.random.default_rng(2).normal(0, 5, n)
    noise -= noise.mean()
    wanted = noise.std(ddof=0) / math.sqrt(n)
    difference = np.round(noise + wanted).astype(int)
    shift = difference.mean() / (difference.std() / math.sqrt(n))
    points = [a_point([50] * n, [1] * 6), a_point(50 + difference, [2] * 6)]
    found = best_within(points, 5)
    assert found is not None
    expected = stats.norm.cdf(shift)
    # Four standard deviations of a share of 1000 draws, and two ends of whole counts.
    assert found.is_best == pytest.approx(expected, abs=4 * math.sqrt(0.25 / 1000) + 0.01)


def test_a_limit_that_is_just_kept_is_not_kept_for_sure() -> None:
    seconds = [4, 4.5, 4.9, 5.1, 5.5, 6, 4.8]
    points = [a_point([90] * 4, seconds), a_point([50] * 4, [1] * 7)]
    found = best_within(points, 5)
    assert found is not None
    assert found.point is points[0]
    assert found.keeps == found.is_best
    assert 0.4 < found.keeps < 0.9
    assert found.runners_up == ((points[1], pytest.approx(1 - found.keeps)),)


def test_the_light_can_be_counted_in() -> None:
    point = steady(90, 4)
    (whole,) = with_light([point])
    assert whole.milliseconds.value == pytest.approx(14)
    assert whole.light_ms.value == 0
    assert best_within([whole], 5) is None


def test_only_what_is_alike_is_compared() -> None:
    points = [steady(90, 4), replace(steady(90, 4), source="y")]
    assert len(by_condition(points)) == 2
    with pytest.raises(ValueError, match="points of one condition"):
        best_within(points, 5)
    with pytest.raises(ValueError, match="a positive time"):
        best_within(points[:1], 0)
    with pytest.raises(ValueError, match="a share of the pixels"):
        cheapest_reaching(points[:1], 1.5)


# -- a study ---------------------------------------------------------------------------------------


@pytest.fixture
def stairs() -> Simulation:
    """Some dozen pixels under good light."""
    scene = scenes["staircase"](16)
    acquisition = replace(scene.acquisition, n_pulses=200)
    return Simulation("stairs", scene, acquisition, Flux(0.3, 1.0))


WAYS = [
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
def test_a_study_measures_what_it_is_given(stairs: Simulation) -> None:
    told: list[tuple[int, int]] = []
    points = study(
        [(stairs, WAYS), (stairs.with_pulses(50), WAYS[:1])],
        seeds=(5, 6),
        repeats=6,
        progress=lambda done, of: told.append((done, of)),
    )
    assert [str(point.candidate) for point in points] == [*map(str, WAYS[:-1]), "peak"]
    assert told[0][0] == 0
    assert told[-1][0] == told[-1][1]
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    first, tracked = points[0], points[1]
    assert first.condition == ("stairs", 1.0, 200)
    assert points[-1].condition == ("stairs", 1.0, 50)
    assert len(first.scores) == 2
    assert (len(first.seconds), len(first.light_s)) == (6, 6)
    assert 0 < first.milliseconds.low <= first.milliseconds.value <= first.milliseconds.high
    assert first.ns_per_pixel_bin == pytest.approx(first.milliseconds.value * 1e6 / 16**2 / 100)
    assert first.peak_bytes > 16**2 * 8  # its answer, at least
    # The same by other arithmetic; what is not found stands elsewhere by rows.
    assert [s.restored for s in points[3].scores] == [s.restored for s in tracked.scores]
    assert [s.restored for s in points[4].scores] == [s.restored for s in tracked.scores]
    # Signals that are kept take memory: of float64 the raw one, both scales and what they give.
    assert points[3].peak_bytes > 5 * 16**2 * 100 * 8 > tracked.peak_bytes
    # Every fourth pixel of 2 x 2 tiles answers for all four.
    assert points[5].rd().value > 0.9
    assert pickle.loads(pickle.dumps(points))[2].rd() == points[2].rd()


@pytest.mark.compiled
def test_memory_is_not_measured_where_others_compute(
    stairs: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracemalloc, "start", lambda: pytest.fail("traced in this process"))
    first, second = study([(stairs, WAYS[:2])], seeds=(5, 6), repeats=6)
    assert min(first.peak_bytes, second.peak_bytes) > 16**2 * 8


@pytest.mark.compiled
def test_settings_make_a_point_again(stairs: Simulation) -> None:
    (point,) = study([(stairs, WAYS[2:3])], seeds=(5, 6), repeats=6)
    told = json.loads(json.dumps(point.settings))
    assert (told["source"], told["sbr"], told["signal"], told["n_pulses"]) == (
        "stairs",
        1,
        0.3,
        200,
    )
    reduction = Reduction(told["merge"], tuple(told["gate"]), told["skip"], told["pool"])
    capture = stairs.capture(6)
    image = estimators.estimate(reduction.of(capture), told["method"], **told["parameters"])
    truth_m, bin_m = np.asarray(capture.truth_range_m), capture.acquisition.bin_length_m
    again = trials.compared(reduction.spread(image.range_m, capture.shape), truth_m, bin_m, 0.0)
    assert replace(point.scores[1], seconds=0.0) == again


@pytest.mark.compiled
def test_a_score_is_that_of_trials() -> None:
    condition = Condition("car", 0.06)
    car = scenes["car"]()
    simulation = Simulation("car", car, car.acquisition, Flux(sbr=0.06))
    (found,) = scored(Piece(0, simulation, (WAYS[1],), 3))
    expected = trials.score(condition.capture(3), method("tracking"))
    assert [replace(each, seconds=0.0) for each in found] == [replace(expected, seconds=0.0)]


@pytest.mark.compiled
def test_the_tracking_differentiators_keep_their_motion_where_bins_are_merged() -> None:
    """With l times the square of the factor they lose little, and with l as it was, much."""
    capture = Condition("uniform", 0.06).capture(1)
    shares = []
    for each in (
        WAYS[1],
        Candidate(method("tracking"), Reduction(merge=4)),
    ):
        less = each.reduction.of(capture)
        range_m = each.answer(less, capture.shape)
        shares.append(within_3_bins(capture, range_m))
    unfitted = estimators.estimate(less, "tracking", t_n=5)
    assert shares[0] - 0.1 < shares[1] < shares[0]
    assert within_3_bins(capture, unfitted.range_m) < 0.5 * shares[1]


def within_3_bins(capture: Capture, range_m: np.ndarray) -> float:
    error = np.abs(range_m - np.asarray(capture.truth_range_m))
    return float((error <= 3 * capture.acquisition.bin_length_m).mean())


def test_settings_are_fitted_to_the_reduced_bins() -> None:
    both = Reduction(merge=2, gate=(7, 90))
    tracking = tradeoff.fitted(ESTIMATORS["tracking"].parameters(l=0.004, t_n=20), both)
    assert (tracking.l, tracking.t_n) == (pytest.approx(0.016), 7)
    cfar = tradeoff.fitted(ESTIMATORS["cfar"].parameters(), both)
    assert (cfar.smoothing_bins, cfar.guard_bins, cfar.training_bins) == (0.5, 2, 4)
    shi = ESTIMATORS["shi"].parameters()
    assert tradeoff.fitted(shi, both) is shi


@pytest.mark.compiled
def test_who_no_longer_wants_to_know_is_heard(stairs: Simulation) -> None:
    asked = iter([False, False, False, True])
    with pytest.raises(Cancelled):
        study([(stairs, WAYS[:1])], seeds=(1, 2), cancelled=lambda: next(asked))


def test_a_study_refuses_what_it_cannot_measure(stairs: Simulation) -> None:
    with pytest.raises(ValueError, match="seeds = 1 is not accepted"):
        study([(stairs, WAYS)], seeds=(1,))
    with pytest.raises(ValueError, match="repeats = 5 is not accepted"):
        study([(stairs, WAYS)], repeats=5)
    sky = replace(stairs, scene=Scene(np.full((4, 4), np.nan)))
    with pytest.raises(ValueError, match="targets = 0 is not accepted"):
        study([(sky, WAYS[:1])])
    with pytest.raises(ValueError, match="kernel = 'float64, by rows' is not accepted"):
        Candidate(method("peak"), kernel="float64, by rows")


def test_the_plan_holds_every_method_and_every_factor() -> None:
    plan = tradeoff_plan.over_pulses(tradeoff_plan.simulated("car", 0.06, 0.1041))
    assert [source.acquisition.n_pulses for source, _ in plan] == list(acquiring.PULSES)
    for source, ways in plan:
        assert {way.method.estimator for way in ways} == set(ESTIMATORS)
        merges = {way.reduction.merge for way in ways}
        assert merges == ({1, 2, 4} if source.acquisition.n_pulses in (100, 1000, 10_000) else {1})
    everything = plan[acquiring.PULSES.index(1000)][1]
    assert {way.kernel for way in everything} == set(tradeoff.KERNELS)
    assert {way.reduction.gate for way in everything} == {None, plan[4][0].window}
    assert {(way.reduction.skip, way.reduction.pool) for way in everything} >= {(2, 1), (1, 2)}
    assert len(set(everything)) == len(everything)
    ((large, ways),) = tradeoff_plan.threaded(0.2, 0.1)
    assert large.acquisition.n_bins * 256**2 > SERIAL_BELOW
    assert {way.threads for way in ways} == set(range(1, numba.config.NUMBA_NUM_THREADS + 1))


# -- captures, and simulations like them -----------------------------------------------------------


@pytest.mark.compiled
def test_a_capture_with_a_truth_is_scored_by_parts(
    stairs: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = replace(stairs.capture(1), signal=None, source="mine")
    (point,) = study([(capture, [WAYS[1], Candidate(method("oracle"))])], repeats=6)
    assert (point.source, point.sbr, len(point.scores)) == ("mine", None, tradeoff.TILES)
    assert {score.targets for score in point.scores} == {16}
    expected = trials.score(capture, method("tracking"))
    assert sum(score.restored[2] for score in point.scores) == expected.restored[2]
    monkeypatch.setattr(tradeoff, "MOST_COUNTS", capture.cube.size // 4)
    (middle,) = study([(capture, WAYS[:1])], repeats=6)
    assert middle.shape == (8, 8, 100)
    assert "the middle 8 x 8 pixels" in middle.source


@pytest.mark.compiled
def test_a_capture_without_a_truth_is_stood_for(stairs: Simulation) -> None:
    seen = stairs.capture(1)
    bare = Capture(seen.cube, seen.acquisition, source="mine")
    points = study([(bare, WAYS[:2])], seeds=(1, 2), repeats=6)
    assert {point.note for point in points} == {
        "the capture has no truth: errors are those of a simulated scene like it"
    }
    assert points[0].sbr == pytest.approx(1, rel=0.1)
    known = study([(stairs, WAYS[:2])], seeds=(1, 2), repeats=6)
    for point, expected in zip(points, known, strict=True):
        # Of 512 pixels: four standard deviations, and a twentieth that the likeness may be off.
        assert point.rd().value == pytest.approx(expected.rd().value, abs=4 * 0.5 / 512**0.5 + 0.05)


@pytest.mark.compiled
def test_a_likeness_has_the_light_and_the_ranges_of_what_it_is_like() -> None:
    scene = scenes["staircase"](32)
    reflectivity = np.where(np.arange(32) < 16, 0.5, 1.5)[:, np.newaxis] * np.ones(32)
    range_m = np.array(scene.range_m)
    range_m[:, :4] = np.nan
    seen = simulate(Scene(range_m, reflectivity), scene.acquisition, Flux(0.1, 0.4), seed=3)
    found = like(Capture(seen.cube, seen.acquisition), "mine")
    target = np.isfinite(range_m)
    assert (np.isfinite(found.scene.range_m) == target).mean() > 0.99
    both = target & np.isfinite(found.scene.range_m)
    error_m = np.abs(found.scene.range_m - range_m)[both]
    assert np.median(error_m) < 0.5 * seen.acquisition.bin_length_m
    assert found.flux.signal == pytest.approx(0.1, rel=0.1)
    assert found.flux.background == pytest.approx(0.25, rel=0.05)
    brightness = np.asarray(found.scene.reflectivity)
    assert brightness[:16, 4:].mean() == pytest.approx(0.5, rel=0.2)
    assert brightness[16:, 4:].mean() == pytest.approx(1.5, rel=0.1)
    assert found.window == window(range_m, seen.pulse, seen.acquisition) == (0, 100)
    dark = Capture(np.zeros((4, 4, 30), np.uint16), Acquisition(n_bins=30))
    with pytest.raises(ValueError, match=r"confidence = 0\.00 at most is not accepted"):
        like(dark, "dark")


def test_all_photons_are_simulated_as_poisson_counts() -> None:
    acquisition = Acquisition(n_bins=10, n_pulses=None)
    scene = Scene(np.full((60, 60), acquisition.bin_to_range_m(3.5)), np.full((60, 60), 0.5))
    capture = Simulation("wall", scene, acquisition, Flux(8.0, 4.0), detection="all").capture(1)
    assert capture.detection == "all"
    expected = 0.2 + 4.0 * capture.pulse.bin_probability(3.5, 10, 1e-9)
    counts = capture.cube.reshape(-1, 10)
    spread = np.sqrt(expected / 3600)
    np.testing.assert_array_less(np.abs(counts.mean(axis=0) - expected), 5 * spread)
    # A variance of n draws is known to about sqrt(2/n) of itself, Poisson's rarest to thrice that.
    np.testing.assert_allclose(counts.var(axis=0), expected, rtol=5 * 3 * math.sqrt(2 / 3600))


# -- how to acquire --------------------------------------------------------------------------------


@pytest.fixture
def car() -> Simulation:
    """Every fourth pixel of the car."""
    built = scenes["car"]()
    scene = Scene(built.range_m[::4, ::4], acquisition=built.acquisition)
    return Simulation("car", scene, scene.acquisition, Flux(sbr=0.06))


@pytest.mark.compiled
def test_theory_and_simulation_agree_where_theory_is_good(car: Simulation) -> None:
    knobs = [
        ((200, 1000), acquiring.over_pulses(car, (200, 1000))),
        ((0.5, 1.0), acquiring.over_exposures(car, (0.5, 1.0))),
    ]
    told: list[tuple[int, int]] = []
    pulses, exposures = acquiring.sweeps(
        knobs, seeds=range(3), progress=lambda done, of: told.append((done, of))
    )
    assert told[-1] == (12, 12)
    assert pulses.theory[1] == exposures.theory[1]
    assert pulses.simulated["oracle"][1] == exposures.simulated["oracle"][1]
    assert pulses.theory[0] < pulses.theory[1]
    for found in (pulses, exposures):
        for at in np.flatnonzero(found.theory > 0.95):
            # As `right_bin_probability` says of itself, beside chance.
            interval = found.simulated["oracle"][at]
            assert interval.low - 0.01 < found.theory[at] < interval.high + 0.01
    assert pulses.simulated["likelihood"][0].value < pulses.simulated["likelihood"][1].value


def test_pulses_by_theory_reach_what_was_asked(car: Simulation) -> None:
    n_pulses = acquiring.pulses_by_theory(car, 0.95)
    assert acquiring.theory(car.with_pulses(round(n_pulses))) == pytest.approx(0.95, abs=1e-3)
    assert 300 < n_pulses < 700
    assert acquiring.pulses_by_theory(car, 0.01) == 1
    # Targets whose echo is outside the gate are found by chance alone.
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
    assert (reached.low, reached.high) == pytest.approx(
        (2000 * math.exp(-0.1), 2000 * math.exp(0.1))
    )
    assert acquiring.pulses_by_simulation(found, "likelihood", 0.001).value == 0
    assert acquiring.pulses_by_simulation(found, "likelihood", 0.9999).value == math.inf


def test_gates_hold_the_targets_and_the_same_background_in_each_bin(car: Simulation) -> None:
    onset_m = car.scene.range_m[np.isfinite(car.scene.range_m)]
    gates = acquiring.over_gates(car)
    sizes = [each.acquisition.n_bins for each in gates]
    assert sizes == sorted(sizes)
    assert sizes[-1] == pytest.approx(acquiring.LONGEST * sizes[0], abs=1)
    for each in gates:
        onset = each.acquisition.range_m_to_bin(onset_m)
        assert 0 <= onset.min() <= onset.max() < each.acquisition.n_bins
        assert each.acquisition.gate_delay_s >= 0
        per_bin = each.flux.background / each.acquisition.n_bins
        assert per_bin == pytest.approx(car.flux.background / 100)
        assert each.flux.signal == car.flux.signal


def test_the_best_exposure_tells_most(car: Simulation) -> None:
    bright = replace(car, flux=Flux(0.4, 0.06))
    factor = acquiring.exposure(bright)
    assert 0.1 < factor < 0.5
    around = acquiring.over_exposures(bright, acquiring.EXPOSURES)
    degrees = [acquiring.theory(each) for each in around]
    (best,) = acquiring.over_exposures(bright, [factor])
    assert acquiring.theory(best) > max(degrees) - 0.01


# -- the command -----------------------------------------------------------------------------------


@pytest.fixture
def small_car(monkeypatch: pytest.MonkeyPatch, car: Simulation) -> None:
    monkeypatch.setitem(scenes, "car", lambda: car.scene)
    monkeypatch.setattr(acquiring, "PULSES", (50, 500))
    monkeypatch.setattr(acquiring, "EXPOSURES", (0.5, 1.0))
    monkeypatch.setattr(acquiring, "GATES", 2)
    monkeypatch.setattr(tradeoff, "VARIED", ("tracking",))


@pytest.mark.compiled
@pytest.mark.usefixtures("small_car")
def test_the_command_answers_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["tradeoff", "--short", "--processes", "1", "--seeds", "2", "--within", "50"]
    assert main([*arguments, "--reach", "0.5", "--folder", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "| car | 0.06 | 1000 | best within 50 ms |" in out
    assert "| car | 0.06 | 1000 | cheapest with RD ≥ 0.5 |" in out
    assert "Pulses needed" in out
    assert (tmp_path / "index.html").exists()
    told = json.loads((tmp_path / "points.json").read_text(encoding="utf-8"))
    with (tmp_path / "points.csv").open(encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert [row[3] for row in rows[1:]] == [each["way"] for each in told]
    assert {each["method"] for each in told} == set(ESTIMATORS)
    for key in ("front_car_0.06_1000", "pulses_car_0.06", "exposure_car_0.06", "gate_car_0.06"):
        assert (tmp_path / f"{key}.csv").exists()
        assert (tmp_path / f"{key}.png").exists()
        assert b"<svg" in (tmp_path / f"{key}.svg").read_bytes()


@pytest.mark.compiled
@pytest.mark.usefixtures("small_car")
def test_the_command_studies_a_capture(
    stairs: Simulation,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tradeoff, "as_they_come", lambda: [method("peak"), method("tracking")])
    path = tmp_path / "stairs.npz"
    save_capture(replace(stairs.capture(1), truth_range_m=None, signal=None), path)
    arguments = ["tradeoff", "--short", "--processes", "1", "--seeds", "2", "--capture", str(path)]
    assert main([*arguments, "--with-light", "--folder", str(tmp_path / "out")]) == 0
    assert "| stairs.npz |" in capsys.readouterr().out
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "stairs.npz: the capture has no truth: errors are those of a simulated scene" in page
    assert "each image is a new one" in page
    assert "pulses_stairs.npz" in page


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scene", "car", "--bin-width", "1ns"], "--bin-width = 1e-09 is not accepted"),
        (["--capture", "x.npz", "--sbr", "0.1"], "sbr = [0.1] is not accepted"),
        (["--sbr", "-1"], "sbr = -1.0 is not accepted"),
        (["--within", "0"], "within = 0.0 is not accepted"),
        (["--reach", "1.2"], "reach = 1.2 is not accepted"),
    ],
)
def test_the_command_refuses_what_does_not_fit(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tradeoff", "--folder", str(tmp_path), *arguments]) == 2
    assert said in capsys.readouterr().err


def test_places_are_drawn_the_same_each_time(tmp_path: Path) -> None:
    place = np.array([[1.0, 2.0], [0.9, 1.8], [1.1, 2.5]])
    scatter = Scatter(
        "places", "Places", "x", "y", {"a": (place, place)}, (place[0], place[0], "ab"), "line"
    )
    band = {"up": (np.array([0.0, 1.0]), np.array([2.0, 3.0]))}
    x = np.array([1.0, 10.0])
    plot = Plot("curve", "Curve", "x", "y", x, {"up": x}, bands=band, x_is_log=True)
    write([scatter, plot], tmp_path, "once", ())
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert first["places.csv"].decode().splitlines() == [
        'group,x,"x, low","x, high",y,"y, low","y, high"',
        "a,1.0,0.9,1.1,1.0,0.9,1.1",
        "a,2.0,1.8,2.5,2.0,1.8,2.5",
    ]
    write([scatter, plot], tmp_path, "once", ())
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first
