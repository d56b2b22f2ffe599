"""Numbers and intervals as text for people."""

from __future__ import annotations

import math

__all__ = ["bounds", "interval_text", "three_digits", "typeset"]

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def three_digits(value: float) -> str:
    """Format a number with three digits; a dash for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞"
    if 0 < abs(value) < 1e-3:
        return typeset(f"{value:.2e}")
    return typeset(f"{float(f'{value:.3g}'):,.0f}" if abs(value) >= 1000 else f"{value:.3g}")


def typeset(text: str) -> str:
    """Write a number with a minus sign, 1.2e-05 as 1.2×10⁻⁵, and 1.2e+03 as 1,200."""
    digits, _, power = text.partition("e")
    if power and int(power) > 0:
        digits = f"{float(text):+,.0f}" if text.startswith("+") else f"{float(text):,.0f}"
    elif power:
        digits = f"{digits}×10{str(int(power)).translate(_RAISED)}"
    return digits.replace("-", "−")


def bounds(low: float, high: float) -> str:
    """Format the ends of an interval; empty for NaN."""
    return "" if math.isnan(low) else f"[{three_digits(low)}–{three_digits(high)}]"


def interval_text(value: float, low: float, high: float) -> str:
    """Format a number with the ends of its interval, or with the lower one if it has no other.

    Examples
    --------
    >>> interval_text(3.4567e-5, 3e-5, 4e-5)
    '3.46×10⁻⁵ [3.00×10⁻⁵–4.00×10⁻⁵]'
    >>> interval_text(float("inf"), 9.69, float("inf"))
    '> 9.69'
    """
    is_open = math.isinf(value) and math.isfinite(low)
    text = f"> {three_digits(low)}" if is_open else f"{three_digits(value)} {bounds(low, high)}"
    return text.strip()
