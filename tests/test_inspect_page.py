"""The Inspect page: pixel, region, pins and capture, on the 21 km capture and on the car."""

from __future__ import annotations

import math
import re
import runpy
from dataclasses import replace

import numpy as np
import pytest

import core
from app.model.colors import map_of
from app.model.script import script_of
from app.model.state import (
    MAPS,
    NEEDED,
    NEIGHBOURS,
    VELOCITY,
    Crop,
    Illumination,
    ReductionSettings,
    Viewing,
)
from app.model.store import built_in_sources, file_source
from app.pages.inspect import text
from app.pages.inspect.capture import CaptureSection
from app.pages.inspect.page import Inspect
from app.pages.inspect.pair import PairSection
from app.pages.inspect.pins import PinsSection
from app.pages.inspect.pixel import PixelSection
from app.pages.inspect.profile import ProfileSection
from app.pages.inspect.results import (
    accuracy_steps,
    inspect_region,
    predict,
    profile_of,
    with_gate,
)
from app.pages.inspect.views import MAX_DRAWN_CORNERS, corners_of, rectangle
from app.pages.session import Session
from app.pages.shared.crop import NO_REGION
from app.pages.shared.measure import TOO_MANY_PINS
from app.plots import inspect as inspect_plots
from app.plots.gate_cut import Cut
from app.theme import DARK
from app.units import ShownGate, scale
from core import Acquisition, TrackingParameters, coates_rate, inspection, tracking_signals
from core.inference import has_fit
from core.tests.captures import real_capture_path
from tests.states import link_to
from tests.test_downloads import columns_of, written
from tests.threads import HeldTasks, change

CAPTURE = "21km_K11_night.mat"


@pytest.fixture(scope="module")
def source():
    """The 21 km capture, read once."""
    return file_source(real_capture_path(CAPTURE), shared=True)


@pytest.fixture
def far(source):
    """A session on the 21 km capture, its page's thread in the hands of the test."""
    return Session({"path 0": source, **built_in_sources()}, tasks=HeldTasks())


@pytest.fixture
def near():
    """A session on the simulated car, whose gate is short: a region takes a second."""
    return Session({"car": built_in_sources()["car"]}, tasks=HeldTasks())


def on_screen(section, until=lambda section: section.found):
    """Show a section, and let it draw."""
    section.session.estimate.changed.subscribe(section.follow)
    section.show(True)
    section.session.tasks.run_until(lambda: until(section))
    return section


def shown_below(section):
    """The plot below the counts."""
    (name,) = (name for name, card in section.cards.items() if card.visible and name != "counts")
    return name


def values(facts):
    return {name: value for name, value, _ in facts.facts}


def button(section, label):
    (found,) = section.view.main.select(lambda each: getattr(each, "label", "") == label)
    return found


def press(button):
    button.clicks += 1


# -- units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["bins", "ns", "m"])
def test_a_position_is_shown_in_the_unit(unit):
    gate = Acquisition(n_bins=200, bin_width_s=2e-9, gate_delay_s=4430e-9)
    at = {"bins": 53.25, "ns": 4430 + 2 * 53.25, "m": float(gate.bin_to_range_m(53.25))}[unit]
    along = scale(unit, ShownGate(gate))
    assert along.at(53.25) == pytest.approx(at)
    assert along.number(53.25) == f"{at:,.{along.decimals}f}"
    assert 10.0**-along.decimals <= 0.1 * along.step  # resolves a tenth of a bin, at least
    assert along.place(np.nan) == "–"


def test_axes_facts_and_table_follow_the_unit_without_new_curves(far):
    section = on_screen(PixelSection(far, "pixel"))
    figure, curve = section.plots.counts.figure, section.plots.counts.curve("raw")
    best = section.found.report.candidates[0]
    for unit, title, opposite in (
        ("ns", "Time (ns)", "Range (m)"),
        ("m", "Range (m)", "Bin"),
        ("bins", "Bin", "Range (m)"),
    ):
        far.state.unit = unit
        far.tasks.run_until(lambda title=title: section.table.columns[1][0] == f"{title}, ± 95 %")
        assert (figure.below[0].axis_label, figure.above[0].axis_label) == (title, opposite)
        along = scale(unit, far.answer.gate)
        position = section.table.rows[0]["cells"][0][0]
        assert position.value == pytest.approx(along.at(best.bin))
        assert re.fullmatch(r"[\d,.]+ ± [\d.]+", position)
        assert ("Position" in values(section.facts)) == (unit != "m")
        np.testing.assert_array_equal(section.plots.counts.curve("raw"), curve)


def test_zoom_along_the_gate_is_kept_until_the_bins_change(far):
    section = on_screen(PixelSection(far, "pixel"))
    bins = section.plots.bins
    bins.update(start=90, end=120)
    far.choose_pixel(100, 100)
    change(far, tracking=replace(far.state.tracking, l=0.01))
    far.state.unit = "ns"
    assert (bins.start, bins.end) == (90, 120)
    change(far, source="building")
    assert (bins.start, bins.end) == (0, far.answer.capture.acquisition.n_bins)


# -- map -------------------------------------------------------------------------------------------


def test_a_file_opens_on_inspect_and_a_scene_on_explore(far, near):
    assert (far.state.page, near.state.page) == ("Inspect", "Explore")


@pytest.mark.parametrize("name", ["far", "near"])
def test_every_map_is_offered_where_possible_and_drawn(name, request):
    session = request.getfixturevalue(name)
    change(session, reduction=ReductionSettings(skip=4))
    capture = session.answer.capture
    offered = session.state.param.map.objects
    has_truth = capture.truth_range_m is not None
    absent = {VELOCITY, *({"Reported"} if has_truth else NEEDED)}
    assert offered == [each for each in MAPS if each not in absent]
    maps = {kind: map_of(session.answer, kind, Viewing()) for kind in offered}
    for image, look in maps.values():
        assert image.shape == capture.shape
        assert look.title and look.low < look.high
    np.testing.assert_array_equal(maps["Counts"][0], capture.counts)
    for kind, find in inspection.maps.items():
        np.testing.assert_array_equal(maps[kind][0], find(capture))
    fired, look = maps["Fired"]
    if capture.gated_pulses is None:
        assert np.isnan(fired).all() and "pulses not known" in look.title
    else:
        np.testing.assert_allclose(fired * capture.gated_pulses, maps["Counts"][0])
    assert np.nanmin(maps["Confidence"][0]) < 0.5  # doubtful pixels are not hidden here


@pytest.fixture
def page(far):
    """The page on the 21 km capture."""
    made = Inspect(far)
    made.view.show(True)
    return made


def test_a_pixel_is_typed_and_refused_outside_the_image(page, far):
    row, col = page.place
    row.value = "100"
    col.value = "131"
    assert far.state.pixel == (100, 131)
    for wrong in ("256", "-1", "x", ""):
        row.value = wrong
        assert far.state.pixel == (100, 131)
        assert "Row = " in page.refusal.text and "0 to 255" in page.refusal.text
    row.value = "101"
    assert (far.state.pixel, page.refusal.text) == ((101, 131), "")
    far.choose_pixel(3, 4)
    far.tasks.run_until(lambda: [each.value for each in page.place] == ["3", "4"])


def test_a_rectangle_is_typed_and_cleared(page, far):
    add, clear = button(page, "Select region"), button(page, "Clear region")
    page.span[0].value, page.span[1].value = "10-20", "5 to 8"
    press(add)
    mask = inspection.pixels_in(far.state.region, far.answer.capture.shape)
    assert mask.sum() == 11 * 4 and mask[10:21, 5:9].all()
    assert far.state.subject == "Region"
    chosen = far.state.region
    for wrong in ("10-300", "", "1 2 3"):
        page.span[0].value = wrong
        press(add)
        assert "0 to 255" in page.refusal.text
        assert far.state.region == chosen
    press(clear)
    assert (far.state.region, far.state.subject) == ((), "Pixel")
    assert clear.disabled


def test_a_drawn_region_becomes_a_short_polygon():
    box = corners_of({"type": "rect", "x0": 8.2, "x1": 5.1, "y0": 10.0, "y1": 20.0})
    assert box == ((10, 5.1), (10, 8.2), (20, 8.2), (20, 5.1))
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    lasso = corners_of({"type": "poly", "x": 30 + 10 * np.cos(angle), "y": 40 + 10 * np.sin(angle)})
    assert 3 <= len(lasso) <= MAX_DRAWN_CORNERS
    mask = inspection.pixels_in(lasso, (64, 64))
    row, col = np.indices((64, 64))
    distance = np.hypot(row - 40, col - 30)
    assert not mask[distance > 10.0].any()
    assert mask[distance <= 9.8].all()


def test_pixel_pins_and_region_are_kept_while_the_capture_keeps_its_pixels(near):
    near.choose_pixel(40, 31)
    near.state.param.update(pins=((40, 31),), region=rectangle((10, 20), (5, 8)))
    kept = (near.state.pixel, near.state.pins, near.state.region)
    for reduction in (ReductionSettings(gate_from=0.1), ReductionSettings(pulses=0.5)):
        change(near, reduction=reduction)
        assert (near.state.pixel, near.state.pins, near.state.region) == kept
    change(near, reduction=ReductionSettings(pool=2))
    assert (near.state.pins, near.state.region) == ((), ())


# -- pixel and region ------------------------------------------------------------------------------


def test_confidence_below_which_estimates_are_hidden_is_set_beside_the_map(near):
    page = Inspect(near)
    page.show(True)
    near.tasks.run_until(lambda: page.legend.text)
    confidence = near.answer.run.image.confidence
    for least in (0.5, 0.99):
        page.least_confidence.value = least
        said = f"{(confidence < least).sum():,} of {confidence.size:,} estimates hidden"
        near.tasks.run_until(lambda said=said: said in page.legend.text)
        assert near.state.viewing.least_confidence == least
    near.state.viewing = replace(near.state.viewing, least_confidence=0.9)
    near.tasks.run_until(lambda: page.least_confidence.value == 0.9)


def test_hot_and_dead_pixels_are_listed_marked_and_shown_by_a_press():
    session = Session({"worn": built_in_sources()["worn"]}, tasks=HeldTasks())
    page = Inspect(session)
    page.show(True)
    session.tasks.run_until(lambda: page.n_faulty.text)
    faulty = inspection.faulty_pixels(session.answer.capture)
    n_hot = sum(each.health == "hot" for each in faulty)
    assert f"{n_hot} hot" in page.n_faulty.text
    assert f"{len(faulty) - n_hot} dead" in page.n_faulty.text
    n_listed = min(n_hot, text.MOST_LISTED) + min(len(faulty) - n_hot, text.MOST_LISTED)
    assert len(page.faulty.rows) == n_listed < len(faulty)
    assert f"{len(faulty) - n_listed} more" in page.n_faulty.text
    (marks,) = (
        each.data_source.data
        for each in page.navigator.figure.renderers
        if each.name == "faulty mark"
    )
    places = {(each.row, each.col): each.health for each in faulty}
    shapes = {"circle": "hot", "x": "dead"}
    assert places == {
        (row, col): shapes[shape]
        for row, col, shape in zip(marks["y"], marks["x"], marks["marker"], strict=True)
    }
    session.state.subject = "Capture"
    row = page.faulty.rows[-1]
    page.faulty.acted = [row["key"], 0]
    assert list(session.state.pixel) == row["key"]
    assert session.state.subject == "Pixel"
    assert places[session.state.pixel] == row["cells"][0][0] == "dead"


def test_the_image_posterior_shows_what_neighbours_tell():
    session = Session({"car": built_in_sources()["car"]}, tasks=HeldTasks())
    session.state.param.update(method="image_posterior", pixel=(32, 32))
    session.tasks.run_until(lambda: session.answer.method == "image_posterior")
    section = on_screen(PixelSection(session, "pixel"))
    found = section.found.report
    assert found.evidence is not None
    assert section.downloads.keys() >= {"pixel and neighbours"}
    names = {"the pixel alone": 0, "its neighbours": 1, "both (posterior)": 2}
    saved, n_bins = table_of(section, "pixel and neighbours"), found.counts.size
    for name, which in names.items():
        column = saved[f"{name} (probability)"][:n_bins]
        np.testing.assert_array_equal(column, found.evidence[which])
    np.testing.assert_allclose(
        section.plots.evidence.curve("posterior"), found.evidence.posterior, 1e-6
    )
    session.state.method = "likelihood"
    session.tasks.run_until(lambda: section.found.report.method == "likelihood")
    assert section.found.report.evidence is None
    session.state.plot = NEIGHBOURS
    assert section.explanation.visible
    assert "Here the score is shown" in section.explanation.text
    assert shown_below(section) == "score"
    session.state.judged_by = "image"
    session.tasks.run_until(lambda: section.found.report.evidence is not None)
    assert not section.explanation.visible
    assert shown_below(section) == "evidence"
    session.state.plot = "Score"
    assert shown_below(section) == "score"


def test_everything_about_a_pixel_is_cores(near):
    section = on_screen(PixelSection(near, "pixel"))
    near.choose_pixel(40, 30)
    near.tasks.run_until(lambda: values(section.facts).get("Pixel") == "40, 30")
    capture, tracking = near.answer.capture, near.answer.request.tracking
    signals = tracking_signals(capture.cube[40, 30], tracking, capture.gated_pulses)
    near.state.plot = "Rate"
    near.state.plot = "Score"
    counts, rate, stages = section.plots.counts, section.plots.rate, section.plots.stages
    for plot, name, expected in (
        (counts, "raw", capture.cube[40, 30]),
        (counts, "small", signals.small),
        (counts, "large", signals.large),
        (rate, "rate", coates_rate(capture.cube[40, 30], capture.gated_pulses)),
        (stages, "residual", signals.residual),
        (stages, "enhanced", signals.enhanced),
    ):
        np.testing.assert_allclose(plot.curve(name), expected, rtol=1e-5, atol=1e-6, err_msg=name)
    image = near.answer.run.image
    report = inspection.pixel_report(capture, image, 40, 30, "tracking", tracking)
    n_bins = capture.acquisition.n_bins
    for button, column, expected in (
        ("counts", "counts", signals.raw),
        ("counts", "small scale (counts)", signals.small),
        ("rate", f"rate ({report.rate_unit})", report.rate),
        ("residual and enhanced", "residual (counts)", signals.residual),
        ("residual and enhanced", "enhanced (counts × weight)", signals.enhanced),
    ):
        np.testing.assert_array_equal(table_of(section, button)[column][:n_bins], expected)
    rate = table_of(section, "rate")
    for column, expected in (
        ("estimate", image.bin[40, 30]),
        ("candidates", [each.bin for each in report.candidates]),
    ):
        assert set(rate["Bin"][rate[column] == 1]) == set(np.atleast_1d(expected))
    marks = section.plots.candidates.data["x"]
    np.testing.assert_allclose(marks, [each.bin for each in report.candidates], rtol=1e-6)
    facts = values(section.facts)
    for name, found in zip(("Signal S", "Background B", "SBR"), report.flux, strict=True):
        assert facts[name] == text.interval(found)
    assert facts.keys() >= {"Truth", "Error", "Confidence"}
    range_m = facts["Range (95 %)"]
    assert (range_m.low, range_m.high) == (report.interval_95_m.low, report.interval_95_m.high)
    assert section.remark.text == f"Verdict: {report.verdict.health}. {report.verdict.why}"
    scores = [row["cells"][1][1] for row in section.table.rows]
    assert scores == sorted((each.score for each in report.candidates), reverse=True)


def test_a_file_without_truth_has_no_error(far):
    section = on_screen(PixelSection(far, "pixel"))
    names = values(section.facts).keys()
    assert "Estimate" in names and not names & {"Truth", "Error"}
    far.state.plot = "Rate"
    assert "as counted" in section.plots.rate.figure.title.text
    section.paint(True)
    assert section.plots.counts.figure.title.text_color == DARK.text


def test_a_region_shows_the_sum_of_its_histograms(near):
    section = on_screen(PixelSection(near, "region"), lambda each: each.remark.text)
    assert section.remark.text == text.NO_REGION
    assert not any(each.visible for each in section.cards.values())
    near.state.region = rectangle((40, 44), (30, 33))
    near.tasks.run_until(lambda: section.found)
    summed = near.answer.capture.cube[40:45, 30:34].sum(axis=(0, 1))
    np.testing.assert_allclose(section.plots.counts.curve("raw"), summed)
    facts = values(section.facts)
    assert facts["Pixels"] == "20"
    image = near.answer.run.image.range_m[40:45, 30:34]
    expected = inspect_region(near.answer, near.state.region)
    # With two digits of the spread.
    decimals = 1 - math.floor(math.log10(expected.region.spread_m))
    assert facts["Median range"] == f"{np.nanmedian(image):.{decimals}f} m"
    assert facts["SBR"] == text.interval(expected.region.flux.sbr)
    assert section.remark.text.startswith(expected.region.fit.verdict)
    assert shown_below(section) == "stages"
    near.state.plot = "Fit"
    near.tasks.run_until(lambda: section.plots.residuals.curve("deviation").size)
    assert shown_below(section) == "residuals"
    predicted = predict(expected).counts
    drawn = section.plots.counts.source("fit").data
    for name, curve in (("fit", predicted.expected), ("low", predicted.low)):
        np.testing.assert_allclose(drawn[name], curve, rtol=1e-6)
    table, n_bins = table_of(section, "counts"), summed.size
    np.testing.assert_array_equal(table["expected (fit) (counts)"][:n_bins], predicted.expected)
    saved = table_of(section, "residuals of the fit")["residual"][:n_bins]
    np.testing.assert_array_equal(saved, predicted.residual)
    near.state.region = ((0.1, 0.1), (0.1, 0.2), (0.2, 0.2))
    near.tasks.run_until(lambda: section.found is None)
    assert "0 pixels" in section.remark.text
    assert not section.facts.facts


def test_pixel_region_pins_profile_and_files_follow_the_method(near):
    region, pins = rectangle((40, 44), (30, 33)), ((40, 30), (41, 31))
    cfar = core.ESTIMATORS["cfar"].parameters(guard_bins=5)
    near.state.param.update(region=region, pins=pins, pixel=(40, 30))
    change(near, method="cfar", settings={**near.state.settings, "cfar": cfar})
    answer = near.answer
    capture, image = answer.capture, core.estimate(answer.capture, "cfar", cfar)
    np.testing.assert_array_equal(answer.run.image.range_m, image.range_m)
    pixel = on_screen(PixelSection(near, "pixel"))
    summed = on_screen(PixelSection(near, "region"))
    at = inspection.pixel_report(capture, image, 40, 30, "cfar", cfar)
    inside = inspection.pixels_in(region, capture.shape)
    of_sum = inspection.region_report(capture, image, inside, "cfar", cfar)
    for section, report in ((pixel, at), (summed, of_sum.pixel)):
        assert section.view.main
        marks = section.plots.candidates.data["x"]
        np.testing.assert_allclose(marks, [each.bin for each in report.candidates], rtol=1e-6)
        np.testing.assert_allclose(section.plots.score.curve("score"), report.curve, rtol=1e-5)
        saved = section.downloads["score"]()
        assert f"settings: {cfar}" in " ".join(saved.subject.lines(saved.what))
    pinned = on_screen(PinsSection(near))
    scores = [core.ESTIMATORS["cfar"].curves(capture, *pin, cfar) for pin in pins]
    np.testing.assert_allclose(pinned.score.source("lines").data["ys"], scores, rtol=1e-5)
    along = on_screen(ProfileSection(near)).plot.source("points").data
    at_ends = [image.confident(0.9).range_m[pin] for pin in pins]
    np.testing.assert_array_equal([along["range"][0], along["range"][-1]], at_ends)


# -- pins ------------------------------------------------------------------------------------------


def test_four_pixels_are_pinned_compared_and_removed_and_a_fifth_refused(page, far):
    for n in range(5):
        far.choose_pixel(100, 130 + n)
        page.keys.pressed = ["p", n]
    pins = tuple((100, 130 + n) for n in range(4))
    assert far.state.pins == pins
    assert page.refusal.text == TOO_MANY_PINS
    assert [chip[0] for chip in page.chips.chips] == [list(pin) for pin in pins]
    assert len({color for *_, color in page.chips.chips}) == 4
    section = on_screen(PinsSection(far))
    lines = section.counts.source("lines").data["ys"]
    np.testing.assert_allclose(lines, [far.answer.capture.cube[pin] for pin in pins])
    assert [row["name"] for row in section.table.rows] == [f"100, {130 + n}" for n in range(4)]
    assert section.note.text.startswith("No distances: confidence below 0.9 at 100, 130")
    assert section.table.rows[0]["cells"][0] == ("–", None, "not reliable")
    far.state.viewing = replace(far.state.viewing, least_confidence=0.0)
    assert re.match(r"Distance from 100, 130: [\d.]+ ± [\d.]+ m to 100, 131; ", section.note.text)
    assert section.note.text.endswith(text.WIDTH_GUESSED)
    section.zoom.button.clicks += 1
    bins = section.counts.figure.x_range
    assert all(bins.start <= each.pixel.answer_bin <= bins.end for each in section.found)
    assert bins.end - bins.start < far.answer.capture.acquisition.n_bins
    page.chips.removed = [[100, 131], 1]
    assert (100, 131) not in far.state.pins
    assert page.refusal.text == ""
    page.chips.chosen = [[100, 132], 1]
    assert far.state.pixel == (100, 132)
    far.tasks.run_until(lambda: len(section.table.rows) == 3)


# -- profile and crop ------------------------------------------------------------------------------


def test_a_profile_runs_through_the_pins_and_is_saved_as_shown(near):
    pins = ((20, 10), (45, 50))
    near.state.param.update(page="Inspect", subject="Profile", pins=pins)
    near.state.light = Illumination(sbr=0.5)
    near.tasks.run_until(near.is_settled)
    section = on_screen(ProfileSection(near))
    answer, viewing = near.answer, near.state.viewing
    assert section.view.main
    expected = profile_of(answer, pins, viewing)
    shown = section.plot.source("points").data
    table = table_of(section, "profile")
    for column, name, values in (
        ("distance", inspect_plots.DISTANCE_LABEL, expected.distance_m),
        ("range", "range (m)", expected.range_m),
        ("low", "95 % interval, lowest (m)", expected.low_m),
        ("high", "95 % interval, highest (m)", expected.high_m),
        ("truth", "truth (m)", answer.capture.truth_range_m[expected.row, expected.col]),
        ("row", "row", expected.row),
        ("col", "col", expected.col),
    ):
        np.testing.assert_array_equal(shown[column], values)
        np.testing.assert_array_equal(table[name], values)
    assert shown["text"][0] == text.range_text(*(shown[n][0] for n in ("range", "low", "high")))
    assert text.range_text(50.1234, 47.0, 53.0) == "50.1 m (47.0–53.0 m)"
    assert text.range_text(5.12345, 5.10, 5.14) == "5.123 m (5.100–5.140 m)"
    assert section.note.text.startswith("41 pixels from 20, 10 to 45, 50, ")
    assert text.WIDTH_GUESSED not in section.note.text  # the scene states its own
    # A wider field of view, and fewer pixels on show.
    wider = replace(
        viewing, field_of_view_deg=2 * answer.own_field_of_view_deg, least_confidence=1.0
    )
    before = section.found
    near.state.viewing = wider
    near.tasks.run_until(lambda: section.found is not before)
    hidden = int((answer.run.image.confidence[expected.row, expected.col] < 1).sum())
    assert f"{hidden} without a range, or hidden." in section.note.text
    link = link_to(near.query())
    again = Session(near.sources, link, tasks=HeldTasks()).state
    assert (again.subject, again.pins, again.viewing) == ("Profile", pins, wider)
    assert "core.inspection.line_profile(" in script_of(answer, near.state)
    near.state.pins = pins[:1]
    assert (section.note.text, section.found) == (text.NO_PROFILE, None)
    with pytest.raises(ValueError, match="nothing is drawn here yet"):
        section.downloads["profile"]()


def test_lengths_rest_on_a_guess_unless_the_user_sets_the_field_of_view(far):
    far.state.pins = ((100, 120), (130, 131))
    section = on_screen(ProfileSection(far))
    assert section.note.text.endswith(text.WIDTH_GUESSED)
    # It remains a guess in the link, with other settings, and after a reload.
    change(far, tracking=TrackingParameters(l=0.02))
    again = Session(far.sources, link_to(far.query()), tasks=HeldTasks())
    for session in (far, again):
        assert session.answer.is_width_guessed(session.state.viewing)
        assert "in degrees is a guess" in script_of(session.answer, session.state)
    far.state.viewing = replace(far.state.viewing, field_of_view_deg=1.0)
    far.tasks.run_until(lambda: text.WIDTH_GUESSED not in section.note.text)
    far.state.crop = Crop(to_m=1.0)
    change(far, reduction=ReductionSettings(gate_from=0.1))
    assert (far.state.viewing.field_of_view_deg, far.state.crop) == (1.0, Crop(to_m=1.0))
    change(far, source="building")
    assert far.state.crop == Crop()  # the limits were those of another scene


def test_the_box_says_what_is_inside_refuses_crossed_limits_and_is_in_the_link(near):
    page = Inspect(near)
    page.show(True)
    crop, image = page.crop, near.answer.run.image
    n_shown = int((image.confidence >= 0.9).sum())
    crop.settings.controls["to_m"].value = 840.0
    assert near.state.crop == Crop(to_m=840.0)
    n_inside = int(((image.confidence >= 0.9) & (image.range_m <= 840)).sum())
    assert crop.note.text.startswith(f"{n_inside:,} of {n_shown:,} points are inside")
    crop.settings.controls["from_m"].value = 850.0
    assert "a number above Range from = 850" in crop.settings.doubts.text
    assert near.state.crop == Crop(to_m=840.0)
    crop.settings.controls["from_m"].value = None
    crop.settings.controls["pixels"].value = "region"
    assert crop.note.text == NO_REGION
    link = link_to(near.query())
    again = Session(near.sources, link, tasks=HeldTasks()).state
    assert again.crop == Crop("region", None, 840.0)


# -- A and B ---------------------------------------------------------------------------------------


def test_each_doubt_about_a_and_b_is_stated_once():
    assert text.pair_doubts("Tail.", "Tail.", "Tail.") == ""
    assert text.pair_doubts("Tail.", "Tail.", "") == "Tail."
    assert text.pair_doubts("Two surfaces.", "Tail.", "Tail.") == "A: Two surfaces."
    assert text.pair_doubts("", "Tail.", "") == "B: Tail."


def test_an_estimate_is_kept_and_subtracted_from_another(near, tmp_path, monkeypatch):
    section, sources = PairSection(near), near.sources
    section.show(True)
    assert section.note.text == text.NO_A
    near.state.param.update(light=Illumination(sbr=0.3), tracking=TrackingParameters(l=0.006))
    near.tasks.run_until(near.is_settled)
    a = near.answer
    press(button(section, "Keep as A"))
    change(near, method="coates")
    section.refresh()
    near.tasks.run_until(lambda: section.pair and section.pair.b is near.answer)
    image_a, image_b = a.run.image, near.answer.run.image
    shown = [each.valid & (each.confidence >= 0.9) for each in (image_a, image_b)]
    difference_m = np.where(shown[0] & shown[1], image_b.range_m - image_a.range_m, np.nan)
    assert section.pair.a is a
    np.testing.assert_array_equal(section.pair.difference_m, difference_m)
    numbers = values(section.facts)
    pixel = near.state.pixel
    for name, image in (("A here", image_a), ("B here", image_b)):
        assert numbers[name].value == image.range_m[pixel]
        assert numbers[name].endswith(" m (95 %)") == (image.confidence[pixel] >= 0.9)
    assert numbers["In both"] == f"{np.isfinite(difference_m).sum():,}"
    assert numbers["Only in A"] == f"{(shown[0] & ~shown[1]).sum():,}"
    assert "SBR0.3" in section.a.title.text and "Coates" in section.b.title.text
    for picture, image, visible in zip(
        (section.a, section.b), (image_a, image_b), shown, strict=True
    ):
        n_valid = image.valid.sum()
        hidden = f"{n_valid - visible.sum():,} of {n_valid:,} estimates hidden below confidence 0.9"
        assert hidden in picture.caption.text
    assert f"{np.isnan(difference_m).sum():,} pixels" in section.difference.caption.text
    # The script computes both.
    near.state.param.update(page="Inspect", subject="A/B")
    monkeypatch.chdir(tmp_path)
    script = script_of(near.answer, near.state, near.kept_answer)
    (tmp_path / "script.py").write_text(script, "utf-8")
    scripted = runpy.run_path("script.py")
    np.testing.assert_array_equal(scripted["difference_m"], difference_m)
    np.testing.assert_array_equal(scripted["image"].range_m, image_b.range_m)
    assert script.count("core.simulate") == 1
    # Another session has only the link, and computes A again.
    link = link_to(near.query())
    again = PairSection(Session(sources, link, tasks=HeldTasks()))
    again.show(True)
    again.session.tasks.run_until(lambda: again.pair)
    np.testing.assert_array_equal(again.pair.a.run.image.range_m, image_a.range_m)
    np.testing.assert_array_equal(again.pair.difference_m, difference_m)
    assert has_fit(again.pair.a.capture) and has_fit(again.pair.b.capture)  # for the legends
    same = script_of(again.session.answer, again.session.state, again.session.kept_answer)
    assert same == script
    kept = near.state.kept
    press(button(section, "Forget A"))
    assert section.note.text == text.NO_A and near.state.kept == ""
    near.state.kept = kept  # as by Undo
    assert near.kept_answer is None  # A does not stay in memory


def test_two_captures_are_subtracted_and_the_script_reads_both(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("before.npz", "after.npz")):
        scene, acquisition = core.scenes["staircase"](16), Acquisition()
        cube = core.simulate(scene, acquisition, core.Flux(0.3, sbr=1.0), seed=seed).cube
        np.savez(name, counts=cube, bin_width_s=1e-9, n_pulses=acquisition.n_pulses)
    sources = {each: file_source(tmp_path / f"{each}.npz") for each in ("before", "after")}
    session = Session(sources, link_to("source=before"), tasks=HeldTasks())
    section = PairSection(session)
    section.show(True)
    press(button(section, "Keep as A"))
    change(session, source="after")
    section.refresh()
    session.tasks.run_until(lambda: section.pair and section.pair.b is session.answer)
    assert "before.npz" in section.a.title.text and "after.npz" in section.b.title.text
    assert np.nanmax(np.abs(section.pair.difference_m)) > 0
    session.state.param.update(page="Inspect", subject="A/B")
    (tmp_path / "script.py").write_text(
        script_of(session.answer, session.state, session.kept_answer), "utf-8"
    )
    found = runpy.run_path("script.py")["difference_m"]
    np.testing.assert_array_equal(found, section.pair.difference_m)


def test_estimates_of_other_sizes_are_not_subtracted(near):
    section = PairSection(near)
    section.show(True)
    press(button(section, "Keep as A"))
    change(near, reduction=ReductionSettings(pool=2))
    section.refresh()
    near.tasks.run_until(lambda: "their sizes must be equal" in section.note.text)
    assert section.pair is None
    near.state.kept = "source=gone"
    assert "There is no scene or capture 'gone'" in section.note.text


# -- downloads -------------------------------------------------------------------------------------


def table_of(section, button):
    """Return the columns of a file that a section's button saves."""
    return columns_of(written(section.downloads[button]().files["csv"]))


@pytest.mark.parametrize("name", ["far", "near"])
def test_region_pins_and_capture_are_saved_as_shown(name, request):
    session = request.getfixturevalue(name)
    pins, region = ((10, 30), (61, 62)), rectangle((40, 44), (30, 33))
    session.state.param.update(pins=pins, region=region)
    cube, n_bins = session.answer.capture.cube, session.answer.capture.acquisition.n_bins

    section = on_screen(PixelSection(session, "region"))
    assert section.view.main
    session.state.plot = "Rate"
    is_tracking = session.answer.method == "tracking"
    below = {"residual and enhanced" if is_tracking else "score", "rate"}
    assert section.downloads.keys() == below | {"counts", "numbers", "table"}
    saved = {button: save() for button, save in section.downloads.items()}
    assert {each.subject.part for each in saved.values()} == {"rows40-44_cols30-33"}
    summed = cube[40:45, 30:34].sum(axis=(0, 1))
    np.testing.assert_array_equal(table_of(section, "counts")["counts"][:n_bins], summed)

    section = on_screen(PinsSection(session))
    assert section.view.main
    counts = table_of(section, "counts")
    for row, col in pins:
        np.testing.assert_array_equal(counts[f"{row}, {col} (counts)"][:n_bins], cube[row, col])

    section = on_screen(CaptureSection(session), lambda each: each.counts.curve("raw").size)
    assert section.view.main
    np.testing.assert_array_equal(
        table_of(section, "counts")["counts"][:n_bins], cube.sum(axis=(0, 1))
    )


def test_an_outdated_region_is_not_saved(near):
    section = on_screen(PixelSection(near, "region"), lambda each: each.remark.text)
    near.state.region = rectangle((40, 44), (30, 33))
    near.tasks.run_until(lambda: section.found)
    near.state.region = rectangle((1, 2), (3, 4))  # drawn when the test lets it
    with pytest.raises(ValueError, match="nothing is drawn here yet"):
        section.downloads["counts"]()


# -- the capture as a whole ------------------------------------------------------------------------


@pytest.fixture
def capture(near):
    """The section on the capture as a whole, its study cancelled."""
    section = CaptureSection(near)
    near.estimate.changed.subscribe(section.follow)
    section.show(True)
    buttons, *_ = section.study.controls
    press(buttons[1])
    near.tasks.run_until(lambda: section.report)
    return section


def test_the_capture_is_reported_and_suggestions_apply(capture, near):
    report, before = capture.report, near.answer.capture
    np.testing.assert_allclose(capture.counts.curve("raw"), before.cube.sum(axis=(0, 1)))
    facts = values(capture.facts)
    for pixels, flux in (("all", report.flux), ("target", report.target_flux)):
        assert facts[f"SBR, {pixels} pixels"] == text.interval(flux.sbr)
        assert facts[f"PPP, {pixels} pixels"] == text.interval(flux.signal)
    assert facts["Hot pixels"] == str(report.n_hot)
    check = inspection.StatedFluxCheck("sbr", "", 2 * report.flux.sbr.value, report.flux.sbr)
    stated = text.capture_facts(near.answer, replace(report, stated=(check,)))
    (shown,) = (value for name, value, _ in stated if name == "SBR, stated")
    assert shown.value == check.stated and shown.note == "estimate −50.0 %"
    unknown = replace(before, acquisition=replace(before.acquisition, n_pulses=None))
    run = replace(near.answer.run, capture=unknown)
    named = text.capture_facts(replace(near.answer, run=run), report)
    assert "Photons per pixel, all pixels" in [name for name, *_ in named]
    assert report.flux_method in capture.flux.text
    assert report.flux_remark in capture.flux.text
    assert report.suggestion.why_gate in capture.advice[0].text
    assert report.suggestion.why_t_n in capture.advice[1].text

    apply_gate, apply_t_n = capture.apply
    press(apply_gate)
    near.tasks.run_until(lambda: capture.report is not report)
    first, end = report.suggestion.gate
    gate = near.answer.capture.acquisition
    assert gate.n_bins == end - first
    opens_s = before.acquisition.gate_delay_s + first * gate.bin_width_s
    assert gate.gate_delay_s == pytest.approx(opens_s)
    press(apply_t_n)
    assert near.state.tracking.t_n == capture.report.suggestion.t_n
    near.tasks.run_until(lambda: apply_t_n.disabled)

    def t_n_shown():
        shown = capture.report is not None and capture.advice[1].visible and apply_t_n.visible
        assert capture.counts.layers["suggested"]["glyph_renderer"].visible == shown
        return shown

    assert t_n_shown()
    near.state.method = "likelihood"  # which has no T_n
    near.tasks.run_until(lambda: not t_n_shown())
    near.state.method = "tracking"
    near.tasks.run_until(t_n_shown)


def test_a_report_that_fails_removes_the_previous_one(capture, near, monkeypatch):
    shown = []
    near.failures.shown.subscribe(shown.append)

    def fail(_capture):
        raise MemoryError("no more")

    monkeypatch.setattr("core.inspection.capture_report", fail)
    near.state.reduction = ReductionSettings(merge=2)
    near.tasks.run_until(lambda: "MemoryError" in "".join(shown))
    assert capture.report is None
    assert capture.facts.facts == []
    assert {sentence.text for sentence in (capture.flux, *capture.advice)} == {""}
    assert all(each.disabled for each in capture.apply)


def test_the_report_on_another_file_or_scene_is_not_shown(capture, near):
    near.sources["wall"] = built_in_sources()["wall"]
    near.state.source = "wall"
    near.tasks.run_until(lambda: near.answer.request.source is near.sources["wall"])
    assert capture.report is None and capture.facts.facts == []
    assert capture.counts.source("window").data["left"] == []
    assert all(each.disabled for each in capture.apply)
    near.tasks.run_until(lambda: capture.facts.facts)
    assert capture.flux.text


def test_a_gate_is_applied_to_an_already_reduced_capture(near):
    change(near, reduction=ReductionSettings(merge=2, gate_from=0.1))
    answer = near.answer
    suggestion = replace(inspection.capture_report(answer.capture).suggestion, gate=(4, 40))
    reduction, t_n = with_gate(answer, suggestion)
    n_bins = answer.whole.acquisition.n_bins
    opens = round(0.1 * n_bins)
    assert reduction.in_bins(n_bins).gate == (opens + 8, opens + 80)
    assert reduction.merge == 2
    assert t_n == max(answer.request.tracking.t_n - 4, 0)


def test_a_gate_of_another_capture_is_not_cut(near):
    cut = Cut.of(near.answer, ReductionSettings())
    before = near.state.reduction
    near.cut_gate(replace(cut, n_bins=cut.n_bins + 1, wanted=(0, cut.n_bins + 1)))
    assert near.state.reduction is before
    near.cut_gate(replace(cut, wanted=(0, cut.n_bins // 2)))
    assert near.state.reduction.gate(cut.n_bins) == (0, cut.n_bins // 2)


def test_accuracy_against_pulses_is_drawn_step_by_step(near):
    section = on_screen(CaptureSection(near), lambda each: len(each.accuracies) == 2)
    drawn = section.accuracy.source("points").data
    assert drawn["pulses"] == [each.n_pulses for each in section.accuracies]
    assert drawn["value"] == [each.within.value for each in section.accuracies]
    assert section.view.main
    saved = table_of(section, "accuracy")
    for column, name in (
        ("within 3 bins", "value"),
        ("95 % interval, lowest (within 3 bins)", "low"),
    ):
        expected = [getattr(each.within, name) for each in section.accuracies]
        np.testing.assert_array_equal(saved[column][: len(expected)], expected)
    assert saved["Pulses"][saved["present number"] == 1] == 1000
    assert "truth" in section.accuracy.figure.yaxis.axis_label
    section.pulses.value = 0.25
    near.tasks.run_until(lambda: near.answer.capture.acquisition.n_pulses == 250)
    np.testing.assert_allclose(section.accuracy.source("present").data["x"], 250)
    change(near, light=replace(near.state.light, n_pulses=12))
    near.tasks.run_until(lambda: len(section.accuracies) == 4)
    assert section.accuracy.source("points").data["pulses"] == [1, 1, 1, 2]
    section.show(False)


def test_an_estimate_for_an_earlier_setting_does_not_reset_the_slider(capture, near):
    before = near.answer
    for share in (0.5, 0.25):
        capture.pulses.value = share
    near.tasks.run_until(lambda: near.answer is not before)
    earlier = replace(near.answer.request, reduction=ReductionSettings(pulses=0.5))
    capture.follow(replace(near.answer, request=earlier))
    assert (capture.pulses.value, near.state.reduction.pulses) == (0.25, 0.25)


def test_a_share_of_pulses_that_fails_is_reset(capture, near, monkeypatch):
    def fail(request, *more):
        raise MemoryError

    monkeypatch.setattr("app.pages.shared.estimate.compute", fail)
    capture.pulses.value = 0.5
    near.tasks.run_until(lambda: capture.pulses.value == 1.0)
    assert near.state.reduction == ReductionSettings()


def test_without_truth_accuracy_is_called_agreement(far):
    (work, *_) = accuracy_steps(far.answer)
    assert work().against != "truth"
    title, across, _ = text.accuracy_titles(far.answer.whole)
    assert "not accuracy" in title
    assert across == "Share of the pulses"


def test_ranks_of_close_candidates_are_above_each_other():
    rows = inspect_plots.lifts([50.0, 52.0, 90.0, 49.0, 56.9], gap=5.0)
    step = rows[0] - rows[1]
    assert step >= 11  # px of a line
    assert rows == [rows[0] - step * row for row in (0, 1, 0, 2, 0)]


def test_a_line_drawn_on_the_map_pins_its_ends_and_bends_for_a_profile(near):
    page, state = Inspect(near), near.state
    page.show(True)
    _, cols = near.answer.capture.shape
    down = np.linspace(2.0, 40.0, 30)
    page.navigator.drawn.data = {"xs": [np.full(30, 5.2)], "ys": [down]}
    assert (state.pins, state.subject) == (((2, 5), (40, 5)), "Profile")
    assert page.navigator.drawn.data["xs"] == [[]]  # the pins are joined by a layer of their own
    bent = {"xs": [[3.0, 3.0, 30.0, cols + 9]], "ys": [[10.0, 30.0, 30.4, 30.0]]}
    page.navigator.drawn.data = bent
    assert state.pins == ((10, 3), (30, 3), (30, cols - 1))
    page.navigator.drawn.data = {"xs": [[7.0, 7.1]], "ys": [[7.0, 7.1]]}  # not a line
    assert len(state.pins) == 3


def test_the_likelihood_with_velocity_shows_velocities():
    session = Session({"approach": built_in_sources()["approach"]}, tasks=HeldTasks())
    assert VELOCITY not in session.state.param.map.objects
    change(session, method="velocity", pixel=(16, 16), reduction=ReductionSettings(skip=2))
    assert VELOCITY in session.state.param.map.objects
    session.state.map = VELOCITY
    answer = session.answer
    drawn, look = map_of(answer, VELOCITY, Viewing(least_confidence=0.9))
    assert look.unit == "m/s"
    assert np.nanmedian(drawn) == pytest.approx(-20, rel=0.05)  # the scene's
    section = on_screen(PixelSection(session, "pixel"))
    velocity = answer.run.image.velocity
    assert values(section.facts)["Velocity"] == velocity.text_at(16, 16).replace("-", "−")
    change(session, method="likelihood")
    assert VELOCITY not in session.state.param.map.objects
    assert session.state.map == "Estimate"
