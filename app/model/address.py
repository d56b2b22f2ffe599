"""Links: the state of a page as the query of its address, without values at their default.

A parameter of `State` is written under its name or that in `LINK_NAMES`, a field of one under both
names, such as ``light.sbr``: a string as it is, any other value as JSON. A link comes from outside:
a value that the parameter or the dataclass rejects is described in a sentence, and the rest is
used.

``pn.state.location.sync`` (Panel 1.9.4) cannot do this: it raises TypeError for 7 of 19 parameters,
writes every default, and drops values that are rejected without a message.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlencode

import param

from app.model.state import State
from core.checks import require
from core.io import ReadOptions

OLD_SETTINGS, SETTINGS = "comparison.settings.", "settings."
"""Beginning of the settings' names in links of the last release, and the present one."""

LINK_NAMES = {"reduction": "less"}
"""Names in links of parameters that were renamed: links that people keep stay valid."""

Result = TypeVar("Result")

MOST_CHARACTERS = 20_000
"""Longest value accepted; a region may have many corners."""

SERVER_ENTRIES = ("bokeh-session-id", "bokeh-token", "theme", "token")
"""Entries of an address that the server reads."""


def defaults() -> dict[str, Any]:
    """Return the default of each parameter of the state."""
    return {name: State.param[name].default for name in State.param if name != "name"}


def query_of(state: State, own: Mapping[str, Any]) -> str:
    """Return the query that restores a state.

    Parameters
    ----------
    state : State
    own : mapping
        Defaults of the session or its capture, which replace those of `State`.
    """
    entries: dict[str, str] = {}
    for name, default in (defaults() | dict(own)).items():
        entries |= _entries(LINK_NAMES.get(name, name), getattr(state, name), default)
    return urlencode(entries, safe="[],:")


def _entries(name: str, value: Any, default: Any) -> dict[str, str]:
    """Write a value as entries; none where it is the default."""
    if value == default:
        return {}
    parts = _parts(value)
    if parts is None:
        if isinstance(default, str):
            return {name: value}
        return {name: _as_json(value)}
    known = _parts(default) or {}
    entries: dict[str, str] = {}
    for each, part in parts.items():
        entries |= _entries(f"{name}.{each}", part, known.get(each))
    return entries


def _as_json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), default=sorted)


def _parts(value: Any) -> dict[str, Any] | None:
    """Return the fields or items of a value by name; None where it has none."""
    if isinstance(value, ReadOptions):
        return {each.name: value.as_text(each.name) for each in fields(value)}
    if is_dataclass(value):
        return {each.name: getattr(value, each.name) for each in fields(value)}
    return dict(value) if isinstance(value, Mapping) else None


class Link:
    """The entries of a link, checked as they are read.

    Parameters
    ----------
    entries : mapping of str to str
        Text of each entry by its name, from outside.

    Attributes
    ----------
    refused : list of str
        A sentence on each entry that could not be used.
    """

    def __init__(self, entries: Mapping[str, str]) -> None:
        self._entries = {
            name.replace(OLD_SETTINGS, SETTINGS, 1): text for name, text in entries.items()
        }
        self._known: set[str] = set()
        self.refused: list[str] = []

    @property
    def sources(self) -> list[str]:
        """Keys of the scenes and captures that the link names; empty strings for none."""
        queries = (self._entries.get(name, "") for name in ("kept", "unread"))
        within = (dict(parse_qsl(query)) for query in queries)
        return [each.get("source", "") for each in (self._entries, *within)]

    def of(self, bases: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters that the link changes, by name.

        Parameters
        ----------
        bases : mapping
            Present values of the parameters to read: an entry may change a part of one.
        """
        found: dict[str, Any] = {}
        for name, base in bases.items():
            kind = getattr(State.param[name], "class_", None)
            is_absent = base is None and is_dataclass(kind)
            linked = LINK_NAMES.get(name, name)
            value = self._created(linked, kind) if is_absent else self._changed(linked, base)
            if value is not base:
                found |= self._attempt(_checked, name, value) or {}
        return found

    def refuse_others(self) -> None:
        """Refuse the entries that are not parameters."""
        others = [n for n in self._entries if n not in self._known and n not in SERVER_ENTRIES]
        if others:
            self.refused.append(f"Unknown parameter: {', '.join(others[:5])}.")

    def _attempt(self, call: Callable[..., Result], *values: Any, **named: Any) -> Result | None:
        """Return the result of a call; None, and a sentence in `refused`, where it fails."""
        try:
            return call(*values, **named)
        except (ValueError, TypeError) as error:
            self.refused.append(str(error))
            return None

    def _changed(self, name: str, base: Any) -> Any:
        """Return a value with the parts that its entries change, or the value itself."""
        if isinstance(base, ReadOptions):
            return self._read_options(name, base)
        parts = _parts(base)
        if parts is None:
            return self._parsed(name, base)
        changed = {each: self._changed(f"{name}.{each}", part) for each, part in parts.items()}
        changed = {each: part for each, part in changed.items() if part is not parts[each]}
        if isinstance(base, Mapping):
            return {**base, **changed} if changed else base
        try:
            return replace(base, **changed) if changed else base
        except (ValueError, TypeError):
            for each, part in changed.items():  # one by one, so that a bad one leaves the others
                base = self._attempt(replace, base, **{each: part}) or base
            return base

    def _created(self, name: str, kind: Any) -> Any:
        """Return an object made from its entries; None where there are none."""
        given = {each.name: self._parsed(f"{name}.{each.name}", None) for each in fields(kind)}
        given = {each: value for each, value in given.items() if value is not None}
        try:
            return kind(**given) if given else None
        except (ValueError, TypeError):
            self.refused.append(f"{name} = {given} is not accepted.")
            return None

    def _read_options(self, name: str, base: ReadOptions) -> ReadOptions:
        for each in fields(base):
            text = self._text(f"{name}.{each.name}")
            if text is not None:
                texts = {other.name: base.as_text(other.name) for other in fields(base)}
                texts[each.name] = text
                base = self._attempt(ReadOptions.from_text, texts) or base
        return base

    def _parsed(self, name: str, base: Any) -> Any:
        text = self._text(name)
        if text is None or isinstance(base, str):
            return base if text is None else text
        try:
            return _like(base, json.loads(text))
        except (ValueError, TypeError, RecursionError):
            is_number = base is None or isinstance(base, float)
            expected = "a finite number" if is_number else f"a value such as {_as_json(base)}"
            self.refused.append(f"{name} = {text[:80]!r} is not accepted: give {expected}.")
            return base

    def _text(self, name: str) -> str | None:
        self._known.add(name)
        text = self._entries.get(name)
        if text is not None and len(text) > MOST_CHARACTERS:
            self.refused.append(f"{name} is not accepted: it has over {MOST_CHARACTERS} letters.")
            return None
        return text


def _checked(name: str, value: Any) -> dict[str, Any]:
    if isinstance(State.param[name], param.Selector):  # param's message is less readable
        options = State.param[name].objects
        require(name, value, value in options, " or ".join(map(repr, options)))
    State(**{name: value})
    return {name: value}


def _like(base: Any, value: Any) -> Any:
    """Convert a value read from JSON to the type of another."""
    if isinstance(base, float) and type(value) is int:
        return float(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError
    if isinstance(base, frozenset):
        return frozenset(value)
    return _tuples(value)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
