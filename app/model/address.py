"""The state of a page as the query of its address, and back: only what differs from the default.

A parameter of the `State` is written under its name, a field of one under both names, such as
``light.sbr``: a string verbatim, anything else as JSON. An address comes from outside: a value that
the parameter or the dataclass does not accept is refused with a sentence, and the rest is used.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any
from urllib.parse import urlencode

import param

from app.model.state import State
from core.checks import require
from core.io import ReadOptions

Entries = Mapping[str, str]
"""Of an address, the text by its name."""

MOST_LETTERS = 20_000
"""Of one entry: a region's many corners."""

NOT_OURS = ("bokeh-session-id", "bokeh-token", "theme", "token")
"""Entries of an address that the server reads."""


def defaults() -> dict[str, Any]:
    """Of each parameter of the state."""
    return {name: State.param[name].default for name in State.param if name != "name"}


def query_of(state: State, own: Mapping[str, Any]) -> str:
    """The query that gives this state again.

    Parameters
    ----------
    state : State
    own : mapping
        Values that need not be told, since the capture brings them: they go before the defaults.
    """
    entries: dict[str, str] = {}
    for name, default in (defaults() | dict(own)).items():
        entries |= _written(name, getattr(state, name), default)
    return urlencode(entries, safe="[],:")


def _written(name: str, value: Any, default: Any) -> dict[str, str]:
    """A value as entries; none where it is the default."""
    if value == default:
        return {}
    inner = _inner(value)
    if inner is None:
        text = (
            value
            if isinstance(default, str)
            else json.dumps(value, separators=(",", ":"), default=sorted)
        )
        return {name: text}
    known = _inner(default) or {}
    entries: dict[str, str] = {}
    for each, part in inner.items():
        entries |= _written(f"{name}.{each}", part, known.get(each))
    return entries


def _inner(value: Any) -> dict[str, Any] | None:
    """What a value consists of, by name; None where it is one piece."""
    if isinstance(value, ReadOptions):
        return {each.name: value.as_text(each.name) for each in fields(value)}
    if is_dataclass(value):
        return {each.name: getattr(value, each.name) for each in fields(value)}
    return dict(value) if isinstance(value, Mapping) else None


class Wanted:
    """What an address asks for.

    Parameters
    ----------
    entries : mapping of str to str
        From outside.

    Attributes
    ----------
    refused : list of str
        A sentence on each entry that could not be used.
    """

    def __init__(self, entries: Entries) -> None:
        self._entries = entries
        self._known: set[str] = set()
        self.refused: list[str] = []

    @property
    def source(self) -> str:
        """Key of the scene or capture for which it asks, or empty."""
        return self._entries.get("source", "")

    def of(self, bases: Mapping[str, Any]) -> dict[str, Any]:
        """Those of some parameters for which it asks, by name.

        Parameters
        ----------
        bases : mapping
            Their values so far: an entry may change a part of one.
        """
        found = {}
        for name, base in bases.items():
            kind = getattr(State.param[name], "class_", None)
            optional = base is None and is_dataclass(kind)
            value = self._made(name, kind) if optional else self._changed(name, base)
            if value is not base:
                try:
                    _check(name, value)
                except ValueError as error:
                    self.refused.append(str(error))
                else:
                    found[name] = value
        return found

    def refuse_others(self) -> None:
        """Refuse the entries that nothing has been asked for."""
        others = [n for n in self._entries if n not in self._known and n not in NOT_OURS]
        if others:
            self.refused.append(f"There is nothing called {', '.join(others[:5])}.")

    def _changed(self, name: str, base: Any) -> Any:
        """A value with the parts that its entries tell."""
        if isinstance(base, ReadOptions):
            return self._reading(name, base)
        inner = _inner(base)
        if inner is None:
            return self._told(name, base)
        changes = {}
        for each, part in inner.items():
            changed = self._changed(f"{name}.{each}", part)
            if changed is not part:
                changes[each] = changed
        if isinstance(base, Mapping):
            return {**base, **changes} if changes else base
        for each, part in changes.items():  # one by one: the others are good without a bad one
            try:
                base = replace(base, **{each: part})
            except (ValueError, TypeError) as error:
                self.refused.append(str(error))
        return base

    def _made(self, name: str, kind: Any) -> Any:
        """An object that there is not unless its entries make it."""
        told = {each.name: self._told(f"{name}.{each.name}", None) for each in fields(kind)}
        told = {each: value for each, value in told.items() if value is not None}
        try:
            return kind(**told) if told else None
        except (ValueError, TypeError):
            self.refused.append(f"{name} = {told} is not accepted.")
            return None

    def _reading(self, name: str, base: ReadOptions) -> ReadOptions:
        typed = {each.name: base.as_text(each.name) for each in fields(base)}
        for each in typed:
            text = self._text(f"{name}.{each}")
            if text is not None:
                try:
                    base = ReadOptions.from_text(typed | {each: text})
                except ValueError as error:
                    self.refused.append(str(error))
                else:
                    typed[each] = text
        return base

    def _told(self, name: str, base: Any) -> Any:
        text = self._text(name)
        if text is None or isinstance(base, str):
            return base if text is None else text
        try:
            return _like(base, json.loads(text))
        except (ValueError, TypeError, RecursionError):
            what = "a finite number" if isinstance(base, float) else f"something like {base}"
            self.refused.append(f"{name} = {text[:80]!r} is not accepted: give {what}.")
            return base

    def _text(self, name: str) -> str | None:
        self._known.add(name)
        text = self._entries.get(name)
        if text is not None and len(text) > MOST_LETTERS:
            self.refused.append(f"{name} is not accepted: it has over {MOST_LETTERS} letters.")
            return None
        return text


def _check(name: str, value: Any) -> None:
    if isinstance(State.param[name], param.Selector):  # more readable than in param's own words
        options = State.param[name].objects
        require(name, value, value in options, " or ".join(map(repr, options)))
    State(**{name: value})


def _like(base: Any, value: Any) -> Any:
    """A value read from JSON, of the type of another."""
    if isinstance(base, float) and type(value) is int:
        return float(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError
    if isinstance(base, frozenset):
        return frozenset(value)
    return _tuples(value)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
