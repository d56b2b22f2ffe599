"""How much signal and background the pixels of a capture see on average, and how well it is known.

The photons of all pixels, their pile-up undone (Coates 1968), add up to the mean of signal and
background together. How much of it is signal is told by a sample of the pixels: how often which
signal occurs among them is estimated by the nonparametric maximum likelihood of a mixing
distribution (Kiefer & Wolfowitz 1956), as in `core.posterior` but on a grid of signals and delays
fine enough for its mean. Intervals are those between the 2.5 % and 97.5 % quantiles of the same on
resampled pixels (the bootstrap of Efron 1979).
"""

from __future__ import annotations

import numpy as np

from core import posterior
from core.acquisition import Floats
from core.capture import Capture, once_per_capture
from core.inspection.light import LEVEL, LightFound
from core.metrics import Interval

METHOD = "mixture likelihood of the pixels' signals, bootstrap over the pixels, 95 %"

_SAMPLE = 1024  # pixels
_LEVELS = 32  # of signal, besides none
_RESAMPLED = 400
_EM_STEPS = 100
_ROUNDS = 3


@once_per_capture
def mean_light(capture: Capture) -> LightFound:
    """Mean signal and background of all pixels, and their ratio, with 95 % intervals.

    In photons per pulse where the pulses are known, else in photons. Pixels without an echo count,
    as ones of no signal.
    """
    total = posterior.total_rates(capture)
    rng = np.random.default_rng(0)
    pixels = rng.permutation(total.size)[:_SAMPLE]
    levels, likelihood, share = _mixture(capture, total, pixels)
    drawn = rng.integers(pixels.size, size=(_RESAMPLED, pixels.size))
    times = np.stack([np.bincount(each, minlength=pixels.size) for each in drawn]).astype(float)
    signal = _shares(likelihood, times, np.tile(share, (_RESAMPLED, 1))) @ levels
    sampled = total.ravel()[pixels]
    off = (times @ sampled / pixels.size - sampled.mean()) * np.sqrt(pixels.size / total.size)
    background = np.maximum(total.mean() + off - signal, 0.0)
    best = float(share @ levels)
    left = max(float(total.mean()) - best, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, best_ratio = signal / background, np.divide(best, left)
    found = LightFound(
        _interval(best, signal), _interval(left, background), _interval(float(best_ratio), ratio)
    )
    n_pulses = capture.acquisition.n_pulses
    return found.per_pulse(n_pulses) if n_pulses and capture.armed_pulses is None else found


def _mixture(capture: Capture, total: Floats, pixels: np.ndarray) -> tuple[Floats, Floats, Floats]:
    """Levels of signal (level,), the likelihood of each (pixel, level), and shares (level,)."""
    known = posterior.detailed_lighting_of(capture)
    top = known.levels[-1] * 1.2
    levels = np.concatenate([[0.0], np.geomspace(top / 200, top, _LEVELS)])
    signal = float(known.share @ known.levels)
    share = np.full(levels.size, 1 / levels.size)
    for _ in range(_ROUNDS):
        lighting = known._replace(
            levels=levels, share=share, background=np.asarray(total.mean() - signal)
        )
        evidence = posterior.level_evidence(capture, pixels, lighting, 4)
        likelihood = np.exp(evidence - evidence.max(axis=1, keepdims=True))
        share = _shares(likelihood, np.ones((1, pixels.size)), share[np.newaxis])[0]
        signal = float(share @ levels)
    return levels, likelihood, share


def _shares(likelihood: Floats, times: Floats, share: Floats) -> Floats:
    """Shares of the levels (resample, level) that make so many of each pixel most likely."""
    for _ in range(_EM_STEPS):
        share = share * ((times / (share @ likelihood.T)) @ likelihood)
        share /= share.sum(axis=1, keepdims=True)
    return share


def _interval(value: float, resampled: Floats) -> Interval:
    low, high = np.nanquantile(resampled, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    return Interval(value, min(float(low), value), max(float(high), value))
