"""Metadata of settings: meaning, unit and bounds of the fields of a frozen dataclass.

The app builds its controls and the command line its options from this metadata.
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
    "Settings",
    "Zone",
    "check_fields",
    "doubts",
    "joint_doubts",
    "parameter",
    "spec_of",
]


@dataclass(frozen=True)
class Zone:
    """Values from `low` to `high` that make estimates unreliable, with the reason as a sentence.

    ``python -m core stability`` measures estimates in these zones.
    """

    low: float
    high: float
    why: str

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Number:
    """A numeric setting.

    Parameters
    ----------
    symbol : str
        Symbol in the literature.
    low, high : float
        Useful range, that of a slider.
    log : bool
        Whether a slider is logarithmic.
    whole : bool
        Whether only integers are accepted.
    unit : str
        Empty for a pure number. A value in ``bins``, or per bin, is rescaled where bins are merged.
    merge_power : int, optional
        Power of the merging factor by which it is rescaled; None takes that of the unit.
    is_bin_index : bool
        Whether the value is a bin of the gate, which moves with the start of a cut gate.
    least, most : float
        Smallest and largest accepted value.
    open_below : bool
        Whether `least` itself is refused.
    optional : bool
        Whether None is accepted.
    none_means : str
        Meaning of None, which a form shows.
    doubtful : tuple of Zone
        Accepted values that make estimates unreliable.
    """

    symbol: str
    low: float
    high: float
    log: bool = False
    whole: bool = False
    unit: str = ""
    merge_power: int | None = None
    is_bin_index: bool = False
    least: float = -math.inf
    most: float = math.inf
    open_below: bool = False
    optional: bool = False
    none_means: str = "automatic"
    doubtful: tuple[Zone, ...] = ()

    def check(self, name: str, value: object) -> None:
        """Raise ``ValueError`` unless `value` is acceptable."""
        noun = "an integer" if self.whole else "a number"
        least = "above" if self.open_below else "from"
        bounds = f"{noun} {least} {self.least:g} to {self.most:g}"
        if math.isinf(self.most):
            least = "above" if self.open_below else "of at least"
            bounds = noun if math.isinf(self.least) else f"{noun} {least} {self.least:g}"
        if self.optional:
            bounds += ", or None"
        require(name, value, self.takes(value), bounds)

    def takes(self, value: Any) -> bool:
        """Return whether `value` is acceptable."""
        if value is None:
            return self.optional
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        above: Any = value
        within = self.least <= above <= self.most
        return bool(within and not (self.open_below and above == self.least))


@dataclass(frozen=True)
class Choice:
    """A setting with a few named options."""

    symbol: str
    options: tuple[str, ...]

    def check(self, name: str, value: object) -> None:
        """Raise ``ValueError`` unless `value` is one of the options."""
        require(name, value, value in self.options, " or ".join(map(repr, self.options)))


def parameter(default: Any, spec: Number | Choice, help: str) -> Any:
    """Return a dataclass field with a specification and a sentence of help."""
    return field(default=default, metadata={"spec": spec, "help": help})


def spec_of(dataclass_field: Field[Any]) -> Number | Choice:
    """Return the specification that `parameter` gave to a field."""
    spec: Number | Choice = dataclass_field.metadata["spec"]
    return spec


def doubts(settings: Any) -> list[str]:
    """Return the reasons why these settings make estimates unreliable, one sentence each.

    Reasons that concern single fields come from their doubtful `Zone`, those that concern several
    from the settings' own method ``joint_doubts``.
    """
    found = []
    for each in fields(settings):
        spec, value = spec_of(each), getattr(settings, each.name)
        if isinstance(spec, Number):
            found += [zone.why for zone in spec.doubtful if value in zone]
    return found + joint_doubts(settings)


def joint_doubts(settings: Any) -> list[str]:
    """Return the `doubts` that concern several fields; empty if the settings define none."""
    reasons: list[str] = settings.joint_doubts() if hasattr(settings, "joint_doubts") else []
    return reasons


@dataclass(frozen=True)
class Settings:
    """Base of frozen dataclasses whose fields have specifications.

    Raises
    ------
    ValueError
        If a field is out of its bounds.
    """

    def __post_init__(self) -> None:
        check_fields(self)


def check_fields(settings: Any) -> None:
    """Check every field of a settings object against its specification.

    Raises
    ------
    ValueError
        If a field is out of its bounds.
    """
    for each in fields(settings):
        spec_of(each).check(each.name, getattr(settings, each.name))
