"""The paper's figures and tables as data, compared with what it prints and what it omits.

The text of the paper was available, its pictures were not: figures show what the text says of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.inference.limits import (
    ACCURACY,
    ASSUMES,
    Limit,
    approximation_error,
    limit,
    right_bin_probability,
)
from core.inspection.echoes import CONFIDENT
from core.inspection.maps import likeliest
from core.metrics import Interval
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.outputs import Item, Pictures, Plot, Table, table
from core.studies.paper.pile_up import figure_5b, figure_6
from core.studies.paper.printed import TABLE_2, TABLE_3, TABLE_5, Printed
from core.studies.trials import (
    Condition,
    Method,
    Results,
    Score,
    default_methods,
    score,
    summary,
    trials,
)
from core.tracking import PRESETS, TrackingParameters, tracking_signals
from core.trigger import first_difference, rate_per_bin, trigger_probability

FROM_TEXT = "Drawn after the paper's text; its picture was not available."
FIGURE_1 = Flux(0.5203, 0.08)
FIGURE_4 = Flux(sbr=0.08)
N_PULSES = 1000
GATE = Acquisition(n_pulses=N_PULSES)
PULSE = Pulse()
SEED = 0
NEAR = {sbr: Condition("car", sbr) for sbr in TABLE_2}
FAR = Condition("building", 0.038, 0.13)
BINS = np.arange(GATE.n_bins, dtype=float) + 0.5
"""Centres of the bins, at which counts are drawn as on the other pages."""
PLACES = tuple(np.arange(2.5, GATE.n_bins - 2, 5.0).tolist())
"""Bins of the echo over which its position is varied."""

WHOLE_BINS = "Tracking gives whole bins, as in the paper: its refinement below a bin is off."
ASSUMED = (
    f"Assumed, since the paper does not print them for its tables: {N_PULSES} pulses per pixel, "
    f"as for its Figure 4, a pulse of τ = {PULSE.tau_s * 1e9:g} ns, and RD within 3 bins."
)


def in_whole_bins(preset: str) -> TrackingParameters:
    """Return a preset whose estimates are whole bins, as the paper defines them."""
    return replace(PRESETS[preset], refine="none")


RECOMMENDED = Method("tracking", "tracking", in_whole_bins("recommended"))
LITERAL = Method("tracking, literal", "tracking", in_whole_bins("literal"))
COMPARED = [RECOMMENDED, *(m for m in default_methods() if m.name != "tracking"), LITERAL]
TABLE_2_METHODS = [m for m in COMPARED if m.estimator in ("tracking", "likelihood", "oracle")]


def plan() -> dict[Condition, list[Method]]:
    """Return the methods that the tables need under each condition."""
    compared = {NEAR[0.06]: COMPARED, FAR: COMPARED}
    return {c: compared.get(c, TABLE_2_METHODS) for c in (*NEAR.values(), FAR)}


# -- Figures of the model --------------------------------------------------------------------------


def figure_1(flux: Flux = FIGURE_1, onset_bin: float = 50.0) -> Plot:
    """Plot the trigger probability of each bin, with and without an echo (Eq. 1)."""
    with_echo, without = (_probability(flux, onset_bin, signal) for signal in (flux.signal, 0.0))
    rate = rate_per_bin(onset_bin, flux.signal, flux.background, PULSE, GATE)
    echo = float((with_echo * (1 - flux.background / GATE.n_bins / rate)).sum())
    return Plot(
        "figure_1",
        "Figure 1: noise triggers first",
        "Bin (1 ns)",
        "Trigger probability per pulse",
        BINS,
        {"with an echo": with_echo, "background alone": without},
        {"echo's onset": onset_bin},
        f"Signal {flux.signal:g} and background {flux.background:.4g} photons per pulse: the echo "
        f"triggers {echo:.1%} of the pulses, background nearly all others.",
    )


def figure_2(flux: Flux = FIGURE_1, onset_bin: float = 50.0) -> Plot:
    """Plot the change of the trigger probability from bin to bin (Eq. 3)."""
    return Plot(
        "figure_2",
        "Figure 2: the first difference shows the jump",
        "Bin (1 ns)",
        "Change of trigger probability",
        BINS,
        {"first difference": first_difference(_probability(flux, onset_bin, flux.signal))},
        {"echo's onset": onset_bin},
        FROM_TEXT,
    )


def figure_4() -> list[Plot]:
    """Plot histogram and both scales for a near, a middle and a far target."""
    return [pixel_signals(onset, key=f"figure_4_bin_{onset:g}") for onset in (20.0, 50.0, 90.0)]


def pixel_signals(
    onset_bin: float,
    parameters: TrackingParameters = PRESETS["recommended"],
    flux: Flux = FIGURE_4,
    key: str = "pixel_signals",
    seed: int = SEED,
) -> Plot:
    """Plot histogram and signals of a pixel with the target at one bin, or with none at NaN."""
    scene = Scene(np.full((1, 1), GATE.bin_to_range_m(onset_bin)))
    capture = simulate(scene, GATE, flux, PULSE, seed)
    signals = tracking_signals(capture.cube[0, 0], parameters, N_PULSES)
    delay_bin = _delays(capture, Method("tracking", "tracking", parameters)).item()
    echo = "no echo" if math.isnan(onset_bin) else f"echo at bin {onset_bin:g}"
    return Plot(
        key,
        f"Both scales, {echo}, SBR {flux.sbr:g}",
        "Bin (1 ns)",
        "Counts",
        BINS,
        {
            "histogram": signals.raw,
            "small scale": signals.small,
            "large scale": signals.large,
            "residual": signals.residual,
        },
        {"echo's onset": onset_bin, "estimate, own lag removed": delay_bin},
        "The enhanced signal, the residual times the weight, has its maximum in bin "
        f"{float(signals.position_bin):g}, the lag of the method behind its estimate. {FROM_TEXT}",
    )


def residual_by_place(
    parameters: TrackingParameters = PRESETS["recommended"], flux: Flux = FIGURE_4
) -> Plot:
    """Compare the residual of an echo with that of noise, by the position of the echo."""
    onset = np.arange(20.0, 96.0)
    signals = tracking_signals(
        np.stack([_probability(flux, d, flux.signal) for d in onset]) * N_PULSES, parameters
    )
    echo_free = simulate(Scene(np.full((32, 32), np.nan)), GATE, flux, PULSE, seed=1)
    noise = tracking_signals(echo_free.cube, parameters, N_PULSES).residual
    highest = np.quantile(noise[..., parameters.t_n :].max(axis=-1), [0.5, 0.95])
    return Plot(
        "residual_by_place",
        f"The later the echo, the smaller its residual (SBR {flux.sbr:g})",
        "Bin of the echo's onset",
        "Residual (counts)",
        onset,
        {
            "largest residual, no noise": signals.residual.max(axis=1),
            "largest of noise alone, median": np.full(onset.size, highest[0]),
            "largest of noise alone, 95 %": np.full(onset.size, highest[1]),
        },
        note="Pile-up leaves fewer armed pulses for a late echo; noise stays the same.",
    )


def weights(flux: Flux = FIGURE_4, onset_bin: float = 80.0) -> Plot:
    """Plot one pixel's residual under each weight, every curve over its maximum."""
    scene = Scene(np.full((1, 1), GATE.bin_to_range_m(onset_bin)))
    histogram = simulate(scene, GATE, flux, PULSE, SEED).cube[0, 0]
    curves = {}
    for weight, alpha in (("none", 1.0), ("cubic", 1.0), ("exponential", 3.0), ("survival", 1.0)):
        parameters = TrackingParameters(weight=weight, alpha=alpha)  # type: ignore[arg-type]
        enhanced = tracking_signals(histogram, parameters, N_PULSES).enhanced
        curves[f"weight {weight}"] = enhanced / max(float(enhanced.max()), 1e-300)
    return Plot(
        "weights",
        f"The weight raises late bins (echo at bin {onset_bin:g}, SBR {flux.sbr:g})",
        "Bin (1 ns)",
        "Enhanced signal, over its largest value",
        BINS,
        curves,
        {"echo's onset": onset_bin},
        "With a cubic weight α has no effect on the normalized curve.",
    )


def field_pixel() -> Plot:
    """Plot one pixel of the simulated twin of the field experiment."""
    capture = FAR.capture(SEED)
    row, col = (size // 2 for size in capture.shape)
    signals = tracking_signals(capture.cube[row, col], PRESETS["recommended"])
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m)[row, col])
    return Plot(
        "field_pixel",
        f"Pixel ({row}, {col}) of the building, simulated",
        "Bin (1 ns)",
        "Counts",
        np.arange(capture.acquisition.n_bins, dtype=float) + 0.5,
        {"histogram": signals.raw, "residual": signals.residual},
        {"truth": float(truth_bin)},
        f"A simulation with the field's PPP {FAR.signal} and SBR {FAR.sbr}.",
    )


# -- Figures of range images -----------------------------------------------------------------------


def figure_8() -> Pictures:
    """Show the car at the six SBRs, by the recommended preset."""
    images = {"truth": scenes["car"]().range_m}
    for sbr, condition in NEAR.items():
        images[f"SBR {sbr:g}"] = _range_image(condition.capture(SEED), RECOMMENDED)
    return _pictures("figure_8", "Figure 8: the car under six SBRs", images)


def figure_9(sbr: float = 0.06) -> Pictures:
    """Show the car by every method the paper compares, at one SBR."""
    capture = Condition("car", sbr).capture(SEED)
    images = {"truth": np.asarray(capture.truth_range_m), **_by_method(capture, TABLE_3)}
    return _pictures("figure_9", f"Figure 9: the methods at SBR {sbr:g}", images)


def figure_11() -> Pictures:
    """Show the paper's reference of the field experiment: its method without background."""
    scene = scenes["building"]()
    night = simulate(scene, scene.acquisition, Flux(FAR.signal, math.inf), PULSE, SEED)
    images = {"truth": scene.range_m, "tracking, no background": _range_image(night, RECOMMENDED)}
    return _pictures("figure_11", "Figure 11, simulated twin: the reference image", images)


def figure_12() -> Pictures:
    """Show the simulated twin of the field experiment by every method the paper compares."""
    capture = FAR.capture(SEED)
    images = {"truth": np.asarray(capture.truth_range_m), **_by_method(capture, TABLE_5)}
    return _pictures("figure_12", "Figure 12, simulated twin: the building", images)


# -- Tables ----------------------------------------------------------------------------------------


def table_2(results: Results, methods: Sequence[Method] = TABLE_2_METHODS) -> Table:
    """Return the car at six SBRs by tracking, the exact likelihood and the oracle."""
    rows = [
        _row(f"{sbr:g}", method, results[condition, method.name], TABLE_2[sbr])
        for sbr, condition in NEAR.items()
        for method in methods
    ]
    title = "Table 2: the car at 50 m under six SBRs"
    note = f"{ASSUMED} {WHOLE_BINS}"
    return Table("table_2", title, ("SBR", *_COLUMNS), tuple(rows), note)


def table_3(results: Results, sbr: float = 0.06) -> Table:
    """Return every method at one SBR; the paper prints all of them at 0.06 only."""
    printed = TABLE_3 if sbr == 0.06 else {"tracking": TABLE_2[sbr]} if sbr in TABLE_2 else {}
    title = f"Table 3: every method on the car at SBR {sbr:g}"
    return _methods_table("table_3", title, Condition("car", sbr), printed, results)


def table_5(results: Results) -> Table:
    """Return every method on the simulated twin of the field experiment."""
    return _methods_table(
        "table_5",
        "Tables 4 and 5, simulated twin: the building, PPP 0.13, SBR 0.038",
        FAR,
        TABLE_5,
        results,
        "The paper's field data are not public. This building is simulated with the parameters of "
        f"Table 4 and does not reproduce a measurement. {ASSUMED} {WHOLE_BINS}",
    )


_COLUMNS = (
    "method",
    "RD, 3 bins",
    "printed RD",
    "difference",
    "RMSE m",
    "printed RMSE m",
    "difference",
    "RD, 1 bin",
    "RD, 2 bins",
    "MAE m",
    "bias m",
    "inlier RMSE m",
    "Var of RD",
    "answered",
    "ms",
)


def _row(
    first: str, method: Method, scores: Sequence[Score], printed: Printed | None
) -> tuple[Any, ...]:
    s = summary(scores)
    rd, rmse_m = s.rd[2], s.rmse_m
    if method.estimator not in TABLE_3:  # the paper has no other methods
        printed = None
    return (
        first,
        method.name,
        *(rd, *((printed.rd, rd.value - printed.rd) if printed else ("", ""))),
        *(rmse_m, *((printed.rmse_m, rmse_m.value - printed.rmse_m) if printed else ("", ""))),
        *(s.rd[0].value, s.rd[1].value, s.mae_m, s.bias_m, s.inlier_rmse_m),
        *(s.rd_variance, s.answered, s.milliseconds),
    )


def _methods_table(
    key: str,
    title: str,
    condition: Condition,
    printed: Mapping[str, Printed],
    results: Results,
    note: str = f"{ASSUMED} {WHOLE_BINS}",
) -> Table:
    rows = []
    for method in COMPARED:
        reconstructed = ESTIMATORS[method.estimator].reconstructed
        kind = "reconstruction" if reconstructed else "as defined"
        scores = results[condition, method.name]
        rows.append(_row(kind, method, scores, printed.get(method.estimator)))
    return Table(key, title, ("kind", *_COLUMNS), tuple(rows), note)


# -- What the paper does not report ----------------------------------------------------------------


def limits() -> Table:
    """Return the limits of a single pixel at each SBR, mean over the target pixels."""
    found = [(each, limit(each.capture(SEED))) for each in (*NEAR.values(), FAR)]

    def right(row: tuple[Condition, Limit]) -> float:
        return float(np.nanmean(row[1].right_bin_probability))

    return table(
        "limits",
        "Limits of a single pixel with known fluxes and uniform depths",
        found,
        {
            "scene": lambda row: row[0].scene,
            "SBR": lambda row: row[0].sbr,
            "probability of the right bin": right,
            "approximated to": lambda row: approximation_error(
                row[1].right_bin_probability, N_PULSES
            ),
            "Cramér-Rao bound m": lambda row: float(np.nanmean(row[1].cramer_rao_m)),
        },
        f"The probability is that of {ASSUMES}. It does not bound other methods: deciding by the "
        "probability within 3 bins adds up to 0.02, and a method that uses neighbours, or where in "
        "the gate targets tend to be, may add more. A measured RD also has a sampling error, "
        "stated as its interval. "
        "The bound holds for the scatter of unbiased estimates without gross errors.",
    )


def arithmetic() -> Table:
    """Check statements of the paper against its own tables."""
    ours = TABLE_3["tracking"]
    scene = scenes["car"]()
    truth_m = scene.range_m[np.isfinite(scene.range_m)]
    nearest_m, farthest_m = scene.acquisition.bin_to_range_m([0, scene.acquisition.n_bins])
    worst_m = float(np.sqrt(np.mean(np.maximum(truth_m - nearest_m, farthest_m - truth_m) ** 2)))
    front_m = float(np.sqrt(np.mean((truth_m - nearest_m) ** 2)))
    rows = [
        (
            f"{name}: RMSE lower by, RD higher by",
            f"{100 * (1 - ours.rmse_m / other.rmse_m):.2f} %, "
            f"{100 * (ours.rd / other.rd - 1):.2f} %",
            'printed as "at least 38.35 % and 19.99 %"',
        )
        for name, other in TABLE_3.items()
        if name != "tracking"
    ]
    rows.append(
        (
            "Largest RMSE possible in the gate of 42 to 57 m, this car",
            f"{front_m:.2f} m if all estimates are at the start of the gate, {worst_m:.2f} m if "
            "each is as wrong as possible",
            f"peak printed as {TABLE_3['peak'].rmse_m} m",
        )
    )
    return Table(
        "arithmetic",
        "Statements of the paper against its own tables",
        ("statement", "value", "the paper"),
        tuple(rows),
        '"At least" holds against KDE only; for Chi, Table 3 gives far less.',
    )


def echo_free(sbr: float = 0.06, size: int = 64) -> Plot:
    """Plot where each method's estimates lie in pixels without echo."""
    capture = simulate(Scene(np.full((size, size), np.nan)), GATE, Flux(sbr=sbr), PULSE, SEED)
    edges = np.arange(0, GATE.n_bins + 1, 5)
    curves = {}
    for method in COMPARED:
        if method.estimator != "oracle":  # which would know that there is no echo
            bins = _delays(capture, method)
            curves[method.name] = np.histogram(bins[np.isfinite(bins)], edges)[0] / bins.size
    return Plot(
        f"echo_free_{sbr:g}",
        f"Estimates without an echo (background of SBR {sbr:g})",
        "Bin of the estimate (in groups of 5)",
        "Share of pixels",
        edges[:-1].astype(float) + 2.5,
        curves,
        note="A method without preference would be uniform. Where the estimates of a method "
        "cluster, some of its correct estimates are luck.",
    )


def by_place(sbr: float = 0.06, size: int = 64, onset: Sequence[float] = PLACES) -> Plot:
    """Plot the restoration degree against the position of the echo, equal in all pixels."""
    flux, onset_bin = Flux(sbr=sbr), np.asarray(onset, dtype=float)
    found = found_by_place(GATE, flux, COMPARED, onset, size, SEED)
    bound = right_bin_probability(onset_bin, flux.signal, flux.background, PULSE, GATE)
    chance = 1.96 * math.sqrt(0.25 / size**2)
    return Plot(
        f"by_place_{sbr:g}",
        f"Restoration degree against the position of the echo (SBR {sbr:g}, 3 bins)",
        "Bin of the echo's onset",
        "Share of pixels within 3 bins",
        onset_bin,
        {**found, "limit: probability of the right bin": bound},
        note="The paper's targets lie in bins 45 to 70. Tracking excludes bins before T_n. "
        f"Limit: {ASSUMES}, {ACCURACY}. "
        f"Sampling error of a share of {size**2:,} pixels: at most ± {chance:.2g} (95 %).",
    )


def found_by_place(
    gate: Acquisition,
    flux: Flux,
    methods: Sequence[Method],
    onset: Sequence[float],
    size: int = 64,
    seed: int = 0,
) -> dict[str, Floats]:
    """Return the share of pixels that each method finds within 3 bins, by the echo's position.

    At each position, all of `size` x `size` pixels see the same flat target.
    """
    curves: dict[str, list[float]] = {each.name: [] for each in methods}
    for onset_bin in onset:
        scene = Scene(np.full((size, size), gate.bin_to_range_m(onset_bin)))
        capture = simulate(scene, gate, flux, PULSE, seed)
        for method in methods:
            error = np.abs(_delays(capture, method) - onset_bin)
            curves[method.name].append(float((error <= 3).mean()))
    return {name: np.array(shares) for name, shares in curves.items()}


def flat_target(size: int = 64, onset_bin: float = 50.0, seeds: Sequence[int] = range(2)) -> Table:
    """Compare every method on a flat target with the same method on the car, at SBR 0.06."""
    car = scenes["car"]()
    flat = Scene(np.full((size, size), GATE.bin_to_range_m(onset_bin)), acquisition=GATE)
    captures = {
        name: [simulate(scene, scene.acquisition, Flux(sbr=0.06), PULSE, seed) for seed in seeds]
        for name, scene in (("flat target", flat), ("car", car))
    }

    def rd(method: Method, scene: str) -> Interval:
        return summary([score(capture, method) for capture in captures[scene]]).rd[2]

    windows = sliding_window_view(car.acquisition.range_m_to_bin(car.range_m), (3, 3))
    span = np.ptp(windows, axis=(2, 3))
    wide = (span > 1)[np.isfinite(span)].mean()
    return table(
        "flat_target",
        f"Neighbours that see the same range: a flat target at bin {onset_bin:g}, and the car",
        COMPARED,
        {
            "method": lambda method: method.name,
            "RD, flat target": partial(rd, scene="flat target"),
            "RD, car": partial(rd, scene="car"),
            "printed RD, car": lambda m: TABLE_3[m.estimator].rd if m.estimator in TABLE_3 else "",
        },
        f"Restoration degree within 3 bins at SBR 0.06. In {wide:.0%} of the car's 3 x 3 windows, "
        "ranges differ by more than a bin. KDE and Chi pool these pixels: there the echo "
        "is spread over several bins, on the flat target it is not.",
    )


SPEEDS = tuple(np.geomspace(1e-4, 1e-2, 13).tolist())
"""Values of l, the speed of the small scale."""


def by_speed(scene: str, seeds: Sequence[int] = (0, 1)) -> Plot:
    """Plot the restoration degree of both presets against l, at three SBRs."""
    curves = {}
    for method in (RECOMMENDED, LITERAL):
        settings = [replace(method.settings, l=value) for value in SPEEDS]
        methods = [replace(method, name=f"{each.l:g}", settings=each) for each in settings]
        for sbr in (0.06, 0.04, 0.03):
            condition = Condition(scene, sbr)
            results = trials({condition: methods}, seeds)
            rd = [summary(results[condition, each.name]).rd[2].value for each in methods]
            curves[f"{method.name}, SBR {sbr:g}"] = np.array(rd)
    return Plot(
        f"by_speed_{scene}",
        f"Restoration degree against l: {'the car' if scene == 'car' else 'random depths'}",
        "l, speed of the small scale",
        "Share of pixels within 3 bins",
        np.array(SPEEDS),
        curves,
        {method.name: method.settings.l for method in (RECOMMENDED, LITERAL)},
        "The paper prints no l. Its literal equations reach the printed restoration degrees on the "
        "car for some values of l.",
        x_is_log=True,
    )


def agreement(capture: Capture, name: str) -> Table:
    """Return the share of pixels in which two methods agree within 3 bins; needs no truth.

    Only pixels with a confident surface are compared: elsewhere, methods agree on noise.
    """
    is_confident = likeliest(capture)[1] >= CONFIDENT
    bins = {
        method.name: _delays(capture, method)
        for method in COMPARED
        if method.estimator != "oracle" or capture.signal is not None
    }

    def share(one: str, other: str) -> float:
        close = np.abs(bins[one] - bins[other])[is_confident] <= 3
        if one == other:
            return 1.0
        return float(close.mean()) if close.size else math.nan

    return table(
        "agreement",
        f"Agreement within 3 bins on {name}",
        bins,
        {"method": str, **{other: partial(share, other=other) for other in bins}},
        "A measured capture without truth: methods that agree may all be wrong. "
        f"{np.count_nonzero(is_confident):,} of {is_confident.size:,} pixels, those in which the "
        f"likelihood gives a surface a confidence of {CONFIDENT:g} or more.",
    )


def model_items(size: int = 64) -> Iterator[Item]:
    """Yield what needs no repetitions; `size` is the side of images with one echo position."""
    yield figure_1()
    yield figure_2()
    yield from figure_4()
    yield figure_5b(FIGURE_4)
    yield figure_6(FIGURE_4)
    yield figure_8()
    yield figure_9()
    yield figure_11()
    yield figure_12()
    yield limits()
    yield arithmetic()
    yield residual_by_place()
    yield weights()
    yield field_pixel()
    yield flat_target(size)
    yield from map(by_speed, ("car", "uniform"))
    for sbr in (0.06, 0.03):
        yield echo_free(sbr, size)
        yield by_place(sbr, size)


def _probability(flux: Flux, onset_bin: float, signal: float) -> Floats:
    rate = rate_per_bin(onset_bin, signal, flux.background, PULSE, GATE)
    return trigger_probability(rate)


def _delays(capture: Capture, method: Method) -> Floats:
    return ESTIMATORS[method.estimator].delays(capture, method.settings)[0]


def _range_image(capture: Capture, method: Method) -> Floats:
    """Return ranges of target pixels, which are all that the paper shows."""
    target = np.isfinite(np.asarray(capture.truth_range_m))
    return np.where(target, capture.acquisition.bin_to_range_m(_delays(capture, method)), np.nan)


def _by_method(capture: Capture, names: Mapping[str, Printed]) -> dict[str, Floats]:
    return {m.name: _range_image(capture, m) for m in COMPARED if m.name in names}


def _pictures(key: str, title: str, images: Mapping[str, Floats]) -> Pictures:
    truth_m = images["truth"]
    low, high = float(np.nanmin(truth_m)), float(np.nanmax(truth_m))
    note = f"Pixels without a target are blank. {ASSUMED} {FROM_TEXT}"
    return Pictures(key, title, "Range (m)", images, low - 0.5, high + 0.5, note)
