"""One user's session: the state, its estimate, and the services shared by all pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from app.model.address import Link, query_of
from app.model.capture_defaults import defaults_of
from app.model.restore import restore
from app.model.state import State
from app.model.store import Answer, Source
from app.pages.shared.estimate import CurrentEstimate
from app.pages.shared.failures import FailureLog
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

    Attributes
    ----------
    state : State
        Everything that the user has chosen.
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
    ) -> None:
        link = link or Link({})
        self.sources = dict(sources)
        key, first = next(iter(self.sources.items()))
        # A session started with a file opens on Inspect.
        self._own = {"source": key, "page": "Explore" if first.is_scene else "Inspect"}
        self.state = State(**self._own)
        self.tasks = tasks or PageTasks()
        self.failures = FailureLog()
        self.tasks.failed.subscribe(self.failures.report)
        first_answer = restore(self.state, self.sources, link, self._own)
        self.refused = link.refused
        self.estimate = CurrentEstimate(
            self.state, self.sources, self.tasks, self.failures, first_answer
        )

    @property
    def answer(self) -> Answer:
        """The latest estimate that could be computed."""
        return self.estimate.answer

    @property
    def page(self) -> Any:
        """The document that the browser shows; None without a browser."""
        return self.tasks.document

    @property
    def own_field_of_view_deg(self) -> float:
        """The field of view that suits the present capture."""
        return self.estimate.own_field_of_view_deg

    def query(self) -> str:
        """Return the query of a link to what the page shows."""
        return query_of(self.state, self._own | defaults_of(self.answer))

    def key(self, source: Source) -> str:
        """Return the key of a source in the catalogue."""
        return next(key for key, known in self.sources.items() if known is source)

    def choose_pixel(self, row: int, col: int) -> None:
        """Show another pixel, or the nearest one inside the image."""
        rows, cols = self.answer.capture.shape
        with self.tasks.hold():  # one message for all consequences
            self.state.pixel = (min(max(row, 0), rows - 1), min(max(col, 0), cols - 1))

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
