"""Lessons: their files, their checks, and the page that shows them."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from html import escape, unescape

import numpy as np
import panel_material_ui as pmui
import pytest
from playwright.sync_api import Page, expect

from app.handout import handout, main
from app.model.glossary import ANCHOR, glossary, linked
from app.model.lessons import (
    PREDICTED,
    SHAPES,
    SPECS,
    Lesson,
    lesson_of,
    number_of,
    read_lesson,
    read_lessons,
)
from app.model.slides import demonstration, slides_of
from app.model.state import Learning
from app.model.store import built_in_sources
from app.pages.learn.lesson import LessonView
from app.pages.learn.page import Learn, numbered
from app.pages.learn.text import answer_label
from app.pages.session import Session
from app.widgets.qr_code import QrCode, qr_image
from core.parameters import Choice
from core.studies.lessons import CHECKS, NEED_SIGNAL, VIEWS, Bench, require_signal
from tests.browser import VIEWS as BOKEH_VIEWS
from tests.browser import choose, chosen, enter, eventually, field, slider
from tests.states import link_to
from tests.threads import HeldLayout, HeldTasks

LESSONS = read_lessons()
FIRST = "1-first-photon"


# -- files -----------------------------------------------------------------------------------------


@pytest.fixture
def session():
    return Session(built_in_sources(), tasks=HeldTasks())


@pytest.mark.parametrize("key", LESSONS)
def test_a_lesson_leads_from_its_question_to_a_right_answer(key, session):
    lesson, check = LESSONS[key], LESSONS[key].check
    assert lesson.introduction and lesson.explanation
    if lesson.further:
        assert not any(lesson.further in each.text for each in slides_of(lesson))
    for hint in check.hints:
        wrong = replace(check, function=hint.function, arguments=hint.arguments).answer
        assert check.verdict(wrong) == (False, hint.text)
    asked, spec = lesson.prediction, SPECS[lesson.control]
    predicted = str(asked.high) if asked.axis else "flat"
    moved = spec.options[-1] if isinstance(spec, Choice) else str(lesson.ends[1])
    state = Learning(key, predicted, moved, repr(wrong))
    page, session.state.learning = Learn(session), state
    page.show(True)
    session.tasks.run_until(lambda: page.shown.verdict.text == hint.text)
    controls, on_page = page.shown.panel.controls, page.shown.layout.select()
    assert [name for name, each in controls.items() if each in on_page] == [lesson.control]
    views = page.shown.views
    session.tasks.run_until(lambda: all(view.item for view in views.values()))
    plot = views["after", asked.view].item
    assert PREDICTED in {*plot.curves, *plot.marks}
    session.state.learning = replace(state, answer=repr(check.answer))
    session.tasks.run_until(lambda: page.shown.verdict.text.startswith("Right: "))


def test_numbers_of_the_built_in_lessons():
    answers = {key: lesson.check.answer for key, lesson in LESSONS.items()}
    assert [*answers] == sorted(answers, key=lambda key: int(key.partition("-")[0]))
    assert answers[FIRST] == pytest.approx(np.exp(-1.735 / 2), abs=1e-4)
    assert answers["2-more-light"] == pytest.approx(0.115, abs=0.002)
    assert answers["3-coates"] == pytest.approx(np.exp(1.735 * 0.8 / 2), rel=0.05)
    assert answers["4-two-scales"] > 3 * 0.2  # of a fifth of the gate
    assert answers["5-knobs"] == pytest.approx(0.74, abs=0.03)
    assert CHECKS["share_moved_by_cubic"](LESSONS["5-knobs"].bench, 0.1, 30.0) == 0
    found = VIEWS["found_by_t_n"](LESSONS["5-knobs"].bench)
    assert np.interp(52, found.x, found.curves["found"]) == pytest.approx(0.847, abs=0.03)
    assert answers["6-pulses"] == pytest.approx(2.25, abs=0.1)
    pulses = VIEWS["accuracy_by_pulses"](LESSONS["6-pulses"].bench)
    assert np.interp(400, pulses.x, pulses.curves["likelihood"]) == pytest.approx(0.9, abs=0.02)
    assert answers["7-who-wins-where"] == pytest.approx(46, abs=2)
    along = VIEWS["found_along_gate"](LESSONS["7-who-wins-where"].bench)
    at = {name: partial(np.interp, xp=along.x, fp=curve) for name, curve in along.curves.items()}
    assert at["peak"](25) == pytest.approx(0.98, abs=0.015)
    assert at["peak"](80) < 0.02 and at["coates"](80) > 0.97 and at["tracking"](10) == 0
    assert answers["8-confidence"] > 0.98
    sure = VIEWS["reliability_diagram"](LESSONS["8-confidence"].bench)
    assert np.interp(0.85, sure.x, sure.curves["right"]) == pytest.approx(0.85, abs=0.05)
    assert answers["9-real-capture"] == pytest.approx(0.16, abs=0.02)
    assert answers["10-neighbours"] == pytest.approx(0.84, abs=0.03)
    assert answers["11-where-light-comes-from"] == pytest.approx(2 * 0.1041 / 16)


def test_links_of_the_lessons_lead_to_other_pages():
    texts = " ".join(each.explanation + each.further for each in LESSONS.values())
    queries = re.findall(r"\]\(\?([^)]+)\)", texts)
    for query in queries:
        session = Session(built_in_sources(), link_to(query), HeldTasks())
        assert session.refused == []
        assert session.state.page in query
    assert len(queries) > 5


TEXT = """+++
title = "T"
before = ["light"]
after = ["first_photons"]
[state]
background = 2.0
[control]
name = "background"
[prediction]
question = "?"
view = "first_photons"
[check]
question = "?"
function = "share_armed"
arguments = { bin = 50 }
tolerance = 0.01
+++
Before.
---
After.
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("+++\ntitle", "title", "front matter"),
        ('title = "T"', "", "title is missing"),
        ('["light"]', '["os.system"]', "view = 'os.system' is not accepted"),
        ("background = 2.0", "background = -1.0", "background = -1.0 is not accepted"),
        ("background = 2.0", "brightness = 2.0", "state = 'brightness' .* give 'signal' or 'back"),
        ('"T"', '"T"\nauthor = "A"', "front matter = 'author' is not accepted: give 'title' or"),
        ('name = "background"', 'name = "colour"', "control.name = 'colour'"),
        ('view = "first_photons"', 'view = "light"', "prediction.view = 'light'"),
        (
            "[check]",
            '[check]\nview = "light"',
            r"check.view = 'light' .* of after, \['first_photons'\]",
        ),
        ('"share_armed"', '"eval"', "check = 'eval' is not accepted"),
        ('view = "first_photons"', 'view = "first_photons"\nlow = "0"', "prediction: low = '0'"),
        ('"first_photons"', '"car_image"', r"view = 'first_photons' .* a plot of after, \[\]"),
        ("{ bin = 50 }", "{ place = 50 }", "arguments = 'place' is not accepted: give 'bin'"),
        ("{ bin = 50 }", "{ bin = true }", "bin = True is not accepted: give a finite number"),
        ("tolerance = 0.01", "", "check: tolerance is missing$"),
        ("tolerance = 0.01", "tolerance = 0", "tolerance = 0 .* a number above 0"),
        ('name = "background"', 'name = "background"\nfrom = 1.0', "control: to is missing"),
        ('name = "background"', 'name = "background"\nfrom = 3\nto = 2', r"\(3, 2\) .* increasing"),
        ('name = "background"', 'name = "background"\nfrom = 1\nto = 99', "from 0.05 to 20"),
        ('name = "background"', 'name = "preset"\nfrom = 1\nto = 2', "'preset' is not a number"),
        ("[check]", "hints = [1]\n[check]", "entry of prediction = 'hints'"),
        ("tolerance = 0.01", "tolerance = 0.01\nhints = [1]", "hints = 1 .* give a table"),
        ("background = 2.0", "signal = 0\nbackground = 2.0\n[x]", "entry of front matter = 'x'"),
    ],
)
def test_a_lesson_that_is_not_valid_is_refused_by_file_and_entry(tmp_path, old, new, message):
    assert lesson_of("t", TEXT).moved("3").background == 3.0
    path = tmp_path / "mine.md"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(ValueError, match=f"^mine.md: .*{message}"):
        read_lesson(path)


def test_a_folder_adds_lessons(tmp_path):
    with pytest.raises(ValueError, match="--lessons"):
        read_lessons([tmp_path])
    (tmp_path / "mine.md").write_text(TEXT, "utf-8-sig")  # as Notepad does
    assert [*read_lessons([tmp_path])] == [*LESSONS, "mine"]
    (tmp_path / "other.md").write_text(TEXT)
    with pytest.raises(ValueError, match=r"^other\.md: title = 'T' is not accepted"):
        read_lessons([tmp_path])
    (tmp_path / "other.md").rename(tmp_path / f"{FIRST}.md")
    with pytest.raises(ValueError, match=f"file name = .*{FIRST}.md' is not accepted"):
        read_lessons([tmp_path])


@pytest.mark.parametrize("name", [*VIEWS, "best_attenuation"])
def test_what_needs_a_signal_is_refused_without_one(name):
    bench = Bench(signal=0.0)
    compute = VIEWS.get(name) or CHECKS[name]
    if name not in NEED_SIGNAL:
        require_signal(name, bench)
        compute(bench)
        return
    for refused in (compute, partial(require_signal, name)):
        with pytest.raises(ValueError, match=r"signal = 0\.0 is not accepted: give a number above"):
            refused(bench)


def test_without_a_signal_there_is_no_echo():
    plot = VIEWS["estimates_without_echo"](Bench(signal=0.0))
    assert np.nanmax(plot.curves["echoes found"]) < 0.3  # by chance only
    text = TEXT.replace('"background"', '"signal"').replace(
        '["first_photons"]', '["first_photons", "both_scales"]'
    )
    with pytest.raises(ValueError, match="above 0, which 'both_scales' needs"):
        lesson_of("t", text).moved("0")


def test_typed_numbers():
    assert number_of(" 42 % ", "answer") == number_of("0,42", "answer") == 0.42
    with pytest.raises(ValueError, match="exposure = 'many' is not accepted: give a number"):
        LESSONS["2-more-light"].moved("many")


# -- the page without a browser --------------------------------------------------------------------


def test_nothing_is_shown_before_the_prediction(session):
    page = Learn(session)
    page.show(True)
    shown = page.shown
    session.tasks.run_until(lambda: shown.views["before", "light"].item)
    assert not shown.moving.visible and not shown.past.visible  # they follow the prediction
    assert not shown.views["after", "first_photons"].holder.visible
    shown.prediction.value = "falling"
    shown.commit.clicks += 1
    assert session.state.learning == Learning(prediction="falling")
    assert shown.moving.visible
    places = [shown.moving, shown.views["after", "still_armed"].holder, shown.past]
    drawn = shown.layout.select()  # what moves is beside the control, what does not is below
    assert shown.past.visible and sorted(places, key=drawn.index) == places
    assert drawn.index(shown.views["before", "light"].holder) > drawn.index(shown.past)
    session.tasks.run_until(lambda: shown.views["after", "first_photons"].item)
    plot = shown.views["after", "first_photons"].item
    first, last = SHAPES["falling"]
    predicted = plot.curves[PREDICTED]
    assert predicted[0] / predicted[-1] == pytest.approx(first / last)
    shown.panel.controls["background"].value = 5.0
    assert session.state.learning.moved == "5.0"
    moved, constant = shown.views["after", "first_photons"], shown.views["before", "light"]
    assert moved.about().settings == (LESSONS[FIRST].bench,)  # the one still on screen
    session.tasks.run_until(lambda: moved.item is not plot)
    plot, light = moved.item, constant.item
    for answer, feedback in (("0.58", "before bin 50"), ("42 %", "Right")):
        shown.answer.value = answer
        assert session.state.learning.answer == answer
        session.tasks.run_until(lambda feedback=feedback: feedback in shown.verdict.text)
    assert moved.about().settings == (replace(LESSONS[FIRST].bench, background=5.0),)
    assert constant.about().settings == (LESSONS[FIRST].bench,)
    assert (moved.item, constant.item) == (plot, light)  # an answer changes no view


def test_a_failed_check_is_shown_until_a_check_works(session, monkeypatch):
    session.state.learning = Learning(FIRST, "flat", "1.0", "0.42")
    heard = []
    session.failures.shown.subscribe(heard.append)
    page = Learn(session)
    with monkeypatch.context() as broken:
        broken.setitem(CHECKS, "share_armed", lambda *_, **__: 1 / 0)
        page.show(True)
        session.tasks.run_until(lambda: heard)
    after = page.shown.views["after", "still_armed"]
    session.tasks.run_until(lambda: after.item)
    assert "ZeroDivisionError" in heard[-1]
    page.shown.answer.value = "0.43"
    session.tasks.run_until(lambda: "Right" in page.shown.verdict.text)
    assert heard[-1] == ""


def test_a_page_that_is_left_while_it_computes_is_drawn_on_return(session):
    page = Learn(session)
    page.show(True)
    page.show(False)
    session.tasks.run_one()
    light = page.shown.views["before", "light"]
    assert light.item is None
    page.show(True)
    session.tasks.run_until(lambda: light.item)


def test_html_in_a_lesson_is_shown_as_text():
    html = "<script>alert(1)</script>"
    text = TEXT.replace('"T"', f'"{html}"').replace('"?"', f'"{html}"')
    text = text.replace("Before.", html).replace("After.", f"**a** {html}")
    lessons = {"t": lesson_of("t", text)}
    page = Learn(Session(built_in_sources(), tasks=HeldTasks(), lessons=lessons))
    shown = [
        unescape(each.get_root().data.object) for each in page.shown.layout.select(pmui.Typography)
    ]
    assert sum(escape(html) in each for each in shown) == 4
    assert any("<strong>a</strong>" in each for each in shown)
    assert not any("<script" in each for each in shown)


def test_a_link_opens_a_lesson_where_the_learner_was():
    query = "page=Learn&learning.lesson=2-more-light&learning.prediction=0.3&learning.moved=10.0"
    session = Session(built_in_sources(), link_to(query), HeldTasks())
    assert session.refused == []
    page = Learn(session)
    page.show(True)
    assert page.choice.value == page.shown.lesson.key == "2-more-light"
    assert page.shown.prediction.value == "0.3"
    assert page.shown.panel.controls["exposure"].value == 10.0
    heard = []
    session.failures.shown.subscribe(heard.append)
    for learning, refused in (
        (Learning("none such"), "no lesson 'none such'"),
        (Learning("2-more-light", "many"), "'many' is not accepted: give a number"),
        (Learning("2-more-light", "7"), "give a number from 0 to 1"),
        (Learning("2-more-light", moved="-1"), "exposure = -1.0 is not accepted"),
    ):
        session.state.learning = learning
        assert refused in heard[-1]
        assert not page.shown.moving.visible
        count = len(heard)
        page.shown.prediction.value = "flat" if page.shown.lesson.key == FIRST else "0.2"
        page.shown.commit.clicks += 1
        assert page.shown.moving.visible
        assert refused not in "".join(heard[count:])
    session.state.learning = Learning("2-more-light")
    page.shown.prediction.value = ""
    page.shown.commit.clicks += 1
    assert "'nothing' is not accepted: give a number" in heard[-1]


def test_an_unknown_lesson_of_a_link_is_reported_with_the_first_one():
    layout = HeldLayout(built_in_sources(), link_to("page=Learn&learning.lesson=none"))
    assert "no lesson 'none' here" in layout.alert.text
    assert layout.contents["Learn"].shown.lesson.key == FIRST
    assert layout.session.state.learning == Learning()


@pytest.fixture
def presenting(session):
    """The page in presenter mode."""
    session.state.present = 1
    page = Learn(session)
    page.show(True)
    return page


def press(page: Learn, key: str) -> None:
    page.shown.bar.pressed = [key, page.shown.bar.pressed[1] + 1]


def test_a_lecturer_goes_through_the_demonstration_slide_by_slide(presenting):
    state, seen = presenting.session.state, []
    keys = demonstration(LESSONS)
    while (place := (presenting.shown.lesson.key, state.learning.step)) not in seen[-1:]:
        seen.append(place)
        press(presenting, "next")
    assert seen == [(key, at) for key in keys for at in range(len(slides_of(LESSONS[key])))]
    press(presenting, "1")
    assert state.learning == Learning(FIRST)
    press(presenting, "reveal")
    first_revealed = presenting.shown.slides[state.learning.step]
    assert first_revealed.view == ("after", LESSONS[FIRST].after[0])
    press(presenting, "reveal")
    press(presenting, "back")
    assert presenting.shown.slides[state.learning.step].reveals
    press(presenting, "end")
    assert not state.present
    assert isinstance(presenting.shown, LessonView)


def test_a_slide_is_legible_across_a_room(presenting):
    for name in LESSONS[FIRST].after:
        press(presenting, "reveal")
        shown = presenting.shown.views["after", name]
        presenting.session.tasks.run_until(lambda shown=shown: shown.item)
        (figure,) = shown.figures
        axis, legend = figure.xaxis[0], figure.legend[0]
        sizes = (axis.axis_label_text_font_size, axis.major_label_text_font_size)
        assert {*sizes, legend.label_text_font_size} == {"24px"}
        widths = [each.glyph.line_width for each in figure.renderers]
        assert all(width >= 3 for width in widths if width)  # bars have no line


def test_the_answer_of_a_check_is_computed_when_it_is_revealed(presenting):
    slides, answer = presenting.shown.slides, f"{LESSONS[FIRST].check.answer:.3g}"
    moved = Learning(FIRST, "flat", "5.0", step=len(slides) - 2)
    presenting.session.state.learning = moved
    text = presenting.shown.layout[1]
    assert "?" in text.object and answer not in text.object
    read = presenting.shown.views["check", "still_armed"]  # the plot that the question is about
    presenting.session.tasks.run_until(lambda: read.item)
    assert read.bench == LESSONS[FIRST].check.bench
    presenting.session.state.learning = replace(moved, step=len(slides) - 1)
    presenting.session.tasks.run_until(lambda: answer in text.object)
    assert read.holder in presenting.shown.layout[3]


def test_a_link_leads_to_a_slide_and_one_beyond_the_last_to_the_last(session):
    layout = HeldLayout(built_in_sources(), link_to("page=Learn&present=1&learning.step=99"))
    assert layout.session.refused == []
    shown = layout.contents["Learn"].shown
    assert shown.bar.place == f"{len(shown.slides)} / {len(shown.slides)}"
    refused = link_to("page=Learn&present=1&learning.step=1.5")
    assert (
        "learning.step = 1.5 is not accepted" in HeldLayout(built_in_sources(), refused).alert.text
    )


# -- glossary, handout and QR code -----------------------------------------------------------------


def test_the_first_occurrence_of_a_term_opens_its_entry():
    found = linked("# Pile-up\n\nTwo pulses pile up. *Pile-up*: `bin`, [a gate](x), gates, pulse.")
    pulse, pile_up, gate = (f"]({ANCHOR}{key})" for key in ("pulse", "pile-up", "gate"))
    assert found == (
        f"# Pile-up\n\nTwo [pulses{pulse} [pile up{pile_up}. *Pile-up*: `bin`, [a gate](x), "
        f"[gates{gate}, pulse."
    )
    assert linked("the signal-to-background\nratio").endswith(f"ratio]({ANCHOR}sbr)")


def test_the_glossary_explains_terms_of_the_lessons():
    terms = glossary()
    assert len(terms) >= 25
    assert len({each.key for each in terms}) == len(terms)
    assert all(each.meaning.endswith(".") for each in terms)
    texts = " ".join(each.introduction + each.explanation for each in LESSONS.values())
    assert linked(texts).count(ANCHOR) > 10


def test_a_handout_has_room_for_answers_and_the_key_has_the_answers(tmp_path):
    first = LESSONS[FIRST]
    answer = f"<strong>{first.check.answer:.3g}</strong>"
    sheet, key = handout([first], 3), handout([first], 3, is_key=True)
    assert "Your answer" in sheet and answer not in sheet
    assert answer in key and all(escape(hint.text) in key for hint in first.check.hints)
    assert "http" not in re.sub(r"data:image[^\"]*", "", sheet + key)  # needs no network
    keys = (handout([LESSONS["10-neighbours"]], each, is_key=True) for each in (3, 4))
    pictures = [re.findall(r'src="([^"]*)"', each) for each in keys]
    same = [one == other for one, other in zip(*pictures, strict=True)]
    assert same == [False, True, True]  # the student's own data, then two of what the app shows
    assert "In the app, set Coates correction to off or on." in handout([LESSONS["3-coates"]])
    path = tmp_path / "mine.html"
    assert main([FIRST, "--student", "3", "--key", "-o", str(path)]) == 0
    assert path.read_text("utf-8") == key


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["9-none"], "LESSON = '9-none' is not accepted: give 1-first-photon"),
        (["--student", "-1"], "seed = -1 is not accepted"),
        (["-o", "nowhere/x.html"], "nowhere"),
    ],
)
def test_a_handout_that_cannot_be_made_is_refused(
    capsys, monkeypatch, tmp_path, arguments, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main([FIRST, *arguments] if arguments[0].startswith("-") else arguments)
    assert message in capsys.readouterr().err


def test_a_qr_code_is_an_image_and_long_links_have_none():
    assert qr_image("http://lab.example.org/?page=Learn").startswith("data:image/svg+xml")
    code = QrCode()
    code.asked = ["x" * 2000, 7]
    assert code.image == ["", 7]
    assert "at most 600 characters" in code.problem


# -- in a browser ----------------------------------------------------------------------------------


def fill_the_histogram(here: Page) -> None:
    """Add pulses one by one, play, pause, and show all of them, by keyboard."""
    player = here.get_by_role("group", name=re.compile("^Histogram that fills"))
    said = player.get_by_role("status")
    expect(said).to_contain_text("Pulse 1 of 1,000")
    player.press("ArrowRight")
    expect(said).to_contain_text("Pulse 2 of 1,000")
    here.emulate_media(reduced_motion="no-preference")
    player.press("Space")
    expect(said).to_contain_text(re.compile(r"Pulse \d{2,3} of"))
    player.press("Space")
    expect(player.get_by_role("button", name="Play")).to_be_visible()
    player.press("Home")
    expect(said).to_contain_text("Pulse 1 of 1,000")
    here.emulate_media(reduced_motion="reduce")
    player.press("Space")
    expect(said).to_contain_text("Pulse 1,000 of 1,000")


def present_the_first_lesson(here: Page) -> None:
    """Step through slides on a projector by keyboard, and return."""
    here.set_viewport_size({"width": 1024, "height": 768})
    here.get_by_role("button", name=re.compile("^Present:")).press("Enter")
    slides = here.get_by_role("navigation", name="Slides")
    expect(slides.get_by_role("status")).to_have_text("1 / 8")
    expect(here.get_by_role("button", name="Toggle theme")).to_be_hidden()
    here.keyboard.press("ArrowRight")
    expect(slides.get_by_role("status")).to_have_text("2 / 8")
    here.keyboard.press("r")
    said = here.get_by_role("status").filter(has_text="Pulse")
    expect(said).to_contain_text("Pulse 1 of 1,000")
    here.keyboard.press("Space")
    expect(said).to_contain_text("Pulse 1,000 of 1,000")
    assert least_type(here) >= 24
    here.set_viewport_size({"width": 390, "height": 844})
    eventually(lambda: here.locator(".bk-Legend").evaluate_all(LEGENDS_FIT))
    here.set_viewport_size({"width": 1024, "height": 768})
    here.keyboard.press("b")
    expect(slides.locator(".blank")).to_be_visible()
    here.keyboard.press("b")
    here.keyboard.press("2")
    expect(here.get_by_role("heading", name="More light, worse picture")).to_be_visible()
    expect(here.get_by_text("The car at a signal")).to_be_visible()
    assert least_type(here) >= 24
    here.keyboard.press("Escape")
    expect(here.get_by_role("button", name="Toggle theme")).to_be_visible()


def present_slides_on_a_phone(here: Page) -> None:
    """Expect the caption of each slide below the axis, and return from the slides."""
    here.get_by_role("button", name=re.compile("^Present:")).press("Enter")
    place = here.get_by_role("navigation", name="Slides").get_by_role("status")
    for key, *numbers in (("ArrowRight", 1, 2, 3, 4), ("ArrowLeft", 5, 4, 3, 2)):
        for number in numbers:
            expect(place).to_have_text(f"{number} / 8")
            if number < 5:
                eventually(lambda: here.evaluate(PAINTED))
            here.keyboard.press(key)
    expect(place).to_have_text("1 / 8")
    here.keyboard.press("Escape")


PAINTED = f"""() => {{ {BOKEH_VIEWS}
  const plots = views.filter((each) => each.model.type === "Figure" && each.bbox.height > 0);
  return plots.length > 0 && plots.every(({{ frame, bbox }}) => frame.bbox.bottom < bbox.height);
}}"""
"""JavaScript: whether plots are painted within their place, the axis below the frame, too."""

LEGENDS_FIT = """all => all.length > 0 && all.every((each) => {
  const { left, right } = each.getBoundingClientRect();
  return 0 <= left && right <= innerWidth;
})"""

TYPE = "p:not(:empty), h1, h6, nav span, button:not([aria-label^=Reset]), input[type=text], .label"
FONT_SIZES = """all => all.map((each) =>
  parseFloat(getComputedStyle(each).fontSize) * each.currentCSSZoom)"""


def least_type(here: Page) -> float:
    """Return the size of the smallest type on a slide, in pixels."""
    sizes: list[float] = here.locator(TYPE).filter(visible=True).evaluate_all(FONT_SIZES)
    return min(sizes)


def look_up_a_term(here: Page) -> None:
    """Open the glossary from a dotted word, and close it, by keyboard."""
    here.get_by_role("link", name="bin", exact=True).first.press("Enter")
    glossary = here.get_by_role("dialog", name="Glossary")
    expect(glossary.get_by_text("Interval of the gate")).to_be_in_viewport()
    here.keyboard.press("Escape")
    expect(glossary).to_be_hidden()


def take_the_first_lesson(here: Page) -> None:
    """Predict, move the control and answer, wrongly and then rightly, by keyboard."""
    expect(here.get_by_text("Now move this control")).to_be_hidden()
    look_up_a_term(here)
    here.get_by_role("button", name="falling", exact=True).press("Enter")
    predict = here.get_by_role("button", name=re.compile("^Predict"))
    predict.press("Enter")
    expect(here.get_by_text("Now move this control")).to_be_visible()
    expect(predict).to_be_disabled()
    fill_the_histogram(here)
    moved = slider(here, "Background (per pulse)").filter(visible=True)
    moved.press("ArrowRight")
    expect(here.get_by_text("The light has no slope")).to_be_visible()
    for answer, feedback in (("0.58", "before bin 50"), ("0.42", "Right: 0.42.")):
        enter(here, "Your answer", answer)
        expect(here.get_by_role("status").filter(has_text=feedback)).to_be_visible()
    eventually(lambda: "learning.answer=0.42" in here.evaluate("location.href"))
    here.set_viewport_size({"width": 390, "height": 844})
    here.reload()
    expect(here.get_by_role("status").filter(has_text="Right: 0.42.")).to_be_visible()
    present_slides_on_a_phone(here)
    present_the_first_lesson(here)


def move_the_control(here: Page, lesson: Lesson) -> None:
    """Move the one control of a lesson by one step, by keyboard."""
    spec = SPECS[lesson.control]
    if isinstance(spec, Choice):
        chosen(here, spec.symbol).press("Enter")
        expect(here.get_by_role("menuitem").first).to_be_visible()
        is_last = getattr(lesson.bench, lesson.control) == spec.options[-1]
        here.keyboard.press("ArrowUp" if is_last else "ArrowDown")
        here.keyboard.press("Enter")
    else:
        label = f"{spec.symbol} ({spec.unit})" if spec.unit else spec.symbol
        slider(here, label).filter(visible=True).press("ArrowRight")


def take(here: Page, lesson: Lesson) -> None:
    """Go from the question of a lesson to a wrong and a right answer, by keyboard."""
    expect(here.get_by_role("heading", name=lesson.title)).to_be_visible()
    expect(here.get_by_text("Now move this control")).to_be_hidden()
    asked = lesson.prediction
    if asked.axis:
        field(here, answer_label(asked.unit)).press_sequentially(f"{asked.high:g}")
        here.keyboard.press("Enter")
    else:
        here.get_by_role("button", name="flat", exact=True).press("Enter")
        here.get_by_role("button", name=re.compile("^Predict")).press("Enter")
    expect(here.get_by_text("Now move this control")).to_be_visible()
    move_the_control(here, lesson)
    check, hint = lesson.check, lesson.check.hints[0]
    wrong = replace(check, function=hint.function, arguments=hint.arguments).answer
    for answer, said in ((wrong, hint.text), (check.answer, "Right: ")):
        enter(here, "Your answer", repr(answer))
        expect(here.get_by_role("status").filter(has_text=said)).to_be_visible()


def take_lessons_of_every_kind(here: Page) -> None:
    """Take the first lesson, and one of each other kind, one after the other."""
    take_the_first_lesson(here)
    kinds = {}
    for lesson in LESSONS.values():
        kind = bool(lesson.prediction.axis), isinstance(SPECS[lesson.control], Choice)
        kinds.setdefault(kind, lesson)
    _, *others = kinds.values()
    for lesson in others:
        choose(here, "Lesson", numbered(lesson))
        take(here, lesson)
