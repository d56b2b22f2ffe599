"""Tests of the views and checks that lessons name: laws of first photons, without the app."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.studies.lessons import CHECKS, VIEWS, Bench
from core.studies.outputs import Pictures, Plot

BENCH = Bench()
DARK = replace(BENCH, signal=0.0)
FAINT = replace(BENCH, background=5.205)
"""A signal-to-background ratio of 0.02."""


def curves(name: str, bench: Bench = BENCH) -> dict[str, np.ndarray]:
    """Curves of a view."""
    plot = VIEWS[name](bench)
    assert isinstance(plot, Plot)
    return {"x": plot.x, **plot.curves}


def check(name: str, bench: Bench = BENCH, **arguments: float) -> float:
    return CHECKS[name](bench, **arguments)


def test_constant_light_gives_a_falling_histogram() -> None:
    assert np.ptp(curves("light", DARK)["photons that arrive"]) == pytest.approx(0.0)
    expected = curves("first_photons", DARK)["expected"]
    np.testing.assert_allclose(np.diff(np.log(expected)), -DARK.background / 100, atol=1e-6)
    assert check("share_armed", DARK, bin=50) == pytest.approx(np.exp(-DARK.background / 2))
    assert check("share_fired", DARK, bin=50) == pytest.approx(1 - np.exp(-DARK.background / 2))
    np.testing.assert_allclose(curves("still_armed", DARK)["still armed"][[0, 50]], [1, 0.42], 1e-3)


def test_the_correction_makes_the_rate_flat_and_its_noise_grow() -> None:
    for switch, late in (("on", 1.0), ("off", np.exp(-1.735 * 0.6))):
        bench = replace(DARK, correction=switch, n_pulses=50_000)
        rate = curves("corrected", bench)["histogram"]
        # 5,200 and 14,600 counts: four standard deviations of their ratio are 6.5 %.
        assert rate[60:80].mean() / rate[:20].mean() == pytest.approx(late, rel=0.065)
    noise = curves("noise_along_gate", DARK)
    assert noise["correction on"][-1] > noise["correction on"][0]
    assert noise["correction off"][-1] < noise["correction off"][0]
    # The noise of n counts is their root; the correction multiplies it by pulses over armed ones.
    assert check("armed_ratio", DARK, bin=90, over=10) == pytest.approx(np.exp(-1.735 * 0.8))
    root = np.exp(1.735 * 0.8 / 2)
    # Standard deviations over 4,096 pixels are known to 1.1 %, ratios to 1.6 %: four of these.
    for name, ratio in (("noise_ratio", root), ("noise_ratio_of_counts", 1 / root)):
        assert check(name, DARK, bin=90, over=10) == pytest.approx(ratio, rel=0.065)


def test_ten_times_the_light_loses_the_echo() -> None:
    found = curves("accuracy_by_exposure")
    for name in ("tracking", "likelihood", "limit"):
        at = [np.interp(each, found["x"], found[name]) for each in (1.0, 10.0)]
        assert at[0] > 0.95 and at[1] < 0.3
    bright = replace(BENCH, signal=1.0, background=1.0 / 0.06)
    best = check("best_attenuation", bright)
    assert best == pytest.approx(0.115, abs=0.002)
    assert check("sbr", bright) == pytest.approx(0.06)
    pictures = VIEWS["car_image"](BENCH)
    assert isinstance(pictures, Pictures) and len(pictures.images) == 2


def test_an_alpha_of_the_cubic_weight_moves_no_pixel() -> None:
    moved = curves("pixels_moved")
    assert moved["cubic weight"].max() == 0 < moved["exponential weight"].max()
    assert check("share_moved_by_cubic", alpha=0.1, to=30.0) == 0
    assert 0.5 < check("share_moved", alpha=0.1, to=3.0) < 1
    found = curves("found_by_t_n")
    assert found["found"][0] > 0.97 and found["found"][-1] < 0.05
    weight, k = curves("weight_along_gate"), np.arange(100)
    cubic, grown = (k / 99) ** 3, np.exp(BENCH.alpha * ((k / 100) ** 3 - 0.99**3))
    np.testing.assert_allclose(weight["cubic weight"], np.where(k >= 20, cubic, 0), 1e-6)
    np.testing.assert_allclose(weight["exponential weight"], np.where(k >= 20, grown, 0), 1e-6)


def test_both_scales_are_drawn_with_and_without_an_echo() -> None:
    echo, none = curves("both_scales"), curves("both_scales_without_echo")
    assert echo.keys() == none.keys()
    # The residual peaks in the echo, higher than anywhere in noise.
    assert 50 <= echo["residual"].argmax() < 56
    assert echo["residual"].max() > none["residual"].max()
    shares = curves("estimates_without_echo")
    assert shares["estimates, no echo"].sum() == pytest.approx(1)
    assert check("share_without_echo", first=0, end=100) == pytest.approx(1)
    assert check("share_without_echo", first=0, end=BENCH.tracking.t_n) < 0.01


def test_ten_times_fewer_misses_take_less_than_ten_times_the_pulses() -> None:
    found = curves("accuracy_by_pulses")
    for name in ("theory, flux known", "likelihood"):
        assert found[name][0] < 0.5 and found[name][-1] > 0.99
    # If misses fell exponentially with the pulses, it would be 2; if as 1 / pulses², √10.
    assert 2 < check("pulses_ratio", share=0.99, over=0.9) < np.sqrt(10)


def test_the_peak_is_lost_late_in_the_gate() -> None:
    found = curves("found_along_gate")
    late = {name: np.interp(80, found["x"], curve) for name, curve in found.items()}
    assert late["peak"] < 0.02 and min(late["coates"], late["likelihood"]) > 0.95
    half = check("place_of_half")
    assert np.interp(half, found["x"], found["peak"]) == pytest.approx(0.5, abs=0.05)


def test_confidence_is_the_share_of_right_estimates() -> None:
    bench = replace(BENCH, background=2.6025, least_confidence=0.9)
    plot = VIEWS["reliability_diagram"](bench)
    assert isinstance(plot, Plot)
    (low, high), off = plot.bands["right"], plot.curves["right"] - plot.curves["calibrated"]
    assert (np.abs(off) < high - low).all()  # the band is two standard deviations to either side
    kept = curves("kept_by_confidence", bench)
    assert (np.diff(kept["kept"]) <= 0).all()
    assert check("share_right", bench, least=0.9) > check("share_right", bench, least=0.0)
    assert np.interp(0.9, kept["x"], kept["kept"]) == check("share_kept", bench, least=0.9)


def test_two_methods_agree_on_noise_too() -> None:
    wrong, agreed = check("share_wrong_of_agreed"), check("share_agreed")
    assert 0.02 < wrong < 0.3 < agreed < 1
    likely = {
        pixel: curves("surface_probability", replace(BENCH, pixel=pixel))["surface within 3 bins"]
        for pixel in ("A", "B")
    }
    assert likely["A"].max() < 0.5  # the sky
    assert likely["B"].max() > 0.99  # the wall
    outdoors, pictures = VIEWS["outdoor_pixel"](BENCH), VIEWS["agreement"](BENCH)
    assert isinstance(outdoors, Plot) and isinstance(pictures, Pictures)
    one, other = outdoors.marks.values()
    assert abs(one - other) <= 3  # on noise: pixel A is sky
    *_, both, wrongly = pictures.images.values()
    assert np.isfinite(both).mean() == agreed
    assert np.isfinite(wrongly).sum() / np.isfinite(both).sum() == wrong


def test_neighbours_help_least_at_edges() -> None:
    inside, edges, alone = (
        check(name, FAINT) for name in ("share_inside", "share_at_edges", "share_at_edges_alone")
    )
    assert alone < edges - 0.2
    assert edges < inside - 0.1
    found = curves("found_by_distance", FAINT)
    assert (found["with neighbours"][0], found["each pixel alone"][0]) == (edges, alone)
    pictures = VIEWS["neighbours_image"](replace(FAINT, neighbours="on"))
    assert isinstance(pictures, Pictures)
    *_, missed = pictures.images.values()
    assert 1 - inside < np.isfinite(missed).mean() < 1 - edges


def test_the_signal_falls_with_the_square_of_the_range() -> None:
    assert check("signal_at", range_m=100.0) == pytest.approx(BENCH.signal / 4)
    away = curves("fluxes_by_range")
    assert np.interp(100.0, away["x"], away["signal"]) == pytest.approx(BENCH.signal / 4, rel=0.01)
    assert np.ptp(away["background"]) == 0
