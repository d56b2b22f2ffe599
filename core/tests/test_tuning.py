"""Tests of settings that are chosen for a capture."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from core.__main__ import main
from core.acquisition import Acquisition
from core.capture import Capture
from core.estimators import ESTIMATORS, settings_of
from core.studies.methods import tuned as study
from core.studies.trials import Condition
from core.tracking_parameters import TrackingParameters
from core.tuning import right_targets, searched, tuned, twin

pytestmark = pytest.mark.compiled


def test_a_twin_resembles_its_capture() -> None:
    capture = Condition("car", 0.06).capture(3)
    made = twin(capture, 0)
    truth, found = np.asarray(capture.truth_range_m), np.asarray(made.truth_range_m)
    both = np.isfinite(truth) & np.isfinite(found)
    assert both.sum() > 0.9 * np.isfinite(truth).sum()
    near = np.abs(truth - found)[both] < 3 * capture.acquisition.bin_length_m
    assert near.mean() > 0.97
    counts, expected = made.counts.astype(float), capture.counts.astype(float)
    # The means of 4096 binomial numbers of standard deviation 12 differ by 0.3 by chance.
    assert counts.mean() == pytest.approx(expected.mean(), abs=1.5)
    assert not np.array_equal(made.cube, twin(capture, 1).cube)


def test_settings_are_chosen_where_they_help() -> None:
    found, default = tuned(Condition("piecewise", 0.02).capture(0)), TrackingParameters()
    assert not found.is_default and found.settings == found.best
    assert "the best are chosen" in found.why
    new = Condition("piecewise", 0.02).capture(77)  # other noise
    before, after = (right_targets(new, "tracking", each) for each in (default, found.settings))
    assert after.mean() > 1.5 * before.mean()
    rd = {each.settings: each.rd for each in found.trials}
    assert rd[found.best] == max(rd.values()) > rd[default]


def test_defaults_are_kept_where_nothing_is_better() -> None:
    steps = []
    found = tuned(
        Condition("car", 0.06).capture(0), progress=lambda done, of: steps.append((done, of))
    )
    assert found.is_default and found.settings == TrackingParameters()
    best, rd = found.settings, found.default_rd
    itself = replace(found, best=best)
    assert itself.why.endswith(f"None restored more than the defaults: RD {rd:.3f}.")
    other = replace(found, best=replace(best, t_n=30), best_rd=rd + 0.002, error=0.002)
    assert other.why.endswith("They differ by 1.0 standard errors: the defaults are kept.")
    *trials, last = steps
    assert [done for done, _ in trials] == list(range(1, len(found.trials) + 1))
    assert all(done <= of for done, of in trials) and last == (len(found.trials),) * 2


@pytest.mark.parametrize(
    ("gained", "lost", "is_chosen"),
    [
        # A difference of independent targets has the standard error √(gained + lost).
        (3, 0, False),  # 3 < 2 √3
        (5, 0, True),  # 5 > 2 √5
        (14, 6, False),  # 8 < 2 √20
        (15, 5, True),  # 10 > 2 √20
    ],
)
def test_the_best_settings_are_chosen_beyond_two_standard_errors(
    gained: int, lost: int, is_chosen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    default, n_targets = TrackingParameters(), 400
    before = np.arange(n_targets) < 200
    after = before.copy()
    after[:lost], after[n_targets - gained :] = False, True

    def right(capture: Capture, method: str, settings: TrackingParameters) -> np.ndarray:
        return after if settings.l > default.l else before

    monkeypatch.setattr("core.tuning.right_targets", right)
    found = tuned(Condition("car", 0.06).capture(0))
    assert found.best.l > default.l and found.n_targets == n_targets
    assert found.settings == (found.best if is_chosen else default)
    assert found.best_rd - found.default_rd == pytest.approx((gained - lost) / n_targets)
    assert found.error == pytest.approx(math.sqrt(gained + lost) / n_targets)


def test_the_defaults_are_kept_if_none_restores_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.tuning.right_targets", lambda *_: np.arange(4) < 2)
    found = tuned(Condition("car", 0.06).capture(0))
    assert found.settings == found.best == TrackingParameters()
    assert found.why.endswith("None restored more than the defaults: RD 0.500.")


def test_a_large_capture_is_judged_by_patches() -> None:
    small = Condition("piecewise", 0.03).capture(0)
    large = replace(
        small,
        cube=np.tile(small.cube, (3, 3, 1)),
        **small.images(lambda image: np.tile(image, (3, 3))),
    )
    # Four patches of 32 × 32 pixels; all but a few pixels of this scene show a surface.
    assert 3 * 32**2 < tuned(large).n_targets <= 64**2 < large.counts.size


def test_settings_that_a_capture_does_not_allow_are_passed_over() -> None:
    capture = Condition("car", 0.3).capture(0)
    photons = replace(capture, acquisition=replace(capture.acquisition, n_pulses=None))
    weights = {each.settings.weight for each in tuned(photons).trials}
    assert "survival" not in weights and len(weights) > 1


def test_a_capture_without_a_surface_keeps_the_defaults() -> None:
    empty = Capture(np.zeros((8, 8, 50), np.uint16), Acquisition(50, 1e-9, n_pulses=100))
    found = tuned(empty)
    assert found.is_default and found.trials == ()
    assert "no surface was found" in found.why


@pytest.mark.parametrize(
    ("method", "accepted"),
    [
        ("oracle", "a method with settings to choose"),  # it knows the fluxes
        ("coates", "a method with settings to choose"),  # it has none
        ("no such method", " or ".join(map(repr, ESTIMATORS))),
    ],
)
def test_methods_without_a_choice_are_refused(method: str, accepted: str) -> None:
    message = f"method = {method!r} is not accepted: give {accepted}."
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        tuned(Condition("car", 0.06).capture(0), method)


def test_work_is_cancelled_by_its_progress() -> None:
    def stop(done: int, of: int) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        tuned(Condition("car", 0.06).capture(0), progress=stop)


def test_a_search_goes_on_until_nothing_is_better() -> None:
    start = settings_of("tracking")
    fields = [each for each in start.__dataclass_fields__.values() if each.name == "l"]
    best = searched(start, fields, lambda settings: settings.l, 5)
    assert best == replace(start, l=1.0)  # the end of its slider


def test_the_study_compares_default_and_chosen() -> None:
    condition = Condition("car", 0.03)
    gains = [study.gain((condition, seed)) for seed in range(2)]
    assert all(each.default < each.chosen <= each.best <= each.targets for each in gains)
    found = study.tuned_table(range(2), 1, [condition])
    (row,) = (dict(zip(found.columns, values, strict=True)) for values in found.rows)
    assert (row["scene"], row["SBR"], row["kept"]) == ("car", 0.03, 0.0)
    n_targets = sum(each.targets for each in gains)
    for column, name in (("default", "default"), ("chosen", "chosen"), ("best tried", "best")):
        assert row[column].value == sum(getattr(each, name) for each in gains) / n_targets
    worst = min((each.chosen - each.default) / each.targets for each in gains)
    assert row["worst change"] == worst


def test_the_command_states_the_settings_and_why(capsys: pytest.CaptureFixture[str]) -> None:
    common = ["estimate", "tracking", "--scene", "car", "--sbr", "0.03", "--tuned"]
    assert main([*common, "--json"]) == 0
    out, expected = capsys.readouterr(), tuned(Condition("car", 0.03).capture(0))
    assert json.loads(out.out)["settings"] == repr(expected.settings)
    assert expected.why in out.err
    assert main([*common, "--l", "0.01"]) == 2
    assert "--tuned cannot be combined with other settings" in capsys.readouterr().err
