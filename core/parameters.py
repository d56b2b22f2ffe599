"""Settings as frozen dataclasses whose fields know their meaning, unit and bounds.

The app's controls are made from this metadata, so that a limit or a sentence of help is written
once.
"""

from __future__ import annotations

import math
from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from typing import Any

from core.checks import require

__all__ = [
    "Choice",
    "Number",
    "Zone",
    "check_fields",
    "doubts",
    "joint_doubts",
    "parameter",
    "spec_of",
]


@dataclass(frozen=True)
class Zone:
    """Values, from `low` to `high`, with which an answer is in doubt, and a sentence that says why.

    ``python -m core stability`` measures what becomes of the answers there.
    """

    low: float
    high: float
    why: str

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Number:
    """A number: its symbol, the range worth exploring, and what is refused.

    Parameters
    ----------
    symbol : str
        As written in the literature.
    low, high : float
        Sensible range, that of a slider.
    log : bool
        Whether the range is best walked by factors.
    whole : bool
        Whether only integers make sense.
    unit : str
        Empty for a pure number.
    least, most : float
        Smallest and largest value accepted at all.
    open_below : bool
        Whether `least` itself is refused.
    doubtful : tuple of Zone
        Values that are accepted, but with which answers are in doubt.
    """

    symbol: str
    low: float
    high: float
    log: bool = False
    whole: bool = False
    unit: str = ""
    least: float = -math.inf
    most: float = math.inf
    open_below: bool = False
    doubtful: tuple[Zone, ...] = ()

    def check(self, name: str, value: object) -> None:
        """Raise ``ValueError`` unless `value` is acceptable."""
        noun = "an integer" if self.whole else "a number"
        relation = "above" if self.open_below else "from"
        bounds = f"{noun} {relation} {self.least:g} to {self.most:g}"
        require(name, value, self.takes(value), bounds)

    def takes(self, value: Any) -> bool:
        """Whether `value` is acceptable."""
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        above: Any = value
        within = self.least <= above <= self.most
        return bool(within and not (self.open_below and above == self.least))


@dataclass(frozen=True)
class Choice:
    """One of a few named ways."""

    symbol: str
    options: tuple[str, ...]

    def check(self, name: str, value: object) -> None:
        """Raise ``ValueError`` unless `value` is one of the options."""
        require(name, value, value in self.options, " or ".join(map(repr, self.options)))


def parameter(default: Any, spec: Number | Choice, help: str) -> Any:
    """A dataclass field with its specification and a line of help."""
    return field(default=default, metadata={"spec": spec, "help": help})


def spec_of(dataclass_field: Field[Any]) -> Number | Choice:
    """The specification that `parameter` gave to a field."""
    spec: Number | Choice = dataclass_field.metadata["spec"]
    return spec


def doubts(settings: Any) -> list[str]:
    """Why answers are in doubt with these settings, one sentence a reason.

    First those of single fields that lie in a doubtful `Zone`, then those that concern several, as
    the settings' own ``joint_doubts`` tells them.
    """
    found = []
    for each in fields(settings):
        spec, value = spec_of(each), getattr(settings, each.name)
        if isinstance(spec, Number):
            found += [zone.why for zone in spec.doubtful if value in zone]
    return found + joint_doubts(settings)


def joint_doubts(settings: Any) -> list[str]:
    """`doubts` that no single field has, empty for settings that know of none."""
    told: list[str] = settings.joint_doubts() if hasattr(settings, "joint_doubts") else []
    return told


def check_fields(settings: Any) -> None:
    """Check every field of a settings object against its own specification."""
    for each in fields(settings):
        spec_of(each).check(each.name, getattr(settings, each.name))
