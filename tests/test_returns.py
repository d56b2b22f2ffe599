"""The choice of returns: cloud, files and reports of the pages follow it."""

from __future__ import annotations

import csv
import io

import laspy
import numpy as np
import pytest

from app.model.colors import cloud_of
from app.model.exports import cloud_files
from app.model.script import script_of
from app.model.state import ALL_RETURNS, Illumination, State, Viewing
from app.model.store import Answer, Request, compute, scene_source
from app.pages.explore.text import cloud_caption
from core.inspection import pixel_report

VIEWING = Viewing(least_confidence=0.5)


def answer_of(returns: str) -> Answer:
    source = scene_source("Net", "net", size=12, separation_bins=15.0, share=0.5)
    light = Illumination(sbr=1.0, ppp=0.3)
    return compute(Request(source, light, method="likelihood", returns=returns), None)


@pytest.mark.compiled
def test_all_returns_are_in_the_cloud_the_files_and_the_reports() -> None:
    answer = answer_of(ALL_RETURNS)
    found = answer.run.image.returns
    assert found is not None
    drawn = cloud_of(answer, "Range", VIEWING)
    assert drawn.points.n_points == len(drawn.rgb) == len(found)
    assert drawn.unseen.n_outside < 0.1 * len(found)  # the scale holds both surfaces
    assert drawn.points.n_points > 1.9 * answer.capture.counts.size
    np.testing.assert_allclose(np.linalg.norm(drawn.points.points, axis=1), found.range_m)
    assert f"{len(found)} of {len(found)} returns shown" in cloud_caption(answer, len(found), None)
    files = cloud_files(answer, "Range", VIEWING)
    written = {suffix: io.BytesIO() for suffix in ("las", "csv")}
    for suffix, file in written.items():
        files[suffix](file)
        file.seek(0)
    las = laspy.read(written["las"])
    np.testing.assert_array_equal(las.return_number, found.number)
    np.testing.assert_array_equal(las.red // 257, drawn.rgb[:, 0])
    (first, *_) = csv.DictReader(io.TextIOWrapper(written["csv"]))
    assert first["number_of_returns"] == "2"
    report = pixel_report(answer.capture, answer.run.image, 5, 5, "likelihood")
    assert report.surfaces_text.startswith("2 surfaces")
    assert "returns=2" in script_of(answer, State(returns=ALL_RETURNS))


@pytest.mark.compiled
def test_the_most_probable_return_is_the_estimate() -> None:
    one = answer_of("most probable")
    assert one.run.image.returns is None
    assert cloud_of(one, "Range", VIEWING).points.n_points <= one.capture.counts.size
    both = compute(
        Request(one.request.source, one.request.light, method="likelihood", returns=ALL_RETURNS),
        one,
    )
    assert both.run.capture is one.run.capture  # only the estimate is made again
    assert both.run.image.returns is not None
