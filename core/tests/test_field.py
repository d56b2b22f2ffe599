"""The study on published captures: its input and the plausibility of its figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from core.acquisition import Acquisition
from core.capture import Capture
from core.estimators import estimate
from core.io.readers import read_capture
from core.reductions import skip_pixels
from core.studies.methods import field

pytestmark = pytest.mark.compiled


@pytest.fixture
def folder(real_capture: Callable[[str], Path]) -> Path:
    """Folder of the published captures."""
    for name in (field.FACE_TRUTH, field.TMF8820):
        real_capture(name)
    return real_capture(field.FACE).parent


def test_the_truth_is_a_face_in_front_of_a_wall(folder: Path) -> None:
    truth = field.face_truth(folder)
    assert truth.range_m.shape == (340, 340)
    assert not (truth.is_face & truth.is_wall).any()
    assert truth.range_m[truth.is_face].max() < truth.range_m[truth.is_wall].min()


def test_the_pulse_measured_on_the_wall_rises_fast_and_decays(folder: Path) -> None:
    pulse = field.wall_pulse(folder, field.face_truth(folder))
    begin_s, end_s = pulse.span_s
    assert 0.2e-9 < end_s - begin_s < 1e-9
    samples = np.array(pulse.samples)
    assert samples.argmax() < len(samples) / 3


def test_the_distances_of_the_sensor_agree_with_the_plane(folder: Path) -> None:
    table = field.tmf8820_table(folder)
    assert [row[0] for row in table.rows] == [
        method for method in field.METHODS if method != "image_posterior"
    ]
    for method, median_mm, half_mm, estimated in table.rows:
        assert median_mm.low <= median_mm.value <= median_mm.high
        assert abs(median_mm.value) < 13.6, method  # a bin of 91 ps
        assert half_mm < 13.6, method
        assert estimated.value > 0.95, method


def test_background_is_added_at_the_given_sbr() -> None:
    cube = np.zeros((40, 40, 50), np.uint16)
    cube[..., 20] = 5
    capture = Capture(cube, Acquisition(50, n_pulses=None), detection="all")
    added = field.with_background(capture, 0.25).counts - capture.counts
    expected = 5 / 0.25
    assert abs(added.mean() - expected) < 5 * np.sqrt(expected / added.size)


def test_the_likelihood_with_the_estimated_pulse_finds_more_than_a_matched_filter(
    folder: Path,
) -> None:
    truth = field.face_truth(folder)
    capture = skip_pixels(read_capture(folder / field.FACE, first_detections=3), 2)
    range_m, is_face = truth.range_m[::2, ::2], truth.is_face[::2, ::2]
    found = {}
    for method in ("likelihood", "matched_filter"):
        error_m = (estimate(capture, method).range_m - range_m)[is_face]
        found[method] = float((np.abs(error_m - np.nanmedian(error_m)) <= 0.03).mean())
    assert found["likelihood"] >= 0.83
    assert found["likelihood"] > found["matched_filter"]
