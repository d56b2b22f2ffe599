"""Profile likelihood intervals of signal, background and their ratio.

The 95 % interval of each is the span of its values where the log likelihood of signal and
background is within 1.92 of its maximum: half of the 95 % quantile of chi-square with one degree of
freedom (Wilks 1938).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.deprecation import renamed
from core.metrics import Interval

LEVEL = 0.95
_DROP = 1.920729

Surface = Callable[[Floats, Floats], Floats]
"""Function from values of two coordinates to log likelihoods, shape (first, second)."""

Coordinates = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Function from values of two coordinates to signal and background, of the same shape."""


class OldFluxNames:
    """Deprecated attributes of reports, to be removed after the next release."""

    light = renamed("flux")
    light_unit = renamed("flux_unit")
    light_method = renamed("flux_method")


class FluxEstimate(NamedTuple):
    """Signal and background, with 95 % intervals."""

    signal: Interval
    """Signal photons, per pulse or, if the number of pulses is unknown, in all."""
    background: Interval
    """Background photons over the whole gate, likewise."""
    sbr: Interval
    """Signal over background: infinite without background, NaN without photons."""

    def scaled(self, factor: float) -> FluxEstimate:
        """Return the fluxes multiplied by `factor`."""
        signal, background = (each.scaled(factor) for each in (self.signal, self.background))
        return self._replace(signal=signal, background=background)

    def in_longer_gate(self, factor: float) -> FluxEstimate:
        """Return the fluxes of a gate `factor` times as long, with as much background per time."""
        return self._replace(
            background=self.background.scaled(factor), sbr=self.sbr.scaled(1 / factor)
        )

    def of(self, capture: Capture) -> FluxEstimate:
        """Convert photons of all pulses to photons per pulse if the number of pulses is known."""
        n_pulses = capture.acquisition.n_pulses
        if capture.gated_pulses is not None or n_pulses is None:
            return self
        return self.scaled(1 / n_pulses)


def difference_of(one: Interval, other: Interval) -> Interval:
    """Interval of the difference of independent, non-negative estimates, at least 0.

    From their own intervals (Zou & Donner 2008, "Construction of confidence limits about effect
    measures").
    """
    value = one.value - other.value
    low = value - math.hypot(one.value - one.low, other.high - other.value)
    high = value + math.hypot(one.high - one.value, other.value - other.low)
    return Interval(*(max(each, 0.0) for each in (value, low, high)))


def ratio_of(one: Interval, other: Interval) -> Interval:
    """Interval of the ratio of independent, non-negative estimates: `difference_of` logarithms."""
    if one.value == 0 or other.value == 0:
        low = one.low / other.high if other.high > 0 else 0.0
        high = one.high / other.low if other.low > 0 else math.inf
        return Interval(math.inf if one.value > 0 else low, low, high)
    value = one.value / other.value
    smaller = math.hypot(_log(one.value, one.low), _log(other.high, other.value))
    larger = math.hypot(_log(one.high, one.value), _log(other.value, other.low))
    return Interval(value, value * math.exp(-smaller), value * math.exp(larger))


def product_of(one: Interval, other: Interval) -> Interval:
    """Interval of the product of independent, non-negative estimates, as `ratio_of`."""
    if one.value == 0 or other.value == 0:
        return Interval(0.0, 0.0, one.high * other.high)
    value, high, low = (1 / each if each > 0 else math.inf for each in astuple(other))
    return ratio_of(one, Interval(value, low, high))


def _log(above: float, below: float) -> float:
    return math.log(above / below) if below > 0 else math.inf


class Box(NamedTuple):
    """Bounds of two coordinates, and the limits of these bounds."""

    low: tuple[float, float]
    high: tuple[float, float]
    least: tuple[float, float]
    most: tuple[float, float]

    def grid(self, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Return values of both coordinates along the sides."""
        one, other = (np.linspace(*each) for each in zip(self.low, self.high, size, strict=True))
        return one, other

    def around(self, inside: NDArray[np.bool_]) -> Box:
        """Bound the points `inside` with a margin of a step, and more where they are cut off."""
        low, high = [], []
        for axis, size in enumerate(inside.shape):
            found = np.flatnonzero(inside.any(axis=1 - axis))
            step = (self.high[axis] - self.low[axis]) / (size - 1)
            is_cut = found[0] == 0, found[-1] == size - 1
            # A margin of one step would leave the maximum next to the opposite side of the box,
            # which would then move to and fro, and grow.
            margin = 2 if any(is_cut) else 1
            more = [size if cut else margin for cut in is_cut]
            low.append(max(self.low[axis] + (found[0] - more[0]) * step, self.least[axis]))
            high.append(min(self.low[axis] + (found[-1] + more[1]) * step, self.most[axis]))
        return self._replace(low=(low[0], low[1]), high=(high[0], high[1]))

    def is_much_of(self, other: Box) -> bool:
        """Return whether this box lies in the other and is nearly as wide.

        More than half as wide: so is the box around two points on both sides of a narrow peak.
        """
        return all(
            other.low[i] <= self.low[i]
            and self.high[i] <= other.high[i]
            and self.high[i] - self.low[i] >= _MUCH * (other.high[i] - other.low[i])
            for i in range(2)
        )


def zoomed(box: Box, surface: Surface, size: tuple[int, int]) -> Box:
    """Zoom in on the region where a likelihood is close to its maximum."""
    for _ in range(_MOST_ZOOMS):
        likelihood = surface(*box.grid(size))
        around = box.around(likelihood >= likelihood.max() - _DROP)
        if around.is_much_of(box):
            break
        box = around
    return box


_MOST_ZOOMS, _MUCH = 30, 0.6
_FINEST = (81, 121)


def spans(box: Box, likelihood: Floats, flux_at: Coordinates) -> FluxEstimate:
    """Find the maximum and the intervals of a likelihood given on a grid of the box."""
    coarse, fine = box.grid(likelihood.shape), box.grid(_FINEST)
    log = np.maximum(likelihood - likelihood.max(), -50.0)
    smooth = scipy.interpolate.RectBivariateSpline(*coarse, log)(*fine)
    best = np.unravel_index(smooth.argmax(), smooth.shape)
    inside = smooth >= smooth[best] - _DROP
    signal, background = flux_at(*fine)
    with np.errstate(divide="ignore", invalid="ignore"):
        sbr = signal / background
    signal_found, background_found, sbr_found = (
        Interval(float(x[best]), float(np.nanmin(x[inside])), float(np.nanmax(x[inside])))
        for x in (signal, background, sbr)
    )
    return FluxEstimate(signal_found, background_found, sbr_found)
