"""The Inspect page: pixel, region, pins and capture, on the 21 km capture and on the façade."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.model.colors import map_of
from app.model.state import MAPS, NEED_TRUTH, Less
from app.model.store import built_in_sources, compute, file_source
from app.pages.inspect import text as inspector_words
from app.pages.inspect.capture import Whole
from app.pages.inspect.page import Inspector
from app.pages.inspect.pins import Pins
from app.pages.inspect.pixel import Sight
from app.pages.inspect.results import accuracy_steps, pixel_seen, region_seen, with_gate
from app.pages.inspect.views import ENOUGH_CORNERS, corners_of, rectangle
from app.pages.layout import Layout
from app.pages.session import Session
from app.pages.shared.downloads import Download
from app.theme import DARK
from app.units import scale
from core import Acquisition, coates_rate, inspection, tracking_signals
from core.tests.captures import real_capture_path
from tests.browser import eventually
from tests.test_downloads import columns_of, written

CAPTURE = "21km_K11_night.mat"


@pytest.fixture(scope="module")
def source():
    """The 21 km capture, read once."""
    return file_source(real_capture_path(CAPTURE), shared=True)


@pytest.fixture
def field(source):
    """A session that opens on the 21 km capture."""
    return Session({"path 0": source, **built_in_sources()})


@pytest.fixture
def facade():
    """A session on the façade."""
    return Session({"building": built_in_sources()["building"]})


def shown(part, *names):
    """A part of the page on screen."""
    view = part(*names).view
    view.paint(False)
    view.show(True)
    return view


def column(plot, layer, name):
    return np.asarray(plot.source(layer).data[name])


# -- units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["bins", "ns", "m"])
def test_a_position_is_told_in_the_unit(unit):
    gate = Acquisition(n_bins=200, bin_width_s=2e-9, gate_delay_s=4430e-9)
    at = {"bins": 53.25, "ns": 4430 + 2 * 53.25, "m": float(gate.bin_to_range_m(53.25))}[unit]
    along = scale(unit, gate)
    assert along.at(53.25) == pytest.approx(at)
    assert along.number(53.25) == f"{at:,.{along.decimals}f}"
    assert 10.0**-along.decimals <= 0.1 * along.step  # tells tenths of a bin, at least
    assert along.place(np.nan) == "–"


def test_axes_take_on_unit_and_gate_without_new_data():
    layout = Layout(built_in_sources())
    session, histogram = layout.session, layout.contents["Explore"].signals.histogram
    figure, data = histogram.figure, histogram.source("raw").data
    before = {name: np.array(values) for name, values in data.items()}
    labels = []
    for unit in ("bins", "ns", "m"):
        session.state.unit = unit
        labels.append((figure.below[0].axis_label, figure.above[0].axis_label))
    assert labels == [
        ("Bin", "Range (m)"),
        ("Time (ns)", "Range (m)"),
        ("Range (m)", "Bin"),
    ]
    for name, values in before.items():
        np.testing.assert_array_equal(histogram.source("raw").data[name], values)
    axis = figure.below[0]
    capture = session.answer.capture
    assert axis.formatter.args["step"] == pytest.approx(capture.acquisition.bin_length_m)


def test_zoom_along_the_gate_stays_until_bins_change(field):
    part = Sight(field, "pixel")
    view = part.view
    view.show(True)
    part._plots._bins.update(start=90, end=120)
    field.choose_pixel(100, 100)
    field.state.tracking = replace(field.state.tracking, l=0.01)
    eventually(lambda: field.answer.request.tracking.l == 0.01)
    view.follow(field.answer)
    field.state.unit = "ns"
    assert (part._plots._bins.start, part._plots._bins.end) == (90, 120)
    field.state.source = "building"
    eventually(lambda: field.state.pixel[0] < 64)  # the façade's own
    view.follow(field.answer)
    n_bins = field.answer.capture.acquisition.n_bins
    eventually(lambda: (part._plots._bins.start, part._plots._bins.end) == (0, n_bins))
    view.show(False)


# -- navigator -------------------------------------------------------------------------------------


def test_a_file_opens_on_inspect_and_a_scene_on_explore(field, facade):
    assert (field.state.page, facade.state.page) == ("Inspect", "Explore")


def test_page_and_state_choose_each_other(source):
    layout = Layout({"path 0": source, **built_in_sources()})
    assert layout.pages.choice.value == "Inspect"
    layout.session.state.page = "Explore"
    assert layout.pages.choice.value == "Explore"
    layout.pages.choice.value = "Inspect"
    assert layout.session.state.page == "Inspect"


def test_every_map_is_offered_where_it_can_be_and_drawn(field, facade):
    for session in (field, facade):
        has_truth = session.answer.capture.truth_range_m is not None
        offered = session.state.param.map.objects
        assert offered == [each for each in MAPS if has_truth or each not in NEED_TRUTH]
        for kind in offered:
            image, look = map_of(session.answer, kind, 0.0)
            assert image.shape == session.answer.capture.shape
            assert look.title
            assert look.low < look.high
    counts, _ = map_of(facade.answer, "Counts", 0.0)
    fired, _ = map_of(facade.answer, "Fired", 0.0)
    np.testing.assert_allclose(fired * facade.answer.capture.gated_pulses, counts)
    fired, look = map_of(field.answer, "Fired", 0.0)
    assert np.isnan(fired).all()
    assert "pulses not known" in look.title
    sure, _ = map_of(facade.answer, "Confidence", 0.9)
    assert np.nanmin(sure) < 0.5  # what is doubtful is what one looks for


@pytest.fixture
def page(field):
    """The page on the 21 km capture, on screen."""
    made = Inspector(field)
    made.view.show(True)
    yield made
    made.view.show(False)


def test_a_pixel_is_typed_and_refused_in_words_outside(page, field):
    row, col = page._place
    row.value = "100"
    col.value = "131"
    assert field.state.pixel == (100, 131)
    for wrong in ("256", "-1", "x", ""):
        row.value = wrong
        assert field.state.pixel == (100, 131)
        assert "0 to 255" in page._refusal.text
        assert "row" in page._refusal.text.lower()
    row.value = "101"
    assert (field.state.pixel, page._refusal.text) == ((101, 131), "")
    field.choose_pixel(3, 4)
    assert [each.value for each in page._place] == ["3", "4"]


def test_a_rectangle_is_typed_outlined_and_cleared(page, field):
    page._span[0].value, page._span[1].value = "10-20", "5 to 8"
    page._add.clicks += 1
    mask = inspection.pixels_in(field.state.region, field.answer.capture.shape)
    assert mask.sum() == 11 * 4
    assert mask[10:21, 5:9].all()
    assert field.state.subject == "Region"
    chosen = field.state.region
    assert page._navigator._region[0].data["ys"] == [[9.5, 9.5, 20.5, 20.5]]
    for wrong in ("10-300", "", "1 2 3"):
        page._span[0].value = wrong
        page._add.clicks += 1
        assert "0 to 255" in page._refusal.text
        assert field.state.region == chosen
    page._clear.clicks += 1
    assert (field.state.region, field.state.subject) == ((), "Pixel")
    assert page._navigator._region[0].data["ys"] == []
    assert page._clear.disabled


def test_what_is_drawn_becomes_a_short_polygon():
    box = corners_of({"type": "rect", "x0": 8.2, "x1": 5.1, "y0": 10.0, "y1": 20.0})
    assert box == ((10, 5.1), (10, 8.2), (20, 8.2), (20, 5.1))
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    drawn = {"type": "poly", "x": 30 + 10 * np.cos(angle), "y": 40 + 10 * np.sin(angle)}
    lasso = corners_of(drawn)
    assert 3 <= len(lasso) <= ENOUGH_CORNERS
    mask = inspection.pixels_in(lasso, (64, 64))
    row, col = np.indices((64, 64))
    outside, inside = (np.hypot(row - 40, col - 30) > r for r in (10.0, 9.8))
    assert not mask[outside].any()
    assert mask[~inside].all()


def test_pixel_pins_and_region_stay_while_the_capture_keeps_its_pixels(page, field):
    field.choose_pixel(100, 131)
    page._pin_pixel()
    page._select(rectangle((10, 20), (5, 8)))
    kept = (field.state.pixel, field.state.pins, field.state.region)
    for less in (Less(gate_from=0.1), Less(pulses=0.5)):
        field.state.less = less
        eventually(lambda less=less: field.answer.request.less == less)
        assert (field.state.pixel, field.state.pins, field.state.region) == kept
    field.state.less = Less(pool=2)
    eventually(lambda: field.answer.capture.shape == (128, 128))
    eventually(lambda: (field.state.pins, field.state.region) == ((), ()))


# -- pixel -----------------------------------------------------------------------------------------


def test_everything_of_a_pixel_is_cores(facade):
    answer = facade.answer
    capture, tracking = answer.capture, answer.request.tracking
    part = Sight(facade, "pixel")
    part.view.show(True)
    facade.choose_pixel(40, 30)
    eventually(lambda: part._facts.facts[0][1] == "40, 30")
    histogram = capture.cube[40, 30]
    signals = tracking_signals(histogram, tracking, capture.gated_pulses)
    plots = part._plots
    for plot, layer, expected in (
        (plots.counts, "raw", histogram),
        (plots.counts, "small", signals.small),
        (plots.counts, "large", signals.large),
        (plots.rate, "rate", coates_rate(histogram, capture.gated_pulses)),
        (plots.stages, "residual", signals.residual),
        (plots.stages, "enhanced", signals.enhanced),
    ):
        drawn = column(plot, "raw" if plot is plots.counts else layer, layer)
        np.testing.assert_allclose(drawn, expected, rtol=1e-5, atol=1e-6, err_msg=layer)
    report = inspection.pixel_report(capture, answer.run.image, 40, 30, "tracking", tracking)
    marks = column(plots.counts, "candidates", "x")
    np.testing.assert_allclose(marks, [each.bin for each in report.candidates], rtol=1e-6)
    facts = {name: value for name, value, _ in part._facts.facts}
    for name, found in zip(("Signal S", "Background B", "SBR"), report.flux, strict=True):
        assert facts[name] == inspector_words.interval(found)
    assert report.verdict.health in part._remark.text
    assert report.verdict.why in part._remark.text
    assert {"Truth", "Error", "Confidence"} <= facts.keys()
    rows = part._table.rows
    assert [row["name"] for row in rows] == [str(n + 1) for n in range(len(rows))]
    scores = [row["cells"][1][1] for row in rows]
    assert scores == sorted(scores, reverse=True)


def test_read_outs_follow_the_unit(field):
    part = Sight(field, "pixel")
    part.view.show(True)
    best = pixel_seen(field.answer, *field.state.pixel).report.candidates[0]
    for unit, title in (("ns", "Time (ns)"), ("m", "Range (m)"), ("bins", "Bin")):
        field.state.unit = unit
        eventually(lambda title=title: part._table.columns[1][0] == title)
        along = scale(unit, field.answer.capture.acquisition)
        assert part._table.rows[0]["cells"][0][0] == along.number(best.bin)
        facts = {name: value for name, value, _ in part._facts.facts}
        assert ("Position" in facts) == (unit != "m")


def test_of_a_file_without_truth_no_error_is_told(field):
    part = Sight(field, "pixel")
    part.view.show(True)
    names = {name for name, *_ in part._facts.facts}
    assert "Estimate" in names and not names & {"Truth", "Error"}
    assert "as counted" in part._plots.rate.figure.title.text
    part._paint(True)
    assert part._plots.counts.figure.title.text_color == DARK.text


# -- region ----------------------------------------------------------------------------------------


def test_a_region_shows_its_pixels_added_to_one(facade):
    part = Sight(facade, "region")
    part.view.show(True)
    assert part._remark.text == inspector_words.NO_REGION
    assert not any(each.visible for each in part._cards)
    facade.state.region = rectangle((40, 44), (30, 33))
    eventually(lambda: part._facts.facts)
    summed = facade.answer.capture.cube[40:45, 30:34].sum(axis=(0, 1))
    np.testing.assert_allclose(column(part._plots.counts, "raw", "raw"), summed)
    facts = {name: value for name, value, _ in part._facts.facts}
    assert facts["Pixels"] == "20"
    image = facade.answer.run.image.range_m[40:45, 30:34]
    assert facts["Median of answers"] == f"{np.nanmedian(image):.4g} m"
    seen = region_seen(facade.answer, facade.state.region)
    assert facts["SBR"] == inspector_words.interval(seen.region.flux.sbr)
    facade.state.region = ((0.1, 0.1), (0.1, 0.2), (0.2, 0.2))
    eventually(lambda: "0 pixels" in part._remark.text)
    assert not part._facts.facts


# -- pins ------------------------------------------------------------------------------------------


def test_four_pixels_are_pinned_compared_and_removed_and_a_fifth_refused(page, field):
    for n in range(5):
        field.choose_pixel(100, 130 + n)
        page._keys.pressed = ["p", n]
    pins = tuple((100, 130 + n) for n in range(4))
    assert field.state.pins == pins
    assert page._refusal.text == inspector_words.TOO_MANY_PINS
    assert [chip[0] for chip in page._chips.chips] == [list(pin) for pin in pins]
    assert len({color for *_, color in page._chips.chips}) == 4
    assert len(page._navigator._pins.data["left"]) == 4
    part = Pins(field)
    part.view.show(True)
    eventually(lambda: len(part._table.rows) == 4)
    lines = part._counts.source("lines").data
    for pin, line in zip(pins, lines["ys"], strict=True):
        np.testing.assert_allclose(line, field.answer.capture.cube[pin])
    assert [row["name"] for row in part._table.rows] == [f"100, {130 + n}" for n in range(4)]
    assert all(len(row["cells"]) == 4 for row in part._table.rows)
    page._chips.removed = [[100, 131], 1]
    assert (100, 131) not in field.state.pins
    assert page._refusal.text == ""
    page._chips.chosen = [[100, 132], 1]
    assert field.state.pixel == (100, 132)
    eventually(lambda: len(part._table.rows) == 3)


# -- what is taken away ----------------------------------------------------------------------------


def tables_of(view):
    """The numbers of each card of a part of the page, by what its button says it shows."""
    return {
        button.what: columns_of(written(button._show().files["csv"]))
        for button in view.main.select(Download)
        if button.what != "numbers"
    }


@pytest.mark.parametrize("name", ["field", "facade"])
def test_region_pins_and_capture_are_taken_away_as_shown(name, request):
    session = request.getfixturevalue(name)
    pins, region = ((100, 30), (61, 62)), rectangle((40, 44), (30, 33))
    if name == "facade":
        pins = ((10, 30), (61, 62))
    session.state.param.update(pins=pins, region=region)
    cube, n_bins = session.answer.capture.cube, session.answer.capture.acquisition.n_bins
    parts = Sight(session, "region"), Pins(session), Whole(session)
    for part in parts:
        part.view.paint(False)
        part.view.show(True)
    of_region, of_pins, whole = parts
    eventually(lambda: of_region._facts.facts and len(of_pins._table.rows) == 2)
    eventually(lambda: column(whole._counts, "raw", "raw").size == n_bins)

    seen = tables_of(of_region.view)
    for button in of_region.view.main.select(Download):
        assert button._show().subject.part == "rows40-44_cols30-33"
    summed = cube[40:45, 30:34].sum(axis=(0, 1))
    np.testing.assert_array_equal(seen["counts"]["counts"][:n_bins], summed)
    assert {"counts", "rate", "residual and enhanced"} <= seen.keys()

    for pin in pins:
        told = tables_of(of_pins.view)["counts"][f"{pin[0]}, {pin[1]} (counts)"][:n_bins]
        np.testing.assert_array_equal(told, cube[pin])

    told = tables_of(whole.view)["counts"]["counts"][:n_bins]
    np.testing.assert_array_equal(told, cube.sum(axis=(0, 1)))
    for part in parts:
        part.view.show(False)


def test_a_region_that_is_not_drawn_yet_is_not_taken_away_as_if_it_were(facade, monkeypatch):
    part = Sight(facade, "region")
    part.view.show(True)
    facade.state.region = rectangle((40, 44), (30, 33))
    eventually(lambda: part._facts.facts)
    buttons = part.view.main.select(Download)
    assert {each._show().subject.part for each in buttons} == {"rows40-44_cols30-33"}
    monkeypatch.setattr(part._jobs, "submit", lambda *_: None)  # it takes long
    facade.state.region = rectangle((1, 2), (3, 4))
    for each in buttons:
        with pytest.raises(ValueError, match="nothing is drawn here yet"):
            each._show()


# -- the capture as a whole ------------------------------------------------------------------------


def test_the_capture_is_reported_and_suggestions_apply(facade):
    part = Whole(facade)
    part.view.show(True)
    part._study._work.cancel()
    eventually(lambda: part._facts.facts)
    report, capture = part._report, facade.answer.capture
    np.testing.assert_allclose(
        column(part._counts, "raw", "raw"), capture.cube.sum(axis=(0, 1)), rtol=1e-6
    )
    facts = {name: value for name, value, _ in part._facts.facts}
    assert facts["SBR"] == inspector_words.interval(report.flux.sbr)
    assert report.flux_method in part._light.text
    assert facts["Hot pixels"] == str(report.n_hot)
    assert report.suggestion.why_gate in part._advice[0].text
    assert report.suggestion.why_t_n in part._advice[1].text

    first, end = report.suggestion.gate
    delay_s = capture.acquisition.gate_delay_s
    part._apply_gate()
    eventually(lambda: facade.answer.capture is not capture)
    gate = facade.answer.capture.acquisition
    assert gate.n_bins == end - first
    assert gate.gate_delay_s == pytest.approx(delay_s + first * gate.bin_width_s)
    part._follow()
    eventually(lambda: part._reported is facade.answer)
    part._apply_t_n()
    assert facade.state.tracking.t_n == part._report.suggestion.t_n


def test_what_is_no_longer_known_of_a_capture_is_taken_back(facade, monkeypatch):
    part, told = Whole(facade), []
    facade.failures.shown.subscribe(told.append)
    part.view.show(True)
    part._study._work.cancel()
    eventually(lambda: part._facts.facts)

    def fail(_capture):
        raise MemoryError("no more")

    monkeypatch.setattr("core.inspection.capture_report", fail)
    facade.state.less = Less(merge=2)
    eventually(lambda: facade.answer.request.less.merge == 2)
    part._follow()
    eventually(lambda: any(told))
    assert "MemoryError" in " ".join(told)
    assert part._facts.facts == []
    assert {sentence.text for sentence in (part._light, *part._advice)} == {""}
    assert all(each.disabled for each in part._apply)
    part._apply_gate()
    assert facade.answer.request.less == Less(merge=2)


def test_a_gate_is_applied_to_what_is_left_of_the_whole(facade):
    facade.state.less = Less(merge=2, gate_from=0.1)
    eventually(lambda: facade.answer.request.less.merge == 2)
    answer = facade.answer
    suggestion = replace(inspection.capture_report(answer.capture).suggestion, gate=(4, 90))
    less, t_n = with_gate(answer, suggestion)
    whole = answer.whole.acquisition
    opens = round(0.1 * whole.n_bins)
    assert less.reduction(whole.n_bins).gate == (opens + 8, opens + 180)
    assert less.merge == 2
    assert t_n == max(answer.request.tracking.t_n - 4, 0)


def test_accuracy_over_pulses_is_found_step_by_step_and_says_where_one_is(facade):
    part = Whole(facade)
    part.view.show(True)
    part._study._work.cancel()
    works = accuracy_steps(facade.answer)
    found = [works[0](), works[1]()]
    for each in found:
        part._add(each)
    drawn = part._accuracy.source("points").data
    assert drawn["pulses"] == [each.share * 1000 for each in found]
    assert drawn["value"] == [each.within.value for each in found]
    assert "truth" in part._accuracy.figure.yaxis.axis_label
    part._pulses.value = 0.25
    eventually(lambda: facade.answer.capture.acquisition.n_pulses == 250)
    part._follow()
    np.testing.assert_allclose(column(part._accuracy, "answer", "x"), 250)


def test_an_answer_to_pulses_chosen_before_takes_nothing_back(facade):
    part = Whole(facade)
    part.view.show(True)
    before = facade.answer
    for share in (0.5, 0.25):
        part._pulses.value = share
    eventually(lambda: facade.answer is not before)
    facade.estimate.answer = replace(
        facade.answer, request=replace(facade.answer.request, less=Less(pulses=0.5))
    )
    part._follow()
    assert (part._pulses.value, facade.state.less.pulses) == (0.25, 0.25)
    part.view.show(False)


def test_pulses_that_cannot_be_had_are_taken_back(facade, monkeypatch):
    works = compute

    def fails(request, *more):
        if request.less.pulses < 1:
            raise MemoryError
        return works(request, *more)

    monkeypatch.setattr("app.pages.shared.estimate.compute", fails)
    part = Whole(facade)
    part.view.show(True)
    facade.estimate.changed.subscribe(lambda answer: part._follow())
    part._pulses.value = 0.5
    eventually(lambda: part._pulses.value == 1.0)
    assert facade.state.less == Less()
    part.view.show(False)


def test_without_truth_accuracy_is_called_agreement(field):
    (work, *_) = accuracy_steps(field.answer)
    title, across, _ = inspector_words.accuracy_titles(work())
    assert "not accuracy" in title
    assert across == "Share of the pulses"
