"""Choice of the settings of a method for a capture, on a simulated twin whose truth is known.

The twin is simulated from what the capture shows: the ranges of the image posterior, the mean
signal of pixels with an echo, the background and the pulse. A search from the default settings
finds those that restore most pixels of the twin. They are compared with the defaults on a second
twin, of other noise; the defaults are kept unless they are beaten by two standard errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import Field, dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.estimators import ESTIMATORS, estimate, require_capture, settings_of
from core.estimators.image_model import image_model_of
from core.inference.flux import flux_prior_of
from core.inference.neighbours import random_patches
from core.inference.posterior import TOLERANCE_BINS
from core.parameters import Choice, spec_of
from core.trigger import draw_counts, rate_per_bin

__all__ = [
    "FACTORS",
    "FIXED",
    "SURE",
    "Trial",
    "Tuning",
    "free_fields",
    "is_tunable",
    "right_targets",
    "searched",
    "tuned",
    "twin",
]

FACTORS = (0.25, 0.5, 0.7, 1.4, 2.0, 4.0)
"""Multiples of a setting that a search tries."""

FIXED = {
    "tracking": ("h", "refine"),  # only (m·h)²·l matters; a pixel is right or wrong without it
    "likelihood": ("steps_per_bin",),  # finer steps only cost time
    "image_posterior": ("false_surface",),  # of targets, most are found if all pixels get a range
}
"""Settings that no search changes, by the name of the estimator."""

SURE = 2.0
"""Standard errors by which other settings have to beat the default ones."""

_COARSE = {"tracking": {"refine": "none"}}  # settings that make a trial faster
_MOST_PIXELS = 64 * 64  # of a twin; of larger images, patches
_MOST_COUNTS = 2**23
_PATCH = 32


class Trial(NamedTuple):
    """Settings that were tried."""

    settings: Any
    rd: float
    """Share of the targets of the first twin within 3 bins."""


@dataclass(frozen=True)
class Tuning:
    """Result of `tuned`, with the figures behind it."""

    method: str
    settings: Any
    """The settings chosen."""
    best: Any
    """Those that restored most of the first twin; the defaults if no others restored more."""
    trials: tuple[Trial, ...]
    """All settings tried, the best first."""
    default_rd: float
    """Share of the targets of the second twin within 3 bins with the default settings."""
    best_rd: float
    """With the best ones."""
    error: float
    """Standard error of their difference."""
    n_targets: int
    """Pixels with a target in the second twin."""

    @property
    def is_default(self) -> bool:
        """Whether the default settings were kept."""
        return bool(self.settings == type(self.settings)())

    @property
    def why(self) -> str:
        """Sentences that state what was tried and why this was chosen."""
        if self.n_targets == 0:
            return "The defaults are kept: no surface was found from which to simulate."
        tried = (
            f"{len(self.trials)} settings were tried on a capture simulated from the surfaces, "
            "signal and background that this one shows."
        )
        if self.best == type(self.best)():
            return f"{tried} None restored more than the defaults: RD {self.default_rd:.3f}."
        compared = (
            f"On a second one of {self.n_targets:,} targets, the best restored {self.best_rd:.3f} "
            f"and the defaults {self.default_rd:.3f} (standard error of the difference: "
            f"{self.error:.3f})."
        )
        kept = "the defaults are kept" if self.is_default else "the best are chosen"
        return f"{tried} {compared} They differ by {self._in_errors} standard errors: {kept}."

    @property
    def _in_errors(self) -> str:
        return f"{(self.best_rd - self.default_rd) / self.error:.1f}" if self.error else "no"


def tuned(
    capture: Capture,
    method: str = "tracking",
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Tuning:
    """Choose the settings of a method for a capture.

    Parameters
    ----------
    capture : Capture
    method : str
        Key of `core.ESTIMATORS`.
    progress : callable
        ``(settings tried, settings to try)``; may raise to cancel.

    Raises
    ------
    ValueError
        If the method is unknown, has no settings, or knows the true fluxes, so that it is no method
        for a capture.
    """
    require_capture(capture)
    default = settings_of(method, None)
    require("method", method, is_tunable(method), "a method with settings to choose")
    free = free_fields(method)
    part = _part(capture)
    first, second = (twin(part, seed) for seed in (0, 1))
    rd_of: dict[Any, float] = {}
    n_settings = len({default, *(other for each in free for other in _others(default, each))})

    def restored(settings: Any) -> float:
        if settings not in rd_of:
            try:
                rd_of[settings] = float(right_targets(first, method, settings).mean())
            except ValueError:  # they need what the capture does not have, such as its pulses
                rd_of[settings] = -math.inf
            progress(len(rd_of), n_settings)
        return rd_of[settings]

    if not np.isfinite(np.asarray(first.truth_range_m)).any():
        return Tuning(method, default, default, (), 0.0, 0.0, 0.0, 0)
    best = searched(default, free, restored, 1)
    progress(len(rd_of), len(rd_of))
    before, after = (right_targets(second, method, each) for each in (default, best))
    gain, error = float(after.mean() - before.mean()), _error(after, before)
    possible = (Trial(*each) for each in rd_of.items() if math.isfinite(each[1]))
    trials = sorted(possible, key=lambda each: -each.rd)
    return Tuning(
        method,
        best if gain > SURE * error else default,
        best,
        tuple(trials),
        float(before.mean()),
        float(after.mean()),
        error,
        before.size,
    )


def is_tunable(method: str) -> bool:
    """Return whether `tuned` can choose settings of a method of `core.ESTIMATORS`."""
    return bool(free_fields(method)) and not ESTIMATORS[method].knows_flux


def free_fields(method: str) -> list[Field[Any]]:
    """Return the settings of a method that a search changes."""
    fixed = FIXED.get(method, ())
    return [each for each in fields(ESTIMATORS[method].parameters) if each.name not in fixed]


def twin(capture: Capture, seed: int) -> Capture:
    """Simulate a capture with the surfaces and fluxes that another one shows.

    Its truth is the range that the image posterior finds, where a surface is likelier than none.
    """
    flux, acquisition = image_model_of(capture), capture.acquisition
    delay_bin = estimate(capture, "image_posterior", pixels="allow empty pixels").bin
    echo = rate_per_bin(delay_bin, flux.typical_signal, 0.0, capture.pulse, acquisition)
    mean = flux.typical_background[..., np.newaxis] / acquisition.n_bins
    rate = echo + mean * flux.relative_background
    counts = draw_counts(rate, capture.gated_pulses, np.random.default_rng(seed))
    return Capture(
        counts,
        acquisition,
        capture.pulse,
        truth_range_m=acquisition.bin_to_range_m(delay_bin),
        source=f"simulated as {capture.source}, seed {seed}",
        detection=capture.detection,
        flux_prior=flux_prior_of(capture),
    )


def searched(
    start: Any, free: Sequence[Field[Any]], restored: Callable[[Any], float], most_rounds: int
) -> Any:
    """Return the settings with the highest value that a search finds.

    One setting after the other is multiplied by each of `FACTORS`, or takes each of its options;
    the best is kept. This is repeated until nothing changes.

    Parameters
    ----------
    start : object
        Settings of a method.
    free : sequence of dataclass fields
        Settings to change.
    restored : callable
        ``settings -> value``.
    most_rounds : int
    """
    best, before = start, None
    for _ in range(most_rounds):
        if best == before:
            break
        before = best
        for each in free:
            best = max([best, *_others(best, each)], key=restored)
    return best


def _others(settings: Any, of: Field[Any]) -> Iterator[Any]:
    """Yield the same settings with other values of one field."""
    spec, now = spec_of(of), getattr(settings, of.name)
    if isinstance(spec, Choice):
        yield from (replace(settings, **{of.name: each}) for each in spec.options)
        return
    start = now or 0.05 * (spec.high - spec.low)  # a multiple of 0 would be 0
    for factor in FACTORS:
        value = min(max(float(f"{factor * start:.3g}"), spec.low), spec.high)
        yield replace(settings, **{of.name: round(value) if spec.whole else value})


def _part(capture: Capture) -> Capture:
    """Return a capture, or random patches of a larger one below each other."""
    most = max(1, min(_MOST_PIXELS, _MOST_COUNTS // capture.acquisition.n_bins))
    if capture.counts.size <= most:
        return capture
    patches = random_patches(capture.shape, most, min(_PATCH, math.isqrt(most)))
    return replace(
        capture,
        cube=np.concatenate([capture.cube[patch] for patch in patches]),
        **capture.images(lambda _: None),
        flux_prior=None,
        stated_flux=None,
        groups=None,
    )


def right_targets(capture: Capture, method: str, settings: Any) -> NDArray[np.bool_]:
    """Whether each target of a twin is restored within 3 bins, shape (target,)."""
    coarse = replace(settings, **_COARSE.get(method, {}))
    delay_bin, _ = ESTIMATORS[method].delays(capture, coarse)
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    target = np.isfinite(truth_bin)
    return np.asarray(np.abs(delay_bin - truth_bin)[target] <= TOLERANCE_BINS)


def _error(after: NDArray[np.bool_], before: NDArray[np.bool_]) -> float:
    """Standard error of the difference of two shares of the same targets, if they are equal.

    From the targets in which they differ (McNemar 1947).
    """
    return math.sqrt(np.count_nonzero(after != before)) / after.size
