"""Parts and corrections that the counts of a capture reveal, without knowledge of the scene.

Where the position of a surface matters, only pixels with nearly certain estimates are used. A part
that no histogram reveals may exist; no model of the capture needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import pdtrc

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.corrections import without_correction
from core.inference import faults, resolution
from core.inference.flux import flux_prior_of
from core.inference.likelihood import windowed_sums
from core.inference.posterior import TOLERANCE_BINS, tolerance_probability
from core.inference.resolution import FEW, Difference, difference
from core.metrics import Interval
from core.studies.ablation import corrections
from core.studies.ablation.criterion import UNKNOWN, Requirement, judged
from core.trigger import draw_counts, trigger_probability

_MIN_CONFIDENCE = 0.95  # of estimates that are taken for the surface
_MAX_PIXELS = 2048
_MIN_PIXELS = 32
_TOO_FEW = "too few pixels have a certain estimate"


def rows(capture: Capture, method: str) -> list[Callable[[], Requirement]]:
    """Return one function per part and correction."""
    return [
        partial(pile_up, capture, method),
        partial(signal_levels, capture, method),
        *(
            partial(judge, capture)
            for judge in (pulse_shape, second_surface, backscatter, faulty_pixels, motion, jitter)
        ),
    ]


def pile_up(capture: Capture, method: str) -> Requirement:
    """Judge whether early photons hide later ones, by the share of pulses that fired."""
    n_pulses = capture.gated_pulses
    if n_pulses is not None:
        fired = capture.counts / n_pulses
        return _corrected(capture, method, "pile_up", resolution.pile_up(fired, n_pulses))
    if capture.detection == "all":
        why = "in multi-detection data no photon hides another"
        return Requirement("pile_up", "not needed", why, 0.0, 0.0, detectable_share=0.0)
    return _unknown("pile_up", "the number of pulses is unknown")


def signal_levels(capture: Capture, method: str) -> Requirement:
    """Judge whether the signal differs from pixel to pixel."""
    return _corrected(capture, method, "signal_levels", corrections.level_deviation(capture))


def _corrected(capture: Capture, method: str, correction: str, apart: Difference) -> Requirement:
    captures = (
        corrections.with_correction(capture, correction),
        without_correction(capture, correction),
    )
    with_m, without_m = (corrections.ranges_m(each, method) for each in captures)
    bin_length_m = capture.acquisition.bin_length_m
    changed = float(np.mean(np.abs(with_m - without_m) > TOLERANCE_BINS * bin_length_m))
    return judged(
        correction,
        apart,
        bin_length_m,
        *_changes(capture, with_m, without_m),
        corrections.ranging_ratio(*captures, method),
        note=f"it changes {changed:.1%} of the estimates by more than {TOLERANCE_BINS} bins",
    )


def _changes(capture: Capture, with_m: Floats, without_m: Floats) -> tuple[Interval, Interval]:
    """Return the changes of restoration degree and RMSE, paired over the rows of the image."""
    truth_m = capture.truth_range_m
    if truth_m is None:
        return UNKNOWN, UNKNOWN
    rows = np.flatnonzero(np.isfinite(truth_m).any(axis=1))
    scores = (
        np.array([corrections.score(range_m[row], truth_m[row], capture) for row in rows])
        for range_m in (with_m, without_m)
    )
    return corrections.changes(*scores)


# -- Histograms of pixels whose surface is known ---------------------------------------------------


class _Sample(NamedTuple):
    """Histograms of pixels whose surface is known."""

    counts: Floats
    """Shape (pixel, bin)."""
    armed: Floats
    """Pulses armed in each bin, likewise; 1 where the number of pulses is unknown."""
    delay_bin: Floats
    """Shape (pixel,)."""
    outside: NDArray[np.bool_]
    """Bins without echo, shape (pixel, bin)."""
    background: Floats
    """Rate in each bin over all these pixels without their echoes, shape (bin,)."""


@cached_per_capture
def _sample_of(capture: Capture) -> _Sample | None:
    """Return None where too few pixels have a certain estimate."""
    bins = corrections.delays(capture, "likelihood")
    certain = tolerance_probability(capture, bins) >= _MIN_CONFIDENCE
    faulty = faults.outlier_pixels(capture)
    if faulty is not None:
        certain &= ~(faulty.hot | faulty.dead)
    pixels = np.random.default_rng(0).permutation(np.flatnonzero(certain))[:_MAX_PIXELS]
    if pixels.size < _MIN_PIXELS:
        return None
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    counts, delay_bin = capture.cube.reshape(-1, n_bins)[pixels].astype(float), bins.ravel()[pixels]
    armed = np.ones_like(counts)
    if n_pulses is not None:
        armed = n_pulses - np.cumsum(counts, axis=1) + counts
    k, echo = np.arange(n_bins), _echo_bins(capture, delay_bin)
    outside = (k < echo[:, :1]) | (k > echo[:, -1:])
    group = k * _groups(n_bins) // n_bins
    seen, sent = (np.bincount(group, (each * outside).sum(axis=0)) for each in (counts, armed))
    even = np.full(seen.size, seen.sum() / max(sent.sum(), 1.0))
    rate = np.divide(seen, sent, out=even, where=sent > 0)
    return _Sample(counts, armed, delay_bin, outside, rate[group])


def _groups(n_bins: int) -> int:
    """Return the number of groups of bins over which the background is averaged."""
    return min(n_bins, 32)


def _echo_bins(capture: Capture, delay_bin: Floats) -> NDArray[np.intp]:
    """Return the bins of an echo and one more on either side (pixel, n), some beyond the gate."""
    echo, first = capture.pulse.taps(capture.acquisition.n_bins, capture.acquisition.bin_width_s)
    here = np.floor(delay_bin).astype(np.intp)[:, np.newaxis]
    return here + np.arange(first - 1, first + echo.size + 1)


def _beyond_chance(apart: Difference, n_free: int, n_pixels: int) -> Difference:
    """Subtract the evidence that chance alone gives a mean histogram: ``n_free / 8 n_pixels``."""
    beyond = np.maximum(apart.evidence - n_free / (8 * n_pixels), 0.0)
    known = np.sqrt(beyond / np.maximum(apart.evidence, np.finfo(float).tiny))
    return Difference(apart.total_variation * known, beyond)


def backscatter(capture: Capture) -> Requirement:
    """Judge whether the background varies over the gate, as in fog."""
    sample = _sample_of(capture)
    if sample is None:
        return _unknown("backscatter", _TOO_FEW)
    n_pulses, n_bins, rate = capture.gated_pulses, sample.background.size, sample.background
    even = np.full(n_bins, rate.mean())
    if n_pulses is not None:  # compare triggers, not rates
        rate, even = (trigger_probability(-np.log1p(-np.minimum(x, 0.999))) for x in (rate, even))
    apart = difference(rate[np.newaxis], even[np.newaxis], n_pulses)
    low, high = sample.background.min(), sample.background.max()
    return judged(
        "backscatter",
        _beyond_chance(apart, _groups(n_bins), len(sample.counts)),
        capture.acquisition.bin_length_m,
        note=f"outside echoes, the background is {low:.2g} to {high:.2g} per bin",
    )


def pulse_shape(capture: Capture) -> Requirement:
    """Judge whether echoes have the shape of the assumed pulse.

    The mean echo, aligned at the estimated delays, is compared with that of simulated echoes of the
    assumed pulse, with the same delays and strengths and ranged by the same method.
    """
    sample = _sample_of(capture)
    if sample is None:
        return _unknown("pulse_shape", _TOO_FEW)
    real = _mean_echo(capture, sample, sample.counts, sample.delay_bin)
    twin = _mean_echo(capture, sample, *_twin(capture, sample))
    if real is None or twin is None:
        return _unknown("pulse_shape", _TOO_FEW)
    (seen, flat), (assumed, _) = real, twin
    wider = _width(seen - flat) / max(_width(assumed - flat), np.finfo(float).tiny)
    assumed *= seen.sum() / max(float(assumed.sum()), np.finfo(float).tiny)  # shapes alone
    apart = difference(seen[np.newaxis], assumed[np.newaxis], None)
    return judged(
        "pulse_shape",
        _beyond_chance(apart, 2 * seen.size, len(sample.counts)),
        capture.acquisition.bin_length_m,
        note=f"echoes are {wider:.2f} times as wide as those of the pulse that is assumed",
    )


def _twin(capture: Capture, sample: _Sample) -> tuple[NDArray[np.unsignedinteger], Floats]:
    """Simulate a sample with the assumed pulse; return counts and estimated delays."""
    n_bins, bin_width_s = capture.acquisition.n_bins, capture.acquisition.bin_width_s
    echo = capture.pulse.bin_probability(sample.delay_bin, n_bins, bin_width_s)
    excess = np.where(sample.outside, 0.0, sample.counts - sample.armed * sample.background)
    seen = np.where(sample.outside, 0.0, sample.armed * echo).sum(axis=1, keepdims=True)
    signal = np.maximum(excess.sum(axis=1, keepdims=True), 0.0) / np.maximum(seen, 1e-9)
    rate, rng = signal * echo + sample.background, np.random.default_rng(0)
    counts = draw_counts(rate, capture.gated_pulses, rng)
    twin = replace(
        capture,
        cube=counts[np.newaxis],
        **capture.images(lambda _: None),
        flux_prior=flux_prior_of(capture),
    )
    return counts, corrections.delays(twin, "likelihood")[0]


def _mean_echo(
    capture: Capture, sample: _Sample, counts: NDArray[Any], delay_bin: Floats
) -> tuple[Floats, Floats] | None:
    """Return mean counts around estimated delays and the background in them, shape (n,).

    Only echoes well within the gate are used; None where they are too few.
    """
    found = np.abs(np.nan_to_num(delay_bin, nan=np.inf) - sample.delay_bin) <= TOLERANCE_BINS
    at = _echo_bins(capture, sample.delay_bin)
    found &= (at[:, 0] >= TOLERANCE_BINS) & (at[:, -1] < counts.shape[1] - TOLERANCE_BINS)
    if np.count_nonzero(found) < _MIN_PIXELS:
        return None
    at = _echo_bins(capture, delay_bin[found])
    background = sample.armed * sample.background
    echo, flat = (np.take_along_axis(x[found], at, 1).mean(axis=0) for x in (counts, background))
    return echo, flat


def _width(echo: Floats) -> float:
    """Return the standard deviation of its photons in bins."""
    photons = np.maximum(echo, 0.0)
    share, k = photons / max(float(photons.sum()), np.finfo(float).tiny), np.arange(echo.size)
    return float(np.sqrt(share @ (k - share @ k) ** 2))


def second_surface(capture: Capture) -> Requirement:
    """Judge whether some window outside the echo has more photons than the background explains."""
    sample = _sample_of(capture)
    if sample is None:
        return _unknown("second_surface", _TOO_FEW)
    if pulse_shape(capture).verdict == "needed":
        why = "echoes do not have the assumed shape, and their tails would resemble it"
        return _unknown("second_surface", why)
    outside, width = sample.outside, capture.echo_bins
    counts, others = sample.counts * outside, sample.armed * sample.background * outside
    # A pixel with more background than others need not have a second echo.
    factor = counts.sum(axis=1) / np.maximum(others.sum(axis=1), np.finfo(float).tiny)
    others *= np.maximum(factor, 1.0)[:, np.newaxis]
    seen, expected = (windowed_sums(each, width) for each in (counts, others))
    whole = windowed_sums(outside.astype(float), width) > width - 0.5
    chance = np.where(whole, pdtrc(np.maximum(seen - 1, 0), expected), 1.0)
    chance[seen < 1] = 1.0
    shows = chance.min(axis=1) * whole.sum(axis=1) < faults.SIGNIFICANCE
    excess = np.where(shows, (seen - expected).max(axis=1), 0.0)
    sent = capture.gated_pulses or sample.counts.sum(axis=1)
    return _found("second_surface", shows, excess / sent, f"{shows.size} of them examined")


# -- Image -----------------------------------------------------------------------------------------


def faulty_pixels(capture: Capture) -> Requirement:
    """Judge whether single pixels detect significantly more or less than all their neighbours."""
    found = faults.outlier_pixels(capture)
    if found is None:
        return _unknown("faulty_pixels", "the image is too narrow")
    counts, n_pulses = capture.counts, capture.gated_pulses
    usual, faulty = faults.neighbour_median(capture), found.hot | found.dead
    too_dark = faults.probability_of_fewer(0, int(np.median(usual)), n_pulses) > faults.SIGNIFICANCE
    if not faulty.any() and too_dark:
        return _unknown("faulty_pixels", "too few photons to recognize a dead pixel")
    sent = n_pulses or np.maximum(np.maximum(counts, usual), 1)
    moved = np.where(faulty, np.abs(counts - usual) / sent, 0.0)
    hot, dead = np.count_nonzero(found.hot), np.count_nonzero(found.dead)
    return _found("faulty_pixels", faulty, moved, f"{hot} of them hot and {dead} dead")


def motion(_: Capture) -> Requirement:
    """Return that it is unknown: a histogram has no order of pulses."""
    return _unknown("motion", "it widens echoes like a longer pulse")


def jitter(_: Capture) -> Requirement:
    """Return that it is unknown: a measured pulse includes it."""
    return _unknown("jitter", "it widens echoes like a longer pulse")


def _unknown(part: str, why: str) -> Requirement:
    return Requirement(part, "cannot tell", why)


def _found(part: str, shows: NDArray[np.bool_], variation: Floats, note: str) -> Requirement:
    """Judge a part that is looked for in each pixel."""
    share = float(np.mean(shows))
    return Requirement(
        part,
        "needed" if share > FEW else "not needed",
        f"histograms reveal it in {share:.1%} of the pixels, {note}",
        float(np.mean(variation)),
        float(np.max(variation)),
        detectable_share=share,
    )
