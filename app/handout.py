"""Print lessons: ``python -m app.handout [lessons]``.

Writes one HTML file that needs no network, to be printed on A4: each lesson with boxes for the
predictions and blank axes to sketch on. With --key, the teacher's key to the same sheets.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt

from app.model.lessons import (
    SHAPES,
    SPECS,
    Item,
    Lesson,
    add_lessons_option,
    read_lessons,
)
from core.checks import require
from core.parameters import Choice
from core.studies.lessons import CHECKS, PLOTS, Bench
from core.studies.pulses import Pulses
from core.studies.report import picture

STYLE = """
@page { size: A4; margin: 14mm 16mm; }
body { font: 11pt/1.4 system-ui, sans-serif; color: #000; max-width: 178mm; margin: 0 auto; }
section { break-after: page; }
section:last-child { break-after: auto; }
h1 { font-size: 17pt; margin: 0 0 2mm; }
h2 { font-size: 12pt; margin: 0 0 1mm; }
.who { display: flex; gap: 6mm; margin: 0 0 4mm; }
.who span { flex: 1; border-bottom: 0.3mm solid #000; }
.who span:last-child { flex: 0 1 auto; border: 0; }
.part { break-inside: avoid; margin-top: 4mm; padding: 3mm 4mm; border: 0.4mm solid #000;
  border-radius: 2mm; }
.part p { margin: 0 0 2mm; }
figure { margin: 2mm 0 0; }
figure img { display: block; max-width: 100%; max-height: 105mm; margin: 0 auto; }
figcaption { font-size: 9pt; color: #333; margin-bottom: 2mm; }
.line { display: inline-block; min-width: 35mm; border-bottom: 0.3mm solid #000; }
.ruled { height: 8mm; border-bottom: 0.2mm solid #888; }
.key { color: #a4133c; }
table { border-collapse: collapse; font-size: 10pt; }
th, td { padding: 1mm 3mm; border: 0.2mm solid #888; text-align: left; vertical-align: top; }
"""

CIRCLE = "Circle the first photon of each pulse, and count them in the histogram."

_MARKDOWN = MarkdownIt("commonmark", {"html": False})


def main(arguments: list[str] | None = None) -> int:
    """Write the handout; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m app.handout",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "chosen",
        nargs="*",
        metavar="LESSON",
        help="name of a lesson's file without .md; by default all",
    )
    parser.add_argument("--key", action="store_true", help="the teacher's key, with all answers")
    parser.add_argument(
        "--student",
        type=int,
        default=0,
        metavar="N",
        help="number of the student: the seed of the data that are printed (default: 0)",
    )
    add_lessons_option(parser)
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("handout.html"), help="default: handout.html"
    )
    given = parser.parse_args(arguments)
    try:
        lessons = read_lessons(given.lessons)
        for each in given.chosen:
            require("LESSON", each, each in lessons, ", ".join(lessons))
        wanted = [lessons[each] for each in given.chosen or lessons]
        given.output.write_text(handout(wanted, given.student, given.key), "utf-8")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(given.output)
    return 0


def handout(lessons: Sequence[Lesson], student: int = 0, is_key: bool = False) -> str:
    """Return the sheets of lessons as an HTML page.

    Parameters
    ----------
    lessons : sequence of Lesson
    student : int
        Number of the student, which is the seed of the data that are printed.
    is_key : bool
        Whether answers are printed instead of blank space.

    Raises
    ------
    ValueError
        If the number cannot be a seed.
    """
    sheets = "".join(_sheet(each, student, is_key) for each in lessons)
    title = "Lessons: the teacher's key" if is_key else "Lessons"
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body>{sheets}</body></html>\n"
    )


def _sheet(lesson: Lesson, student: int, is_key: bool) -> str:
    bench = replace(lesson.bench, seed=student)
    who = "Teacher's key" if is_key else "Name <span></span> Date <span></span>"
    return (
        f'<section><h1>{escape(lesson.title)}</h1><p class="who">{who}'
        f"<span>Student {student}</span></p>{_MARKDOWN.render(lesson.introduction)}"
        + "".join(_figure(lesson.seen(name, bench, None)) for name in lesson.before)
        + _part("Predict", _prediction(lesson, is_key))
        + _part("Observe", _observation(lesson, bench, is_key))
        + _part("Check", _check(lesson, is_key))
        + "</section>"
    )


def _prediction(lesson: Lesson, is_key: bool) -> str:
    """Return the question, room for an answer, and blank axes; in the key, what happens.

    It is what the app shows, whatever the student's number.
    """
    asked = lesson.prediction
    seen = lesson.seen(asked.view, lesson.bench, None)
    if is_key:
        return _rendered(asked.question) + _figure(seen)
    if asked.axis:
        room = f"Your prediction: {_LINE} {escape(asked.unit)}"
    else:
        room = " &emsp; ".join(f"☐ {each}" for each in SHAPES)
    sketch = "Sketch it before you go on; draw over it, in another colour, what happens."
    return _rendered(asked.question) + f"<p>{room}</p><p>{sketch}</p>" + _figure(seen, True)


def _observation(lesson: Lesson, bench: Bench, is_key: bool) -> str:
    """Return what to do and room for notes; in the key, the other views and the explanation."""
    others = [name for name in lesson.after if name != lesson.prediction.view]
    seen = {name: lesson.seen(name, bench, None) for name in others if name not in PLOTS}
    exercises = "".join(
        f"<p>{CIRCLE}</p>{_figure(each, is_blank=not is_key)}"
        for each in seen.values()
        if isinstance(each, Pulses)
    )
    question = _rendered(f"In the app, {_moving(lesson)} What happens, and why?")
    if not is_key:
        return exercises + question + '<p class="ruled"></p>' * 4
    moved = _moved(lesson)
    plots = "".join(
        _figure(lesson.seen(name, moved, None))
        for name in others
        if not isinstance(seen.get(name), Pulses)
    )
    return exercises + question + plots + _MARKDOWN.render(lesson.explanation)


def _moving(lesson: Lesson) -> str:
    """Return the rest of a sentence about the one control."""
    spec = SPECS[lesson.control]
    if isinstance(spec, Choice):
        return f"set {spec.symbol} to {' or '.join(spec.options)}."
    low, high = lesson.ends or (spec.low, spec.high)
    return f"move {spec.symbol} from {low:g} to {high:g} {spec.unit}".rstrip() + "."


def _moved(lesson: Lesson) -> Bench:
    """Return the state at the end of the control's range, or with its next option."""
    spec, present = SPECS[lesson.control], getattr(lesson.bench, lesson.control)
    if isinstance(spec, Choice):
        value: Any = next(each for each in spec.options if each != present)
    else:
        value = (lesson.ends or (spec.low, spec.high))[1]
    return replace(lesson.bench, **{lesson.control: value})


def _check(lesson: Lesson, is_key: bool) -> str:
    """Return the question and room for the answer; in the key, the right and wrong answers."""
    check = lesson.check
    if not is_key:
        return _rendered(check.question) + f"<p>Your answer: {_LINE}</p>"
    wrong = "".join(
        f"<tr><td>{CHECKS[hint.function](check.bench, **hint.arguments):.3g}</td>"
        f"<td>{escape(hint.text)}</td></tr>"
        for hint in check.hints
    )
    hints = f"<table><tr><th>Wrong answer</th><th>What to say</th></tr>{wrong}</table>"
    return (
        _rendered(check.question)
        + f'<p class="key"><strong>{check.answer:.3g}</strong>, accepted within '
        f"{check.tolerance:g}</p>" + (hints if wrong else "")
    )


_LINE = '<span class="line">&nbsp;</span>'


def _part(title: str, content: str) -> str:
    return f'<div class="part"><h2>{title}</h2>{content}</div>'


def _rendered(text: str) -> str:
    return str(_MARKDOWN.render(text))


def _figure(item: Item, is_blank: bool = False) -> str:
    title, note = escape(item.title), "" if is_blank else escape(item.note)
    source = picture(item, is_blank)
    return f'<figure><img src="{source}" alt="{title}"><figcaption>{note}</figcaption></figure>'


if __name__ == "__main__":
    sys.exit(main())
