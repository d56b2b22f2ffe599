"""The current estimate of a session, computed whenever the state changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import param

from app.model.capture_defaults import enter, offer_kinds
from app.model.restore import parameters_of, request_of
from app.model.state import State
from app.model.store import (
    COMPUTED_FROM,
    Answer,
    Refused,
    Request,
    Source,
    compute,
    predicted_seconds,
    same_subject,
    same_view,
)
from app.model.text import failure, no_estimates, refusal
from app.pages.shared.failures import FailureLog
from app.tasks.page import PageTasks
from app.tasks.scheduler import GENERAL, PAGE, SHORT, Lane
from app.tasks.signals import Signal

FEW_COUNTS = 2**20
"""Size of a cube (pixels × bins) up to which an estimate takes less time than drawing it."""

FEW_S = 0.1
"""Predicted time up to which an estimate may run on the page's thread."""


class CurrentEstimate:
    """Keep the estimate for the state up to date.

    Parameters
    ----------
    state : State
    sources : mapping of str to Source
    tasks : PageTasks
    failures : FailureLog
    first : Answer
        The estimate for the present state.
    refused : Refused or None
        The file that was requested instead, if it could not be read.

    Attributes
    ----------
    answer : Answer
        The latest estimate that could be computed.
    changed : Signal of Answer
        Emitted with each new estimate, and with the old one again where a request failed.
    refused : Refused or None
        The file that was requested last, as long as it could not be read.
    is_settled : bool
        Whether the answer is that of the latest request.
    """

    def __init__(
        self,
        state: State,
        sources: Mapping[str, Source],
        tasks: PageTasks,
        failures: FailureLog,
        first: Answer,
        refused: Refused | None = None,
    ) -> None:
        self.answer, self.refused = first, refused
        self.changed: Signal[Answer] = Signal()
        self.is_settled = True
        self._state, self._sources = state, sources
        self._tasks, self._failures = tasks, failures
        self._channel = tasks.latest()
        self._take_reduction(first)
        state.param.watch(lambda *_: self.refresh(), list(COMPUTED_FROM))

    @property
    def request(self) -> Request:
        """The request described by the state."""
        return request_of(self._state, self._sources)

    def refresh(self) -> None:
        """Compute the state's request, or again when more of its file has been read."""
        request = self.request
        self.is_settled = False
        self._channel.submit(
            partial(compute, request, self.answer),
            self._accept,
            partial(self._restore, request),
            lane_of(request, self.answer),
        )

    def _accept(self, answer: Answer) -> None:
        previous, self.answer, self.refused = self.answer, answer, None
        self._take_reduction(answer)
        if not same_view(answer.request, previous.request):
            enter(self._state, answer, previous)
        else:
            offer_kinds(self._state, answer)  # those of the method
        with self._tasks.hold():  # one message for all consequences
            self._failures.clear(no_estimates(answer))
            self.is_settled = not self._channel.has_more
            self.changed.emit(answer)

    def _take_reduction(self, answer: Answer) -> None:
        """Show the reduction that was added to keep the request within its limits."""
        if self._state.reduction == answer.requested != answer.request.reduction:
            with param.discard_events(self._state):
                self._state.reduction = answer.request.reduction

    def _restore(self, request: Request, error: Exception) -> None:
        """Return to the request that the page still shows, unless the user has moved on."""
        why = failure(error)
        if request == self.request:
            # Sliders keep their values: the next move starts from there.
            kept = {name: getattr(request, name) for name in ("light", "tracking", "settings")}
            shown = replace(self.answer.request, **kept)
            with param.discard_events(self._state):
                self._state.param.update(parameters_of(shown, self._sources))
            if not (request.source.is_scene or same_subject(request, self.answer.request)):
                self.refused = Refused.of(request, error, why)
                why = refusal(self.refused)
        self.is_settled = not self._channel.has_more
        self.changed.emit(self.answer)
        self._failures.report(error, lambda _: why)


def lane_of(request: Request, previous: Answer) -> Lane:
    """Return the lane in which to compute a request, by its cost after the previous one."""
    before = previous.request
    if previous.cutout is not None or previous.whole.cube.size > FEW_COUNTS:
        return GENERAL
    if predicted_seconds(request, previous) > FEW_S:
        return GENERAL
    chosen = {name: getattr(request, name) for name in ("method", "tracking", "settings")}
    if request == replace(before, **chosen):
        return PAGE
    same_scene = request.source is before.source and request.absent == before.absent
    return SHORT if request.source.is_scene and same_scene else GENERAL
