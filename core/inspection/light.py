"""How much signal and background a histogram has seen: estimates and 95 % intervals.

With ``S`` signal and ``B`` background photons a pulse, the likelihood of a first-photon histogram
(`core.posterior`) is averaged over all delays of the gate, none being likelier than another: where
the echo lies is not known, and its largest peak is not taken for it. What is left is a likelihood
of ``S`` and ``B`` alone. The 95 % interval of each, and of ``S / B``, is the span of its values
wherever that likelihood falls short of its largest by a logarithm of 1.92 or less: the profile
likelihood interval (half of chi-square's 95 % quantile with one degree of freedom, Wilks 1938).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.metrics import Interval

LEVEL = 0.95
_DROP = 1.920729  # half of chi-square's 95 % quantile, one degree of freedom


class LightFound(NamedTuple):
    """What a histogram tells of its light."""

    signal: Interval
    """Signal photons, per pulse or, where the pulses are not known, in all."""
    background: Interval
    """Background photons over the whole gate, likewise."""
    sbr: Interval
    """Signal over background: infinite where there may be no background, NaN without a photon."""

    def per_pulse(self, n_pulses: int) -> LightFound:
        """The same of photons that fell on so many pulses."""
        signal, background = (
            Interval(x.value / n_pulses, x.low / n_pulses, x.high / n_pulses)
            for x in (self.signal, self.background)
        )
        return self._replace(signal=signal, background=background)


def light_found(
    histogram: Floats, acquisition: Acquisition, pulse: Pulse, n_pulses: int | None
) -> LightFound:
    """Signal, background and their ratio, with 95 % intervals.

    Parameters
    ----------
    histogram : ndarray, shape (bin,)
    acquisition : Acquisition
    pulse : Pulse
    n_pulses : int or None
        Pulses sent, where these are first photons; where None counts are taken for Poisson, and
        photons are told instead of photons per pulse.
    """
    surface = _Surface(histogram, acquisition, pulse, n_pulses)
    box = _zoomed(surface.whole, surface)
    if surface.forget_delays():  # now that the light is about known
        box = _zoomed(box, surface)
    return _spans(box, surface(*box.grid(_FINE)))


_COARSE, _FINE, _FINEST = (15, 25), (21, 33), (121, 193)
_MOST_ZOOMS = 30
_RIGHT = math.pi / 2


class _Box(NamedTuple):
    """Bounds of ``√(S + B)`` and of ``asin √(S / (S + B))``.

    In these, which have about the same standard deviation everywhere, a likelihood's peak is round.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    least: tuple[float, float]
    most: tuple[float, float]

    def grid(self, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Values of both along the sides."""
        root, angle = (np.linspace(*each) for each in zip(self.low, self.high, size, strict=True))
        return root, angle

    def around(self, inside: NDArray[np.bool_]) -> _Box:
        """The bounds of what is inside, a step more on each side; wider where it is cut off."""
        low, high = [], []
        for axis, size in enumerate(inside.shape):
            found = np.flatnonzero(inside.any(axis=1 - axis))
            step = (self.high[axis] - self.low[axis]) / (size - 1)
            more = [size if found[0] == 0 else 1, size if found[-1] == size - 1 else 1]
            low.append(max(self.low[axis] + (found[0] - more[0]) * step, self.least[axis]))
            high.append(min(self.low[axis] + (found[-1] + more[1]) * step, self.most[axis]))
        return self._replace(low=tuple(low), high=tuple(high))

    def is_much_of(self, other: _Box) -> bool:
        """Whether going on to this box gains little: within the other, and half as wide or more."""
        return all(
            other.low[i] <= self.low[i]
            and self.high[i] <= other.high[i]
            and 2 * (self.high[i] - self.low[i]) >= other.high[i] - other.low[i]
            for i in range(2)
        )


def _zoomed(box: _Box, surface: _Surface) -> _Box:
    """The bounds of where the likelihood is close to its largest, and little more."""
    for _ in range(_MOST_ZOOMS):
        likelihood = surface(*box.grid(_COARSE))
        around = box.around(likelihood >= likelihood.max() - _DROP)
        if around.is_much_of(box):
            break
        box = around
    return box


class _Surface:
    """The likelihood of signal and background, averaged over delays."""

    def __init__(
        self, histogram: Floats, acquisition: Acquisition, pulse: Pulse, n_pulses: int | None
    ) -> None:
        self._acquisition, self._pulse, self._n_pulses = acquisition, pulse, n_pulses
        self._counts = np.asarray(histogram, float)
        n_bins, detected = self._counts.size, float(self._counts.sum())
        if n_pulses is None:
            self._unfired = np.ones(n_bins)
            total, sd, most = detected, math.sqrt(detected), 2 * detected + 100
        else:
            self._unfired = n_pulses - np.cumsum(self._counts)
            left = max(float(self._unfired[-1]), 0.5)
            total, sd = math.log(n_pulses / left), math.sqrt(1 / left - 1 / n_pulses)
            most = n_bins * math.log(1000.0 * n_pulses)  # where all pulses fire beyond any doubt
        one = 1 / (n_pulses or 1)
        low, high = max(total - 6 * sd - one, 0.0), min(total + 6 * sd + 6 * one, most)
        self.whole = _Box(
            low=(math.sqrt(low), 0.0),
            high=(math.sqrt(high), _RIGHT),
            least=(0.0, 0.0),
            most=(math.sqrt(most), _RIGHT),
        )
        self._bins = np.arange(n_bins)
        self._all_delays = 0
        self._take_steps(
            1 if pulse.span_s[1] - pulse.span_s[0] > 8 * acquisition.bin_width_s else 2
        )

    def _take_steps(self, per_bin: int) -> None:
        """Try so many delays in each of the bins that are left."""
        n_bins = self._counts.size
        delay = (np.arange(per_bin) + 0.5) / per_bin
        self._echo, first = self._pulse.taps(n_bins, self._acquisition.bin_width_s, delay)
        n_taps = self._echo.shape[1]
        # What an echo at each bin meets, shape (tap, bin): nothing beyond the gate.
        before, behind = max(-first, 0), max(first + n_taps - 1, 0)
        met = (
            sliding_window_view(np.pad(each, (before, behind)), n_taps)[before + first + self._bins]
            for each in (self._counts, self._unfired)
        )
        self._met_counts, met_unfired = (each.T for each in met)
        self._reach = self._echo @ met_unfired
        self._all_delays = n_bins * per_bin
        self._best = np.full(self._reach.shape, -np.inf)

    def __call__(self, root: Floats, angle: Floats) -> Floats:
        """Log likelihood, shape (root, angle)."""
        signal, background = (x.ravel() for x in _light_at(root, angle))
        background = np.maximum(background, _DARKEST)
        log = self._ratios(signal, background)
        self._best = log.max(axis=0).reshape(self._reach.shape)
        top = log.max(axis=1)
        mean = np.exp(log - top[:, np.newaxis]).sum(axis=1) / self._all_delays
        found = self._flat(background) + top + np.log(mean)
        return np.asarray(found.reshape(root.size, angle.size))

    def _flat(self, background: Floats) -> Floats:
        """Log likelihood of background alone."""
        b, detected = background / self._counts.size, self._counts.sum()
        if self._n_pulses is None:
            return np.asarray(detected * np.log(b) - background)
        return np.asarray(detected * np.log(-np.expm1(-b)) - b * self._unfired.sum())

    def _ratios(self, signal: Floats, background: Floats) -> Floats:
        """What an echo adds to it at each delay, shape (light, delay)."""
        s = signal[:, np.newaxis, np.newaxis] * self._echo
        b = (background / self._counts.size)[:, np.newaxis, np.newaxis]
        if self._n_pulses is None:
            gain = np.log1p(s / b)
        else:
            gain = np.log1p(np.expm1(-s) * np.exp(-b) / np.expm1(-b))
        ratio = gain @ self._met_counts - signal[:, np.newaxis, np.newaxis] * self._reach
        return np.asarray(ratio.reshape(signal.size, -1))

    def forget_delays(self) -> bool:
        """Leave out delays that no light of the last call makes likely; look closer at the rest.

        Whether there were any.
        """
        best = self._best.max(axis=0)
        likely = best >= best.max() - _NEGLIGIBLE
        self._bins = self._bins[likely]
        self._take_steps(_CLOSE if self._bins.size <= _FEW_BINS else len(self._echo))
        return not bool(likely.all())


_DARKEST = 1e-200  # photons: without any a count would be impossible, and its logarithm infinite
_NEGLIGIBLE = 25.0
_CLOSE, _FEW_BINS = 16, 8


def _light_at(root: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """Signal and background at the coordinates of a `_Box`, each of shape (root, angle)."""
    total = root[:, np.newaxis] ** 2
    return total * np.sin(angle) ** 2, total * np.where(angle < _RIGHT, np.cos(angle) ** 2, 0.0)


def _spans(box: _Box, likelihood: Floats) -> LightFound:
    """Where the likelihood is largest, and its intervals, from its values on a grid."""
    coarse, (root, angle) = box.grid(likelihood.shape), box.grid(_FINEST)
    log = np.maximum(likelihood - likelihood.max(), -50.0)
    smooth = scipy.interpolate.RectBivariateSpline(*coarse, log)(root, angle)
    best = np.unravel_index(smooth.argmax(), smooth.shape)
    inside = smooth >= smooth[best] - _DROP
    signal, background = _light_at(root, angle)
    if box.high[0] == box.most[0]:  # where every pulse fires, it may be by any light
        signal[-1, angle > 0] = background[-1, angle < _RIGHT] = np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        sbr = signal / background
    signal_found, background_found, sbr_found = (
        Interval(float(x[best]), float(np.nanmin(x[inside])), float(np.nanmax(x[inside])))
        for x in (signal, background, sbr)
    )
    return LightFound(signal_found, background_found, sbr_found)
