"""The first state and estimate of a session, from its link."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from app.model import text
from app.model.address import Link, defaults
from app.model.capture_defaults import FROM_CAPTURE, defaults_of, enter
from app.model.state import State
from app.model.store import COMPUTED_FROM, Answer, Request, Source, compute

log = logging.getLogger(__name__)


def restore(
    state: State, sources: Mapping[str, Source], link: Link, own: Mapping[str, Any]
) -> Answer:
    """Set a state as its link says, and compute the estimate.

    Each setting that cannot be restored is described in ``link.refused``.

    Parameters
    ----------
    state : State
    sources : mapping of str to Source
    link : Link
    own : mapping
        Defaults of this session that differ from the state's.
    """
    answer = _first_answer(state, sources, link, own)
    enter(state, answer, None)
    rows, cols = answer.capture.shape
    before = defaults() | defaults_of(answer)
    changed = link.of({name: before[name] for name in FROM_CAPTURE})
    pins, (row, col) = changed.get("pins", ()), changed.get("pixel", state.pixel)
    changed["pins"] = tuple(pin for pin in pins if pin[0] < rows and pin[1] < cols)
    if changed["pins"] != pins:
        link.refused.append(text.pins_outside(rows, cols))
    changed["pixel"] = min(row, rows - 1), min(col, cols - 1)
    state.param.update(changed)
    link.refuse_others()
    return answer


def _first_answer(
    state: State, sources: Mapping[str, Source], link: Link, own: Mapping[str, Any]
) -> Answer:
    before = {**defaults(), **own}
    changed = link.of({name: before[name] for name in before if name not in FROM_CAPTURE})
    if changed.get("source", own["source"]) not in sources:
        link.refused.append(text.source_is_gone(changed["source"]))
        of_source = ("source", "reading", "window", "less")
        changed = {name: value for name, value in changed.items() if name not in of_source}
    plain = {name: value for name, value in changed.items() if name not in COMPUTED_FROM}
    source = {name: value for name, value in changed.items() if name == "source"}
    for attempt in (changed, plain | source, plain):
        state.param.update(before | attempt)
        try:
            return compute(request_of(state, sources), None)
        except Exception as error:  # the page reports any failure
            log.warning("could not restore the link", exc_info=error)
            link.refused.append(text.reason(error))
    return compute(request_of(state, sources), None)


def request_of(state: State, sources: Mapping[str, Source]) -> Request:
    """Return the request of a state."""
    chosen = {name: getattr(state, name) for name in COMPUTED_FROM}
    return Request(**chosen | {"source": sources[state.source]})


def parameters_of(request: Request, sources: Mapping[str, Source]) -> dict[str, Any]:
    """Return the parameters of the state that make a request: the inverse of `request_of`."""
    key = next(key for key, each in sources.items() if each is request.source)
    return {name: getattr(request, name) for name in COMPUTED_FROM} | {"source": key}
