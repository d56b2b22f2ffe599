"""Confidence of the estimates of any method by the posterior of the image."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

import core
from core.cli import main
from core.effects import Motion
from core.inspection import pixel_report
from core.metrics import calibration_error, reliability
from core.studies.methods.calibration import confidence_and_right
from core.studies.methods.judged import METHODS, judged_table
from core.studies.trials import Condition

compiled = pytest.mark.compiled


@compiled
@pytest.mark.parametrize("method", ["unmixing", "likelihood"])
def test_the_image_knows_which_estimates_are_right(method: str) -> None:
    capture = Condition("piecewise", 0.02).capture(0)
    alone = core.estimate(capture, method)
    image = core.judged_by_image(capture, alone)
    np.testing.assert_array_equal(image.range_m, alone.range_m)
    before, right = confidence_and_right(capture, alone)
    after, _ = confidence_and_right(capture, image)
    error = {
        name: calibration_error(reliability(each, right))
        for name, each in {"before": before, "after": after}.items()
    }
    assert error["after"] < error["before"] / 2
    assert np.count_nonzero(after >= 0.9) > 2 * np.count_nonzero(before >= 0.9)
    sure = right[after >= 0.9]
    assert sure.sum() >= binom.ppf(0.001, sure.size, 0.9)


@compiled
def test_estimates_of_the_image_posterior_keep_their_confidence() -> None:
    capture = Condition("car", 0.04).capture(1)
    own = core.estimate(capture, "image_posterior")
    np.testing.assert_array_equal(core.judged_by_image(capture, own).confidence, own.confidence)


@compiled
def test_where_neighbours_do_not_agree_the_pixel_alone_decides() -> None:
    capture = Condition("uniform", 0.06).capture(0)
    alone = core.estimate(capture, "tracking", false_alarm=0.01)
    image = core.estimate(capture, "tracking", false_alarm=0.01, judged_by="image")
    np.testing.assert_array_equal(image.confidence, alone.confidence)
    assert image.made_by is not None
    assert alone.made_by is not None
    assert image.made_by.facts["judged_by"] == "image"
    assert "judged_by" not in alone.made_by.facts


@compiled
def test_a_pixel_without_an_estimate_has_no_confidence() -> None:
    capture = Condition("car", 0.06).capture(0)
    image = core.estimate(capture, "likelihood", false_alarm=0.01, judged_by="image")
    assert (~image.valid).any()
    assert (image.confidence[~image.valid] == 0).all()


@compiled
def test_moving_surfaces_are_judged_as_before() -> None:
    scene = replace(core.scenes["wall"](16), motion=Motion(20.0, pulse_rate_hz=20e3))
    capture = core.simulate(scene, scene.acquisition, core.Flux(sbr=1.0), n_groups=8)
    moving = core.estimate(capture, "velocity")
    assert core.judged_by_image(capture, moving) is moving


@compiled
def test_returns_are_added_to_a_judged_image() -> None:
    scene = core.scenes["net"](16)
    capture = core.simulate(scene, scene.acquisition, core.Flux(0.3, sbr=1.0))
    alone = core.estimate(capture, "likelihood", judged_by="image")
    image = core.estimate(capture, "likelihood", judged_by="image", returns=2)
    assert image.returns is not None
    one = image.returns.count(capture.shape) == 1
    np.testing.assert_array_equal(image.confidence[one], alone.confidence[one])
    with pytest.raises(ValueError, match=r"image\.returns = .* an image without returns"):
        core.judged_by_image(capture, image)


@compiled
def test_candidates_of_a_pixel_are_judged_like_its_estimate() -> None:
    capture = Condition("piecewise", 0.03).capture(0)
    alone = core.estimate(capture, "likelihood")
    image = core.judged_by_image(capture, alone)
    gained = np.argmax(image.confidence - alone.confidence)
    row, col = map(int, np.unravel_index(gained, capture.shape))
    before = pixel_report(capture, alone, row, col, "likelihood")
    after = pixel_report(capture, image, row, col, "likelihood")
    assert before.confidence < 0.5
    assert after.confidence == image.confidence[row, col] > 0.9
    best = max(after.candidates, key=lambda each: each.probability)
    assert (best.bin, best.probability) == (after.answer_bin, after.confidence)
    assert [each.score for each in after.candidates] == [each.score for each in before.candidates]
    assert before.evidence is None
    assert after.evidence is not None
    around = np.abs(np.arange(capture.acquisition.n_bins) + 0.5 - after.answer_bin) <= 3
    assert after.evidence.alone[around].sum() < 0.5 < after.evidence.neighbours[around].sum()


def test_what_cannot_be_judged_is_refused() -> None:
    scene = core.scenes["wall"](8)
    capture = core.simulate(scene, scene.acquisition, core.Flux(sbr=1.0))
    image = core.estimate(capture, "peak")
    smaller = replace(image, bin=image.bin[:4])
    with pytest.raises(ValueError, match=r"image = .*\(4, 8\).* not accepted: give shape \(8, 8\)"):
        core.judged_by_image(capture, smaller)
    for call in (core.estimate, core.run):
        with pytest.raises(ValueError, match=r"judged_by = .*both.* not accepted"):
            call(capture, "peak", judged_by="both")  # type: ignore[operator]


@compiled
def test_a_table_compares_both_confidences() -> None:
    found = judged_table(range(1), conditions=[Condition("piecewise", 0.03)])
    rows = [dict(zip(found.columns, row, strict=True)) for row in found.rows]
    assert [row["method"] for row in rows] == list(METHODS)
    for row in rows:
        assert row["image: error"] < row["pixel: error"]
        assert row["image: sure"] > row["pixel: sure"]
        assert row["image: sure and right"].high >= 0.9


@compiled
@pytest.mark.usefixtures("blank_figures")
def test_the_command_line_takes_the_judge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = core.scenes["piecewise"](24)
    capture = core.simulate(scene, scene.acquisition, core.Flux(0.1, sbr=0.1))
    expected = core.estimate(capture, "tracking", judged_by="image")
    core.save_capture(capture, "planes.npz")
    by_image = "--judged-by", "image"
    assert (
        main(["estimate", "tracking", "--capture", "planes.npz", *by_image, "--out", "a.npz"]) == 0
    )
    assert main(["batch", "tracking", "planes.npz", *by_image, "--out", "found"]) == 0
    assert main(["report", "tracking", "planes.npz", "report.html", *by_image]) == 0
    for path in ("a.npz", "found/planes_tracking_judged-by-image_range-image.npz"):
        with np.load(path) as archive:
            np.testing.assert_array_equal(archive["confidence"], expected.confidence)
            assert archive["judged_by"] == "image"
    with open("found/summary.csv", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["judged_by"] == "image"
    assert float(row["mean_confidence"]) == pytest.approx(expected.confidence.mean())
    assert "judged_by=&quot;image&quot;" in Path("report.html").read_text("utf-8")
