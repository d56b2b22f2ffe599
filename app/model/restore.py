"""The first state and estimate of a session, from its link."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl

from app.model import text
from app.model.address import Link, defaults
from app.model.capture_defaults import FROM_CAPTURE, defaults_of, enter, possible_kinds
from app.model.state import State
from app.model.store import (
    COMPUTED_FROM,
    Answer,
    Refused,
    Request,
    Source,
    compute,
    first_answer,
    is_ambiguous,
)
from core import CaptureError

log = logging.getLogger(__name__)


def restore(
    state: State, sources: Mapping[str, Source], link: Link, own: Mapping[str, Any]
) -> tuple[Answer, Refused | None]:
    """Set a state as its link says, and compute the estimate.

    Each setting that cannot be restored is described in ``link.refused``; a file that cannot be
    read is returned, too. A scene is shown where the session's own file is such a file.

    Parameters
    ----------
    state : State
    sources : mapping of str to Source
    link : Link
    own : mapping
        Defaults of this session that differ from the state's.
    """
    answer, refused = _restored_answer(state, sources, link, own)
    enter(state, answer, None)
    state.param.update(places(link, answer))
    link.refuse_others()
    if refused is None and state.unread:
        refused = still_refused(state.unread, sources, link, own)
    return answer, refused


def still_refused(
    query: str, sources: Mapping[str, Source], link: Link, own: Mapping[str, Any]
) -> Refused | None:
    """Return the file of a query that could not be read before, unless it can be or is gone."""
    try:
        request = described(query, sources, own)
    except ValueError as error:
        link.refused.append(str(error))
        return None
    if request.source.is_scene:
        return None
    try:
        compute(request, None)
    except Exception as error:  # the page reports any failure
        _report(error, link)
        return Refused.of(request, error, text.failure(error))
    return None


def _report(error: Exception, link: Link) -> None:
    """Add to a link why it could not be restored, unless the page asks which array to read."""
    if not is_ambiguous(error):
        unforeseen = None if isinstance(error, CaptureError) else error
        log.warning("could not restore the link: %s", error, exc_info=unforeseen)
        why = text.reason(error)
        link.refused += [] if why in link.refused else [why]


def places(link: Link, answer: Answer) -> dict[str, Any]:
    """Return the parameters `FROM_CAPTURE` that a link describes, for its estimate."""
    rows, cols = answer.capture.shape
    before = defaults() | defaults_of(answer)
    found = {name: before[name] for name in FROM_CAPTURE}
    found |= link.of(found)
    pins, (row, col) = found["pins"], found["pixel"]
    found["pins"] = tuple(pin for pin in pins if pin[0] < rows and pin[1] < cols)
    if found["pins"] != pins:
        link.refused.append(text.pins_outside(rows, cols))
    found["pixel"] = min(row, rows - 1), min(col, cols - 1)
    for name, possible in possible_kinds(answer).items():
        found[name] = found[name] if found[name] in possible else possible[0]
    return found


def choices(link: Link, own: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters that a link describes, except those of `places`."""
    before = {**defaults(), **own}
    base = {name: before[name] for name in before if name not in FROM_CAPTURE}
    return base | link.of(base)


def _restored_answer(
    state: State, sources: Mapping[str, Source], link: Link, own: Mapping[str, Any]
) -> tuple[Answer, Refused | None]:
    before, changed = {**defaults(), **own}, choices(link, own)
    if changed["source"] not in sources:
        link.refused.append(text.source_is_gone(changed["source"], sources))
        of_source = ("source", "reading", "window", "reduction")
        changed = {name: value for name, value in changed.items() if name not in of_source}
    plain = {name: value for name, value in changed.items() if name not in COMPUTED_FROM}
    source = {name: value for name, value in changed.items() if name == "source"}
    refused: Refused | None = None
    scenes = [{"source": key} for key, each in sources.items() if each.is_scene]
    for attempt in (changed, plain | source, plain, *(plain | scene for scene in scenes[:1])):
        state.param.update(before | attempt)
        request = request_of(state, sources)
        try:
            answer = first_answer(request)
        except Exception as error:  # the page reports any failure
            _report(error, link)
            if refused is None and not request.source.is_scene:
                refused = Refused.of(request, error, text.failure(error))
        else:
            is_open = refused is None or answer.request.source is refused.request.source
            return answer, None if is_open else refused
    return first_answer(request_of(state, sources)), refused


def parsed(
    query: str, sources: Mapping[str, Source], own: Mapping[str, Any]
) -> tuple[Link, dict[str, Any]]:
    """Return a query as a link, and its `choices`.

    Raises
    ------
    ValueError
        If its scene or capture is not among the sources.
    """
    link = Link(dict(parse_qsl(query)))
    chosen = choices(link, own)
    if chosen["source"] not in sources:
        raise ValueError(text.source_is_gone(chosen["source"], sources))
    return link, chosen


def described(query: str, sources: Mapping[str, Source], own: Mapping[str, Any]) -> Request:
    """Return the request that a query describes.

    Raises
    ------
    ValueError
        If its scene or capture is not among the sources.
    """
    _, chosen = parsed(query, sources, own)
    values = {name: chosen[name] for name in COMPUTED_FROM}
    return Request(**values | {"source": sources[chosen["source"]]})


def request_of(state: State, sources: Mapping[str, Source]) -> Request:
    """Return the request of a state."""
    chosen = {name: getattr(state, name) for name in COMPUTED_FROM}
    return Request(**chosen | {"source": sources[state.source]})


def parameters_of(request: Request, sources: Mapping[str, Source]) -> dict[str, Any]:
    """Return the parameters of the state that make a request: the inverse of `request_of`."""
    key = next(key for key, each in sources.items() if each is request.source)
    return {name: getattr(request, name) for name in COMPUTED_FROM} | {"source": key}
