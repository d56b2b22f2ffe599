"""Confidence where the model does not hold: is it right, or does the capture carry a warning?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.effects import Jitter, Motion
from core.estimators import estimate
from core.inference.fit import Fit, fit_of
from core.inspection import CONFIDENT
from core.metrics import Interval, wilson
from core.scene import scenes
from core.simulation import simulate
from core.studies.methods.calibration import confidence_and_right
from core.studies.outputs import Table, table
from core.studies.trials import Condition
from core.trigger import draw_counts, rate_per_bin

LEAST_RIGHT = 0.85
"""Share of the confident estimates that must be right in a capture without a warning."""

MOST_WARNED = 0.05
"""Largest share of the captures with a warning where the model holds."""

_SIGNAL, _PULSE = 0.1041, Pulse(1e-9)


@dataclass(frozen=True)
class Case:
    """A scene whose captures are ranged with one echo of a 1 ns pulse over a smooth background."""

    scene: str
    sbr: float = 0.06
    background: Callable[[Floats], Floats] | None = None
    """Shape over the bins of the gate; None for a flat one."""
    pulse: Pulse = _PULSE
    """The true pulse."""
    parts: dict[str, Any] = field(default_factory=dict)
    """Further `core.PARTS` of the scene."""

    def capture(self, seed: int) -> Capture:
        """Draw a capture; the seed draws random depths, too."""
        if self.background is not None:
            return self._shaped(self.background, seed)
        condition = Condition(self.scene, self.sbr, _SIGNAL)
        if self.pulse == _PULSE and not self.parts:
            return condition.capture(seed)
        scene, flux = replace(scenes[self.scene](), **self.parts), Flux(_SIGNAL, self.sbr)
        capture = simulate(scene, scene.acquisition, flux, self.pulse, seed)
        return replace(capture, pulse=_PULSE)

    def _shaped(self, shape: Callable[[Floats], Floats], seed: int) -> Capture:
        scene = scenes[self.scene]()
        return shaped_capture(scene.range_m, scene.acquisition, self.sbr, shape, seed)


def shaped_capture(
    range_m: Floats,
    acquisition: Acquisition,
    sbr: float,
    shape: Callable[[Floats], Floats],
    seed: int,
) -> Capture:
    """Draw a capture whose background is a function of the bin, for ranges that may be NaN."""
    onset = acquisition.range_m_to_bin(range_m)
    echo = rate_per_bin(onset, np.full(onset.shape, _SIGNAL), 0.0, _PULSE, acquisition)
    background = shape(np.arange(float(acquisition.n_bins)))
    rate = echo + _SIGNAL / sbr * background / background.sum()
    counts = draw_counts(rate, acquisition.n_pulses, np.random.default_rng(seed))
    return Capture(counts, acquisition, _PULSE, range_m)


def ramp(rise: float) -> Callable[[Floats], Floats]:
    """Return a background that changes linearly over the gate, by `rise` of its first bin."""
    return lambda k: 1 + rise * k / k[-1]


def decay(k: Floats) -> Floats:
    """Return a background that is half as large again at first, and decays over 10 bins."""
    return np.asarray(1 + 0.5 * np.exp(-k / 10))


CASES = {
    "background rises by 50 %": Case("car", background=ramp(0.5)),
    "background falls by 50 %": Case("car", background=ramp(-0.5)),
    "+50 % that decays over 10 bins": Case("car", background=decay),
    "fog": Case("fog"),
    "pulse × 3": Case("car", pulse=Pulse(3e-9)),
    "jitter of 3 ns": Case("car", parts={"jitter": Jitter(3e-9)}),
    "motion of 2 m": Case("car", parts={"motion": Motion(-40.0, 20e3)}),
    "worn instrument": Case("worn"),
}
"""Captures that the model does not describe, by name."""

NULL_CASES = tuple(
    Case(scene, sbr) for scene in ("car", "building", "uniform") for sbr in (0.03, 0.06, 0.3, 30.0)
)
"""Captures that the model describes."""


@dataclass(frozen=True)
class Outcome:
    """Confident estimates and warnings of the captures of a case."""

    name: str
    case: Case | None
    """None: several together."""
    right: tuple[int, ...]
    """Confident estimates that are right, of each capture."""
    confident: tuple[int, ...]
    fits: tuple[Fit, ...]

    @property
    def warned(self) -> Interval:
        """Share of the captures with a warning."""
        return wilson(sum(not fit.fits for fit in self.fits), len(self.fits))

    @property
    def all_right(self) -> Interval:
        """Share of the confident estimates that are right."""
        return wilson(sum(self.right), sum(self.confident))

    @property
    def unwarned_right(self) -> Interval:
        """Share of the confident estimates that are right, in captures without a warning.

        NaN if there are none.
        """
        kept = [fit.fits for fit in self.fits]
        right, confident = (int(np.sum(x, where=kept)) for x in (self.right, self.confident))
        return wilson(right, confident) if confident else Interval(np.nan, np.nan, np.nan)

    @property
    def holds(self) -> bool:
        """Whether confident estimates without a warning are right, or warnings are rare enough."""
        if self.name in CASES:
            return not self.unwarned_right.value < LEAST_RIGHT
        return self.warned.low <= MOST_WARNED

    def effect(self, check: str) -> float:
        """Median effect of a check."""
        return float(np.median([getattr(fit, check).effect for fit in self.fits]))


def outcome(name: str, case: Case, seeds: Sequence[int]) -> Outcome:
    """Range one capture of a case for each seed."""
    found = []
    for capture in map(case.capture, seeds):
        confidence, right = confidence_and_right(capture, estimate(capture, "likelihood"))
        sure = confidence >= CONFIDENT
        found.append((int(right[sure].sum()), int(sure.sum()), fit_of(capture)))
    right_counts, confident, fits = zip(*found, strict=True)
    return Outcome(name, case, right_counts, confident, fits)


def outcomes(seeds: Sequence[int]) -> Iterator[Outcome]:
    """Yield the outcome of each case, and last of all that the model describes together."""
    for name, case in CASES.items():
        yield outcome(name, case, seeds)
    found = [outcome("as the model", case, seeds) for case in NULL_CASES]
    yield from found
    together = (
        sum((getattr(each, part) for each in found), ()) for part in ("right", "confident", "fits")
    )
    yield Outcome("as the model", None, *together)


def fit_table(found: Sequence[Outcome]) -> Table:
    """Return shares of right estimates and of warned captures, and effects, of each outcome."""
    right, unwarned, warned = (
        f"right of those stated ≥ {CONFIDENT}",
        "right, captures without warning",
        "captures with warning",
    )

    def effect(check: str) -> Callable[[Outcome], float]:
        return lambda of: of.effect(check)

    effects = {f"{check}, effect": effect(check) for check in Fit._fields}
    return table(
        "fit",
        "Confidence outside the model, and warnings of the goodness of fit",
        found,
        {
            "case": lambda of: of.name,
            "scene": lambda of: of.case.scene if of.case else "all",
            "SBR": lambda of: f"{of.case.sbr:g}" if of.case else "all",
            "captures": lambda of: len(of.fits),
            right: lambda of: of.all_right,
            unwarned: lambda of: of.unwarned_right,
            warned: lambda of: of.warned,
            **effects,
        },
        note="Likelihood, with 95 % intervals. Effects are medians, see `core.inference.fit.Fit`.",
        formats=dict.fromkeys((right, unwarned, warned, *effects), ".3f"),
    )
