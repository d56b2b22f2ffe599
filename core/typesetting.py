"""Numbers and intervals as text for people."""

from __future__ import annotations

import math

__all__ = [
    "interval_text",
    "probability_text",
    "scientific",
    "three_digits",
    "typeset",
    "value_and_bounds",
]

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


def scientific(value: float) -> str:
    """Format a number with three digits, and a power of ten far from 1.

    Examples
    --------
    >>> scientific(1.7346), scientific(4096.0), scientific(1.823e12)
    ('1.73', '4,096', '1.82×10¹²')
    """
    if 1e3 <= abs(value) < 1e6:
        return typeset(f"{value:,.0f}")
    digits, _, power = f"{value:.3g}".partition("e")
    raised = f"×10{str(int(power)).translate(_RAISED)}" if power else ""
    return typeset(digits) + raised


LEAST_PROBABILITY = 1e-6
"""Smaller probabilities are shown as a bound, since they depend on the tails of a model."""


def probability_text(value: float) -> str:
    """Format a probability with two digits, four above 0.1, or as a bound.

    Examples
    --------
    >>> probability_text(0.9963), probability_text(0.0312), probability_text(5e-169)
    ('0.9963', '0.031', '< 0.000001')
    """
    if value < LEAST_PROBABILITY:
        return f"< {LEAST_PROBABILITY:f}"
    if value >= 0.1:
        return f"{value:.4g}"
    return f"{value:.2g}" if value >= 1e-4 else f"{value:.6f}"


def value_and_bounds(value: float, low: float, high: float) -> tuple[str, str]:
    """Format a number with three digits, and the ends of its interval with as many decimals.

    The digits count from the larger of the number and half the width of its interval.

    Returns
    -------
    tuple of str
        The number; the ends in brackets, empty for NaN.

    Examples
    --------
    >>> value_and_bounds(0.03, 0.0273, 0.03261)
    ('0.0300', '[0.0273–0.0326]')
    """
    half = (high - low) / 2
    scale = max(abs(value), half if math.isfinite(half) else 0.0)
    texts = [_like(scale, each) for each in (value, low, high)]
    return texts[0], "" if math.isnan(low) else f"[{texts[1]}–{texts[2]}]"


def _like(scale: float, value: float) -> str:
    """Format a number with the decimals that give a number of another size three digits."""
    if not math.isfinite(value) or not 0 < scale < math.inf or abs(value) >= 1000:
        return three_digits(value)
    if scale < 1e-3:
        return typeset(f"{value:.2e}")
    exponent = int(f"{scale:.2e}".partition("e")[2])  # after rounding
    return typeset(f"{value:.{max(0, 2 - exponent)}f}")


def interval_text(value: float, low: float, high: float) -> str:
    """Format a number with the ends of its interval, or with the lower one if it has no other.

    Examples
    --------
    >>> interval_text(3.4567e-5, 3e-5, 4e-5)
    '3.46×10⁻⁵ [3.00×10⁻⁵–4.00×10⁻⁵]'
    >>> interval_text(float("inf"), 9.69, float("inf"))
    '> 9.69'
    """
    if math.isinf(value) and math.isfinite(low):
        return f"> {three_digits(low)}"
    return " ".join(value_and_bounds(value, low, high)).strip()
