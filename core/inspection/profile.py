"""Profile likelihood intervals of signal, background and their ratio, from a likelihood of two.

The 95 % interval of each is the span of its values wherever the likelihood falls short of its
largest by a logarithm of 1.92 or less: half of chi-square's 95 % quantile with one degree of
freedom (Wilks 1938).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.metrics import Interval

LEVEL = 0.95
_DROP = 1.920729

Surface = Callable[[Floats, Floats], Floats]
"""Log likelihood at each of some values of one coordinate and of another, shape (one, other)."""

Coordinates = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Signal and background there, each of that shape."""


class FluxEstimate(NamedTuple):
    """Signal and background, with 95 % intervals."""

    signal: Interval
    """Signal photons, per pulse or, where the pulses are not known, in all."""
    background: Interval
    """Background photons over the whole gate, likewise."""
    sbr: Interval
    """Signal over background: infinite where there may be no background, NaN without a photon."""

    def scaled(self, factor: float) -> FluxEstimate:
        """So many times the light."""
        signal, background = (
            Interval(x.value * factor, x.low * factor, x.high * factor)
            for x in (self.signal, self.background)
        )
        return self._replace(signal=signal, background=background)

    def of(self, capture: Capture) -> FluxEstimate:
        """In photons per pulse, where photons of all pulses were found and the pulses are known."""
        n_pulses = capture.acquisition.n_pulses
        if capture.gated_pulses is not None or n_pulses is None:
            return self
        return self.scaled(1 / n_pulses)


class Box(NamedTuple):
    """Bounds of two coordinates, and how far they can go."""

    low: tuple[float, float]
    high: tuple[float, float]
    least: tuple[float, float]
    most: tuple[float, float]

    def grid(self, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Values of both along the sides."""
        one, other = (np.linspace(*each) for each in zip(self.low, self.high, size, strict=True))
        return one, other

    def around(self, inside: NDArray[np.bool_]) -> Box:
        """The bounds of what is inside, a step more on each side; wider where it is cut off."""
        low, high = [], []
        for axis, size in enumerate(inside.shape):
            found = np.flatnonzero(inside.any(axis=1 - axis))
            step = (self.high[axis] - self.low[axis]) / (size - 1)
            more = [size if found[0] == 0 else 1, size if found[-1] == size - 1 else 1]
            low.append(max(self.low[axis] + (found[0] - more[0]) * step, self.least[axis]))
            high.append(min(self.low[axis] + (found[-1] + more[1]) * step, self.most[axis]))
        return self._replace(low=(low[0], low[1]), high=(high[0], high[1]))

    def is_much_of(self, other: Box) -> bool:
        """Whether going on to this box gains little: within the other, and half as wide or more."""
        return all(
            other.low[i] <= self.low[i]
            and self.high[i] <= other.high[i]
            and 2 * (self.high[i] - self.low[i]) >= other.high[i] - other.low[i]
            for i in range(2)
        )


def zoomed(box: Box, surface: Surface, size: tuple[int, int]) -> Box:
    """The bounds of where a likelihood is close to its largest, and little more."""
    for _ in range(_MOST_ZOOMS):
        likelihood = surface(*box.grid(size))
        around = box.around(likelihood >= likelihood.max() - _DROP)
        if around.is_much_of(box):
            break
        box = around
    return box


_MOST_ZOOMS = 30
_FINEST = (81, 121)


def spans(box: Box, likelihood: Floats, flux_at: Coordinates) -> FluxEstimate:
    """Where a likelihood is largest, and the intervals, from its values on a grid of the box."""
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
