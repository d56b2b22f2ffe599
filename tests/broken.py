"""The app with parts that fail, for `tests.test_failures`: ``python -m tests.broken``.

The seed of the simulation selects what fails, so that another seed works.
"""

from __future__ import annotations

import sys
from concurrent.futures import BrokenExecutor
from pathlib import Path

import app.model.store
import app.pages.explore.page
import app.pages.session
from app import __main__ as started
from core import CaptureError
from core.checks import refusing

FOLDER = Path(__file__).resolve().parent


def refused() -> None:
    with refusing(FOLDER / "x <b>.npz", CaptureError):
        (FOLDER / "no such folder" / "x <b>.npz").open()


def recursing() -> None:
    recursing()


def raising(error: BaseException):
    def fail() -> None:
        raise error

    return fail


AT_SEED = {
    1: raising(MemoryError()),
    2: recursing,
    3: raising(BrokenExecutor("a worker has died")),
    4: raising(SystemExit(1)),
    5: raising(OSError(28, "No space left on device", str(FOLDER / "x"))),
    6: refused,
}
WHEN_DRAWN = 7
WHEN_INSPECTED = (3, 4)
WHEN_TAPPED = (5, 6)


def failing_where(works, is_failing):
    """Return a function that raises where its arguments say so."""

    def work(*arguments, **options):
        if is_failing(*arguments, **options):
            raise KeyError(str(FOLDER))
        return works(*arguments, **options)

    return work


simulate = app.model.store.simulate


def failing_simulate(*arguments, seed, **options):
    AT_SEED.get(seed, lambda: None)()
    return simulate(*arguments, seed=seed, **options)


if __name__ == "__main__":
    page, session = app.pages.explore.page, app.pages.session.Session
    app.model.store.simulate = failing_simulate
    page.text.figure_strip = failing_where(
        page.text.figure_strip, lambda answer: answer.request.light.seed == WHEN_DRAWN
    )
    page.inspect = failing_where(page.inspect, lambda _, *pixel: pixel == WHEN_INSPECTED)
    session.choose_pixel = failing_where(
        session.choose_pixel, lambda _, *pixel: pixel == WHEN_TAPPED
    )
    sys.exit(started.main())
