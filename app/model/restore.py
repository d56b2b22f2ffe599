"""The first state and answer of a session, as its link asks for them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from app.model import text
from app.model.address import Wanted, defaults
from app.model.capture_defaults import FROM_CAPTURE, defaults_of, enter
from app.model.state import State
from app.model.store import COMPUTED_FROM, Answer, Request, Source, compute

log = logging.getLogger(__name__)


def restore(
    state: State, sources: Mapping[str, Source], wanted: Wanted, own: Mapping[str, Any]
) -> Answer:
    """Set a state to what a link asks for, as far as that can be computed, and compute it.

    Each setting that cannot be restored is described in ``wanted.refused``.

    Parameters
    ----------
    state : State
    sources : mapping of str to Source
    wanted : Wanted
        The link.
    own : mapping
        Defaults of this session that differ from the state's.
    """
    answer = _first_answer(state, sources, wanted, own)
    enter(state, answer, None)
    rows, cols = answer.capture.shape
    before = defaults() | defaults_of(answer)
    asked = wanted.of({name: before[name] for name in FROM_CAPTURE})
    pins, (row, col) = asked.get("pins", ()), asked.get("pixel", state.pixel)
    asked["pins"] = tuple(pin for pin in pins if pin[0] < rows and pin[1] < cols)
    if asked["pins"] != pins:
        wanted.refused.append(text.pins_outside(rows, cols))
    asked["pixel"] = min(row, rows - 1), min(col, cols - 1)
    state.param.update(asked)
    wanted.refuse_others()
    return answer


def _first_answer(
    state: State, sources: Mapping[str, Source], wanted: Wanted, own: Mapping[str, Any]
) -> Answer:
    before = {**defaults(), **own}
    asked = wanted.of({name: before[name] for name in before if name not in FROM_CAPTURE})
    if asked.get("source", own["source"]) not in sources:
        wanted.refused.append(text.source_is_gone(asked["source"]))
        of_source = ("source", "reading", "window", "less")
        asked = {name: value for name, value in asked.items() if name not in of_source}
    plain = {name: value for name, value in asked.items() if name not in COMPUTED_FROM}
    source = {name: value for name, value in asked.items() if name == "source"}
    for attempt in (asked, plain | source, plain):
        state.param.update(before | attempt)
        try:
            return compute(request_of(state, sources), None)
        except Exception as error:  # the page reports any failure
            log.warning("what the link asks for failed", exc_info=error)
            wanted.refused.append(text.reason(error))
    return compute(request_of(state, sources), None)


def request_of(state: State, sources: Mapping[str, Source]) -> Request:
    """Return what a state asks to be computed."""
    chosen = {name: getattr(state, name) for name in COMPUTED_FROM}
    return Request(**chosen | {"source": sources[state.source]})


def parameters_of(request: Request, sources: Mapping[str, Source]) -> dict[str, Any]:
    """Return the parameters of the state that ask for a request: the inverse of `request_of`."""
    key = next(key for key, each in sources.items() if each is request.source)
    return {name: getattr(request, name) for name in COMPUTED_FROM} | {"source": key}
