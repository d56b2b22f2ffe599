"""What goes wrong is told by the page in words, and the next move works."""

from __future__ import annotations

import asyncio
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor

import pytest

from app import ranking_words, words
from app.jobs import LatestWins
from core import CaptureError
from tests.broken import AT_SEED, WHEN_DRAWN, WHEN_INSPECTED, WHEN_TAPPED
from tests.browser import ROOT, serving
from tests.load import opened


@pytest.fixture(scope="module")
def broken():
    """Where the app is served whose parts break."""
    with serving(module="tests.broken") as running_at:
        yield running_at


def provoke(address, break_it, mend_it):
    """What the page says when something is broken, and when it has been mended."""

    async def session():
        wire, _ = await opened(address, seed=0)
        alert = wire.find("Sentence", warning=True)
        said = []
        for act, is_over in ((break_it, bool), (mend_it, lambda text: not text)):
            await act(wire)
            async with asyncio.timeout(60), wire.news:
                await wire.news.wait_for(lambda is_over=is_over: is_over(text(wire, alert)))
            said.append(text(wire, alert))
        wire.close()
        assert all(str(ROOT) not in trouble for trouble in wire.troubles)
        return said

    return asyncio.run(session())


def text(wire, sentence):
    return wire.values.get((sentence, "text"), "")


def moving(kind, attribute, value, **attributes):
    async def move(wire):
        await wire.set(wire.find(kind, **attributes), attribute, value)

    return move


@pytest.mark.parametrize("seed", [*AT_SEED, WHEN_DRAWN])
def test_an_answer_that_fails_is_told_and_the_next_move_works(broken, seed):
    said, mended = provoke(
        broken,
        moving("Knob", "value", seed, label="Seed"),
        moving("Knob", "value", 99, label="Seed"),
    )
    assert "The picture still shows" in said
    assert str(ROOT) not in said and "Traceback" not in said
    assert mended == ""


def test_a_callback_that_fails_is_told_and_the_next_works(broken):
    for row, col in (WHEN_INSPECTED, WHEN_TAPPED):
        said, _ = provoke(
            broken,
            moving("PixelKeys", "pixel", [row, col]),
            moving("Knob", "value", 98, label="Seed"),
        )
        assert "KeyError" in said
        assert str(ROOT) not in said


class Dead(ThreadPoolExecutor):
    """Workers of which none is left."""

    def submit(self, *_):
        raise BrokenExecutor("no worker is left")


def test_where_no_worker_is_left_the_page_is_told_of_each_request():
    told = []
    jobs = LatestWins(lambda act: act(), Dead())
    for _ in range(3):
        jobs.submit(lambda: 1, told.append, told.append)
    assert [type(each) for each in told] == [BrokenExecutor] * 3


def test_files_have_names_and_no_folders():
    for path, name in (
        ("/srv/data/secret/face.mat", "face.mat"),
        ("'/srv/my data/fa ce.mat'", "'fa ce.mat'"),
        ('"/srv/a/b.npz"', '"b.npz"'),
    ):
        told = f"it.mat: cannot be read ({path}: 3.5 counts/s, 1/2/3, m/s): give another"
        kept = f"it.mat: cannot be read ({name}: 3.5 counts/s, 1/2/3, m/s): give another"
        assert words.without_folders(told) == kept
        for say in (words.failure, ranking_words.problem):
            assert "/srv" not in say(CaptureError(told))
            assert "/srv" not in say(OSError(told))
