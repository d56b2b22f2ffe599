"""Size and power of the verdicts on captures: how often they are right for effects of known size.

Captures of random depths are simulated with one property of known size each. Where it is absent,
the share of the verdicts "needed" is the size of the test.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from core.acquisition import Acquisition, Pulse
from core.capture import Capture
from core.metrics import Interval, wilson
from core.studies.ablation import capture_parts
from core.studies.ablation.criterion import TITLES, Requirement
from core.studies.ablation.evidence import POWER, SIZE, Verdict
from core.studies.outputs import Table, table
from core.studies.trials import mapped
from core.trigger import draw_counts, rate_per_bin

_SIDE = 24  # rows and columns of a capture
_SIGNAL, _PULSES = 0.1041, 1000
_LATEST_BIN = 94
_SEEN = f"p < {SIZE:g}"
SURE = 0.995
"""Level of the intervals that tell whether an absent property is found too often. Of the eight
that are tried, one would be by chance in 3 % of the studies of 100 captures."""
_SEEDS_PER_PIECE = 10

_JUDGES: dict[str, Callable[[Capture], Requirement]] = {
    "pulse_shape": capture_parts.pulse_shape,
    "second_surface": capture_parts.second_surface,
    "backscatter": capture_parts.backscatter,
    "faulty_pixels": capture_parts.faulty_pixels,
    "signal_levels": partial(capture_parts.signal_levels, method="likelihood"),
    "pile_up": partial(capture_parts.pile_up, method="likelihood"),
}

UNITS = {
    "pulse_shape": "width of the true pulse relative to that of the assumed one",
    "second_surface": "share of the pixels in which half the signal comes from a second surface",
    "backscatter": "fall of the background over the gate",
    "faulty_pixels": "share of hot and dead pixels",
    "signal_levels": "standard deviation of the logarithm of the signal",
    "pile_up": "photons per pulse, with as many in all pulses",
}
"""Property that is varied for each part or correction."""

_ABSENT = {
    "pulse_shape": 1.0,
    "second_surface": 0.0,
    "backscatter": 0.0,
    "faulty_pixels": 0.0,
    "signal_levels": 0.0,
}
_VALUES = {
    "pulse_shape": (1.0, 0.5, 0.8, 1.1, 1.25, 2.0, 3.0),
    "second_surface": (0.0, 0.02, 0.05, 0.1, 0.3, 1.0),
    "backscatter": (0.0, 0.02, 0.05, 0.1, 0.2, 0.5),
    "faulty_pixels": (0.0, 0.005, 0.01, 0.02, 0.05),
    "signal_levels": (0.0, 0.1, 0.2, 0.3, 0.5),
    "pile_up": (0.02, 0.1, 0.2, 0.5, 2.0),
}


@dataclass(frozen=True)
class Case:
    """Captures with one property of known size."""

    part: str
    """A key of `UNITS`."""
    value: float
    """In the unit of `UNITS`."""
    sbr: float

    @property
    def is_absent(self) -> bool:
        """Whether the property is absent."""
        return self.value == _ABSENT.get(self.part)

    def capture(self, seed: int) -> Capture:
        """Draw a capture; its depths are random, too."""
        rng, shape = np.random.default_rng(seed), (_SIDE, _SIDE)
        photons = _SIGNAL * (1 + 1 / self.sbr)
        dimmed = self.value / photons if self.part == "pile_up" else 1.0
        n_pulses = round(_PULSES / dimmed)
        acquisition, pulse = Acquisition(n_pulses=n_pulses), Pulse(1e-9 * self._of("pulse_shape"))
        fall = self._of("backscatter")
        background = np.linspace(1.0, 1.0 - fall, acquisition.n_bins) / (1 - fall / 2)
        signal = _SIGNAL * rng.lognormal(0.0, self._of("signal_levels"), shape)
        second = (rng.random(shape) < self._of("second_surface")) / 2
        rate = background * _SIGNAL / self.sbr / acquisition.n_bins
        for share in (1 - second, second):
            onset = rng.uniform(0, _LATEST_BIN, shape)
            rate = rate + rate_per_bin(onset, share * signal, 0.0, pulse, acquisition)
        faulty = rng.random(shape) < self._of("faulty_pixels")
        hot = rng.random(shape) < 0.5
        rate[faulty & hot] += photons / acquisition.n_bins
        rate[faulty & ~hot] = 0.0
        return Capture(draw_counts(dimmed * rate, n_pulses, rng), acquisition, Pulse(1e-9))

    def _of(self, part: str) -> float:
        return self.value if part == self.part else _ABSENT[part]


_SBRS = {"pulse_shape": (0.03, 0.06), "second_surface": (0.06, 0.3), "signal_levels": (0.06, 0.3)}

CASES = tuple(
    Case(part, value, sbr)
    for part in UNITS
    for sbr in _SBRS.get(part, (0.06,))
    for value in _VALUES[part]
)


@dataclass(frozen=True)
class Outcome:
    """Verdicts on the captures of a case."""

    case: Case
    found: tuple[Requirement, ...]

    def share(self, verdict: Verdict, level: float = 0.95) -> Interval:
        """Share of the captures with a verdict."""
        return wilson(sum(each.verdict == verdict for each in self.found), len(self.found), level)

    def seen(self, level: float = 0.95) -> Interval:
        """Share of the captures in which a test of the property is significant; NaN without one."""
        if any(math.isnan(each.p_value) for each in self.found):
            return Interval(math.nan, math.nan, math.nan)
        return wilson(sum(each.p_value < SIZE for each in self.found), len(self.found), level)

    def median(self, name: str) -> float:
        """Median of a field of `Requirement`."""
        return float(np.median([getattr(each, name) for each in self.found]))

    @property
    def holds(self) -> bool:
        """Whether an absent property is not found significantly more often than `SIZE`."""
        shares = (self.seen(SURE), self.share("needed", SURE))
        return not (self.case.is_absent and any(each.low > SIZE for each in shares))


def outcomes(
    cases: Sequence[Case],
    n_captures: int,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Iterator[Outcome]:
    """Yield the verdicts on as many captures of each case."""
    pieces = [
        (case, range(first, min(first + _SEEDS_PER_PIECE, n_captures)))
        for case in cases
        for first in range(0, n_captures, _SEEDS_PER_PIECE)
    ]
    found: dict[Case, list[Requirement]] = {case: [] for case in cases}
    for done, ((case, _), verdicts) in enumerate(mapped(_verdicts, pieces, processes), 1):
        found[case] += verdicts
        progress(done, len(pieces))
    yield from (Outcome(case, tuple(verdicts)) for case, verdicts in found.items())


def _verdicts(piece: tuple[Case, range]) -> list[Requirement]:
    case, seeds = piece
    return [_JUDGES[case.part](case.capture(seed)) for seed in seeds]


def power_table(found: Sequence[Outcome]) -> Table:
    """Return one row per case: shares of the verdicts with 95 % intervals."""
    verdicts: tuple[Verdict, ...] = ("needed", "not needed", "cannot tell")

    def share(verdict: Verdict) -> Callable[[Outcome], Interval]:
        return lambda of: of.share(verdict)

    units = ". ".join(f"{TITLES[part].capitalize()}: {unit}" for part, unit in UNITS.items())
    return table(
        "power",
        f"Verdicts on captures of {_SIDE} × {_SIDE} pixels with a property of known size",
        found,
        {
            "part or correction": lambda of: TITLES[of.case.part],
            "size": lambda of: f"{of.case.value:g}" + (" (absent)" if of.case.is_absent else ""),
            "SBR": lambda of: f"{of.case.sbr:g}",
            "captures": lambda of: len(of.found),
            **{verdict: share(verdict) for verdict in verdicts},
            _SEEN: lambda of: of.seen(),
            "effect": lambda of: of.median("effect"),
            "seen from": lambda of: of.median("smallest_effect"),
        },
        note=f"Size. {units}. Effects and the smallest ones that are seen with a probability of "
        f"{POWER:.0%} are medians. An absent property should be seen ({_SEEN}) in no more than "
        f"{SIZE:.0%} of the captures. Depths are random; {_SIGNAL:g} signal photons per pulse, "
        f"{_PULSES} pulses.",
        formats={**dict.fromkeys((*verdicts, _SEEN), ".2f"), "effect": ".3f", "seen from": ".3f"},
    )
