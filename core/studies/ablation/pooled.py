"""Tests of a whole capture: of what its pixels share, and of the share with a second surface.

Delays and fluxes are drawn from the posterior of each pixel, as in `core.inference.fit`, so that
pixels whose estimates are uncertain need not be left out.

Second surface. Counts of windows of one pulse length are compared with what the echo and the
background explain, both with the mean shape that they have in all pixels, so that neither another
pulse nor a background that varies resembles a second surface. The p-value of a pixel is that of its
most unusual window. How often pixels with a second surface have a small p-value is found from
simulated ones, in which half the signal comes from a second delay.

Signal. Its scatter over the pixels is compared with that by chance. This needs pixels whose
estimates are certain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference import faults
from core.inference.fit import (
    FEWEST,
    GROUPS,
    Deviation,
    Residuals,
    background_deviation,
    drawn_residuals,
    echo_offset,
    in_parts,
    over_uniform_background,
    pulse_deviation,
    quantile_residuals,
)
from core.inference.flux import flux_model_of, flux_prior_of, total_rates
from core.inference.likelihood import rate_and_n_armed
from core.inference.posterior import same_echo_bins, tolerance_probability
from core.kernels.streams import uniforms
from core.studies.ablation import corrections
from core.studies.ablation.evidence import Evidence, evidence_of_deviation, evidence_of_share
from core.trigger import draw_counts

_FEWEST_PIXELS = 32  # with an echo
_MOST_PIXELS = 2**14
_CERTAIN = 0.95  # confidence of estimates that are taken for the surface
_MOSTLY = 0.8  # least share of them that stands for all pixels
_LEAST_SHARE = 1e-3  # of an echo within the gate
_LEAST_RATE = 1e-12  # photons in a bin
_UNUSUAL = 0.001  # p-value of pixels that seem to have a second surface
_SEED = np.uint64(1)


class PooledEvidence(NamedTuple):
    """Evidence of what pixels share, and of second surfaces in a share of them."""

    background: Evidence
    """Effect: deviation of the background over the gate from its mean, relative to it (RMS)."""
    pulse: Evidence
    """Effect: deviation of the mean echo from the pulse, relative to it (noise-weighted RMS)."""
    second_surface: Evidence | None
    """Effect: share of the pixels with an echo that see a second surface, as strong as the first.

    None if too few pixels have an echo, or the gate is too short for two.
    """


@cached_per_capture
def pooled_evidence(capture: Capture) -> PooledEvidence:
    """Test the pixels together, but for hot, dead and bright ones.

    Among the bright ones are hot pixels that use up the pulses when the gate opens.
    """
    usual, outliers = faults.ordinary_pixels(capture), faults.outlier_pixels(capture)
    parts = _parts(capture, usual if outliers is None else usual & ~outliers.bright)
    residuals = drawn_residuals(capture, parts[0])
    uniform = over_uniform_background(capture, residuals)
    background = evidence_of_deviation(background_deviation(capture, uniform))
    pulse = evidence_of_deviation(pulse_deviation(capture, residuals))
    if capture.acquisition.n_bins < 2 * same_echo_bins(capture):
        return PooledEvidence(background, pulse, None)
    counts = _second_surfaces(capture, residuals)
    for part in parts[1:]:
        counts = counts + _second_surfaces(capture, drawn_residuals(capture, part))
    n_pixels, found, seen = counts.tolist()
    if n_pixels < _FEWEST_PIXELS:
        return PooledEvidence(background, pulse, None)
    share = evidence_of_share(found, n_pixels, _UNUSUAL, seen / n_pixels)
    return PooledEvidence(background, pulse, share)


def _second_surfaces(capture: Capture, residuals: Residuals) -> NDArray[np.intp]:
    """Count pixels with an echo, those that seem to have a second one, and likewise simulated."""
    every = np.arange(residuals.pixels.size)
    simulated = drawn_residuals(_with_second_surface(capture, residuals), every)
    has_echo = np.isfinite(residuals.delay_bin)
    found, seen = (
        np.count_nonzero(_second_surface_p_values(capture, each)[has_echo] < _UNUSUAL)
        for each in (residuals, simulated)
    )
    return np.array([np.count_nonzero(has_echo), found, seen])


def _parts(capture: Capture, usual: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Divide pixels (row, col) into random parts that bound the memory; some of them if many.

    Returns flat indices.
    """
    some = np.random.default_rng(0).permutation(np.flatnonzero(usual))[:_MOST_PIXELS]
    return [np.sort(part) for part in in_parts(capture, some)]


def _second_surface_p_values(capture: Capture, residuals: Residuals) -> Floats:
    """P-value of each pixel, shape (pixel,): from its window with the largest excess of counts.

    Windows overlap by half, so that the p-values are slightly too large.
    """
    n_bins, width = capture.acquisition.n_bins, capture.echo_bins
    rate = (residuals.signal + residuals.background) * _mean_shape(capture, residuals)
    largest, n_windows = np.full(len(rate), -np.inf), 0
    for begin in sorted({0, width // 2}):
        first = np.unique([0, *range(begin, n_bins, width)])
        counts, mean = (np.add.reduceat(each, first, axis=1) for each in (residuals.counts, rate))
        armed = None if capture.gated_pulses is None else residuals.armed[:, first]
        uniform = uniforms(_SEED, residuals.pixels, n_windows, first.size)
        excess = quantile_residuals(counts, armed, mean[np.newaxis], uniform).max(axis=1)
        largest, n_windows = np.maximum(largest, excess), n_windows + first.size
    return np.asarray(-np.expm1(n_windows * scipy.special.log_ndtr(largest)))


def _mean_shape(capture: Capture, residuals: Residuals) -> Floats:
    """Ratio of counts to expected ones, shape (pixel, bin): the mean over all pixels.

    By bin of the gate away from echoes, and by distance from the delay around them.
    """
    n_bins = capture.acquisition.n_bins
    n_groups = min(n_bins, GROUPS)
    offset = echo_offset(capture, residuals.delay_bin)
    gate: NDArray[np.intp] = np.arange(n_bins) * n_groups // n_bins
    group = np.where(np.isnan(offset), gate, n_groups + np.nan_to_num(offset)).astype(np.intp)
    counts, expected = (
        np.bincount(group.ravel(), each.ravel()) for each in (residuals.counts, residuals.expected)
    )
    ratio = np.divide(counts, expected, out=np.ones_like(counts), where=expected >= FEWEST)
    return np.asarray(ratio[group])


def with_second_surfaces(capture: Capture) -> Capture:
    """Simulate pixels that have an echo (1, pixel, bin) with half of it at another delay."""
    residuals = drawn_residuals(capture, _parts(capture, faults.ordinary_pixels(capture))[0])
    simulated = _with_second_surface(capture, residuals)
    return _with_counts(simulated, simulated.cube[0, np.isfinite(residuals.delay_bin)])


def _with_second_surface(capture: Capture, residuals: Residuals) -> Capture:
    """Simulate the pixels with half the signal at another delay, which is uniform over the gate."""
    n_pixels, n_bins = residuals.counts.shape
    rng, apart = np.random.default_rng(0), same_echo_bins(capture)
    distance = rng.integers(apart, n_bins - apart, (n_pixels, 1), endpoint=True)
    other = np.take_along_axis(residuals.signal, (np.arange(n_bins) - distance) % n_bins, axis=1)
    rate = residuals.background + (residuals.signal + other) / 2
    return _with_counts(capture, draw_counts(rate, capture.gated_pulses, rng))


def _with_counts(capture: Capture, counts: NDArray[np.unsignedinteger]) -> Capture:
    """Return a capture of one row of pixels (pixel, bin) with the same acquisition and fluxes."""
    return replace(
        capture,
        cube=counts[np.newaxis],
        **capture.images(lambda _: None),
        flux_prior=flux_prior_of(capture),
        groups=None,
    )


# -- Corrections -----------------------------------------------------------------------------------


def pile_up_evidence(capture: Capture) -> Evidence:
    """Fall of the armed pulses over the gate, relative to their mean (RMS).

    A flat background seems to fall as much. With ``Λ`` photons per pulse, ``exp(-Λ u)`` of the
    pulses are armed at ``u``, from 0 to 1.
    """
    n_counts, photons = int(capture.counts.sum()), float(total_rates(capture).mean())
    if n_counts == 0:
        return evidence_of_deviation(Deviation(0.0, 0, 1.0))
    mean, mean_square = (-np.expm1(-k * photons) / (k * photons) for k in (1, 2))
    effect = float(np.sqrt(max(mean_square / mean**2 - 1, np.finfo(float).eps)))
    return evidence_of_deviation(Deviation(n_counts, 1, np.sqrt(n_counts) / effect))


@cached_per_capture
def signal_evidence(capture: Capture) -> Evidence | None:
    """Scatter of the signal over pixels with a certain estimate, relative to its mean.

    None if they are too few. If many others are not certain, the scatter of all may be larger.
    """
    acquisition, n_pulses, n_bins = capture.acquisition, capture.gated_pulses, capture.cube.shape[2]
    pixels = _parts(capture, faults.ordinary_pixels(capture))[0]
    some = _with_counts(capture, capture.cube.reshape(-1, n_bins)[pixels])
    found = corrections.delays(some, "likelihood")
    certain = tolerance_probability(some, found)[0] >= _CERTAIN
    if np.count_nonzero(certain) < _FEWEST_PIXELS:
        return None
    delay_bin, histograms = found[0, certain], some.cube[0, certain].astype(float)
    rate, armed = rate_and_n_armed(histograms, n_pulses)
    background = flux_model_of(some).typical_background[0, certain, np.newaxis] / n_bins
    inside = _echo_bins(capture, delay_bin)
    share = capture.pulse.bin_probability(delay_bin, n_bins, acquisition.bin_width_s) * inside
    exposure = np.maximum(share.sum(axis=1), _LEAST_SHARE)
    signal = ((rate - background) * inside).sum(axis=1) / exposure

    def variance(mean: float) -> Floats:
        """Variance of the signals by chance if all are equal (Greenwood 1926)."""
        expected = np.maximum(mean * share + background, _LEAST_RATE)
        of_bins = expected if n_pulses is None else np.expm1(expected) / np.maximum(armed, 1.0)
        return np.asarray((of_bins * inside).sum(axis=1) / exposure**2)

    mean = float(np.average(signal, weights=1 / variance(float(signal.mean()))))
    by_chance = variance(mean)
    evidence = evidence_of_deviation(
        Deviation(
            float(((signal - mean) ** 2 / by_chance).sum()),
            signal.size - 1,
            float(np.sqrt((mean**2 / by_chance).sum())),
        )
    )
    if np.mean(certain) < _MOSTLY:
        return evidence._replace(smallest=np.inf, largest=np.inf)
    return evidence


def _echo_bins(capture: Capture, delay_bin: Floats) -> NDArray[np.bool_]:
    """Find the bins of the echo at each delay, and one more on either side, (pixel, bin)."""
    n_bins = capture.acquisition.n_bins
    echo, first = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s)
    offset = np.arange(n_bins) - np.floor(delay_bin)[:, np.newaxis] - first
    return np.asarray((offset >= -1) & (offset <= echo.size))
