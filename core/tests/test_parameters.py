"""Tests of the bounds of settings."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from core.estimators import ESTIMATORS
from core.parameters import Choice, Number, Settings, parameter, spec_of
from core.tracking import PRESETS, TrackingParameters

FIELDS = [
    pytest.param(each, id=f"{name}.{each.name}")
    for name, estimator in ESTIMATORS.items()
    for each in fields(estimator.parameters)
]


@dataclass(frozen=True)
class Example(Settings):
    width: float = parameter(2.0, Number("w", 1.0, 4.0, least=0.0, open_below=True), "Width.")
    count: int = parameter(3, Number("c", 0, 9, whole=True, least=0), "Count.")
    way: str = parameter("up", Choice("Way", ("up", "down")), "Way.")
    level: float = parameter(0.0, Number("v", -1.0, 1.0), "Any number.")


@pytest.mark.parametrize(
    "accepted",
    [
        {"width": 5e-324},
        {"width": 7},  # beyond the slider, but not absurd
        {"width": np.float32(0.5)},
        {"width": Fraction(1, 3)},
        {"count": 0},
        {"count": np.int64(4)},
        {"way": "down"},
        {"level": -1e9},
    ],
)
def test_sensible_values_are_accepted(accepted: dict[str, Any]) -> None:
    (name,) = accepted
    assert getattr(Example(**accepted), name) == accepted[name]


@pytest.mark.parametrize(
    ("refused", "what"),
    [
        ({"width": 0.0}, "a number above 0"),
        ({"width": -1.0}, "a number above 0"),
        ({"width": np.nan}, "a number above 0"),
        ({"width": "2"}, "a number above 0"),
        ({"width": True}, "a number above 0"),
        ({"width": None}, "a number above 0"),
        ({"width": 1j}, "a number above 0"),
        ({"count": -1}, "an integer of at least 0"),
        ({"count": 2.0}, "an integer of at least 0"),
        ({"count": False}, "an integer of at least 0"),
        ({"way": "left"}, "'up' or 'down'"),
        ({"way": 1}, "'up' or 'down'"),
        ({"level": np.nan}, "a number"),
    ],
)
def test_the_rest_is_refused_in_words(refused: dict[str, Any], what: str) -> None:
    ((name, value),) = refused.items()
    with pytest.raises(ValueError, match="is not accepted") as error:
        Example(**refused)
    assert f"{name} = {value!r} is not accepted: give {what}" in str(error.value)


@pytest.mark.parametrize("each", FIELDS)
def test_every_setting_of_every_estimator_describes_itself(each: Any) -> None:
    spec = spec_of(each)
    assert each.metadata["help"].endswith(".")
    assert spec.symbol
    spec.check(each.name, each.default)
    if isinstance(spec, Number):
        assert spec.least <= spec.low <= each.default <= spec.high
        for end in (spec.low, spec.high):
            spec.check(each.name, end)
    else:
        assert each.default in spec.options


def test_the_recommended_preset_is_the_default() -> None:
    assert PRESETS["recommended"] == TrackingParameters()


def test_the_literal_preset_takes_what_the_paper_prints() -> None:
    literal = PRESETS["literal"]
    assert (literal.weight, literal.start, literal.sigma_from) == ("cubic", "zero", "gate")
    assert (literal.t_n, literal.refine) == (20, "none")
    assert PRESETS["as printed"] == replace(literal, l=0.001)  # deprecated
    with pytest.raises(KeyError):
        PRESETS["printed"]


@pytest.mark.parametrize(
    ("spec", "accepted"),
    [
        (Number("x", 1, 2, least=0.0), "a number of at least 0"),
        (Number("x", 1, 2, least=0.0, open_below=True), "a number above 0"),
        (Number("x", 1, 2, least=0.0, most=1.0), "a number from 0 to 1"),
    ],
)
def test_a_refused_value_names_what_is_accepted_without_infinite_bounds(spec, accepted):
    with pytest.raises(ValueError, match=f"{accepted}[.]"):
        spec.check("x", -1.0)
