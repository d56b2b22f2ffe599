"""Texts of the Learn page."""

from __future__ import annotations

LESSON_HELP = "Each lesson asks first, and shows what happens after your prediction."

COMMIT_HELP = "Predict: the prediction stays drawn on the plot."
SHAPES_HELP = "Shape that you expect along the gate."
NOTHING = "nothing"  # predicted where the field is empty
AGAIN_HELP = "Start again: clear the prediction and the answer of this lesson."
CHECK_HELP = "Check: compares your answer with a computation."

PRESENT_HELP = "Present: this lesson in the whole window, one slide at a time, by keyboard."
DEMONSTRATION_HELP = "Twenty-minute demonstration: lessons 1, 2, 4 and 7 as slides."

MOVE = "Now move this control; everything else stays the same."
PAST = "Before the control was moved:"

NO_SIDEBAR = "This page has its own controls; the other pages' controls are hidden."


def answer_label(unit: str) -> str:
    """Return the label of the field for a predicted number."""
    return f"Your prediction ({unit})" if unit else "Your prediction"


def no_lesson(key: str) -> str:
    """Return the message about a lesson of a link that does not exist."""
    return f"There is no lesson {key[:40]!r} here: the first one is shown."
