"""A page's thread under control of a test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from queue import SimpleQueue
from typing import Any

from app.model.address import Link
from app.model.store import Answer, Source
from app.model.uploads import Uploads
from app.pages.layout import Arrivals, Layout
from app.pages.session import Session
from app.tasks.page import PageTasks
from app.tasks.scheduler import Act


class HeldTasks(PageTasks):
    """Holds callbacks of a page until the test runs them.

    Attributes
    ----------
    waiting : SimpleQueue
        Callbacks in the order in which their turns have come.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waiting: SimpleQueue[Act] = SimpleQueue()

    def queue(self, act: Act, due: Act | None = None) -> None:
        """Keep a callback; its turn has come."""
        if due is not None:
            due()
        self.waiting.put(act)

    def run_one(self) -> None:
        """Run the next callback; wait for it if necessary."""
        self.waiting.get(timeout=60)()

    def run_until(self, holds: Callable[[], object]) -> None:
        """Run callbacks until something is so."""
        while not holds():
            self.run_one()


class HeldLayout(Layout):
    """The app without a browser, its page's thread under control of the test.

    Attributes
    ----------
    heard : list of str
        Every sentence on failures, the latest last; empty ones where all works.
    """

    def __init__(
        self,
        sources: Mapping[str, Source],
        wanted: Link | None = None,
        uploads: Uploads | None = None,
        arrivals: Arrivals | None = None,
    ) -> None:
        self.tasks = HeldTasks()
        super().__init__(sources, wanted, uploads, self.tasks, arrivals)
        self._own_sources = frozenset(self.session.sources)
        self.heard = [""]
        self.session.failures.shown.subscribe(self.heard.append)
        self._answers: list[Answer] = []
        self.session.estimate.changed.subscribe(self._answers.append)

    def next_answer(self) -> Answer:
        """Let the page draw until a request is answered; return the answer that is shown then."""
        before = len(self._answers)
        while len(self._answers) == before:
            self.tasks.run_one()
        return self._answers[-1]

    def restart(self) -> None:
        """Return to what the page showed first: building it again would take a second."""
        self.session.recall("")
        self.tasks.run_until(self.session.is_settled)
        self.settle()
        for key in self.session.sources.keys() - self._own_sources:
            del self.session.sources[key]
        self.heard[:] = [""]

    def settle(self) -> None:
        """Let the page do all that is waiting now."""
        while not self.tasks.waiting.empty():
            self.tasks.run_one()


def change(session: Session, **chosen: Any) -> None:
    """Change the state, and wait for the estimate."""
    before = session.answer
    session.state.param.update(**chosen)
    assert isinstance(session.tasks, HeldTasks)
    session.tasks.run_until(lambda: session.answer is not before)


def control(layout: Layout, label: str) -> Any:
    """The one widget of this label."""
    (found,) = layout.page.select(lambda each: getattr(each, "label", None) == label)
    return found
