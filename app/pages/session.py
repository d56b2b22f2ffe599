"""One user's session: the state, its estimate, and the services shared by all pages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qsl, urlencode

from app.model.address import Link, query_of
from app.model.capture_defaults import defaults_of
from app.model.lessons import Lesson, built_in_lessons
from app.model.restore import (
    described,
    parameters_of,
    parsed,
    places,
    restore,
    still_refused,
)
from app.model.state import State
from app.model.store import Answer, Refused, Request, Source
from app.model.text import no_estimates, refusal
from app.pages.shared.estimate import CurrentEstimate
from app.pages.shared.failures import FailureLog
from app.plots.gate_cut import Cut
from app.tasks.page import PageTasks


class Session:
    """State and services shared by the pages of one user.

    Parameters
    ----------
    sources : mapping of str to Source
        Scenes and captures to choose from; copied, so that an upload belongs to this session only.
    link : Link, optional
        Settings from the link of the page.
    tasks : PageTasks, optional
        The page's thread; by default that of the page being built.
    lessons : mapping of str to Lesson, optional
        Lessons of the page Learn; by default the built-in ones.

    Attributes
    ----------
    state : State
        Everything that the user has chosen.
    lessons : mapping of str to Lesson
    estimate : CurrentEstimate
        The estimate for that state.
    tasks : PageTasks
        The page's thread.
    failures : FailureLog
        The error that the page shows.
    refused : list of str
        A sentence on each setting of the link that could not be restored.
    """

    def __init__(
        self,
        sources: Mapping[str, Source],
        link: Link | None = None,
        tasks: PageTasks | None = None,
        lessons: Mapping[str, Lesson] | None = None,
    ) -> None:
        link = link or Link({})
        self.sources = dict(sources)
        self.lessons = lessons or built_in_lessons()
        key, first = next(iter(self.sources.items()))
        # A session started with a file opens on Inspect.
        self._own = {"source": key, "page": "Explore" if first.is_scene else "Inspect"}
        self.state = State(**self._own)
        self.tasks = tasks or PageTasks()
        self.failures = FailureLog()
        self.tasks.failed.subscribe(self.failures.report)
        first_answer, refused_file = restore(self.state, self.sources, link, self._own)
        self.refused = link.refused
        self.estimate = CurrentEstimate(
            self.state, self.sources, self.tasks, self.failures, first_answer, refused_file
        )
        self._recalled: tuple[Link, str] | None = None
        self._kept: tuple[str, Answer] | None = None
        self._unread: dict[str, Refused | None] = {}
        self._note_unread()
        self.estimate.changed.subscribe(lambda _: self._find_places())
        self.estimate.changed.subscribe(lambda _: self._note_unread())

    @property
    def answer(self) -> Answer:
        """The latest estimate that could be computed."""
        return self.estimate.answer

    @property
    def request(self) -> Request:
        """The request that the state describes."""
        return self.estimate.request

    @property
    def page(self) -> Any:
        """The document that the browser shows; None without a browser."""
        return self.tasks.document

    def query(self) -> str:
        """Return the query of a link to what the page shows."""
        own = self._own | defaults_of(self.answer)
        if not self.answer.request.source.is_scene:
            own["source"] = ""  # always in the link: another server may have another file
        return query_of(self.state, own)

    def request_query(self) -> str:
        """Return the part of the link from which the estimate on screen is computed."""
        return self._query_of(self.answer.request)

    def _query_of(self, request: Request) -> str:
        # The source is always named: an empty query stands for none.
        return query_of(State(**parameters_of(request, self.sources)), {"source": ""})

    def described(self, query: str) -> Request:
        """Return the request that a query of `request_query` describes.

        Raises
        ------
        ValueError
            If its scene or capture is not here.
        """
        return described(query, self.sources, self._own)

    @property
    def kept_answer(self) -> Answer | None:
        """The estimate that was kept as A; None if there is none, or it has not been computed."""
        query, answer = self._kept or ("", None)
        return answer if query == self.state.kept else None

    def keep(self, query: str, answer: Answer) -> None:
        """Keep an estimate as A, which `query` describes."""
        self._kept = query, answer
        self.state.kept = query

    def forget(self) -> None:
        """Forget the estimate that was kept as A, and free its memory."""
        self._kept = None
        self.state.kept = ""

    def is_settled(self) -> bool:
        """Return whether all that was requested is on screen."""
        return self._recalled is None and self.estimate.is_settled

    def recall(self, query: str) -> None:
        """Return to what the page showed when `query` was its link."""
        try:
            link, chosen = parsed(query, self.sources, self._own)
        except ValueError as error:
            self.failures.show(str(error))
            return
        self._recalled = link, chosen["unread"]
        self.estimate.refused = None
        self.failures.clear(no_estimates(self.answer))
        try:
            self.state.param.update(chosen)
        except Exception:
            self._recalled = None
            raise
        if not self.is_settled() and self.estimate.is_settled:  # nothing has to be computed
            self.estimate.changed.emit(self.answer)

    def _note_unread(self) -> None:
        """Keep in the state which file could not be read: a reloaded page asks again."""
        refused = self.estimate.refused
        query = "" if refused is None else self._query_of(refused.request)
        self._unread[query] = refused
        self.state.unread = query

    def _refuse_again(self, query: str, link: Link) -> None:
        """Return to a file that could not be read, and show why."""
        if query not in self._unread:  # refused before the page was loaded
            self._unread[query] = still_refused(query, self.sources, link, self._own)
        refused = self._unread[query]
        if refused is not None:
            self.estimate.refused = refused
            self.failures.put(refusal(refused))

    def go_on_with(self, key: str) -> None:
        """Show another capture with the present settings, pixel and views."""
        entries = dict(parse_qsl(self.query()))
        entries |= {"source": key, "pixel": json.dumps(self.state.pixel), "unread": ""}
        self.recall(urlencode(entries))

    def forget_source(self, key: str) -> None:
        """Remove a file that could not be read."""
        source = self.sources.pop(key)
        self._unread = {
            query: refused
            for query, refused in self._unread.items()
            if refused is None or refused.request.source is not source
        }
        refused = self.estimate.refused
        if refused is not None and refused.request.source is source:
            self.estimate.refused = None

    def _find_places(self) -> None:
        """Return to the recalled pixel, pins, region and views, once their estimate is there."""
        if self._recalled is not None and self.estimate.is_settled:
            (link, unread), self._recalled = self._recalled, None
            self.state.param.update(places(link, self.answer))
            if unread:
                self._refuse_again(unread, link)

    def key(self, source: Source) -> str:
        """Return the key of a source in the catalogue."""
        return next(key for key, known in self.sources.items() if known is source)

    def choose_pixel(self, row: int, col: int) -> None:
        """Show another pixel, or the nearest one inside the image."""
        rows, cols = self.answer.capture.shape
        with self.tasks.hold():  # one message for all consequences
            self.state.pixel = (min(max(row, 0), rows - 1), min(max(col, 0), cols - 1))

    def cut_gate(self, cut: Cut) -> None:
        """Keep the wanted bins of the whole gate, unless they are those of another gate."""
        n_bins = self.answer.whole.acquisition.n_bins
        if cut.n_bins != n_bins:
            return  # dragged before the capture changed
        reduction = self.state.reduction.with_gate(*cut.wanted, n_bins)
        if reduction != self.state.reduction:  # param would announce an equal object
            self.state.reduction = reduction

    def pick(self, index: int) -> None:
        """Show the pixel with this index in the flattened image; -1 is none."""
        if index >= 0:
            self.choose_pixel(*divmod(index, self.answer.capture.shape[1]))

    def scene_id(self) -> str:
        """Return a name that changes when the camera of a 3D cloud should be reset."""
        answer, cutout = self.answer, self.answer.cutout
        acquisition = replace(answer.capture.acquisition, n_pulses=None)
        part = "" if cutout is None else f"{cutout.window} {cutout.read}"
        return f"{self.key(answer.request.source)} {answer.capture.shape} {acquisition} {part}"
