"""Cases of the laws on probabilities, likelihoods and limits; see `invariants`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.inference import limits
from core.inference.likelihood import Conditions, log_likelihood_ratio
from core.studies.sensitivity.extremes import (
    SUBNORMAL,
    Case,
    Grid,
    Light,
    histograms,
    lights,
    onsets,
    pairs,
)
from core.trigger import coates_rate, no_trigger_probability, rate_per_bin, trigger_probability

# --- Probabilities ---


def _rates(grid: Grid) -> Iterator[tuple[Light, Floats]]:
    """Rates of echoes all over a gate and beside it, (delay, bin), under every light."""
    for light in lights(grid):
        onset = onsets(light.n_bins)
        signal = np.full(onset.size, light.signal)
        yield (
            light,
            rate_per_bin(onset, signal, light.background, light.pulse, light.acquisition),
        )


def beyond_0_and_1(grid: Grid) -> Iterator[Case]:
    """How far outside of [0, 1] a trigger probability lies."""
    for light, rate in _rates(grid):
        probability = trigger_probability(rate)
        yield float(max(-probability.min(), probability.max() - 1.0)), str(light)


def sums(grid: Grid) -> Iterator[Case]:
    """How far from 1 the probabilities of a pulse sum up."""
    for light, rate in _rates(grid):
        total = trigger_probability(rate).sum(axis=-1) + no_trigger_probability(rate)
        yield float(np.abs(total - 1.0).max()), str(light)


def logarithms(grid: Grid) -> Iterator[Case]:
    """Off by what share of its logarithm a probability is; 0 where that is below all numbers."""
    least = math.log(np.finfo(float).tiny)
    for light, rate in _rates(grid):
        before = np.cumsum(np.pad(rate[:, :-1], ((0, 0), (1, 0))), axis=-1)
        with np.errstate(divide="ignore"):
            log = np.log(-np.expm1(-rate)) - before
            found = np.log(trigger_probability(rate))
        normal = log > least
        off = np.abs(found[normal] - log[normal]) / np.maximum(1.0, np.abs(log[normal]))
        alive = (log < math.log(SUBNORMAL) - 1) & (found > -np.inf)
        yield float(max(off.max(initial=0.0), alive.max())), str(light)


def draws(grid: Grid) -> Iterator[Case]:
    """Counts that exceed the pulses, and such where the probability is 0."""
    for light in lights(grid):
        capture = light.capture()
        possible = trigger_probability(
            rate_per_bin(
                capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m)),
                np.asarray(capture.signal),
                light.background,
                light.pulse,
                light.acquisition,
            )
        )
        too_many = capture.counts > light.n_pulses
        yield float(np.sum(too_many) + np.sum((capture.cube > 0) & (possible == 0))), str(light)


def round_trip(grid: Grid) -> Iterator[Case]:
    """By what share of a count Coates' rates miss the counts that they were made from."""
    for where, capture in _first_photons(grid):
        sent = int(capture.gated_pulses or 0)
        rate = np.nan_to_num(coates_rate(capture.cube, sent), nan=0.0, posinf=np.inf)
        again = trigger_probability(rate) * sent
        yield float((np.abs(again - capture.cube) / np.maximum(capture.cube, 1)).max()), where


def _first_photons(grid: Grid) -> Iterator[tuple[str, Capture]]:
    yield from ((str(light), light.capture()) for light in lights(grid))
    for counts in histograms(grid):
        if counts.detection == "first":
            yield str(counts), counts.capture


# --- What light tells ---


def likelihood(grid: Grid) -> Iterator[Case]:
    """Numbers of a likelihood that are not finite."""
    for counts, (signal, background) in product(histograms(grid), pairs(grid)):
        given = Conditions(
            Acquisition(counts.cube.shape[2]),
            Pulse(),
            counts.n_pulses,
            np.asarray(signal),
            np.asarray(background),
            1.0,
        )
        ratio = log_likelihood_ratio(counts.cube.astype(float), given)
        where = f"{counts}, signal {signal:g}, background {background:g}"
        yield float(np.count_nonzero(~np.isfinite(ratio))), where


def any_limits(grid: Grid) -> Iterator[Case]:
    """Limits that are no numbers, and probabilities outside of [0, 1]."""
    for light in lights(replace(grid, long_gates=())):
        told = (light.signal, light.background, light.pulse, light.acquisition)
        onset = onsets(light.n_bins)
        right, bound = (
            limits.right_bin_probability(onset, *told),
            limits.cramer_rao_bins(onset, *told),
        )
        wrong = ~((right >= 0) & (right <= 1)) | ~(bound >= 0)
        if light.n_pulses == grid.n_pulses[0]:
            exposure = limits.best_exposure(onset, *told)
            wrong |= ~((exposure > 0) & (exposure <= 1))
        yield float(np.count_nonzero(wrong)), str(light)


def more_background(grid: Grid) -> Iterator[Case]:
    """By what share the Cramér-Rao bound falls from one background to the next larger."""
    for n_bins, tau, signal in product(grid.n_bins, grid.tau_bins, grid.photons):
        before = np.zeros(11)
        for background in sorted(grid.photons):
            light = Light(n_bins, 1000, tau, signal, background)
            told = (signal, background, light.pulse, light.acquisition)
            bound = limits.cramer_rao_bins(onsets(n_bins), *told)
            falls = bound < before
            yield float((1.0 - bound[falls] / before[falls]).max(initial=0.0)), str(light)
            before = bound
