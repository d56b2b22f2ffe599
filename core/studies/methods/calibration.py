"""Calibration of confidences and intervals: is 0.9 right nine times in ten?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture, Detection
from core.estimators import RangeImage, estimate
from core.inference.intervals import interval_tolerance_bins, range_interval
from core.inference.posterior import TOLERANCE_BINS
from core.inspection import estimate_mean_flux, estimate_target_flux
from core.inspection.pulse_fit import changed
from core.metrics import Interval, ReliabilityBin, calibration_error, reliability, wilson
from core.reductions import merge_bins
from core.studies.outputs import Table, table
from core.studies.paper.printed import TABLE_2
from core.studies.statistics import mean_interval
from core.studies.trials import Condition, mapped
from core.trigger import draw_counts, rate_per_bin

METHODS = ("likelihood", "tracking", "coates", "peak")

_FEW_PULSES = 100
CONDITIONS = tuple(
    condition
    for scene in ("uniform", "car", "building", "staircase", "piecewise")
    for condition in (
        *(Condition(scene, sbr) for sbr in TABLE_2),
        Condition(scene, 0.1, signal=0.3, n_pulses=_FEW_PULSES),
        Condition(scene, 0.3, signal=0.3, n_pulses=30),
        Condition(scene, 1.0, signal=1.0, n_pulses=10),
    )
)
"""Conditions under which confidences are measured, by scene."""

LEAST_COUNT = 200
"""Estimates in a tenth of confidence whose gap is judged."""

MOST_GAP = 0.05
"""Gap up to which the confidence in a tenth is called calibrated."""

LEVELS = (0.68, 0.95)
"""Levels of the intervals whose coverage is measured."""

_PULSES, _SIDE = 1000, 48


def confidence_and_right(capture: Capture, image: RangeImage) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the confidence of all estimates and whether each is right; wrong without a surface.

    Raises
    ------
    ValueError
        If the capture has no truth.
    """
    if capture.truth_range_m is None:
        raise ValueError("truth_range_m = None is not accepted: calibration needs a truth.")
    truth_bin = capture.acquisition.range_m_to_bin(capture.truth_range_m)
    error = np.abs(np.nan_to_num(image.bin - truth_bin, nan=np.inf))
    return image.confidence[image.valid], (error <= TOLERANCE_BINS)[image.valid]


Pair = tuple[Floats, NDArray[np.bool_]]
"""Confidence of the estimates of a capture, and whether each is right."""


def tenths_over(captures: Sequence[Pair]) -> list[ReliabilityBin]:
    """Group estimates of several captures by tenths of confidence.

    Intervals are those of `core.metrics.reliability`, or wider if the captures differ by more than
    chance: the pixels of a capture share one estimate of its fluxes and depths. The sums over
    captures have Student's interval.
    """
    joined = [np.concatenate(parts) for parts in zip(*captures, strict=True)]
    found = reliability(joined[0], joined[1])
    if len(captures) < 2:
        return found
    by_capture = [{each.tenth: each for each in reliability(*pair)} for pair in captures]
    wider = []
    for each in found:
        parts = [of_one[each.tenth] for of_one in by_capture if each.tenth in of_one]
        deviation = np.zeros(len(captures))
        deviation[: len(parts)] = [x.count * (x.gap.value - each.gap.value) for x in parts]
        half = len(captures) * mean_interval(deviation).high / each.count
        share = each.right.value
        student = Interval(share, max(share - half, 0.0), min(share + half, 1.0))
        wider.append(replace(each, right=each.right.joined(student)))
    return wider


def verdict(tenth: ReliabilityBin) -> str:
    """Return ``"beyond"`` if a gap exceeds `MOST_GAP`, ``"chance"`` if its interval does not.

    Empty if the gap does not exceed it or there are too few estimates to judge.
    """
    if tenth.count < LEAST_COUNT or abs(tenth.gap.value) <= MOST_GAP:
        return ""
    within = tenth.gap.overlaps(Interval(0.0, -MOST_GAP, MOST_GAP))
    return "chance" if within else "beyond"


@dataclass(frozen=True)
class Report:
    """One method under one condition, or under all of a scene's in `CONDITIONS` (None)."""

    scene: str
    condition: Condition | None
    method: str
    tenths: list[ReliabilityBin]
    """Estimates by tenths of confidence, from `tenths_over`."""

    @property
    def error(self) -> float:
        """Expected calibration error."""
        return calibration_error(self.tenths)

    @property
    def count(self) -> int:
        """Number of estimates."""
        return sum(each.count for each in self.tenths)

    @property
    def widest(self) -> ReliabilityBin | None:
        """The tenth with the largest gap, of those with at least `LEAST_COUNT` estimates."""
        full = [each for each in self.tenths if each.count >= LEAST_COUNT]
        return max(full, key=lambda each: abs(each.gap.value), default=None)


def reports(seeds: Sequence[int], conditions: Sequence[Condition] = CONDITIONS) -> Iterator[Report]:
    """Yield a report per condition and method, and last of each scene one over all conditions."""
    for scene, group in groupby(conditions, lambda condition: condition.scene):
        found: dict[str, list[Pair]] = {name: [] for name in METHODS}
        for condition in group:
            captures = [condition.capture(seed) for seed in seeds]
            for method in METHODS:
                pairs = [confidence_and_right(c, estimate(c, method)) for c in captures]
                found[method] += pairs
                yield Report(scene, condition, method, tenths_over(pairs))
        for method in METHODS:
            yield Report(scene, None, method, tenths_over(found[method]))


def calibration_tables(seeds: Sequence[int]) -> Iterator[Table]:
    """Yield calibration error and largest gap of each report, and the gaps of all tenths."""
    found = list(reports(seeds))
    judged = [
        verdict(each)
        for report in found
        if report.condition
        for each in report.tenths
        if each.count >= LEAST_COUNT
    ]
    named: dict[str, Callable[[Report], Any]] = {
        "scene": lambda report: report.scene,
        "pulses": lambda report: report.condition.n_pulses if report.condition else "all",
        "SBR": lambda report: f"{report.condition.sbr:g}" if report.condition else "all",
        "method": lambda report: report.method,
    }
    yield table(
        "calibration",
        "Calibration of confidence",
        found,
        named
        | {
            "estimates": lambda report: report.count,
            "calibration error": lambda report: report.error,
            "largest gap": lambda report: report.widest.gap if report.widest else math.nan,
            "at confidence": lambda report: report.widest.confidence if report.widest else math.nan,
            f"beyond {MOST_GAP}": lambda report: verdict(report.widest) if report.widest else "",
        },
        note="Gap: share of right estimates minus mean confidence, in a tenth of confidence. The "
        f"largest is that of the tenths with at least {LEAST_COUNT} estimates, with its 95 % "
        "interval: Wilson's, or Student's over the captures where that is wider, since the pixels "
        "of a capture share one estimate of fluxes and depths. The largest of ten gaps is some two "
        f"standard deviations by chance alone; it is beyond {MOST_GAP} if all of its interval is, "
        f"and otherwise chance. Of {len(judged)} tenths with as many estimates, not counting rows "
        f"over all conditions, {len(judged) - judged.count('')} exceed {MOST_GAP}, "
        f"{judged.count('beyond')} of them beyond chance. With {_FEW_PULSES} pulses or fewer, more "
        "signal is sent per pulse.",
        formats={"largest gap": "+.3f", "at confidence": ".2f"},
    )
    shown = [report for report in found if report.method in ("likelihood", "tracking")]

    def gap(tenth: int) -> Callable[[Report], str]:
        def text(of: ReliabilityBin) -> str:
            return f"{of.gap.value:+.2f} ({', '.join(filter(None, (str(of.count), verdict(of))))})"

        return lambda report: next((text(t) for t in report.tenths if t.tenth == tenth), "–")

    yield table(
        "reliability",
        "Gap of each tenth of confidence (estimates)",
        shown,
        named | {f"{k / 10:.1f} to {(k + 1) / 10:.1f}": gap(k) for k in range(10)},
        note=f"Gaps beyond {MOST_GAP} of at least {LEAST_COUNT} estimates are marked as above.",
    )


@dataclass(frozen=True)
class Regime:
    """Pixels with random depths that see echoes of a Gaussian pulse."""

    detection: Detection
    sigma_bins: float
    sbr: float
    signal: float = Flux().signal

    def capture(self, seed: int) -> Capture:
        """Draw a capture; of all photons, those of as many pulses are counted."""
        acquisition, rng = Acquisition(), np.random.default_rng(seed)
        flux = Flux(self.signal, self.sbr)
        pulse = Pulse.gaussian(self.sigma_bins * acquisition.bin_width_s)
        onset = rng.uniform(0, acquisition.n_bins, (_SIDE, _SIDE))
        signal = np.full(onset.shape, flux.signal)
        rate = rate_per_bin(onset, signal, flux.background, pulse, acquisition)
        is_first = self.detection == "first"
        cube = draw_counts(rate if is_first else rate * _PULSES, _PULSES if is_first else None, rng)
        truth_m = acquisition.bin_to_range_m(onset)
        return Capture(cube, acquisition, pulse, truth_m, detection=self.detection)


REGIMES = (
    *(
        Regime(*each)
        for each in product(get_args(Detection), (0.5, 1.0, 2.0, 5.0), (0.03, 0.06, 0.3, 3.0))
    ),
    *(Regime("first", 1.0, 3.0, signal) for signal in (1.0, 3.0, 5.0)),
)


@dataclass(frozen=True)
class Coverage:
    """Share of the right estimates of a method whose interval contains the truth."""

    regime: Regime
    method: str
    right: int
    """Estimates within `interval_tolerance_bins` of the truth."""
    shares: tuple[Interval, ...]
    """One for each of `LEVELS`."""


def coverage(piece: tuple[Regime, str, range]) -> Coverage:
    """Measure the coverage of the range intervals of a method, from some seeds."""
    regime, method, seeds = piece
    right, hits = 0, np.zeros(len(LEVELS), int)
    for capture in map(regime.capture, seeds):
        image, truth_m = estimate(capture, method), np.asarray(capture.truth_range_m)
        error_m = np.abs(image.range_m - truth_m)
        most_m = interval_tolerance_bins(capture) * capture.acquisition.bin_length_m
        is_right = image.valid & (error_m <= most_m)
        right += int(np.count_nonzero(is_right))
        for i, level in enumerate(LEVELS):
            low_m, high_m = range_interval(capture, image, level)
            hits[i] += np.count_nonzero(is_right & (low_m <= truth_m) & (truth_m <= high_m))
    return Coverage(regime, method, right, tuple(wilson(int(hit), right) for hit in hits))


def coverage_table(seeds: range, processes: int = 1) -> Table:
    """Return the coverage of range intervals in each of `REGIMES`, for two methods."""
    pieces = list(product(REGIMES, ("likelihood", "tracking"), [seeds]))
    found = dict(mapped(coverage, pieces, processes))
    return table(
        "coverage",
        "Coverage of range intervals",
        (found[piece] for piece in pieces),
        {
            "detection": lambda found: found.regime.detection,
            "pulse σ, bins": lambda found: f"{found.regime.sigma_bins:g}",
            "SBR": lambda found: f"{found.regime.sbr:g}",
            "signal": lambda found: f"{found.regime.signal:g}",
            "method": lambda found: found.method,
            "right": lambda found: found.right,
            "68 %": lambda found: found.shares[0],
            "95 %": lambda found: found.shares[1],
        },
        note="Share of the estimates within 3 bins of the truth, or two standard deviations of a "
        "longer pulse, whose interval contains the truth.",
        formats={"68 %": ".3f", "95 %": ".3f"},
    )


@dataclass(frozen=True)
class FluxRegime:
    """Images of which a third is sky, recorded with another pulse than is assumed."""

    photons: str
    """Key of `FLUXES`."""
    depths: str
    """``"middle"`` of the gate, or ``"whole"`` gate, which leaves no bins without echoes."""
    pulse: str
    """Key of `TRUE_PULSES`."""

    def captures(self, seed: int) -> tuple[list[Capture], list[tuple[float, float, float]]]:
        """Draw the same photons in bins of each of `BIN_WIDTHS_S`, with true fluxes.

        Those of the mean pixel and of the mean target pixel: signal, background and SBR.
        """
        rng, width_s = np.random.default_rng(seed), BIN_WIDTHS_S[0]
        n_pulses, signal, background, unevenness, in_proportion = FLUXES[self.photons]
        acquisition = Acquisition(round(_GATE_S / width_s), width_s, n_pulses=n_pulses)
        shape = (_FLUX_SIDE, _FLUX_SIDE)
        low, high = _DEPTHS[self.depths]
        onset = acquisition.n_bins * rng.uniform(low, high, shape)
        onset[: _FLUX_SIDE // 3] = np.nan
        target = np.isfinite(onset)
        signals = np.where(target, signal * rng.gamma(4, 1 / 4, shape), 0.0)
        pulse = changed(_ASSUMED_PULSE, *TRUE_PULSES[self.pulse], _RESOLUTION_S)
        brightness = rng.uniform(1 - unevenness, 1 + unevenness, shape)
        backgrounds = background * brightness
        if in_proportion:
            signals *= brightness
        rate = rate_per_bin(onset, signals, 0.0, pulse, acquisition)
        rate += backgrounds[..., np.newaxis] / acquisition.n_bins
        cube = draw_counts(rate, n_pulses, rng)
        detection: Detection = "all" if n_pulses is None else "first"
        finest = Capture(cube, acquisition, _ASSUMED_PULSE, detection=detection)
        merged = [merge_bins(finest, round(each / width_s)) for each in BIN_WIDTHS_S]
        means, mean = (float(signals.mean()), float(signals[target].mean())), backgrounds.mean()
        return merged, [(each, float(mean), each / float(mean)) for each in means]


FLUXES = {
    "all": (None, 3.5, 0.25, 0.0, False),
    "first": (200, 0.3, 1.0, 0.0, False),
    "first, SBR 0.03": (1000, 0.1041, 3.47, 0.0, False),
    "first, uneven background": (200, 0.3, 1.0, 0.5, False),
    "first, uneven reflectivity": (200, 0.3, 1.0, 0.5, True),
}
"""Pulses; mean signal of a target pixel and background per pulse, of all pulses if None; the
largest relative deviation of a pixel's background; and whether its signal deviates likewise."""

TRUE_PULSES = {
    "as assumed": (1.0, 0.0, 0.0),
    "half as long": (0.5, 0.0, 0.0),
    "twice as long": (2.0, 0.0, 0.0),
    "exponential tail": (1.0, 0.4, 1.5),
}
"""Stretch, share of a tail and its length, as for `core.inspection.pulse_fit.changed`."""

BIN_WIDTHS_S = (0.25e-9, 1e-9)

FLUX_REGIMES = (
    *(
        FluxRegime(*each, pulse)
        for each in (("all", "middle"), ("all", "whole"), ("first", "whole"))
        for pulse in TRUE_PULSES
    ),
    FluxRegime("first, SBR 0.03", "middle", "as assumed"),
    FluxRegime("first, uneven background", "whole", "as assumed"),
    FluxRegime("first, uneven reflectivity", "whole", "as assumed"),
)
_DEPTHS = {"middle": (0.4, 0.6), "whole": (0.06, 0.8)}
_ASSUMED_PULSE, _RESOLUTION_S = Pulse.gaussian(1e-9), 0.05e-9
_GATE_S, _FLUX_SIDE = 150e-9, 32

FLUX_CHECKS = (
    "PPP, all pixels",
    "background",
    "SBR, all pixels",
    "PPP, target pixels",
    "SBR, target pixels",
    "SBR overlaps that of the finest bins",
)
"""Statements about a capture of which `flux_coverage` counts how many hold."""


@dataclass(frozen=True)
class FluxCoverage:
    """Captures whose flux intervals contain the truth."""

    regime: FluxRegime | None
    """None: all of them together."""
    bin_width_s: float
    captures: int
    hits: NDArray[np.int64]
    """Shape (check,): captures for which each of `FLUX_CHECKS` holds."""

    def share(self, check: str) -> Interval:
        """Return the share of the captures for which one of `FLUX_CHECKS` holds."""
        return wilson(int(self.hits[FLUX_CHECKS.index(check)]), self.captures)


def flux_coverage(piece: tuple[FluxRegime, range]) -> list[FluxCoverage]:
    """Measure the coverage of flux intervals in bins of each width, from some seeds."""
    regime, seeds = piece
    hits = np.zeros((len(BIN_WIDTHS_S), len(FLUX_CHECKS)), int)
    for seed in seeds:
        captures, truth = regime.captures(seed)
        images = [estimate_mean_flux(each) for each in captures]
        for i, (capture, image) in enumerate(zip(captures, images, strict=True)):
            target = estimate_target_flux(capture)
            intervals = (*image, target.signal, target.sbr)
            true = (*truth[0], truth[1][0], truth[1][2])
            covers = [each.low <= x <= each.high for each, x in zip(intervals, true, strict=True)]
            hits[i] += [*covers, image.sbr.overlaps(images[0].sbr)]
    return [
        FluxCoverage(regime, width_s, len(seeds), each)
        for width_s, each in zip(BIN_WIDTHS_S, hits, strict=True)
    ]


def flux_table(captures: int, processes: int = 1) -> Table:
    """Return the coverage of flux intervals in each of `FLUX_REGIMES`, and in all together."""
    pieces = [
        (regime, range(i * captures, (i + 1) * captures)) for i, regime in enumerate(FLUX_REGIMES)
    ]
    by_piece = dict(mapped(flux_coverage, pieces, processes))
    found = [each for piece in pieces for each in by_piece[piece]]
    for width_s in BIN_WIDTHS_S:
        hits = [each.hits for each in found if each.bin_width_s == width_s]
        found.append(FluxCoverage(None, width_s, captures * len(hits), np.sum(hits, axis=0)))

    def share(check: str) -> Callable[[FluxCoverage], Interval]:
        return lambda of: of.share(check)

    return table(
        "flux_coverage",
        "Coverage of 95 % flux intervals, with a wrong pulse and in bins of several widths",
        found,
        {
            "photons": lambda of: of.regime.photons if of.regime else "all regimes",
            "depths": lambda of: f"{of.regime.depths} gate" if of.regime else "",
            "true pulse": lambda of: of.regime.pulse if of.regime else "",
            "bins, ns": lambda of: f"{of.bin_width_s * 1e9:g}",
            "captures": lambda of: of.captures,
            **{check: share(check) for check in FLUX_CHECKS},
        },
        note="Share of the captures whose interval contains the truth.",
        formats=dict.fromkeys(FLUX_CHECKS, ".2f"),
    )
