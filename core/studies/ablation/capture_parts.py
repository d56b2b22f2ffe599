"""Parts and corrections that a capture itself tells of, its scene being unknown.

What depends on where surfaces are is asked of pixels whose answer is nearly certain. A part that no
histogram shows may still be there; no model of the capture needs it.
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
from core.inference.posterior import TOLERANCE_BINS, tolerance_probability
from core.inference.resolution import FEW, Difference, difference
from core.metrics import Interval
from core.studies.ablation import corrections
from core.studies.ablation.criterion import UNKNOWN, Requirement, judged
from core.trigger import drawn, trigger_probability

_SURE = 0.95  # confidence of answers that are taken for the surface
_SAMPLE = 2048  # pixels, at most, that are looked at closely
_FEWEST = 32
_NOT_SURE = "too few pixels are sure of their surface"


def rows(capture: Capture, method: str) -> list[Callable[[], Requirement]]:
    """One for each part and correction, to be called."""
    return [
        partial(pile_up, capture, method),
        partial(signal_levels, capture, method),
        *(
            partial(judge, capture)
            for judge in (pulse_shape, second_surface, backscatter, faulty_pixels, motion, jitter)
        ),
    ]


def pile_up(capture: Capture, method: str) -> Requirement:
    """Whether early photons hide later ones, by the share of pulses that fired."""
    n_pulses = capture.gated_pulses
    if n_pulses is not None:
        fired = capture.counts / n_pulses
        return _corrected(capture, method, "pile_up", resolution.pile_up(fired, n_pulses))
    if capture.detection == "all":
        why = "the capture holds all photons, none hides another"
        return Requirement("pile_up", "not needed", why, 0.0, 0.0, told_share=0.0)
    return _unknown("pile_up", "the number of pulses is not known")


def signal_levels(capture: Capture, method: str) -> Requirement:
    """Whether pixels tell that surfaces return more or less than others."""
    return _corrected(capture, method, "signal_levels", corrections.levels_apart(capture))


def _corrected(capture: Capture, method: str, correction: str, apart: Difference) -> Requirement:
    made = corrections.with_correction(capture, correction)
    spared = without_correction(capture, correction)
    one_m, other_m = (corrections.answers_m(each, method) for each in (made, spared))
    bin_length_m = capture.acquisition.bin_length_m
    moved = float(np.mean(np.abs(one_m - other_m) > TOLERANCE_BINS * bin_length_m))
    return judged(
        correction,
        apart,
        bin_length_m,
        *_changes(capture, one_m, other_m),
        corrections.ranging_ratio(made, spared, method),
        note=f"it moves {moved:.1%} of the answers by more than {TOLERANCE_BINS} bins",
    )


def _changes(capture: Capture, one_m: Floats, other_m: Floats) -> tuple[Interval, Interval]:
    """Of restoration degree and RMSE, paired over the rows of the image."""
    truth_m = capture.truth_range_m
    if truth_m is None:
        return UNKNOWN, UNKNOWN
    seen = [row for row in range(len(truth_m)) if np.isfinite(truth_m[row]).any()]
    scores = (
        np.array([corrections.score(range_m[row], truth_m[row], capture) for row in seen])
        for range_m in (one_m, other_m)
    )
    return corrections.changes(*scores)


# -- what stands in the histograms of pixels whose surface is known --------------------------------


class _Sample(NamedTuple):
    """Some pixels whose surface is known, and their histograms."""

    counts: Floats
    """Shape (pixel, bin)."""
    armed: Floats
    """Pulses before each bin, likewise; 1 where photons are counted for each pixel."""
    delay_bin: Floats
    """Shape (pixel,)."""
    beside: NDArray[np.bool_]
    """Which bins hold nothing of the echo, shape (pixel, bin)."""
    background: Floats
    """Rate in each bin, of all these pixels together, beside their echoes; shape (bin,)."""


@cached_per_capture
def _sample_of(capture: Capture) -> _Sample | None:
    """None where too few pixels are sure of their surface."""
    bins = corrections.delays(capture, "likelihood")
    sure = tolerance_probability(capture, bins) >= _SURE
    faulty = faults.standing_out(capture)
    if faulty is not None:
        sure &= ~(faulty.hot | faulty.dead)
    pixels = np.random.default_rng(0).permutation(np.flatnonzero(sure))[:_SAMPLE]
    if pixels.size < _FEWEST:
        return None
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    counts, delay_bin = capture.cube.reshape(-1, n_bins)[pixels].astype(float), bins.ravel()[pixels]
    armed = np.ones_like(counts)
    if n_pulses is not None:
        armed = n_pulses - np.cumsum(counts, axis=1) + counts
    k, echo = np.arange(n_bins), _echo_bins(capture, delay_bin)
    beside = (k < echo[:, :1]) | (k > echo[:, -1:])
    group = k * _groups(n_bins) // n_bins
    seen, sent = (np.bincount(group, (each * beside).sum(axis=0)) for each in (counts, armed))
    even = np.full(seen.size, seen.sum() / max(sent.sum(), 1.0))
    rate = np.divide(seen, sent, out=even, where=sent > 0)
    return _Sample(counts, armed, delay_bin, beside, rate[group])


def _groups(n_bins: int) -> int:
    """Groups of bins in which a background's course is known."""
    return min(n_bins, 32)


def _echo_bins(capture: Capture, delay_bin: Floats) -> NDArray[np.intp]:
    """Bins that hold an echo, one more on either side; shape (pixel, n), some beyond the gate."""
    echo, first = capture.pulse.taps(capture.acquisition.n_bins, capture.acquisition.bin_width_s)
    here = np.floor(delay_bin).astype(np.intp)[:, np.newaxis]
    return here + np.arange(first - 1, first + echo.size + 1)


def _beyond_chance(apart: Difference, n_free: int, n_pixels: int) -> Difference:
    """Of a mean histogram that was seen: chance alone makes ``n_free / 8 n_pixels`` of evidence."""
    beyond = np.maximum(apart.evidence - n_free / (8 * n_pixels), 0.0)
    known = np.sqrt(beyond / np.maximum(apart.evidence, np.finfo(float).tiny))
    return Difference(apart.total_variation * known, beyond)


def backscatter(capture: Capture) -> Requirement:
    """Whether the background changes over the gate, as that of fog does."""
    sample = _sample_of(capture)
    if sample is None:
        return _unknown("backscatter", _NOT_SURE)
    n_pulses, n_bins, rate = capture.gated_pulses, sample.background.size, sample.background
    even = np.full(n_bins, rate.mean())
    if n_pulses is not None:  # a share of the armed pulses fires, of the rate that makes it do so
        rate, even = (trigger_probability(-np.log1p(-np.minimum(x, 0.999))) for x in (rate, even))
    apart = difference(rate[np.newaxis], even[np.newaxis], n_pulses)
    low, high = sample.background.min(), sample.background.max()
    return judged(
        "backscatter",
        _beyond_chance(apart, _groups(n_bins), len(sample.counts)),
        capture.acquisition.bin_length_m,
        note=f"beside echoes, the background is {low:.2g} to {high:.2g} a bin",
    )


def pulse_shape(capture: Capture) -> Requirement:
    """Whether echoes look as those of the pulse that is assumed.

    They are put one over another at the delays that were found, which make the best of each echo;
    so are echoes drawn with that pulse, as strong, at these delays, and found by the same method.
    """
    sample = _sample_of(capture)
    if sample is None:
        return _unknown("pulse_shape", _NOT_SURE)
    real = _mean_echo(capture, sample, sample.counts, sample.delay_bin)
    twin = _mean_echo(capture, sample, *_twin(capture, sample))
    if real is None or twin is None:
        return _unknown("pulse_shape", _NOT_SURE)
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
    """Counts drawn for the pixels of a sample with the pulse that is assumed, and delays found."""
    n_bins, bin_width_s = capture.acquisition.n_bins, capture.acquisition.bin_width_s
    echo = capture.pulse.bin_probability(sample.delay_bin, n_bins, bin_width_s)
    excess = np.where(sample.beside, 0.0, sample.counts - sample.armed * sample.background)
    seen = np.where(sample.beside, 0.0, sample.armed * echo).sum(axis=1, keepdims=True)
    signal = np.maximum(excess.sum(axis=1, keepdims=True), 0.0) / np.maximum(seen, 1e-9)
    rate, rng = signal * echo + sample.background, np.random.default_rng(0)
    counts = drawn(rate, capture.gated_pulses, rng)
    twin = replace(
        capture,
        cube=counts[np.newaxis],
        truth_range_m=None,
        signal=None,
        flux_prior=flux_prior_of(capture),
    )
    return counts, corrections.delays(twin, "likelihood")[0]


def _mean_echo(
    capture: Capture, sample: _Sample, counts: NDArray[Any], delay_bin: Floats
) -> tuple[Floats, Floats] | None:
    """Mean counts about delays that were found, and what of them is background; shape (n,).

    Of echoes that lie within the gate, None where they are too few.
    """
    found = np.abs(np.nan_to_num(delay_bin, nan=np.inf) - sample.delay_bin) <= TOLERANCE_BINS
    at = _echo_bins(capture, sample.delay_bin)
    found &= (at[:, 0] >= TOLERANCE_BINS) & (at[:, -1] < counts.shape[1] - TOLERANCE_BINS)
    if np.count_nonzero(found) < _FEWEST:
        return None
    at = _echo_bins(capture, delay_bin[found])
    background = sample.armed * sample.background
    echo, flat = (np.take_along_axis(x[found], at, 1).mean(axis=0) for x in (counts, background))
    return echo, flat


def _width(echo: Floats) -> float:
    """Standard deviation of where its photons lie, in bins."""
    photons = np.maximum(echo, 0.0)
    share, k = photons / max(float(photons.sum()), np.finfo(float).tiny), np.arange(echo.size)
    return float(np.sqrt(share @ (k - share @ k) ** 2))


def second_surface(capture: Capture) -> Requirement:
    """Whether some place beside the echo holds more photons than the background explains."""
    sample = _sample_of(capture)
    if sample is None:
        return _unknown("second_surface", _NOT_SURE)
    if pulse_shape(capture).verdict == "needed":
        why = "echoes have not the shape that is assumed, and their wings would look like it"
        return _unknown("second_surface", why)
    beside, width = sample.beside, capture.echo_bins
    counts, others = sample.counts * beside, sample.armed * sample.background * beside
    # A pixel that sees more background than others is none with a second echo.
    factor = counts.sum(axis=1) / np.maximum(others.sum(axis=1), np.finfo(float).tiny)
    others *= np.maximum(factor, 1.0)[:, np.newaxis]
    seen, expected = (_windows(each, width) for each in (counts, others))
    whole = _windows(beside.astype(float), width) > width - 0.5
    chance = np.where(whole, pdtrc(np.maximum(seen - 1, 0), expected), 1.0)
    chance[seen < 1] = 1.0
    shows = chance.min(axis=1) * whole.sum(axis=1) < faults.BY_CHANCE
    excess = np.where(shows, (seen - expected).max(axis=1), 0.0)
    sent = capture.gated_pulses or sample.counts.sum(axis=1)
    return _found("second_surface", shows, excess / sent, f"{shows.size} of them looked at")


def _windows(values: Floats, width: int) -> Floats:
    """Sums of `width` neighbours along the last axis."""
    until = np.pad(np.cumsum(values, axis=1), ((0, 0), (1, 0)))
    return np.asarray(until[:, width:] - until[:, :-width])


# -- what stands in the image ----------------------------------------------------------------------


def faulty_pixels(capture: Capture) -> Requirement:
    """Whether single pixels detect more, or less, than all their neighbours by more than chance."""
    found = faults.standing_out(capture)
    if found is None:
        return _unknown("faulty_pixels", "an image so narrow has no neighbours")
    counts, n_pulses = capture.counts, capture.gated_pulses
    usual, faulty = faults.usual_counts(capture), found.hot | found.dead
    too_dark = faults.fewer_by_chance(0, int(np.median(usual)), n_pulses) > faults.BY_CHANCE
    if not faulty.any() and too_dark:
        return _unknown("faulty_pixels", "too few photons to tell a dead pixel")
    sent = n_pulses or np.maximum(np.maximum(counts, usual), 1)
    moved = np.where(faulty, np.abs(counts - usual) / sent, 0.0)
    hot, dead = np.count_nonzero(found.hot), np.count_nonzero(found.dead)
    return _found("faulty_pixels", faulty, moved, f"{hot} stand out as hot and {dead} as dead")


def motion(_: Capture) -> Requirement:
    """Never: a histogram keeps no order of pulses."""
    return _unknown("motion", "it widens echoes as a longer pulse does")


def jitter(_: Capture) -> Requirement:
    """Never: a pulse that was measured holds it already."""
    return _unknown("jitter", "it widens echoes as a longer pulse does")


def _unknown(part: str, why: str) -> Requirement:
    """A part of which the data say nothing."""
    return Requirement(part, "cannot tell", why)


def _found(part: str, shows: NDArray[np.bool_], variation: Floats, note: str) -> Requirement:
    """A part that is looked for in each pixel."""
    share = float(np.mean(shows))
    return Requirement(
        part,
        "needed" if share > FEW else "not needed",
        f"histograms show it in {share:.1%} of the pixels, {note}",
        float(np.mean(variation)),
        float(np.max(variation)),
        told_share=share,
    )
