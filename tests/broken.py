"""The app with parts that break, for `tests.test_failures`: ``python -m tests.broken``.

What breaks is asked for by the seed of the simulation, so that another seed mends it.
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


def failing(error: BaseException):
    def fail() -> None:
        raise error

    return fail


AT_SEED = {
    1: failing(MemoryError()),
    2: recursing,
    3: failing(BrokenExecutor("a worker has died")),
    4: failing(SystemExit(1)),
    5: failing(OSError(28, "No space left on device", str(FOLDER / "x"))),
    6: refused,
}
WHEN_DRAWN = 7
WHEN_INSPECTED = (3, 4)
WHEN_TAPPED = (5, 6)

simulate, enter, inspect, choose = (
    app.model.store.simulate,
    app.pages.explore.text.figure_strip,
    app.pages.explore.page.inspect,
    app.pages.session.Session.choose_pixel,
)


def breaking_simulate(*arguments, seed, **options):
    AT_SEED.get(seed, lambda: None)()
    return simulate(*arguments, seed=seed, **options)


def breaking_figures(answer):
    if answer.request.light.seed == WHEN_DRAWN:
        raise KeyError(str(FOLDER))
    return enter(answer)


def breaking_inspect(answer, row, col):
    if (row, col) == WHEN_INSPECTED:
        raise KeyError(str(FOLDER))
    return inspect(answer, row, col)


def breaking_choose(session, row, col):
    if (row, col) == WHEN_TAPPED:
        raise KeyError(str(FOLDER))
    choose(session, row, col)


if __name__ == "__main__":
    app.model.store.simulate = breaking_simulate
    app.pages.explore.text.figure_strip = breaking_figures
    app.pages.explore.page.inspect = breaking_inspect
    app.pages.session.Session.choose_pixel = breaking_choose
    sys.exit(started.main())
