"""Times as text."""

from __future__ import annotations

import re

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "ps": 1e-12, "fs": 1e-15}
"""Seconds of each unit of time, by its symbol."""

EXAMPLE = f"a time such as 64ps or 1e-9; units are {', '.join(UNITS_S)}"

MOST_WITHOUT_UNIT_S = 1e-3


def parsed_time(text: str) -> float:
    """Parse a time such as ``64ps``, ``4.43 us`` or, in seconds and up to a millisecond, ``1e-9``.

    Raises
    ------
    ValueError
        If it is something else; a forgotten unit would turn nanoseconds into light years.
    """
    parts = re.fullmatch(r"([-+.\deE]+) *([a-zµ]*)", text.strip())
    number, unit = parts.groups() if parts else ("", "")
    if unit and unit not in UNITS_S:
        raise ValueError(text)
    time_s = float(number) * UNITS_S[unit or "s"]
    if not unit and abs(time_s) > MOST_WITHOUT_UNIT_S:
        raise ValueError(text)
    return time_s


def time_as_typed(time_s: float) -> str:
    """Return text that `parsed_time` parses as this time."""
    return repr(float(time_s)) if abs(time_s) <= MOST_WITHOUT_UNIT_S else f"{float(time_s)!r} s"


def time_text(time_s: float) -> str:
    """Return a time in a suitable unit: 6.4e-11 is "64 ps"."""
    for unit in ("s", "ms", "µs", "ns"):
        scale = UNITS_S[unit]
        if time_s >= scale * (1 - 1e-9):
            return f"{time_s / scale:.6g} {unit}"
    return f"{time_s * 1e12:.6g} ps"
