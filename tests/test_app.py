"""The app without a browser: state, estimates, colours, texts, plots, controls and the page."""

from __future__ import annotations

import re
from dataclasses import asdict, fields, replace
from threading import Event

import numpy as np
import panel_material_ui as pmui
import pytest
from bokeh.document import Document
from bokeh.document.models import DocumentModelManager

import core
from app.model import colors as looks
from app.model import text as model_text
from app.model.address import Link, query_of
from app.model.capture_defaults import enter
from app.model.glossary import linked
from app.model.range_prior import range_prior_of
from app.model.script import script_of
from app.model.state import ALL_RETURNS, Illumination, ReductionSettings, State, Viewing
from app.model.store import (
    Source,
    built_in_sources,
    compute,
    file_source,
    inspect,
    is_wrong,
)
from app.pages.catalog import PAGES
from app.pages.explore import text as explore_text
from app.pages.layout import CUSTOM, HELP, MORE_TRACKING, Layout
from app.pages.session import Session
from app.pages.shared import measure
from app.pages.shared.estimate import lane_of
from app.pages.shared.illumination import MORE, IlluminationPanel
from app.plots import elements as plots
from app.plots.gate_cut import Cut
from app.tasks.scheduler import GENERAL, PAGE, SHORT
from app.widgets.cards import Part
from app.widgets.controls import Knob, SettingsPanel
from app.widgets.figures import Plot
from app.widgets.image_view import ImageView
from app.widgets.signal_plots import SignalPlots
from core import PRESETS, Acquisition, Capture, TrackingParameters, save_capture, tracking_signals
from core.geometry import Box
from core.inference import fit_of, has_fit
from core.io import OUTSIDE_COLOR, ColorScale, ReadOptions, reading_options
from core.parameters import Number, spec_of
from core.reductions import Reduction
from core.tests.read_options import EXAMPLES
from tests.states import ask, link_to
from tests.threads import HeldLayout, HeldTasks, control

NEED_TRUTH = {"RMSE", "Within 1 bin", "Within 3 bins", "Truth", "Error"}


@pytest.fixture
def small_capture(rng):
    """Other sizes than the built-in scenes, and only the counts are known."""
    cube = rng.poisson(5, (4, 6, 37)).astype(np.uint16)
    cube[:, :, 20] += 60
    return Capture(cube, Acquisition(37, 2e-9, 1e-6, None, 1e-3), source="made here")


@pytest.fixture
def small_file(small_capture, tmp_path):
    path = tmp_path / "small.npz"
    save_capture(small_capture, path)
    return path


@pytest.fixture
def rng():
    return np.random.default_rng(7)


# -- state ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "changes"),
    [
        (Illumination(), {"sbr": 0.0}),
        (Illumination(), {"ppp": -1.0}),
        (Illumination(), {"n_pulses": 0}),
        (Illumination(), {"n_pulses": 1.5}),
        (Illumination(), {"seed": -1}),
        (Viewing(), {"least_confidence": -0.1}),
        (Viewing(), {"least_confidence": 1.01}),
        (Viewing(), {"field_of_view_deg": 0.0}),
        (Viewing(color_from_m=50.0), {"color_to_m": 50.0}),
        (Viewing(), {"color_map": "jet"}),
    ],
)
def test_impossible_settings_are_refused_by_name(settings, changes):
    (name,) = changes
    with pytest.raises(ValueError, match=name):
        replace(settings, **changes)


# -- estimates ------------------------------------------------------------------------------------


def test_only_what_changed_is_computed_again(car):
    other_settings = compute(ask("car", tracking=PRESETS["literal"]), car)
    assert other_settings.capture is not car.capture  # another catalogue's scene is another source
    request = replace(car.request, tracking=PRESETS["literal"])
    other_settings = compute(request, car)
    assert other_settings.capture is car.capture
    assert other_settings.capture_s == car.capture_s
    assert not np.array_equal(other_settings.run.image.bin, car.run.image.bin)
    for change in ({"light": Illumination(seed=1)}, {"source": built_in_sources()["staircase"]}):
        assert compute(replace(car.request, **change), car).capture is not car.capture


def test_the_page_computes_what_is_faster_than_drawing(car):
    other = {"tracking": PRESETS["literal"]}
    assert lane_of(replace(car.request, **other), car) is PAGE
    for again in ({"light": Illumination(seed=1)}, {"reduction": ReductionSettings(skip=2)}):
        assert lane_of(replace(car.request, **again, **other), car) is SHORT
    for new in ({"source": built_in_sources()["staircase"]}, {"absent": frozenset(["jitter"])}):
        assert lane_of(replace(car.request, **new, **other), car) is GENERAL
    large = compute(ask("car_256"), None)
    for change in (other, {"light": Illumination(seed=1)}):
        assert lane_of(replace(large.request, **change), large) is GENERAL
    file = compute(ask("sample"), None)
    assert lane_of(replace(file.request, **other), file) is PAGE
    assert lane_of(replace(file.request, reduction=ReductionSettings(skip=2)), file) is GENERAL


def test_a_reduction_is_applied_to_the_whole_capture(car):
    reduction = ReductionSettings(merge=2, gate_from=0.2, gate_to=0.9, pool=2, pulses=0.5)
    reduced = compute(replace(car.request, reduction=reduction), car)
    assert reduced.whole is car.whole is car.capture
    assert reduced.capture.cube.shape == (32, 32, 35)
    assert compute(car.request, reduced).whole is car.whole
    np.testing.assert_array_equal(
        reduced.capture.cube,
        Reduction(merge=2, gate=(20, 90), pool=2, pulses=0.5).of(car.capture).cube,
    )


@pytest.mark.parametrize(
    "reduction",
    [Reduction(), Reduction(4, (7, 33), skip=2), Reduction(gate=(0, 99), pool=3, pulses=0.1)],
)
def test_settings_and_reduction_describe_each_other(reduction):
    for n_bins in (100, 334, 876):
        assert ReductionSettings.of(reduction, n_bins).in_bins(n_bins) == reduction


def test_a_gate_is_never_empty():
    assert ReductionSettings(gate_from=1.0, gate_to=0.0).in_bins(10) == Reduction(gate=(9, 10))


def test_an_estimate_is_what_core_computes(car):
    scene, light = core.scenes["car"](), Illumination()
    capture = core.simulate(scene, light.acquisition(scene.acquisition), light.flux, seed=0)
    run = core.run(capture, "tracking", TrackingParameters())
    np.testing.assert_array_equal(car.run.image.range_m, run.image.range_m)
    assert car.run.figures == run.figures


@pytest.mark.parametrize("preset", PRESETS)
def test_a_pixel_shows_the_stages_of_its_own_estimate(car, preset):
    answer = compute(replace(car.request, tracking=PRESETS[preset]), car)
    pixel = inspect(answer, 32, 30)
    histogram = answer.capture.cube[32, 30]
    expected = tracking_signals(histogram, PRESETS[preset], 1000)
    for stage, values in expected._asdict().items():
        np.testing.assert_array_equal(getattr(pixel.signals, stage), values)
    np.testing.assert_array_equal(pixel.histogram, histogram)
    np.testing.assert_array_equal(pixel.difference, core.first_difference(histogram))
    acquisition = answer.capture.acquisition
    assert pixel.range_m == answer.run.image.range_m[32, 30]
    assert pixel.truth_m == answer.capture.truth_range_m[32, 30]
    assert acquisition.bin_to_range_m(pixel.answer_bin) == pytest.approx(pixel.range_m)
    assert acquisition.bin_to_range_m(pixel.truth_bin) == pytest.approx(pixel.truth_m)
    assert pixel.confidence == answer.run.image.confidence[32, 30]
    assert pixel.counts == histogram.sum()


def test_expected_counts_are_the_mean_of_many_pulses(car):
    many = compute(ask("car", light=Illumination(n_pulses=100_000)), None)
    pixel = inspect(many, 32, 30)
    np.testing.assert_allclose(pixel.signals.raw, pixel.expected, atol=5 * np.sqrt(4000))
    assert pixel.expected.sum() == pytest.approx(pixel.counts, rel=0.01)


def test_an_estimate_is_wrong_far_off_or_without_a_target(car):
    wrong = is_wrong(car)
    truth_m, image = car.capture.truth_range_m, car.run.image
    np.testing.assert_array_equal(wrong[np.isnan(truth_m)], image.valid[np.isnan(truth_m)])
    target = np.isfinite(truth_m)
    assert 1 - wrong[target].mean() == pytest.approx(car.run.figures["rd_3_bins"], abs=1e-9)
    assert is_wrong(car, 0.1).sum() > wrong.sum()


# -- colours ---------------------------------------------------------------------------------------


def test_truth_and_estimate_share_one_scale(car):
    truth, of_truth = looks.image_of(car, "Truth", Viewing(0.9))
    estimate, of_estimate = looks.image_of(car, "Estimate", Viewing(0.9))
    assert (of_truth.low, of_truth.high) == (of_estimate.low, of_estimate.high)
    assert of_truth.colors == of_estimate.colors
    assert of_truth.low < np.nanmin(truth) < np.nanmax(truth) < of_truth.high
    np.testing.assert_array_equal(truth, car.capture.truth_range_m)
    known = np.isfinite(estimate)
    np.testing.assert_array_equal(estimate[known], car.run.image.range_m[known])


def test_what_an_image_hides_is_said(car):
    image, n_pixels = car.run.image, car.run.image.valid.sum()
    for least in (0.0, 0.9):
        values, look = looks.image_of(car, "Estimate", Viewing(least))
        said = looks.legend(car, "Estimate", Viewing(least), values, look)
        n_hidden = (image.valid & (image.confidence < least)).sum()
        assert (f"{n_hidden:,} of {n_pixels:,} estimates hidden" in said) == (n_hidden > 0)
        n_outside = ((values < look.low) | (values > look.high)).sum()
        assert (f"Grey: {n_outside:,} beyond" in said) == (n_outside > 0)
    nothing = np.full_like(values, np.nan)
    assert "Lower" in looks.legend(car, "Estimate", Viewing(1.0), nothing, look)
    values, look = looks.image_of(car, "Counts", Viewing(0.9))
    assert looks.legend(car, "Counts", Viewing(), values, look) == ""


def test_a_cloud_states_what_its_box_hides_and_shows_grey(car):
    image, box = car.run.image, Box(to_m=50.0)
    viewing = Viewing(0.9, color_from_m=49.0)
    found = looks.cloud_of(car, "Range", viewing, box)
    inside, sure = image.valid & (image.range_m <= 50.0), image.confidence >= 0.9
    n_hidden, n_grey = (inside & ~sure).sum(), (inside & sure & (image.range_m < 49.0)).sum()
    assert found.points.n_points == len(found.rgb) == len(found.wrong) == (inside & sure).sum()
    assert 0 < n_hidden < (image.valid & ~sure).sum() and n_grey > 0
    assert looks.cloud_legend(found.unseen, 0.9) == (
        f"Hidden: {n_hidden:,} below confidence 0.9. Grey: {n_grey:,} beyond the colour scale."
    )
    assert looks.cloud_legend(looks.Unseen(0, 0), 0.9) == ""


def test_a_misfit_is_stated_once_it_is_known():
    worn, kind = compute(ask("worn"), None), "Estimate"
    drawn = looks.image_of(worn, kind, Viewing())
    assert "unreliable" not in looks.legend(worn, kind, Viewing(), *drawn)
    misfit = fit_of(worn.capture).remark
    assert "unreliable" in misfit
    assert f"{misfit.capitalize()}." in looks.legend(worn, kind, Viewing(), *drawn)


def test_image_and_cloud_take_the_chosen_limits_and_colours(car):
    viewing = Viewing(color_from_m=48.5, color_to_m=50.0, color_map="inferno")
    values, look = looks.image_of(car, "Estimate", viewing)
    assert (look.low, look.high) == (48.5, 50.0)
    outside = (values < 48.5) | (values > 50.0)
    said = looks.legend(car, "Estimate", viewing, values, look)
    assert f"Grey: {outside.sum():,} beyond the colour scale." in said
    rgb = looks.cloud_of(car, "Range", viewing).rgb
    known = np.isfinite(values)
    np.testing.assert_array_equal(rgb, look.rgb(values[known]))
    grey = tuple(bytes.fromhex(OUTSIDE_COLOR[1:]))
    np.testing.assert_array_equal((rgb == grey).all(axis=1), outside[known])
    assert looks.image_of(car, "Truth", viewing)[1].colors == look.colors
    for one_end in ({"color_from_m": 1e4}, {"color_to_m": 1.0}):  # far from all estimates
        _, look = looks.image_of(car, "Estimate", Viewing(**one_end))
        assert look.low < look.high
        assert next(iter(one_end.values())) in (look.low, look.high)


def test_limits_of_colours_are_kept_with_the_scene_and_dropped_with_another(car, sample):
    chosen = Viewing(color_from_m=48.0, color_map="plasma")
    for answer, kept in ((car, 48.0), (sample, None)):
        state = State(viewing=chosen)
        enter(state, answer, car)
        assert (state.viewing.color_from_m, state.viewing.color_map) == (kept, "plasma")


@pytest.mark.parametrize("kind", ["Estimate", "Error"])
def test_estimates_below_the_confidence_are_blank(car, kind):
    confidence = car.run.image.confidence
    for least in (0.0, 0.5, 0.99):
        image, _ = looks.image_of(car, kind, Viewing(least))
        blank = confidence < least
        if kind == "Error":
            blank |= np.isnan(car.capture.truth_range_m)
        np.testing.assert_array_equal(np.isnan(image), blank | ~car.run.image.valid)


def test_error_is_estimate_minus_truth_around_zero(car):
    error, look = looks.image_of(car, "Error", Viewing(0.0))
    expected = car.run.image.range_m - car.capture.truth_range_m
    np.testing.assert_array_equal(error, expected)
    assert look.low == -look.high < 0
    assert look.unit == "m"


def test_counts_are_those_of_the_capture(car):
    counts, look = looks.image_of(car, "Counts", Viewing(1.0))
    np.testing.assert_array_equal(counts, car.capture.counts)
    assert (look.low, look.high, look.unit) == (counts.min(), counts.max(), "counts")


def test_without_truth_the_scale_fits_confident_estimates(sample):
    image, look = looks.image_of(sample, "Truth", Viewing(0.9))
    assert look.title == "Estimated range"
    inside = (image > look.low) & (image < look.high)
    assert inside.sum() >= 0.95 * np.isfinite(image).sum()


def test_a_colour_for_every_value():
    look = ColorScale("", "", 0.0, 1.0, ["#000000", "#808080", "#ffffff"], OUTSIDE_COLOR)
    grey = [int(OUTSIDE_COLOR[at : at + 2], 16) for at in (1, 3, 5)]
    rgb = look.rgb(np.array([-0.01, 0.0, 0.5, 1.0, 1.01]))
    np.testing.assert_array_equal(rgb, [grey, [0] * 3, [128] * 3, [255] * 3, grey])
    assert rgb.dtype == np.uint8
    without = replace(look, outside=None).rgb(np.array([-9.0, 9.0]))
    np.testing.assert_array_equal(without, [[0] * 3, [255] * 3])


# -- texts ----------------------------------------------------------------------------------------


def names(facts):
    return {name for name, _, _ in facts}


def test_figures_and_numbers_are_cores(car):
    figures = {name: value for name, value, _ in explore_text.figure_strip(car)}
    assert figures["RMSE"] == f"{car.run.figures['rmse_m']:.4g} m"
    assert figures["Within 3 bins"] == f"{100 * car.run.figures['rd_3_bins']:.1f} %"
    pixel = explore_text.pixel_numbers(car, inspect(car, 32, 30))
    numbers = {name: value for name, value, _ in pixel}
    image, sigma, settings = car.run.image, car.capture.cube[32, 30].std(), TrackingParameters()
    assert numbers["Pixel"] == "row 32, col 30"
    report = core.inspection.pixel_report(car.capture, image, 32, 30)
    low, high = report.interval_95_m.low, report.interval_95_m.high
    assert 0.1 <= (high - low) / 2 < 1, "two digits are two decimals"
    assert numbers["Range (95 %)"] == f"{(low + high) / 2:.2f} ± {(high - low) / 2:.2f} m"
    assert (numbers["Range (95 %)"].low, numbers["Range (95 %)"].high) == (low, high)
    assert numbers["Estimate"] == f"{image.range_m[32, 30]:.2f} m"
    assert numbers["Truth"] == f"{car.capture.truth_range_m[32, 30]:.2f} m"
    assert numbers["σ"] == f"{sigma:.4g} counts"
    assert numbers["r small"] == f"{settings.l * sigma:.4g}"
    assert numbers["r large"] == f"{settings.n * settings.l * sigma:.4g}"
    assert numbers["Pulses that fired"] == f"{car.capture.counts[32, 30] / 10:.1f} %"
    empty = np.argwhere(np.isnan(car.capture.truth_range_m))[0]
    numbers = {
        name: value for name, value, _ in explore_text.pixel_numbers(car, inspect(car, *empty))
    }
    assert (numbers["Truth"], numbers["Error"]) == ("no target", "–")


def test_what_needs_a_truth_is_left_out_without_one(car, sample):
    def names_of(answer):
        pixel = inspect(answer, 32, 32)
        numbers = explore_text.pixel_numbers(answer, pixel)
        return names(explore_text.figure_strip(answer)) | names(numbers)

    assert names_of(car) >= NEED_TRUTH
    assert names_of(car) - names_of(sample) == NEED_TRUTH | {"Simulated in"}
    assert "wrong" in explore_text.cloud_caption(car, 10, 3)
    assert "wrong" not in explore_text.cloud_caption(sample, 10, None)


def test_texts_have_no_markup(car, sample):
    for answer in (car, sample):
        pixel = inspect(answer, 32, 32)
        facts = explore_text.figure_strip(answer) + explore_text.pixel_numbers(answer, pixel)
        texts = [text for fact in facts for text in fact]
        texts += [model_text.provenance(answer), explore_text.cloud_caption(answer, 1, 1)]
        assert all(texts)
        assert not [text for text in texts if "<" in text or "&" in text]


def test_provenance_states_size_and_gate(car):
    sentence = model_text.provenance(car)
    for part in ("64 × 64 pixels", "100 bins of 1 ns", "280 to 380 ns", "41.9709 to 56.9606 m"):
        assert part in sentence


# -- plots -----------------------------------------------------------------------------------------


def test_every_plot_has_a_title_a_legend_and_labels_with_units():
    signals, image = SignalPlots(), ImageView(lambda row, col: None)
    figures = [plot.figure for plot in signals.plots]
    assert [figure.yaxis.axis_label for figure in figures] == [
        "Counts",
        "Counts",
        "Counts × weight",
        "Score",
    ]
    for figure in figures:
        assert figure.title.text
        assert "Bin" in [axis.axis_label for axis in figure.xaxis]
        assert figure.legend.items
    assert "Range (m)" in [axis.axis_label for axis in figures[0].xaxis]
    assert (image.figure.xaxis.axis_label, image.figure.yaxis.axis_label) == ("Column", "Row")
    assert image.figure.y_range.flipped


# -- widgets --------------------------------------------------------------------------------------


def test_only_changed_columns_travel_and_as_float32():
    ones = np.ones(8)
    plot = Plot(plots.residual, plots.RESIDUAL_LAYERS)
    plot.write("residual", residual=ones, bin=plots.centres(8))
    page, sent = Document(), []
    page.add_root(plot.figure)
    page.on_change(sent.append)
    plot.write("residual", residual=ones, bin=plots.centres(8))
    assert sent == []
    plot.write("residual", residual=2 * ones, bin=plots.centres(8))
    (event,) = sent
    assert event.cols == ["residual"]
    assert columns(plot, "residual")["residual"].dtype == np.float32


def columns(plot, layer):
    return plot.source(layer).data


def test_a_pixels_stages_stand_in_its_plots(car):
    views, pixel = SignalPlots(), inspect(car, 32, 30)
    views.update(pixel, car.gate, with_difference=True)
    signals = pixel.signals
    drawn = {
        "raw": (columns(views.histogram, "raw")["top"], signals.raw),
        "expected": (columns(views.histogram, "expected")["counts"], pixel.expected),
        "small": (columns(views.histogram, "small")["counts"], signals.small),
        "large": (columns(views.histogram, "large")["counts"], signals.large),
        "residual": (columns(views.residual, "residual")["residual"], signals.residual),
        "difference": (columns(views.residual, "raw")["residual"], pixel.difference),
        "enhanced": (columns(views.enhanced, "enhanced")["enhanced"], signals.enhanced),
    }
    for name, (found, expected) in drawn.items():
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6, err_msg=name)
    for plot in (views.histogram, views.residual, views.enhanced):
        np.testing.assert_allclose(columns(plot, "truth")["bin"], pixel.truth_bin, rtol=1e-6)
        np.testing.assert_allclose(columns(plot, "estimate")["bin"], pixel.answer_bin, rtol=1e-6)
        shown = [curve.max() for curve in (signals.raw, signals.large)]
        assert plot is not views.histogram or plot.figure.y_range.end >= max(shown)


def test_axes_follow_another_gate(car, small_file):
    views = SignalPlots()
    views.update(inspect(car, 32, 30), car.gate, with_difference=False)
    answer = compute(ask(file_source(small_file)), None)
    views.cut.update(Cut.of(answer, ReductionSettings()))
    views.update(inspect(answer, 1, 2), answer.gate, with_difference=False)
    for plot in views.plots:
        assert (plot.figure.x_range.start, plot.figure.x_range.end) == (0, 37)
        for layer in plot.layers:
            lengths = {len(column) for column in columns(plot, layer).values()}
            assert lengths == ({2} if layer in ("truth", "estimate") else {37}), layer
    start_m, step_m = 149.896229, 0.299792458
    metres = views.histogram.figure.above[0].formatter.args
    assert (metres["origin"], metres["step"]) == pytest.approx((start_m, step_m))


def test_a_pixel_without_photons_has_axes(car):
    cube = car.capture.cube.copy()
    cube[3, 4] = 0
    unlit = replace(car.capture, cube=cube, signal=None, background=None)
    source = Source("unlit", lambda _: unlit)
    dark = compute(ask(source, method="tracking"), None)
    views = SignalPlots()
    views.update(inspect(dark, 3, 4), dark.gate, with_difference=True)
    for plot in (views.histogram, views.residual, views.enhanced):
        ends = plot.figure.y_range
        assert (ends.start, ends.end) == (0, 1), plot.figure.title.text


def legend(plot):
    return {item.label.value: item.visible for item in plot.figure.legend.items}


def test_lines_without_a_position_are_not_drawn(car, sample):
    views = SignalPlots()
    for answer, has_truth in ((car, True), (sample, False), (car, True)):
        pixel = inspect(answer, 32, 30)
        views.update(pixel, answer.gate, with_difference=False)
        for plot in (views.histogram, views.residual, views.enhanced):
            assert plot.layers["truth"]["glyph_renderer"].visible == has_truth
            assert legend(plot)["truth"] == has_truth
            assert legend(plot)["estimate"]
        assert legend(views.histogram)["expected"] == has_truth
        assert not legend(views.residual)["first difference of the raw histogram"]


def test_an_image_is_shown_with_its_scale_and_its_frame(car):
    view = ImageView(lambda row, col: None)
    view.enter(64, 64, car.grid)
    image, look = looks.image_of(car, "Estimate", Viewing(0.9))
    view.update(image, look)
    view.mark(3, 5)
    (picture,) = (r for r in view.figure.renderers if "image" in r.data_source.data)
    drawn = picture.data_source.data["image"][0]
    np.testing.assert_array_equal(drawn, image.astype(np.float32))
    assert drawn.dtype == np.float32
    mapper = picture.glyph.color_mapper
    assert (mapper.low, mapper.high, mapper.low_color) == (look.low, look.high, OUTSIDE_COLOR)
    assert view.figure.title.text == look.title
    frames = [r.data_source.data for r in view.figure.renderers if r is not picture]
    for data in frames:
        middle = (data["left"][0] + data["right"][0]) / 2, (data["top"][0] + data["bottom"][0]) / 2
        assert middle == (5, 3)


def test_another_kind_of_image_does_not_search_the_page_for_models(car, monkeypatch):
    view = ImageView(lambda row, col: None)
    view.enter(64, 64, car.grid)
    view.update(*looks.image_of(car, "Estimate", Viewing()))
    document = Document()
    document.add_root(view.figure)
    searched = []
    monkeypatch.setattr(DocumentModelManager, "recompute", searched.append)
    view.update(*looks.image_of(car, "Counts", Viewing()))
    assert view.figure.title.text.startswith("Detections")
    assert searched == []


@pytest.mark.parametrize(
    ("rows", "cols", "proportions"), [(64, 32, 0.5), (159, 9, 0.25), (1, 16, 4)]
)
def test_the_frame_of_a_narrow_image_is_wide_enough_to_be_read(car, rows, cols, proportions):
    view = ImageView(lambda row, col: None)
    view.enter(rows, cols, car.grid)
    assert view.figure.match_aspect == (cols / rows == proportions)  # else axes exceed the image
    (style,) = view.figure.stylesheets
    assert f"* {proportions:g} +" in style
    assert f"/ {proportions:g} +" in style


@pytest.mark.parametrize(
    ("rows", "cols", "height", "width"), [(1, 8, 1, 1), (2, 600, 1, 16.8), (64, 64, 3, 3)]
)
def test_the_frame_of_a_pixel_is_visible_and_close_around_large_pixels(
    car, rows, cols, height, width
):
    view = ImageView(lambda row, col: None)
    view.enter(rows, cols, car.grid)
    left, bottom, right, top = view.frame(0, 5)
    assert (top - bottom, right - left) == pytest.approx((height, width))


# -- controls --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings", [TrackingParameters(), Illumination(), ReductionSettings(), Viewing()]
)
def test_every_field_has_a_control_made_from_its_metadata(settings):
    controls = SettingsPanel(settings, lambda new: None).controls
    assert list(controls) == [each.name for each in fields(settings)]
    for each in fields(settings):
        control, spec = controls[each.name], spec_of(each)
        assert control.value == getattr(settings, each.name)
        assert control.label == spec.symbol
        if isinstance(spec, Number):
            assert (control.low, control.high) == (spec.low, spec.high)
            assert (control.log, control.whole) == (spec.log, spec.whole)
            assert (control.unit, control.help) == (spec.unit, each.metadata["help"])
            assert control.optional == spec.optional
            assert control.optional or control.low <= control.initial <= control.high
        else:
            assert tuple(control.options) == spec.options
            assert control.description == each.metadata["help"]


def test_signal_background_and_sbr_move_together():
    state = State()
    panel = IlluminationPanel(state)
    state.param.watch(lambda event: panel.show(event.new), "light")
    signal, sbr = panel.controls["ppp"], panel.controls["sbr"]
    background = panel.background.value
    assert background == pytest.approx(0.1041 / 0.06)
    signal.value = 0.2082  # a target twice as bright
    assert (sbr.value, panel.background.value) == pytest.approx((0.12, background))
    panel.held.value = "SBR"
    signal.value = 0.1041
    assert (sbr.value, panel.background.value) == pytest.approx((0.12, background / 2))
    sbr.value = 0.06
    assert (signal.value, panel.background.value) == pytest.approx((0.1041, background))
    panel.background.value = 1.041
    assert state.light == Illumination(sbr=0.1)
    panel.background.value = 0.0
    assert state.light == Illumination(sbr=0.1)
    assert "Background = 0.0 is not accepted: give a number above 0" in panel.doubts.text


def test_without_a_signal_the_sbr_stays():
    state = State(light=Illumination(ppp=0.0))
    panel = IlluminationPanel(state)
    panel.show(state.light)
    panel.controls["ppp"].value = 0.1041
    assert state.light == Illumination()
    panel.controls["ppp"].value = 0.0
    assert state.light == Illumination(ppp=0.0)


def test_values_that_exclude_each_other_are_refused_in_words_of_the_form():
    reported = []
    panel = SettingsPanel(Viewing(color_from_m=40.0), reported.append)
    panel.controls["color_to_m"].value = 30.0
    assert reported == []
    assert panel.doubts.text.startswith("Colours to = 30.0 is not accepted")
    panel.controls["color_from_m"].value = None
    assert reported == [Viewing(color_to_m=30.0)]
    assert panel.doubts.text == ""


def test_a_change_by_the_user_is_reported_as_new_settings_and_one_by_the_page_is_not():
    reported = []
    panel = SettingsPanel(Illumination(), reported.append)
    panel.controls["n_pulses"].value = 500.0
    assert reported == [Illumination(n_pulses=500)]
    assert isinstance(reported[0].n_pulses, int)
    panel.show(Illumination(sbr=2.0))
    assert {name: control.value for name, control in panel.controls.items()} == asdict(
        Illumination(sbr=2.0)
    )
    panel.controls["seed"].value = 7
    assert reported[1:] == [Illumination(sbr=2.0, seed=7)]


# -- the whole page --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def one_layout():
    return HeldLayout(built_in_sources())


@pytest.fixture
def layout(one_layout):
    """The app on Explore, shared by tests that open no other page and make no models."""
    one_layout.restart()
    return one_layout


@pytest.fixture
def own_layout():
    return HeldLayout(built_in_sources())


@pytest.fixture
def explore(layout):
    return layout.contents["Explore"]


def alert_of(layout):
    """Return the sentence that the page shows on failures."""
    return layout.heard[-1]


def open_file(layout, path):
    """Open a file, as an upload does once it is stored."""
    layout.session.sources[path.name] = file_source(path)
    layout.session.state.param.update(source=path.name, reading=ReadOptions())


def values_of(facts):
    return {name: value for name, value, _ in facts.facts}


def test_a_page_opens_complete_and_draws_its_pixel_once(monkeypatch):
    drawn = []

    def counted(*arguments):
        drawn.append(arguments)
        return inspect(*arguments)

    monkeypatch.setattr("app.pages.explore.page.inspect", counted)
    layout = HeldLayout(built_in_sources())
    layout.settle()
    assert len(drawn) == 1
    explore, session = layout.contents["Explore"], layout.session
    assert values_of(explore.figures)["RMSE"] == f"{session.answer.run.figures['rmse_m']:.4g} m"
    assert values_of(explore.numbers)["Pixel"] == "row {}, col {}".format(*session.state.pixel)
    assert np.isfinite(session.answer.capture.truth_range_m[session.state.pixel])
    shown = looks.shown(session.answer, 0.9).sum()
    assert len(explore.cloud.positions) == 12 * shown
    assert f"{shown:,} of 4,096" in explore.cloud.caption
    assert f"Hidden: {4096 - shown:,} below confidence 0.9." in explore.cloud.caption
    model = layout.page.get_root()
    kinds = [type(part).__name__ for part in model.references()]
    assert kinds.count("figure") == 4  # one more is sent when it is first shown
    assert sum(kind.startswith("PointCloud") for kind in kinds) == 1


def draw_in_every_way(layout, explore):
    session = layout.session
    for kind in session.state.param.image.objects:
        session.state.image = kind
        layout.settle()
        _, look = looks.image_of(session.answer, kind, session.state.viewing)
        assert explore.image.figure.title.text == look.title
    for kind in session.state.param.cloud_color.objects:
        session.state.cloud_color = kind
        layout.settle()
        rgb = looks.cloud_of(session.answer, kind, session.state.viewing).rgb
        assert explore.cloud.colors == rgb.tobytes()


def test_every_source_is_estimated_and_drawn(layout, explore):
    session = layout.session
    for key, source in reversed(session.sources.items()):
        control(layout, "Scene or capture").value = key
        answer = layout.next_answer()
        layout.settle()
        assert answer.request.source is source
        assert answer.run.image.valid.any() and answer.capture.source
        assert bool(answer.run.figures) == source.is_scene
        n_shown = looks.shown(answer, session.state.viewing.least_confidence).sum()
        assert len(explore.cloud.positions) == 12 * n_shown > 0
        assert explore.image.figure.title.text
        if key in ("car", "sample"):  # with truth, and without
            draw_in_every_way(layout, explore)
    assert {*layout.heard} == {""}


def test_another_scene_or_capture_keeps_the_method_and_what_it_shows(layout):
    kept = {"method": "likelihood", "judged_by": "image", "returns": ALL_RETURNS}
    layout.session.state.param.update(kept)
    layout.next_answer()
    for key in ("staircase", "sample"):
        control(layout, "Scene or capture").value = key
        request = layout.next_answer().request
        assert request.source is layout.session.sources[key]
        assert {name: getattr(request, name) for name in kept} == kept
    layout.settle()
    assert {*layout.heard} == {""}


def test_presets_set_all_controls_and_a_change_makes_them_custom(layout):
    opened(layout, MORE_TRACKING)
    preset = control(layout, "Preset")
    preset.value = "literal"
    assert layout.next_answer().request.tracking == PRESETS["literal"]
    assert (control(layout, "m").value, control(layout, "Weight").value) == (1.5, "cubic")
    control(layout, "m").value = 2.0
    assert preset.value == CUSTOM
    assert layout.next_answer().request.tracking == replace(PRESETS["literal"], m=2.0)
    control(layout, "m").value = 1.5
    assert preset.value == "literal"


def test_a_file_that_cannot_be_read_is_reported_and_leaves_the_page(layout, tmp_path):
    path = tmp_path / "noise.npz"
    path.write_bytes(b"nothing of the kind")
    before = layout.session.answer
    open_file(layout, path)
    assert layout.next_answer() is before
    assert "noise.npz" in alert_of(layout)
    assert "still shows the last settings" in alert_of(layout)
    assert control(layout, "Scene or capture").value == layout.session.state.source == "car"
    control(layout, "SBR").value = 1.0
    assert layout.next_answer().request.light.sbr == 1.0
    assert alert_of(layout) == ""


def test_a_failure_keeps_the_reading_options_of_the_present_file(layout, small_file, tmp_path):
    open_file(layout, small_file)
    layout.next_answer()
    layout.session.state.reading = ReadOptions(bin_width_s=3e-9)
    assert layout.next_answer().capture.acquisition.bin_width_s == 3e-9
    open_file(layout, tmp_path / "absent.npz")
    layout.next_answer()
    assert "absent.npz" in alert_of(layout)
    control(layout, "l").value = 0.01
    assert layout.next_answer().capture.acquisition.bin_width_s == 3e-9


def test_the_score_is_explained_where_it_is_drawn(car):
    views, titles = SignalPlots(), {}
    for name, place in (("target", (32, 30)), ("none", (0, 0))):
        for method in ("tracking", "likelihood"):
            answer = compute(replace(car.request, method=method), car)
            pixel = inspect(answer, *place)
            views.update(pixel, answer.gate, with_difference=False, unit="ns")
            plot = views.score if pixel.signals is None else views.enhanced
            titles[name, method] = plot.figure.title.text
    lag_ns = inspect(car, 32, 30).peak_lag_bins  # bins of 1 ns
    assert 1 < lag_ns < 5
    assert f"maximum − lag ({lag_ns:.1f} ns)" in titles["target", "tracking"]
    assert "its maximum is the estimate" in titles["target", "likelihood"]
    assert all("no target" in titles["none", method] for method in ("tracking", "likelihood"))
    source = built_in_sources()["approach"]
    few = {"source": source, "reduction": ReductionSettings(skip=4)}
    moving = compute(replace(car.request, method="velocity", **few), None)
    views.update(inspect(moving, 8, 8), moving.gate, with_difference=False, unit="ns")
    assert views.score.figure.title.text == "Score of a surface at rest"


def test_a_weight_that_needs_pulses_is_refused_without_them(layout, small_file):
    open_file(layout, small_file)
    before = layout.next_answer()
    opened(layout, MORE_TRACKING)
    control(layout, "Weight").value = "survival"
    assert layout.next_answer() is before
    assert "weight = 'survival' needs the number of pulses" in alert_of(layout)
    control(layout, "Weight").value = "none"
    assert layout.next_answer() is not before
    assert alert_of(layout) == ""


def opened(layout, title):
    """Unfold a part of the sidebar."""
    (part,) = layout.page.select(lambda each: getattr(each, "title", "") == title)
    part.collapsed = False
    return part


def test_a_folded_part_is_built_when_it_is_first_opened(own_layout):
    names = [spec_of(each).symbol for each in fields(ReductionSettings)]

    def on_page():
        return [each.label for each in own_layout.page.select(Knob) if each.label in names]

    assert on_page() == []
    part = opened(own_layout, "Data reduction")
    for collapsed in (False, True, False):
        part.collapsed = collapsed
        assert on_page() == names


def test_form_link_and_script_have_each_option_for_reading_a_file(layout, small_file):
    given = ReadOptions(**EXAMPLES)
    open_file(layout, small_file)
    answer = layout.next_answer()
    opened(layout, "Reading options")
    for name, option in reading_options().items():
        control(layout, option.label).value = given.as_text(name)
    control(layout, "Read again").clicks += 1
    state = layout.session.state
    assert state.reading == given
    linked = link_to(query_of(state, {})).of({"reading": ReadOptions()})
    assert linked == {"reading": given}
    script = script_of(replace(answer, request=replace(answer.request, reading=given)), state)
    assert [name for name in EXAMPLES if f" {name}=" not in script] == []


def test_a_reduced_capture_is_shown(layout):
    opened(layout, "Data reduction")
    control(layout, "Pixels summed").value = 4
    assert layout.next_answer().capture.shape == (16, 16)
    assert max(layout.session.state.pixel) < 16
    control(layout, "Bins merged").value = 2
    assert layout.next_answer().capture.cube.shape == (16, 16, 50)
    control(layout, "Gate from").value = 1.0  # leaves one bin, where two are to be merged
    layout.next_answer()
    assert "factor = 2 is not accepted" in alert_of(layout)
    assert (control(layout, "Bins merged").value, control(layout, "Gate from").value) == (2, 0.0)
    control(layout, "Scene or capture").value = "staircase"
    assert layout.next_answer().capture.shape == (64, 64)
    assert control(layout, "Pixels summed").value == 1


def test_a_capture_without_truth_hides_what_needs_one(layout, explore, real_capture):
    session = layout.session
    session.state.param.update(image="Error", cloud_color="Error")
    open_file(layout, real_capture("21km_K11_night.mat"))
    assert layout.next_answer().capture.shape == (256, 256)
    assert session.state.param.image.objects == ["Estimate", "Counts"]
    assert session.state.param.cloud_color.objects == ["Range", "Counts"]
    assert (session.state.image, session.state.cloud_color) == ("Estimate", "Range")
    assert not NEED_TRUTH & (set(values_of(explore.figures)) | set(values_of(explore.numbers)))
    assert not any(explore.cloud.wrong)
    control(layout, "Scene or capture").value = "car"
    assert layout.next_answer().request.source.is_scene
    assert session.state.param.image.objects == ["Estimate", "Truth", "Error", "Counts"]


def test_a_capture_without_estimates_is_reported(layout, explore, tmp_path):
    for counts in (0, 1):
        path = tmp_path / f"silence {counts}.npz"
        save_capture(Capture(np.full((3, 5, 40), counts, np.uint16), Acquisition(40)), path)
        open_file(layout, path)
        answer = layout.next_answer()
        assert answer.request.source.title == path.name
        assert not answer.run.image.valid.any()
        assert "No pixel has an estimate" in alert_of(layout)
        assert values_of(explore.numbers)["Estimate"] == "–"
        assert explore.cloud.positions == b""
        assert explore.cloud.caption == "0 of 0 estimates shown"
        control(layout, "Scene or capture").value = "car"
        layout.next_answer()
        assert alert_of(layout) == "" and explore.cloud.positions


def test_a_gate_that_ends_before_t_n_is_reported(layout, tmp_path):
    path = tmp_path / "short.npz"
    cube = np.ones((3, 5, 9), np.uint16)
    cube[:, :, 5] = 9
    save_capture(Capture(cube, Acquisition(9)), path)
    open_file(layout, path)
    layout.next_answer()
    assert "T_n excludes all 9 bins of the gate" in alert_of(layout)
    assert control(layout, "T_n").high == 8
    control(layout, "T_n").value = 3
    layout.next_answer()
    assert alert_of(layout) == ""


def test_a_button_zooms_all_plots_to_the_echo_and_back(layout, explore):
    layout.session.state.pixel = (32, 32)
    layout.settle()
    estimate = explore.signals.histogram.source("estimate").data["bin"][0]
    bins = explore.signals.residual.figure.x_range
    for ends in ((estimate - 10, estimate + 10), (0, 100)):
        explore.zoom.button.clicks += 1
        assert (bins.start, bins.end) == pytest.approx(ends)


def test_a_gate_is_cut_on_the_histogram_and_shown_in_the_unit_of_the_axes(layout, explore):
    state, cut = layout.session.state, explore.signals.cut
    (part,) = (each for each in layout.page.select(Part) if each.title == "Data reduction")
    part.collapsed = False
    gate = {name: control(layout, name) for name in ("Gate from", "Gate to", "T_n")}
    state.reduction = ReductionSettings(merge=2)
    layout.next_answer()
    cut.box.left = 20  # of 100 bins, by the mouse
    layout.next_answer()
    cut.box.right = 90
    assert layout.next_answer().capture.acquisition.n_bins == 35
    layout.settle()
    assert state.reduction == ReductionSettings(merge=2, gate_from=0.2, gate_to=0.9)
    histogram = explore.signals.histogram.figure
    assert (histogram.x_range.start, histogram.x_range.end) == (-10, 40)  # the whole gate

    histogram.x_range.update(start=0, end=5)
    gate["Gate from"].value = 0.3
    layout.next_answer()
    layout.settle()
    assert (cut.box.left, cut.box.right) == (30, 90)
    assert (histogram.x_range.start, histogram.x_range.end) == (-5, 0)  # as before, in the scene

    def shown(name):
        origin, step, _ = gate[name].along
        return origin + step * gate[name].value, gate[name].unit

    assert shown("Gate from") == (pytest.approx(30), "bins")
    assert shown("T_n") == (30 + 2 * 20, "bins")  # of the whole gate, like the axes
    assert histogram.below[0].axis_label == "Bin of the whole gate"
    state.unit = "ns"
    assert shown("Gate from") == (pytest.approx(280 + 30), "ns")
    assert shown("Gate to") == (pytest.approx(280 + 90), "ns")
    assert shown("T_n") == (pytest.approx(280 + 30 + 2 * 20), "ns")
    assert state.tracking.t_n == 20


def test_a_pixel_can_be_chosen_by_point_and_by_key(layout, explore):
    session = layout.session
    explore.cloud.selected = 10 * 64 + 20
    layout.settle()
    assert session.state.pixel == tuple(explore.image_keys.pixel) == (10, 20)
    explore.image_keys.pixel = [11, 20]  # a list, as the browser sends it
    layout.settle()
    assert explore.cloud.selected == 11 * 64 + 20
    assert values_of(explore.numbers)["Pixel"] == "row 11, col 20"


def test_a_page_off_screen_is_not_drawn_and_catches_up(own_layout):
    layout, explore = own_layout, own_layout.contents["Explore"]
    layout.pages.choice.value = "Inspect"
    before = explore.numbers.facts
    layout.session.choose_pixel(3, 4)
    layout.settle()
    assert explore.numbers.facts is before
    layout.pages.choice.value = "Explore"
    assert values_of(explore.numbers)["Pixel"] == "row 3, col 4"


def test_hidden_estimates_leave_the_cloud_but_not_the_figures(layout, explore):
    session, figures = layout.session, values_of(explore.figures)
    confidence = session.answer.run.image.confidence
    for least in (0.0, 0.5, 1.0):
        control(layout, "Show from confidence").value = least
        layout.settle()
        assert len(explore.cloud.positions) / 12 == (confidence >= least).sum()
        assert values_of(explore.figures) == figures


def test_points_of_the_cloud_are_pinned_and_measured(own_layout):
    layout, explore = own_layout, own_layout.contents["Explore"]
    session, cloud, note = layout.session, explore.cloud, explore.measure.note
    explore.measure.part.collapsed = False
    places = np.argwhere(session.answer.run.image.confidence > 0.99)[[0, -1]]
    for row, col in places:
        cloud.selected = int(row * 64 + col)
        layout.settle()
        control(layout, "Pin").clicks += 1
    # The distance may be known before the second pin is drawn.
    layout.tasks.run_until(lambda: "Distance from" in note.text and len(cloud.pinned) == 2)
    assert cloud.pinned == [row * 64 + col for row, col in places]
    points = np.frombuffer(cloud.positions, "<f4").reshape(-1, 3)
    pixels = np.frombuffer(cloud.pixels, "<i4").tolist()
    one, other = (points[pixels.index(pixel)] for pixel in cloud.pinned)
    stated, margin = map(float, re.search(r": ([0-9.]+) ± ([0-9.]+) m", note.text).groups())
    # From the middles of the intervals, not from the estimates.
    assert stated == pytest.approx(np.linalg.norm(one - other), abs=2 * margin)
    assert 0 < margin < 0.5 and model_text.WIDTH_GUESSED not in note.text
    control(layout, "Profile").clicks += 1
    assert (session.state.page, session.state.subject) == ("Inspect", "Profile")
    session.state.page = "Explore"
    control(layout, "Clear").clicks += 1
    layout.settle()
    assert (session.state.pins, cloud.pinned, note.text) == ((), [], measure.HOW)


def test_controls_fit_the_capture_they_are_for(layout, small_file):
    open_file(layout, small_file)
    answer = layout.next_answer()
    assert control(layout, "T_n").high == 36
    opened(layout, "View")
    field_of_view = control(layout, "Field of view")
    width_deg = np.degrees(answer.capture.shape[1] * answer.capture.acquisition.pixel_angle_rad)
    assert (field_of_view.value, field_of_view.empty) == (None, "")
    assert field_of_view.substitute == pytest.approx(width_deg, rel=0.01)


def test_a_link_unfolds_the_rarely_used_settings_that_it_changes():
    often_used = {"tracking.l": "0.006"}
    for rarely_used, expected in (("light.seed", MORE), ("tracking.m", MORE_TRACKING)):
        link = Link(often_used | {rarely_used: "2"})
        parts = HeldLayout(built_in_sources(), link).page.select(Part)
        found = {each.title for each in parts if not each.collapsed}
        assert found & {MORE, MORE_TRACKING} == {expected}


def has_drawn_prior(explore):
    figure = explore.prior.figure
    return figure and any(each.visible for each in figure.renderers)


def test_estimates_without_an_echo_are_shown_in_place_of_the_stages(layout, explore):
    state = layout.session.state
    state.tracking = PRESETS["literal"]
    layout.next_answer()
    assert "counts below" in explore.remark.text
    state.echo_free = True
    layout.settle()
    layout.tasks.run_until(lambda: has_drawn_prior(explore))
    assert [each.visible for each in explore.cards] == [True, False, False, False]
    assert explore.prior.card.visible
    assert explore.prior.figure.x_range is explore.signals.histogram.figure.x_range
    expected = range_prior_of(layout.session.answer)
    drawn = {each.name: each.data_source.data["y"] for each in explore.prior.figure.renderers}
    for name, values in expected.curves.items():
        np.testing.assert_allclose(drawn[name], values, rtol=1e-6)
    state.param.update(method="oracle")
    layout.next_answer()
    assert not explore.prior.card.visible  # the oracle knows that there is no echo


def test_estimates_without_an_echo_are_those_of_the_estimate_on_screen(
    layout, explore, monkeypatch
):
    state, may_end = layout.session.state, Event()

    def computed(answer):
        assert may_end.wait(60)
        return range_prior_of(answer)

    monkeypatch.setattr("app.pages.explore.page.range_prior_of", computed)
    with monkeypatch.context() as patched:  # the model is tested at once
        patched.setattr(layout.tasks, "call_later", lambda _, act: act())
        state.echo_free = True
        state.light = replace(state.light, seed=1)  # another estimate, before the first are known
        layout.next_answer()
    may_end.set()
    layout.tasks.run_until(lambda: has_drawn_prior(explore))
    layout.tasks.run_until(lambda: has_fit(layout.session.answer.capture))
    layout.settle()
    may_end.clear()
    state.light = replace(state.light, seed=2)
    layout.next_answer()
    layout.settle()
    assert not has_drawn_prior(explore)
    explore.show(False)
    may_end.set()
    layout.tasks.run_one()  # the result arrives off screen
    explore.show(True)
    layout.tasks.run_until(lambda: has_drawn_prior(explore))
    drawn = {each.name: each.data_source.data["y"] for each in explore.prior.figure.renderers}
    for name, values in range_prior_of(layout.session.answer).curves.items():
        np.testing.assert_allclose(drawn[name], values, rtol=1e-6)


def help_on(layout):
    """Return the texts of the help at the top of the sidebar."""
    [sidebar] = layout.page.sidebar
    assert isinstance(sidebar, pmui.Column)  # in which a part lays out no plot
    help = sidebar[0]
    assert help.title == HELP
    help.collapsed = False
    return [each.object for each in help.select(pmui.Typography)] if help.visible else []


@pytest.mark.parametrize("is_standalone", [False, True])
def test_a_link_opens_its_page_alone_and_every_page_has_its_own_help(is_standalone):
    first = next(page for page in PAGES[1:] if page.is_standalone == is_standalone)
    layout = HeldLayout(built_in_sources(), Link({"page": first.name}))
    assert (layout.pages.choice.value, [*layout.contents]) == (first.name, [first.name])
    assert layout.page.sidebar_open != is_standalone
    others = [] if is_standalone else PAGES
    for chosen in (*others, PAGES[0], first, PAGES[0]):  # the last cancels what others compute
        layout.pages.choice.value = chosen.name
        assert layout.session.state.page == chosen.name
        assert layout.page.sidebar_open != chosen.is_standalone
        assert help_on(layout) == ([linked(chosen.explanation)] if chosen.explanation else [])
        assert chosen.explanation or chosen.name not in ("Explore", "Compare")
    assert layout.alert.text == ""


def test_a_page_that_does_not_exist_is_refused_by_name():
    layout = Layout(built_in_sources(), Link({"page": "Nowhere"}))
    assert layout.pages.choice.value == "Explore"
    assert "page = 'Nowhere' is not accepted: give Explore, Inspect" in layout.alert.text


def test_sessions_share_no_control_and_no_source(layout, own_layout):
    knobs = [set(map(id, each.page.select(Knob))) for each in (layout, own_layout)]
    assert all(knobs) and not knobs[0] & knobs[1]
    layout.session.sources["mine"] = layout.session.sources["car"]
    assert "mine" not in own_layout.session.sources


def test_only_the_first_estimate_of_a_scene_is_shared_and_only_where_requests_are_equal(tmp_path):
    path = tmp_path / "capture.npz"
    save_capture(core.simulate(core.scenes["wall"](16), Acquisition(), core.Flux(), seed=0), path)
    sources = built_in_sources() | {"file": file_source(path)}

    def opened(**chosen):
        return Session(sources, Link(chosen), HeldTasks()).answer

    assert opened() is opened()
    assert opened(**{"light.sbr": "0.2"}) is not opened()
    assert opened(source="file") is not opened(source="file")


def test_the_bar_of_long_work_comes_and_goes_in_its_own_place(layout):
    (bar,) = layout.page.select(pmui.LinearProgress)
    place = bar.visible, bar.height
    shown = []
    for is_busy in (False, True, False):
        layout.session.tasks.busy.changed.emit(is_busy)
        shown.append("display" not in bar.sx)
        assert (bar.visible, bar.height) == place == (True, 4)
    assert shown == [False, True, False]
