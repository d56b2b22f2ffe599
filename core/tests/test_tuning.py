"""Tests of settings that choose themselves."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from core.__main__ import main
from core.acquisition import Acquisition
from core.capture import Capture
from core.estimators import settings_of
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
    assert found.trials[0].rd == max(each.rd for each in found.trials)


def test_defaults_are_kept_where_nothing_is_better() -> None:
    steps = []
    found = tuned(
        Condition("car", 0.06).capture(0), progress=lambda done, of: steps.append((done, of))
    )
    assert found.is_default and found.settings == TrackingParameters()
    assert "the defaults are kept" in found.why or "None restored more" in found.why
    *trials, last = steps
    assert [done for done, _ in trials] == list(range(1, len(found.trials) + 1))
    assert all(done <= of for done, of in trials) and last == (len(found.trials),) * 2


def test_a_large_capture_is_judged_by_patches() -> None:
    small = Condition("piecewise", 0.02).capture(0)
    large = replace(
        small,
        cube=np.tile(small.cube, (3, 3, 1)),
        **small.images(lambda image: np.tile(image, (3, 3))),
    )
    assert tuned(large).n_targets <= 64**2 < large.counts.size


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


@pytest.mark.parametrize("method", ["oracle", "no such method"])
def test_methods_without_a_choice_are_refused(method: str) -> None:
    with pytest.raises(ValueError, match="method"):
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


def test_the_study_compares_default_and_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    found = study.gain((Condition("car", 0.03), 0))
    assert found.default < found.chosen <= found.best <= found.targets
    main(["estimate", "tracking", "--scene", "car", "--sbr", "0.03", "--tuned", "--json"])
    out = capsys.readouterr()
    assert "TrackingParameters(" in json.loads(out.out)["settings"]
    assert "the best are chosen" in out.err
    assert main(["estimate", "tracking", "--tuned", "--l", "0.01"]) != 0
    assert "no settings beside it" in capsys.readouterr().err
