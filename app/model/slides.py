"""Lessons as slides, for a lecturer: one plot and one text at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from app.model.lessons import Lesson, number_of_lesson

DEMONSTRATION = (1, 2, 4, 7)
"""Numbers of the lessons for a demonstration of twenty minutes."""


@dataclass(frozen=True)
class Slide:
    """One step of a lesson."""

    text: str = ""
    """Markdown."""
    view: tuple[str, str] | None = None
    """``"before"``, ``"after"`` or ``"check"``, and the name of a view."""
    asks: bool = False
    """Whether it asks for the prediction."""
    reveals: bool = False
    """Whether it answers what an earlier slide asked."""
    answers: bool = False
    """Whether it shows the computed answer of the check."""


def slides_of(lesson: Lesson) -> tuple[Slide, ...]:
    """Return the slides of a lesson: introduction, question, views, explanation, check, answer."""
    before = [("before", name) for name in lesson.before]
    asked = before[-1] if before else None
    check, read = lesson.check, ("check", lesson.check.view)
    return (
        Slide(lesson.introduction, before[0] if before else None),
        *(Slide(view=each) for each in before[1:]),
        Slide(lesson.prediction.question, asked, asks=True),
        *(Slide(view=("after", name), reveals=True) for name in lesson.after),
        Slide(lesson.explanation, ("after", lesson.prediction.view)),
        Slide(check.question, read),
        Slide(check.question, read, reveals=True, answers=True),
    )


def next_revealed(slides: tuple[Slide, ...], step: int) -> int:
    """Return the next slide that reveals something, or the same one if there is none."""
    return next((at for at, each in enumerate(slides) if at > step and each.reveals), step)


def by_digit(keys: Iterable[str]) -> dict[str, str]:
    """Return the lesson that each digit opens: that of its number, 0 for lesson 10."""
    numbers = {key: number_of_lesson(key) for key in keys}
    return {str(n % 10): key for key, n in numbers.items() if n is not None and 1 <= n <= 10}


def demonstration(keys: Iterable[str]) -> list[str]:
    """Return the lessons of the demonstration that exist."""
    return [key for key in keys if number_of_lesson(key) in DEMONSTRATION]


def following(keys: Iterable[str], key: str, by: int) -> str | None:
    """Return the lesson after another, `by` steps on, in the demonstration or among all lessons."""
    order = [*keys]
    if key in demonstration(order):
        order = demonstration(order)
    at = order.index(key) + by
    return order[at] if 0 <= at < len(order) else None
