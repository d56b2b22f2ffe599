"""States of the app other than its first: one for each parameter and field, and random ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import param

from app.model.address import Link, defaults
from app.model.state import CLOUDS, Comparison, Learning, State
from app.model.store import Request, Source, built_in_sources
from core import ESTIMATORS, PhotonBudget, Window
from core.io import ReadOptions
from core.parameters import Choice
from core.tests.read_options import EXAMPLES

OTHERWISE: dict[str, list[Any]] = {
    "method": ["likelihood", "peak"],
    "source": ["building", "a b&c=d/é?#", "17"],
    "window": [Window((0, 8), (3, 9)), Window((2, 30), (0, 40), step=3)],
    "absent": [frozenset({"jitter"}), frozenset({"pile_up", "signal_levels", "motion"})],
    "pixel": [(0, 0), (63, 5)],
    "page": ["Inspect", "Compare", "Trade-off", "Paper", "Learn"],
    "pins": [((1, 2),), ((1, 2), (3, 4), (0, 0), (9, 9))],
    "region": [((1, 2), (1, 9), (7, 5)), ((0.5, 1.25), (-3.0, 9.0), (7.0, 5.1))],
    "budget": [
        PhotonBudget(),
        PhotonBudget(0.5, 20.0, 1.0, 2e4, 0.5, 0.3, 0.8, 1550.0, 10.0, 2.0, 0.2),
    ],
    "kept": ["source=car&method=coates", "tracking.l=0.006&light.sbr=2.0"],
    "unread": ["source=two.mat", "source=a%20b&reading.n_bins=40"],
    "learning": [Learning("2-more-light", "0.3", "5.0"), Learning(answer="0.42", step=3)],
    "reading": [ReadOptions(**{name: value}) for name, value in EXAMPLES.items()],
}
"""Other values of parameters whose kind does not tell which there are."""


def ask(source: str | Source = "car", **chosen: Any) -> Request:
    """Return a request for a built-in source, by its key, or another one."""
    known = built_in_sources()
    return Request(known[source] if isinstance(source, str) else source, **chosen)


def link_to(query: str) -> Link:
    """Return the link with this query."""
    return Link(dict(parse_qsl(query)))


def another(name: str) -> Iterator[Any]:
    """Other values of a parameter than its default; each field of it is changed in one of them."""
    parameter, default = State.param[name], State.param[name].default
    if name in OTHERWISE:
        yield from OTHERWISE[name]
    elif isinstance(parameter, param.Selector):
        yield from (each for each in parameter.objects if each != default)
    elif isinstance(parameter, param.Boolean):
        yield not default
    else:
        yield from otherwise(default)


def otherwise(settings: Any) -> Iterator[Any]:
    """The same settings, each time with another field or entry changed."""
    if isinstance(settings, Comparison):
        yield replace(settings, methods=("peak",))
        yield replace(settings, methods=())
        yield replace(settings, false_alarm=0.1)
        yield replace(settings, kind="Error")
        for viewing in otherwise(settings.viewing):
            yield replace(settings, viewing=viewing, kind=CLOUDS)
        return
    if isinstance(settings, Mapping):
        for name, own in settings.items():
            yield from ({**settings, name: changed} for changed in otherwise(own))
        return
    for each in fields(settings):
        yield replace(settings, **{each.name: other_value(each, getattr(settings, each.name))})


def other_value(field: Any, value: Any, share: float = 0.37) -> Any:
    """Another value of a field, so far between the ends of its slider."""
    spec = field.metadata["spec"]
    if isinstance(spec, Choice):
        return next(option for option in spec.options if option != value)
    chosen = spec.low + share * (spec.high - spec.low)
    chosen = round(chosen) if spec.whole else chosen
    return chosen if chosen != value else spec.high


def random_state(rng: np.random.Generator) -> State:
    """A state in which about half of everything is chosen."""
    return State(**{name: random_value(name, rng) for name in defaults() if rng.random() < 0.6})


def random_value(name: str, rng: np.random.Generator) -> Any:
    """Some value of a parameter, with about half of its fields changed."""
    default = State.param[name].default
    if isinstance(default, Mapping):
        return {each: _random(own, rng) for each, own in default.items()}
    if not is_dataclass(default) or name in OTHERWISE:
        values = list(another(name))
        return values[rng.integers(len(values))]
    return _random(default, rng)


def _random(settings: Any, rng: np.random.Generator) -> Any:
    if isinstance(settings, Comparison):
        return Comparison(
            tuple(method for method in ESTIMATORS if rng.random() < 0.5),
            float(rng.uniform(0.01, 1)),
            "Confidence",
            _random(settings.viewing, rng),
        )
    changed = {
        each.name: other_value(each, getattr(settings, each.name), float(rng.random()))
        for each in fields(settings)
        if rng.random() < 0.5
    }
    for ends in (("color_from_m", "color_to_m"), ("from_m", "to_m")):
        if {*ends} <= changed.keys():
            low, high = sorted(changed[end] for end in ends)
            changed |= dict(zip(ends, (low, high + 1.0), strict=True))
    return replace(settings, **changed)
