"""Cases of the laws on what estimators answer; see `core.studies.sensitivity.invariants`."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

import core
from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS, RangeImage, estimate
from core.inference import limits
from core.inference.flux import flux_model_of, flux_prior_of
from core.inference.posterior import TOLERANCE_BINS
from core.kernels.blocks import to_blocks
from core.out_of_core.tiles import estimate_large
from core.scene import Scene
from core.simulation import simulate
from core.studies.sensitivity.extremes import (
    SIGNAL,
    SUBNORMAL,
    Case,
    Grid,
    Light,
    histograms,
    impossible,
    lights,
    settings,
)
from core.studies.trials import Condition
from core.tracking import CALM_M, PRESETS, TrackingParameters, track, tracking_signals
from core.trigger import rate_per_bin, trigger_probability

_EPS_32 = float(np.finfo(np.float32).eps)
_ROUNDINGS = 16  # float32 operations between a count and a score, about


# --- Answers ---


def _broken(capture: Capture, image: RangeImage) -> float:
    """Pixels of which an answer is not what every answer must be."""
    answered = image.valid
    with np.errstate(invalid="ignore"):
        inside = (image.bin >= 0) & (image.bin <= capture.acquisition.n_bins)
    good = np.where(answered, inside & np.isfinite(image.range_m), np.isnan(image.range_m))
    good &= np.isnan(image.bin) != answered
    good &= np.isfinite(image.score)
    good &= (image.confidence >= 0) & (image.confidence <= np.where(answered, 1.0, 0.0))
    good &= ~(answered & (capture.counts == 0))
    return float(np.count_nonzero(~good))


def any_light(grid: Grid) -> Iterator[Case]:
    """Pixels of which the answer breaks the contract, under every light."""
    every = islice(product(lights(grid), ESTIMATORS), 0, None, grid.every)
    for number, (light, method) in enumerate(every):
        capture = light.capture()
        # A threshold costs an image of its own: with some of the lights.
        alarm = 0.01 if number % 256 == 255 and light.n_bins <= 100 else None
        found = estimate(capture, method, false_alarm=alarm)
        yield _broken(capture, found), f"{method}, {light}"


def any_settings(grid: Grid) -> Iterator[Case]:
    """The same for every histogram and all settings."""
    for method in ESTIMATORS:
        every = product(histograms(grid), settings(method, grid))
        for counts, chosen in islice(every, 0, None, grid.every):
            if getattr(chosen, "weight", None) == "survival" and counts.n_pulses is None:
                continue
            capture = counts.capture
            yield (
                _broken(capture, estimate(capture, method, chosen)),
                f"{method}, {counts}, {chosen}",
            )


def refused(grid: Grid) -> Iterator[Case]:
    """1 for each value without an end that is taken, or refused without being named."""
    endless: list[tuple[str, Callable[[float], Any]]] = [
        ("bin_width_s", lambda x: Acquisition(bin_width_s=x)),
        ("gate_delay_s", lambda x: Acquisition(gate_delay_s=x)),
        ("tau_s", Pulse),
        ("signal", Flux),
        ("signal", lambda x: limits.cramer_rao_bins(1.0, x, 1.0, Pulse(), Acquisition())),
        ("background", lambda x: limits.cramer_rao_bins(1.0, 1.0, x, Pulse(), Acquisition())),
    ]
    for name, build in endless:
        for value in (np.inf, -np.inf, np.nan):
            yield _takes(name, value, build), f"{name} = {value}"
    for method in ESTIMATORS:
        kind = ESTIMATORS[method].parameters
        for name, value in impossible(method):
            yield _takes(name, value, partial(_with, kind, name)), f"{method}, {name} = {value}"


def _with(kind: type[Any], name: str, value: float) -> Any:
    return kind(**{name: value})


def _takes(name: str, value: float, build: Callable[[float], Any]) -> float:
    try:
        build(value)
    except ValueError as error:
        return 0.0 if name in str(error) and "is not accepted: give" in str(error) else 1.0
    return 1.0


# --- What must not matter ---


def _echoes(seed: int = 0, sbr: float = 0.06, rows: int = 16) -> Capture:
    """Some rows of echoes at depths all over the gate, as the paper's instrument records them."""
    whole = Condition("uniform", sbr).capture(seed)
    truth_m = np.asarray(whole.truth_range_m)[:rows]
    return replace(
        whole,
        cube=whole.cube[:rows].copy(),
        truth_range_m=truth_m,
        signal=np.asarray(whole.signal)[:rows],
    )


def _differing(found: RangeImage, expected: RangeImage) -> float:
    """Pixels in which two images are not the same to the last bit."""
    names = ("range_m", "bin", "score", "confidence", "valid")
    same = [
        np.isclose(getattr(found, n), getattr(expected, n), rtol=0, atol=0, equal_nan=True)
        for n in names
    ]
    return float(np.count_nonzero(~np.logical_and.reduce(same)))


def threads(grid: Grid) -> Iterator[Case]:
    """Pixels that another number of threads answers otherwise."""
    capture = _echoes(rows=16)
    # Many counts, or one thread would do all of it.
    wide = replace(
        capture, cube=np.tile(capture.cube, (grid.tiles, 1, 1)), truth_range_m=None, signal=None
    )
    before = numba.get_num_threads()
    for method in ESTIMATORS:
        if method == "oracle":  # the likelihood's kernels
            continue
        found = []
        for count in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(count)
            # A fresh capture, or it would remember its posterior.
            found.append(estimate(replace(wide), method))
        numba.set_num_threads(before)
        yield _differing(*found), f"{method}, 1 and {numba.config.NUMBA_NUM_THREADS} threads"


def chunks(grid: Grid) -> Iterator[Case]:
    """Images, and pixels of rows, that are answered otherwise in parts."""
    import xarray as xr  # noqa: PLC0415 - slow to come

    cube = _echoes(rows=12).cube[:, :20]
    capture = Capture(cube.copy(), Acquisition())
    counts = xr.DataArray(
        cube,
        dims=("row", "col", "bin"),
        attrs={"bin_width_s": 1e-9, "gate_delay_s": 280e-9, "n_pulses": 1000, "tau_s": 1e-9},
    )
    for method, each in ESTIMATORS.items():
        if each.whole_image or method == "oracle":
            continue
        found = [
            estimate_large(counts.chunk({"row": row, "col": col, "bin": -1}), method).compute()
            for row, col in ((12, 20), (1, 20), (5, 7))
        ]
        for other in found[1:]:
            same = [np.array_equal(found[0][n], other[n], equal_nan=True) for n in found[0]]
            yield float(not all(same)), f"{method}, in parts"
        if each.reach(each.parameters()) == 1:
            yield _by_rows(capture, method), f"{method}, row by row"


def _by_rows(capture: Capture, method: str) -> float:
    """Pixels that are answered differently where each row is a capture of its own."""
    estimator = ESTIMATORS[method]
    parameters = estimator.parameters()
    told, flux_prior = estimator.calibration(capture, parameters), flux_prior_of(capture)
    whole = estimator.ranged(capture, parameters, told)
    differing = 0.0
    for row in range(capture.shape[0]):
        one = np.s_[row : row + 1]
        cube = capture.cube[one].copy()
        part = Capture(cube, capture.acquisition, capture.pulse, flux_prior=flux_prior)
        expected = RangeImage(**{name: image[one] for name, image in vars(whole).items()})
        differing += _differing(estimator.ranged(part, parameters, told), expected)
    return differing


def types(grid: Grid) -> Iterator[Case]:
    """Pixels that narrow or wide counts answer otherwise."""
    cube = np.minimum(
        4 * _echoes(rows=4).cube[:, :16], 255
    )  # sums beyond what a narrow count holds
    for method in ESTIMATORS:
        found = []
        for dtype in (np.uint8, np.uint16, np.uint32):
            signal = np.full(cube.shape[:2], SIGNAL)
            capture = Capture(
                cube.astype(dtype), Acquisition(n_pulses=4000), signal=signal, background=1.735
            )
            found.append(estimate(capture, method))
        yield max(_differing(each, found[0]) for each in found[1:]), method


SCALES = (2, 3, 7, 1000, 65_537)


def scales(grid: Grid) -> Iterator[Case]:
    """Pixels whose answer another unit of counts moves, beyond what rounding leaves open."""
    capture = _echoes()
    rows = capture.cube.reshape(-1, 100)
    for (name, chosen), scale in product(PRESETS.items(), SCALES):
        scaled = rows.astype(np.uint32) * np.uint32(scale)
        signals = tracking_signals(rows, chosen)
        for precision, position in (
            ("float32", track(to_blocks(scaled), chosen)[0]),
            ("float64", tracking_signals(scaled, chosen).position_bin),
        ):
            worse = _beyond_rounding(rows, signals.enhanced, signals.weight, position)
            yield worse, f"tracking, {name}, {precision}, counts x {scale}"
    for method, scale in product(("peak", "matched_filter"), SCALES):
        cube = capture.cube.astype(np.uint32) * np.uint32(scale)
        acquisition = replace(capture.acquisition, n_pulses=1000 * scale)
        flux_prior = flux_prior_of(capture)
        more = replace(capture, cube=cube, acquisition=acquisition, flux_prior=flux_prior)
        moved = estimate(more, method).bin != estimate(capture, method).bin
        yield float(np.count_nonzero(moved)), f"{method}, counts x {scale}"


def _beyond_rounding(
    rows: NDArray[np.unsignedinteger], enhanced: Floats, weight: Floats, position: Any
) -> float:
    """How much better than the bins chosen the best ones are, in what float32 may lose."""
    at = np.nan_to_num(position).astype(np.intp)[:, np.newaxis]
    chosen = np.where(np.isnan(position), 0.0, np.take_along_axis(enhanced, at, axis=1)[:, 0])
    rounding = _ROUNDINGS * _EPS_32 * rows.max(axis=1) * weight.max(axis=1)
    lost = enhanced.max(axis=1) - chosen
    return float(np.divide(lost, rounding, out=np.zeros_like(lost), where=lost > 0).max())


def evidence(grid: Grid) -> Iterator[Case]:
    """Pixels whose answer leaves an echo that more photons are added to, or believes less in it."""
    acquisition = Acquisition()
    onset = 53.6
    plane = Scene(np.full((8, 8), float(acquisition.bin_to_range_m(onset))))
    for sbr, method in product((0.1, 1.0), ESTIMATORS):  # some find nothing at the lower one
        capture = simulate(plane, acquisition, Flux(SIGNAL, sbr), seed=4)
        before = estimate(capture, method)
        for more in (1, 3, 10, 30, 100):
            cube = capture.cube.copy()
            cube[:, :, int(onset) + 1] += np.minimum(more, 1000 - capture.counts).astype(cube.dtype)
            stronger = replace(capture, cube=cube, flux_prior=flux_prior_of(capture))
            after = estimate(stronger, method)
            right = np.abs(before.bin - onset) <= 3
            left = right & ~(np.abs(after.bin - onset) <= 3)
            doubts = right & (after.confidence < before.confidence - 1e-3)
            where = f"{method}, SBR {sbr:g}, {more} counts more"
            yield float(np.count_nonzero(left | doubts)), where


def confidence(grid: Grid) -> Iterator[Case]:
    """By how much the mean confidence exceeds the share of answers that are right."""
    for sbr in sorted({*grid.sbr, *SATURATING}):
        capture = _echoes(sbr=sbr, rows=32)
        truth = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
        for method in ("likelihood", "coates", "tracking"):
            image = estimate(capture, method)
            right = np.abs(image.bin - truth)[image.valid] <= TOLERANCE_BINS
            told = image.confidence[image.valid]
            yield float((told - right).mean()) if told.size else 0.0, f"{method}, SBR {sbr:g}"


SATURATING = (0.02, 0.015, 0.01, 0.003, 1e-4)
"""SBRs at which the background fires every pulse, or nearly."""


# --- Precision ---


def compared(
    rows: NDArray[np.unsignedinteger], chosen: TrackingParameters, n_pulses: int | None = None
) -> tuple[float, float]:
    """Float32 beside float64: share of pixels with other bins, and how far beyond rounding."""
    signals = tracking_signals(rows, chosen, n_pulses)
    position, _ = track(to_blocks(rows), chosen, n_pulses)
    other = ~np.isclose(position, signals.position_bin, rtol=0, atol=0, equal_nan=True)
    worse = _beyond_rounding(rows, signals.enhanced, signals.weight, position)
    return float(other.mean()), worse


def _precisions(grid: Grid) -> Iterator[tuple[float, float, str]]:
    for name, capture in (("SBR 0.06", _echoes(rows=8)), ("SBR 10", _echoes(sbr=10.0, rows=8))):
        rows = capture.cube.reshape(-1, capture.acquisition.n_bins)
        for preset, base in PRESETS.items():
            for chosen in settings("tracking", grid):
                changed = {n: v for n, v in vars(chosen).items() if v != getattr(DEFAULT, n)}
                mixed = replace(base, **changed)
                if mixed.m >= CALM_M:
                    told = " ".join(f"{n} = {v}" for n, v in changed.items())
                    yield (*compared(rows, mixed, 1000), f"{name}, {preset}, {told}")


DEFAULT = TrackingParameters()


def disagreeing(grid: Grid) -> Iterator[Case]:
    """Share of pixels in which float32 and float64 choose different bins."""
    yield from ((share, where) for share, _, where in _precisions(grid))


def rounding(grid: Grid) -> Iterator[Case]:
    """By how many roundings the scores differ there."""
    yield from ((worse, where) for _, worse, where in _precisions(grid))


def likelihood_in_float32(grid: Grid) -> Iterator[Case]:
    """How much likelier than the oracle's answer the best delay is, in what float32 may lose."""
    steps = 2
    for n_pulses, sbr in product(grid.n_pulses, grid.sbr):
        light = Light(100, n_pulses, 1.0, SIGNAL, SIGNAL / sbr)
        capture = light.capture()
        delay = (np.arange(100 * steps) + 0.5) / steps
        rate = rate_per_bin(
            delay, np.full(delay.size, SIGNAL), light.background, light.pulse, light.acquisition
        )
        armed = light.n_pulses - np.cumsum(capture.cube, axis=2, dtype=np.int64)
        log = capture.cube @ np.log(-np.expm1(-rate)).T - armed @ rate.T
        none = light.background / 100
        size = np.abs(capture.cube * np.log(-np.expm1(-none))).sum(axis=2) + armed[..., -1] * (
            SIGNAL + light.background
        )
        found = estimate(capture, "oracle", steps_per_bin=steps)
        place = np.nan_to_num(found.bin) * steps
        # The parabola may lead to the very edge of a step: either side of it.
        at = np.stack([np.floor(place), np.ceil(place) - 1], axis=2).astype(np.intp)
        there = np.take_along_axis(log, np.clip(at, 0, delay.size - 1), axis=2).max(axis=2)
        lost = np.where(found.valid, log.max(axis=2) - there, 0.0)
        rounding = _ROUNDINGS * _EPS_32 * size
        worse = np.divide(lost, rounding, out=np.zeros_like(lost), where=lost > 0)
        yield float(worse.max()), str(light)


def compiled(grid: Grid) -> Iterator[Case]:
    """Pixels in which plain Python answers otherwise, beyond what float32 leaves open."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "answers.npz"
        root = str(Path(core.__file__).parent.parent)
        command = f"import sys; from {__name__} import answer_plainly; answer_plainly(sys.argv[1])"
        subprocess.run(
            [sys.executable, "-c", command, str(path)],
            check=True,
            cwd=root,
            env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONWARNINGS": "ignore"},
        )
        with np.load(path) as plain:
            for method, image in plain_answers():
                other = np.abs(plain[method] - np.stack([image.bin, image.confidence]))
                unlike = np.isnan(plain[method][0]) != np.isnan(image.bin)
                yield float(np.max(np.nan_to_num(other)) + unlike.sum()), method


def answer_plainly(path: str) -> None:
    """Write `plain_answers` to a file: what the law on compiled kernels runs without them."""
    found = {name: np.stack([image.bin, image.confidence]) for name, image in plain_answers()}
    np.savez(path, **found)  # type: ignore[arg-type]


def plain_answers() -> Iterator[tuple[str, RangeImage]]:
    """Every estimator on a few pixels, so few that uncompiled kernels answer in seconds."""
    capture = _echoes(sbr=0.2, rows=4)
    few = replace(
        capture,
        cube=capture.cube[:, :16, 20:40].copy(),
        acquisition=replace(capture.acquisition, n_bins=20),
        truth_range_m=None,
        signal=np.asarray(capture.signal)[:, :16],
    )
    yield from ((method, estimate(few, method)) for method in ESTIMATORS)


# --- Time ---


def slow(grid: Grid) -> Iterator[Case]:
    """Time with numbers so small that they lose digits, over the time with ordinary ones."""
    n_bins = grid.long_gates[-1]
    rng = np.random.default_rng(0)
    noise = rng.poisson(5, (64, n_bins)).astype(np.uint16)
    rest = np.zeros_like(noise)
    rest[:, 5] = 40  # an echo, and then nothing: filters come to rest
    usual, tiny = to_blocks(noise), to_blocks(rest)
    for name, chosen in (*PRESETS.items(), ("m = 5", TrackingParameters(m=5.0))):
        fast = _ratio(partial(track, tiny, chosen), partial(track, usual, chosen))
        yield fast, f"tracking in float32, {name}, a gate at rest"
        full = _ratio(
            partial(tracking_signals, rest, chosen), partial(tracking_signals, noise, chosen)
        )
        yield full, f"tracking in float64, {name}, a gate at rest"
    for method in ("likelihood", "coates", "shi", "cfar", "chi"):
        bright, dark = (
            Light(100, 1000, 1.0, SIGNAL, background) for background in (1.7, SUBNORMAL)
        )
        ratio = _ratio(_estimation(dark, method), _estimation(bright, method))
        yield ratio, f"{method}, background {SUBNORMAL}"
    rate = np.full((64, n_bins), 1.0 / n_bins)
    fading = np.full((64, n_bins), 740.0 / n_bins)  # nearly all armed pulses gone
    ratio = _ratio(lambda: trigger_probability(fading), lambda: trigger_probability(rate))
    yield ratio, "trigger probability, light that fires every pulse"


def _estimation(light: Light, method: str) -> Callable[[], Any]:
    capture = light.capture()
    many = replace(
        capture,
        cube=np.tile(capture.cube, (16, 16, 1)),
        truth_range_m=None,
        signal=None,
    )
    estimator = ESTIMATORS[method]
    parameters = estimator.parameters()
    flux_model_of(many)
    return lambda: estimator.delays(many, parameters)


def _ratio(rare: Callable[[], Any], usual: Callable[[], Any], repeats: int = 9) -> float:
    """Median time of one over that of the other, taken in turns, the first calls left out."""
    times = np.array([[_seconds(rare), _seconds(usual)] for _ in range(repeats + 1)])[1:]
    return float(np.divide(*np.median(times, axis=0)))


def _seconds(work: Callable[[], Any]) -> float:
    started = perf_counter()
    work()
    return perf_counter() - started
