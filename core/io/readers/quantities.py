"""Times and angles as text, with a unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from decimal import Decimal
from math import pi

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "ps": 1e-12, "fs": 1e-15}
"""Seconds of each unit of time, by its symbol."""

UNITS_RAD = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "µrad": 1e-6, "deg": pi / 180, "°": pi / 180}
"""Radians of each unit of angle, by its symbol."""

EXAMPLE = f"a time such as 64ps or 1e-9; units are {', '.join(UNITS_S)}"
EXAMPLE_OF_ANGLE = f"an angle such as 20urad or 2e-5; units are {', '.join(UNITS_RAD)}"

MOST_WITHOUT_UNIT_S = 1e-3


def parsed_time(text: str) -> float:
    """Parse a time such as ``64ps``, ``4.43 us`` or, in seconds and up to a millisecond, ``1e-9``.

    Raises
    ------
    ValueError
        If it is something else; a forgotten unit would turn nanoseconds into light years.
    """
    time_s, unit = _parsed(text, UNITS_S, "s")
    if not unit and abs(time_s) > MOST_WITHOUT_UNIT_S:
        raise ValueError(text)
    return time_s


def parsed_angle(text: str) -> float:
    """Parse an angle such as ``20urad``, ``0.01 deg`` or, in radians, ``2e-5``.

    Raises
    ------
    ValueError
        If it is something else.
    """
    return _parsed(text, UNITS_RAD, "rad")[0]


def _parsed(text: str, units: Mapping[str, float], own: str) -> tuple[float, str]:
    """Return a quantity in the unit `own`, and the unit that the text names."""
    parts = re.fullmatch(r"([-+.\deE]+?) *([a-zµμ°]*)", text.strip())
    number, unit = parts.groups() if parts else ("", "")
    unit = unit.replace("μ", "µ")  # the Greek letter for the micro sign
    if unit and unit not in units:
        raise ValueError(text)
    # In decimal, so that 20 µrad is 2e-5 and not the float below.
    return float(Decimal(repr(float(number))) * Decimal(repr(units[unit or own]))), unit


def time_as_typed(time_s: float) -> str:
    """Return text that `parsed_time` parses as this time, with a suitable unit where one is exact.

    Examples
    --------
    >>> time_as_typed(6.4e-11)
    '64 ps'
    """
    if time_s == 0:
        return "0 s"
    if parsed_time(text := time_text(time_s)) == time_s:
        return text
    return repr(float(time_s)) if abs(time_s) <= MOST_WITHOUT_UNIT_S else f"{float(time_s)!r} s"


def angle_as_typed(angle_rad: float) -> str:
    """Return text that `parsed_angle` parses as this angle.

    Examples
    --------
    >>> angle_as_typed(2e-5)
    '20 µrad'
    """
    for unit in ("mrad", "µrad"):
        text = f"{angle_rad / UNITS_RAD[unit]:.6g} {unit}"
        if angle_rad >= UNITS_RAD[unit] and parsed_angle(text) == angle_rad:
            return text
    return repr(float(angle_rad))


def time_text(time_s: float) -> str:
    """Return a time in a suitable unit: 6.4e-11 is "64 ps"."""
    for unit in ("s", "ms", "µs", "ns"):
        scale = UNITS_S[unit]
        if abs(time_s) >= scale * (1 - 1e-9):
            return f"{time_s / scale:.6g} {unit}"
    return f"{time_s * 1e12:.6g} ps"
