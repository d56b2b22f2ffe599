"""Sensitivity: the range of each parameter in which each estimator can be trusted.

One parameter at a time is swept through all accepted values, the others at their defaults, on
depths uniform over the gate. A value is trusted where it loses at most `LOSS` of the pixels against
the best value of its sweep; differences are paired over pixels. Tracking is not refined below a
bin: the refinement hides the difference between an estimate in the right bin and one beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS, estimate, settings_of
from core.inference.posterior import TOLERANCE_BINS
from core.kernels.blocks import to_blocks
from core.parameters import Number, Zone, joint_doubts, spec_of
from core.scene import Scene
from core.simulation import simulate
from core.studies.outputs import as_text
from core.tracking import (
    FEW_BINS,
    SLOW_L,
    STEEP_ALPHA,
    TrackingParameters,
    track,
    tracking_signals,
)

SIGNAL = 0.1041  # the paper's photons per pulse

_ROUNDINGS = 16 * float(np.finfo(np.float32).eps)  # float32 operations from count to score, about

LOSS = 0.1
"""Share of the pixels that a trusted value may lose against the best one."""

FAILING = 0.5
"""Share of the best value's correct estimates below which a method fails."""

MAX_DISAGREEMENT = 0.01
"""Share of pixels with another bin in float32 above which rounding decides."""

MAX_RINGING = 1e-6
"""Share of an echo that a filter at rest may still move by."""

BASES = (0.06, 0.1, 0.2, 0.5, 1.0)
"""SBRs of sweeps: the first at which a method restores nine pixels in ten by its defaults."""

SEED = 2000  # not used by the tables or by the search for the preset

METHODS = {name: each for name, each in ESTIMATORS.items() if not each.follows_motion}
"""Methods whose settings are swept; those that follow motion need pulses in order."""


@dataclass(frozen=True, eq=False)
class Point:
    """A method's result with one value of the swept parameter."""

    value: float
    right: NDArray[np.bool_]
    """Whether each target pixel is estimated within 3 bins."""
    answered: float
    """Share of target pixels with an estimate."""
    confidence: float
    """Mean over the estimates."""

    @property
    def share(self) -> float:
        """Restoration degree within 3 bins."""
        return float(self.right.mean())


@dataclass(frozen=True, eq=False)
class Sweep:
    """One parameter of one method, values in rising order."""

    method: str
    parameter: str
    sbr: float
    """With all parameters at their defaults."""
    points: Sequence[Point]

    @property
    def best(self) -> Point:
        """The value with most correct estimates."""
        return max(self.points, key=lambda point: point.share)

    def loss(self, point: Point) -> tuple[float, float]:
        """Return the share of pixels lost against the best value, and its standard deviation.

        Paired over pixels where both values have the same number of them.
        """
        best, here = self.best.right, point.right
        if best.size == here.size:
            lost = best.astype(float) - here
            return float(lost.mean()), float(lost.std() / math.sqrt(lost.size))
        variance = sum(x.mean() * (1 - x.mean()) / x.size for x in (best, here))
        return float(best.mean() - here.mean()), math.sqrt(variance)

    def state(self, point: Point) -> str:
        """Return ``trusted``, ``degraded`` or ``failing``; a loss within chance is ignored."""
        loss, deviation = self.loss(point)
        if loss - 2 * deviation <= LOSS:
            return "trusted"
        return "failing" if point.share < FAILING * self.best.share else "degraded"

    def ranges(self, state: str) -> str:
        """Return the values in one state as ranges."""
        runs = groupby(self.points, self.state)
        values = [[point.value for point in run] for kind, run in runs if kind == state]
        return ", ".join(_span(run[0], run[-1]) for run in values)

    @property
    def worst(self) -> Point:
        """The value with fewest correct estimates."""
        return min(self.points, key=lambda point: point.share)


def _span(low: float, high: float) -> str:
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


# -- Scenes ----------------------------------------------------------------------------------------


def tile(method: str) -> int:
    """Return the side of tiles of equal depth: above 1 for methods that use neighbours."""
    each = ESTIMATORS[method]
    return 8 if each.whole_image or each.window_size(each.parameters()) > 1 else 1


@dataclass(frozen=True)
class SweepScene:
    """Depths uniform over the middle of a gate; each field is a parameter to sweep."""

    signal: float = SIGNAL
    background: float = SIGNAL / 0.06
    n_pulses: int = 1000
    n_bins: int = 100
    tau_bins: float = 1.0

    @cache  # noqa: B019 - one entry per swept value
    def capture(self, tile: int = 1, side: int = 32) -> Capture:
        """Simulate `side` x `side` pixels, fewer with a long gate."""
        gate = Acquisition(self.n_bins, n_pulses=self.n_pulses)
        side = min(side, max(tile, math.isqrt(2**22 // self.n_bins)))
        drawn = np.random.default_rng(SEED).uniform(0.2, 0.94, (side // tile, side // tile))
        onset = self.n_bins * np.kron(drawn, np.ones((tile, tile)))
        flux = Flux(self.signal, self.signal / self.background if self.background else np.inf)
        pulse = Pulse(self.tau_bins * gate.bin_width_s)
        return simulate(Scene(gate.bin_to_range_m(onset)), gate, flux, pulse, seed=SEED)


SCENE_VALUES: dict[str, tuple[float, ...]] = {
    "background": (0.0, 1e-7, 1e-3, 0.02, 0.1, 0.5, 1.0, 1.7, 2.6, 3.5, 5.0, 10.0, 100.0, 1e5),
    "signal": (1e-12, 1e-3, 0.01, 0.03, 0.05, 0.08, 0.1, 0.3, 1.0, 3.0, 10.0, 1e3, 1e6),
    "n_pulses": (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 10**6, 10**9),
    "n_bins": (10, 20, 30, 50, 100, 300, 1000, 4096, 100_000),
    "tau_bins": (1e-3, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0, 1e3),
}
"""With the default signal a background of 1e5 is an SBR of 1e-6."""


def measured(capture: Capture, method: str, settings: Any, value: float) -> Point:
    """Compare a method's estimates with the truth of a capture."""
    image = estimate(capture, method, _in_whole_bins(settings_of(method, settings)))
    truth = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    target = np.isfinite(truth)
    right = np.abs(np.nan_to_num(image.bin, nan=np.inf) - truth) <= TOLERANCE_BINS
    confidence = image.confidence[image.valid]
    return Point(
        value,
        right[target],
        float(image.valid[target].mean()),
        float(confidence.mean()) if confidence.size else math.nan,
    )


def _in_whole_bins(settings: Any) -> Any:
    is_tracking = isinstance(settings, TrackingParameters)
    return replace(settings, refine="none") if is_tracking else settings


@cache
def base_sbr(method: str) -> float:
    """Return the first of `BASES` at which a method restores nine pixels in ten."""
    for sbr in BASES:
        if measured(reference_capture(method, sbr), method, None, sbr).share >= 0.9:
            return sbr
    return BASES[-1]


def reference_capture(method: str, sbr: float) -> Capture:
    """Return the capture on which a method's settings are swept."""
    return SweepScene(background=SIGNAL / sbr).capture(tile(method), side=64)


def scene_sweeps(progress: Callable[[], None] = lambda: None) -> list[Sweep]:
    """Sweep every parameter of a scene, for every estimator."""
    points: dict[tuple[str, str], list[Point]] = {}
    for parameter, values in SCENE_VALUES.items():
        for value in values:
            for sbr in BASES:
                methods = [method for method in METHODS if base_sbr(method) == sbr]
                if not methods:
                    continue
                changed: dict[str, Any] = {"background": SIGNAL / sbr, parameter: value}
                scene = SweepScene(**changed)
                for method in methods:
                    found = measured(scene.capture(tile(method)), method, None, value)
                    points.setdefault((method, parameter), []).append(found)
            progress()
    sweeps = [Sweep(m, p, base_sbr(m), found) for (m, p), found in points.items()]
    return [*sweeps, *(_as_sbr(each) for each in sweeps if each.parameter == "background")]


def _as_sbr(sweep: Sweep) -> Sweep:
    """Convert a sweep over the background into one over the SBR."""
    points = [
        replace(point, value=SIGNAL / point.value if point.value else math.inf)
        for point in reversed(sweep.points)
    ]
    return replace(sweep, parameter="sbr", points=points)


# -- Settings --------------------------------------------------------------------------------------


def setting_sweeps(progress: Callable[[], None] = lambda: None) -> list[Sweep]:
    """Sweep every numeric setting of every estimator, along its slider and beyond."""
    found = []
    for method, field, spec, default in numbers():
        found.append(setting_sweep(method, field, along(spec, default)))
        progress()
    return found


def numbers() -> list[tuple[str, str, Number, Any]]:
    """Return method, field, specification and default of every numeric setting."""
    return [
        (method, field.name, spec, field.default)
        for method, each in METHODS.items()
        for field in fields(each.parameters)
        if isinstance(spec := spec_of(field), Number)
    ]


def setting_sweep(method: str, field: str, values: Sequence[float]) -> Sweep:
    """Sweep one setting, the others at their defaults."""
    sbr, kind = base_sbr(method), ESTIMATORS[method].parameters
    capture = reference_capture(method, sbr)
    points = [measured(capture, method, kind(**{field: v}), v) for v in values]
    return Sweep(method, field, sbr, points)


def along(spec: Number, default: float, steps: int = 13) -> list[float]:
    """Return values along a slider, beyond it, and on both sides of each zone's ends."""
    space = np.geomspace if spec.log else np.linspace
    values = {float(f"{x:.3g}") for x in space(spec.low, spec.high, steps)}
    values |= {float(default), spec.low / 10, 10 * spec.high, 0.0, spec.least, spec.most}
    values |= {x for zone in spec.doubtful for x in (*inside(spec, zone), *outside(spec, zone))}
    if spec.whole:
        return sorted({round(value) for value in values if spec.takes(round(value))})
    return sorted(value for value in values if spec.takes(value))


STEP = 0.2
"""Relative distance from the end of a zone at which it is measured."""


def inside(spec: Number, zone: Zone) -> list[float]:
    """Return values just inside both ends of a zone, within the slider."""
    return [max(zone.low * (1 + STEP), spec.low), min(zone.high * (1 - STEP), spec.high)]


def outside(spec: Number, zone: Zone) -> list[float]:
    """Return values just outside a zone, within the slider and in no other zone."""
    near = (zone.low * (1 - STEP), zone.high * (1 + STEP))
    within = [value for value in near if spec.low <= value <= spec.high]
    return [v for v in within if not any(v in each for each in spec.doubtful)]


@dataclass(frozen=True)
class Signs:
    """Signs of doubtful settings; the last three apply to tracking only."""

    loss: float
    """Share of pixels lost against the defaults, minus two standard deviations."""
    disagreement: float = 0.0
    """Share of pixels with another bin in float32 than in float64, at the worst of `BASES`."""
    noise: float = 0.0
    """Standard deviation of white noise after a scale in its linear zone, over that before it."""
    ringing: float = 0.0
    """Movement of a scale a thousand bins after an echo, as a share of that echo."""

    def __str__(self) -> str:
        texts = {
            "pixels lost": self.loss > LOSS and f"{self.loss:.2f}",
            "float32 differs": self.disagreement > MAX_DISAGREEMENT and f"{self.disagreement:.2f}",
            "noise passed": self.noise >= 1 and f"{self.noise:.2f}",
            "ringing": self.ringing > MAX_RINGING and f"{self.ringing:.1g}",
        }
        return ", ".join(f"{name} {text}" for name, text in texts.items() if text)

    @property
    def is_doubtful(self) -> bool:
        """Whether there is any sign."""
        return bool(str(self))


def signs(method: str, settings: Any) -> Signs:
    """Measure the signs of doubt of some settings."""
    capture = reference_capture(method, base_sbr(method))
    default, here = (measured(capture, method, each, 0.0).right for each in (None, settings))
    lost = default.astype(float) - here
    loss = float(lost.mean() - 2 * lost.std() / math.sqrt(lost.size))
    if method != "tracking":
        return Signs(loss)
    rows = [reference_capture(method, sbr).cube[:16].reshape(-1, 100) for sbr in BASES]
    noise = np.random.default_rng(SEED).normal(0.0, 1.0, (64, 400))
    linear = replace(settings, l=1e6, weight="none", start="zero")
    echo = np.zeros((1, 1000))
    echo[0, 5] = 1000.0
    still = tracking_signals(echo, settings).small[0, -100:]
    return Signs(
        loss,
        max(float32_disagreement(some, settings)[0] for some in rows),
        float(tracking_signals(noise, linear).small[:, 100:].std()),
        float(np.ptp(still)) / 1000.0,
    )


def float32_disagreement(
    rows: NDArray[np.unsignedinteger], settings: TrackingParameters, n_pulses: int | None = None
) -> tuple[float, float]:
    """Compare tracking in float32 with float64.

    Parameters
    ----------
    rows : ndarray of int, shape (pixel, bin)

    Returns
    -------
    share : float
        Share of the pixels with another bin.
    roundings : float
        See `lost_to_rounding`.
    """
    signals = tracking_signals(rows, settings, n_pulses)
    position, _ = track(to_blocks(rows), settings, n_pulses)
    differs = ~np.isclose(position, signals.position_bin, rtol=0, atol=0, equal_nan=True)
    roundings = lost_to_rounding(rows, signals.enhanced, signals.weight, position)
    return float(differs.mean()), roundings


def lost_to_rounding(
    rows: NDArray[np.unsignedinteger],
    enhanced: Floats,
    weight: Floats,
    position: NDArray[np.floating],
) -> float:
    """Return how far the best scores exceed those at `position`, in float32 roundings."""
    at = np.nan_to_num(position).astype(np.intp)[:, np.newaxis]
    chosen = np.where(np.isnan(position), 0.0, np.take_along_axis(enhanced, at, axis=1)[:, 0])
    rounding = _ROUNDINGS * rows.max(axis=1) * weight.max(axis=1)
    lost = enhanced.max(axis=1) - chosen
    return float(np.divide(lost, rounding, out=np.zeros_like(lost), where=lost > 0).max())


JOINT: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "(m·h)²·l": ({"l": 1.0 / 1.4**2}, {"l": 0.02}),
    "α, exponential": ({"alpha": 1.1 * STEEP_ALPHA}, {"alpha": 0.9 * STEEP_ALPHA}),
    "l, start mean": ({"l": 0.7 * SLOW_L}, {"l": 1.4 * SLOW_L}),
    "start zero": ({"start": "zero"}, {"start": "mean"}),
    "σ before T_n": (
        {"sigma_from": "before T_n", "t_n": FEW_BINS - 1},
        {"sigma_from": "before T_n", "t_n": 20},
    ),
}
"""Settings that are doubtful together, and similar ones that are not."""


def zone_rows() -> Iterator[tuple[str, ...]]:
    """Yield method, parameter, zone, reason, signs inside, signs outside, and whether confirmed."""
    for method, field, spec, _ in numbers():
        for zone in spec.doubtful:
            within = [{field: value} for value in inside(spec, zone)]
            beyond = [{field: value} for value in outside(spec, zone)]
            span = _span(zone.low, zone.high)
            yield method, field, span, zone.why, *_confirmed(method, within, beyond)
    for name, (doubtful, sound) in JOINT.items():
        (why,) = joint_doubts(TrackingParameters(**doubtful))
        values = ", ".join(f"{field} {as_text(value)}" for field, value in doubtful.items())
        yield "tracking", name, values, why, *_confirmed("tracking", [doubtful], [sound])


def _confirmed(method: str, within: Sequence[Any], beyond: Sequence[Any]) -> tuple[str, str, str]:
    """Return the signs of doubtful and of sound settings, and whether they confirm the zone."""
    kind = ESTIMATORS[method].parameters
    doubtful, sound = ([signs(method, kind(**each)) for each in side] for side in (within, beyond))
    good = all(each.is_doubtful for each in doubtful) and not any(x.is_doubtful for x in sound)
    texts = ["; ".join(str(x) or "nothing" for x in side) or "–" for side in (doubtful, sound)]
    return texts[0], texts[1], "yes" if good else "NO"
