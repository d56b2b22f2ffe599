"""Mean signal and background of the pixels of a capture, with intervals.

Pixels differ: some have no echo, others a stronger one. In a sample of pixels, an unknown share has
an echo, with a gamma distributed signal of unknown shape. The likelihoods of the pixels, averaged
over uniform delays, give a likelihood of mean signal and mean background, maximised over share and
shape, and profile likelihood intervals as for a single pixel (`core.inspection.flux`).

Where pixels differ in their backgrounds, the likelihood only gives the signal; the mean background
is what it leaves of the total. Where signals are in proportion to the backgrounds
(`core.inference.flux`), the likelihood gives the ratio of both, which is multiplied by the
brightness of the pixels that have an echo; both add up to the total. The share of pixels with an
echo does not depend on their background: beside a sky that is much brighter than the targets, too
many pixels seem to have an echo, and signals are too high.

The maximum-likelihood gamma distribution has the mean of the observed signals, whatever their
true distribution, so that the model need not be exact where signals are clear.

Target pixels are those with an echo: the same likelihood, as a function of their mean signal
instead of that of all pixels. How many there are does depend on the distribution: beside a few
retroreflectors, most pixels seem to have no echo. If signal levels with shares of their own are
clearly likelier, the interval includes what they give, too.

The intervals are for the means of the pixels of the capture that are neither hot nor dead, and
include the chance by which a sample differs from the image. They hold for the fitted pulse: the
uncertainty of the fit is not included. On 120 captures with a pulse half or twice as long as
assumed or with an exponential tail, they contained the mean signal of all pixels 0.96 of the time,
the background 0.975, and the signal of target pixels 0.925 [0.86, 0.96]. The error of the latter
hardly depends on the width of the fitted pulse: they correlate by 0.25 at most.
``python -m core calibration --only fluxes`` measures the coverage.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse
from core.capture import Capture, cached_per_capture
from core.inference.faults import ordinary_pixels
from core.inference.flux import (
    SAMPLE,
    background_in_strong_sun,
    detailed_flux_prior_of,
    flux_model_with,
    has_many_spent,
    level_likelihoods,
    level_shares,
    total_rates,
)
from core.inference.flux_model import FluxPrior
from core.inspection.echoes import darkest_flux, echo_free_flux, total_flux
from core.inspection.flux import estimate_flux
from core.inspection.profile import (
    LEVEL,
    Box,
    FluxEstimate,
    difference_of,
    product_of,
    ratio_of,
    spans,
    zoomed,
)
from core.inspection.pulse_fit import fit_pulse
from core.kernels.posterior import learn_shares
from core.metrics import Interval
from core.reductions import merge_bins, share_of_pulses

METHOD = (
    "95 % profile likelihood intervals; signals of pixels with an echo are modelled as gamma "
    "distributed, and the pulse is fitted to the echoes"
)

_Fit = Callable[[Floats, Floats], Floats]

_SIGMAS = float(scipy.special.ndtri(0.5 + LEVEL / 2))
_SAMPLE = 512  # pixels
_CLEARLY_LIKELIER = 10.0  # log likelihood of levels of signal, above that of a gamma distribution
_FEW = 24  # pixels, too few to estimate the scatter of the signals
_DARK = 30  # photons in all, too few to separate signal and background
_BRIGHT = 400  # photons of the brightest echo, enough for the mean
_ECHO_BINS = 3  # bins of an echo, enough to locate it
_COARSE, _FINE = (7, 9), (9, 15)  # values of background and signal that are tried


class MeanFlux(NamedTuple):
    """Fluxes of the pixels of a capture, in the units of `estimate_mean_flux`."""

    image: FluxEstimate
    """Mean over all pixels; those without an echo have no signal."""
    target: FluxEstimate
    """Mean over the target pixels, those with an echo; its background is that of the image."""
    model: FluxEstimate
    """The image's by the likelihood alone."""
    free: FluxEstimate | None
    """The image's by the bins without echoes alone (`core.inspection.echoes.echo_free_flux`). By
    the darkest tenth of the gate where that contradicts these bins over a uniform background or, if
    they are unknown, the likelihood (`core.inspection.echoes.darkest_flux`)."""
    pulse: Pulse
    """The capture's, or the one that fits the echoes clearly better
    (`core.inspection.pulse_fit`)."""
    is_darkest: bool = False
    """Whether `free` is that of the darkest tenth of the gate."""

    @classmethod
    def alike(cls, found: FluxEstimate, pulse: Pulse) -> MeanFlux:
        """Return the same fluxes for every pixel."""
        return cls(found, found, found, None, pulse)

    def in_longer_gate(self, factor: float) -> MeanFlux:
        """Return the fluxes of a gate `factor` times as long, with as much background per time."""
        return self._replace(
            image=self.image.in_longer_gate(factor),
            target=self.target.in_longer_gate(factor),
            model=self.model.in_longer_gate(factor),
            free=self.free and self.free.in_longer_gate(factor),
        )

    @property
    def is_contradicted(self) -> bool:
        """Whether bins without echoes give another background than the likelihood."""
        return self.free is not None and not self.free.background.overlaps(self.model.background)


def estimate_mean_flux(capture: Capture) -> FluxEstimate:
    """Estimate mean signal and background of all pixels, and their ratio, with 95 % intervals.

    In photons per pulse if the number of pulses is known, otherwise in photons. Pixels without an
    echo count as having no signal; hot and dead ones are left out. Fewer than 24 pixels are assumed
    to have the same fluxes.
    """
    return mean_flux_of(capture).image


def estimate_target_flux(capture: Capture) -> FluxEstimate:
    """Estimate the fluxes as `estimate_mean_flux` does, of a mean pixel with an echo."""
    return mean_flux_of(capture).target


@cached_per_capture
def mean_flux_of(capture: Capture) -> MeanFlux:
    """Estimate the fluxes of the image and of its target pixels."""
    coarse = _coarse(capture)
    lengths_s = [
        each.n_bins * each.bin_width_s for each in (capture.acquisition, coarse.acquisition)
    ]
    return _mean_flux(coarse).in_longer_gate(lengths_s[0] / lengths_s[1])


def _mean_flux(capture: Capture) -> MeanFlux:
    ordinary = selected_pixels(capture, ordinary_pixels(capture))
    n_pixels, acquisition, pulse = ordinary.shape[1], ordinary.acquisition, ordinary.pulse
    if n_pixels < _FEW:
        counts = ordinary.cube[0].astype(float)
        found = estimate_flux(counts, acquisition, pulse, ordinary.gated_pulses)
        return MeanFlux.alike(found.of(ordinary), pulse)
    if 2 * ordinary.echo_bins >= acquisition.n_bins or ordinary.counts.sum() < _DARK:
        return MeanFlux.alike(_unresolved(ordinary).of(ordinary), pulse)
    some, share = _dimmer(ordinary)
    mixture, scale = _Mixture(some), 1.0 if acquisition.n_pulses else 1 / share
    model, target = (each.of(some).scaled(scale) for each in (mixture.image, mixture.target))
    # Few unfired pulses show too small a total.
    total = None if has_many_spent(ordinary) else total_flux(ordinary)
    has_own_backgrounds, at_background = mixture.has_own_backgrounds, mixture.at_background
    known = _in_strong_sun(ordinary) if has_own_backgrounds else None
    if at_background is not None:
        # The likelihood gives signals relative to backgrounds; both add up to the total.
        brightness = mixture.brightness_of_targets
        sbr, of_target = (
            product_of(each.signal.scaled(1 / at_background), brightness)
            for each in (mixture.image, mixture.target)
        )
        background = known or (total and _below_signal(total, sbr)) or model.background
        model = whole = FluxEstimate(product_of(sbr, background), background, sbr)
        target = FluxEstimate(product_of(of_target, background), background, of_target)
    elif known is not None:
        whole = FluxEstimate(model.signal, known, ratio_of(model.signal, known))
    elif has_own_backgrounds and total is not None:
        whole = _below_total(model.signal, total)
    else:
        whole = _with_total(model, total)
    # The share of target pixels in a sample differs from that of the image, by chance.
    is_whole = n_pixels <= _SAMPLE
    signal = (
        _at_same_share(target.signal, model.signal, whole.signal) if is_whole else target.signal
    )
    if signal != target.signal or (has_own_backgrounds and at_background is None):
        sbr = ratio_of(signal, whole.background)
        target = FluxEstimate(signal, whole.background, sbr)
    free, darkest = echo_free_flux(capture), darkest_flux(capture)
    by_free = _combined(MeanFlux(whole, target, whole, free, mixture.pulse))
    # Bins before and after the echoes that are found may hold those of another surface. Where the
    # background varies, a window may instead be darker than a smooth shape.
    is_smooth = free is not None and detailed_flux_prior_of(capture).background_shape is not None
    most = (free or whole).background.low
    if is_smooth or darkest is None or darkest.background.high >= most:
        return by_free
    by_darkest = _combined(by_free._replace(image=whole, target=target, free=darkest))
    return by_darkest._replace(
        image=_joined(by_darkest.image, by_free.image),
        target=_joined(by_darkest.target, by_free.target),
        is_darkest=True,
    )


def _joined(found: FluxEstimate, other: FluxEstimate) -> FluxEstimate:
    """Return fluxes with intervals that include others."""
    return FluxEstimate(
        found.signal.joined(other.signal),
        found.background.joined(other.background),
        found.sbr.joined(other.sbr),
    )


def _in_strong_sun(capture: Capture) -> Interval | None:
    """Return `background_in_strong_sun` with its 95 % interval."""
    known = background_in_strong_sun(capture)
    if known is None:
        return None
    mean, half = known[0], _SIGMAS * known[1]
    return Interval(mean, mean - half, mean + half)


def _below_signal(total: Interval, sbr: Interval) -> Interval:
    """Return the background that a signal in proportion to it leaves of the total."""
    return ratio_of(total, Interval(1 + sbr.value, 1 + sbr.low, 1 + sbr.high))


def _below_total(signal: Interval, total: Interval) -> FluxEstimate:
    """Return the fluxes of pixels with backgrounds of their own, which the signal leaves."""
    background = difference_of(total, signal)
    return FluxEstimate(signal, background, ratio_of(signal, background))


def _with_total(model: FluxEstimate, total: Interval | None) -> FluxEstimate:
    """Return the signal of all pixels above the background, if that is known better.

    The likelihood is that of a sample of the pixels, in which more or fewer may have an echo.
    """
    if total is None or math.isinf(model.background.high):
        return model
    signal = difference_of(total, model.background)
    if signal.high - signal.low > model.signal.high - model.signal.low:
        return model
    ratio = ratio_of(total, model.background)
    sbr = Interval(*(max(each - 1, 0.0) for each in (ratio.value, ratio.low, ratio.high)))
    return FluxEstimate(signal, model.background, sbr)


def _at_same_share(target: Interval, sample: Interval, image: Interval) -> Interval:
    """Return the signal of target pixels if as large a share of the image has an echo as sampled.

    Unless the signal of the image is known worse than that of the target pixels.
    """
    if not (image.high - image.low) * target.value < (target.high - target.low) * image.value:
        return target
    return target.scaled(image.value / sample.value) if sample.value > 0 else target


def _combined(found: MeanFlux) -> MeanFlux:
    """Prefer the narrower of both estimates; include both where they disagree."""
    free, model, target = found.free, found.model, found.target
    if free is None:
        return found
    if not found.is_contradicted:
        if free.signal.high - free.signal.low > model.signal.high - model.signal.low:
            return found
        signal = _at_same_share(target.signal, model.signal, free.signal)
        sbr = ratio_of(signal, free.background)
        return found._replace(image=free, target=FluxEstimate(signal, free.background, sbr))
    image = _joined(free, model)
    # The same share of the pixels has an echo.
    factor = free.signal.value / model.signal.value if model.signal.value > 0 else 1.0
    signal = target.signal.scaled(factor)
    sbr = ratio_of(signal, free.background).joined(target.sbr)
    joined = FluxEstimate(signal.joined(target.signal), image.background, sbr)
    return found._replace(image=image, target=joined)


def selected_pixels(capture: Capture, mask: NDArray[np.bool_]) -> Capture:
    """Return the pixels of a mask (row, col) in one row, without truth and flux prior."""
    return _of_counts(capture, capture.cube[mask])


def _of_counts(capture: Capture, counts: NDArray[Any]) -> Capture:
    """Return a capture of a row of pixels (col, bin), without truth and flux prior."""
    cube, images = counts[np.newaxis], capture.images(lambda _: None)
    return replace(capture, cube=cube, **images, flux_prior=None, groups=None)


def _coarse(capture: Capture) -> Capture:
    """Merge bins of which an echo covers many: they hold no more information on fluxes."""
    factor = capture.echo_bins // _ECHO_BINS
    fits = factor > 1 and 2 * capture.echo_bins < capture.acquisition.n_bins
    return merge_bins(capture, factor) if fits else capture


def _unresolved(capture: Capture) -> FluxEstimate:
    """Estimate fluxes that cannot be separated: all photons may be signal, or background.

    The interval of the total is the exact one of a binomial share of all pulses (Clopper & Pearson
    1934) or of a Poisson mean (Garwood 1936).
    """
    n_pixels, n_pulses, seen = capture.counts.size, capture.gated_pulses, int(capture.counts.sum())
    tail = 0.5 - LEVEL / 2
    if n_pulses is None:
        total = seen / n_pixels
        high = float(scipy.special.gammaincinv(seen + 1, 1 - tail)) / n_pixels
    else:
        unfired = n_pulses * n_pixels - seen
        total = math.log(n_pulses * n_pixels / max(unfired, 0.5))
        least = float(scipy.special.betaincinv(unfired, seen + 1, tail)) if unfired else 0.0
        high = -math.log(least) if least > 0 else math.inf
    sbr = Interval(0.0 if seen else math.nan, 0.0, math.inf)
    return FluxEstimate(Interval(0.0, 0.0, high), Interval(total, 0.0, high), sbr)


def _dimmer(capture: Capture) -> tuple[Capture, float]:
    """Reduce the pulses of a capture whose echoes are brighter than the mean requires."""
    known = detailed_flux_prior_of(capture)
    strongest = flux_model_with(capture, known._replace(levels=known.levels[-1:])).signal.max()
    share = _BRIGHT / max(float(strongest) * (capture.gated_pulses or 1), _BRIGHT)
    return (share_of_pulses(capture, share), share) if share < 1 else (capture, 1.0)


class _Mixture:
    """Likelihood of mean background and signal, from a sample of the pixels.

    With the pulse that fits their echoes best (`core.inspection.pulse_fit`).
    """

    def __init__(self, capture: Capture) -> None:
        known = detailed_flux_prior_of(capture)
        total, n_pulses = total_rates(capture), capture.gated_pulses or 1
        pixels = _drawn(total.size)
        self._sample = _of_counts(capture, capture.cube[0, pixels])
        top = 2 * float(known.levels[-1])
        count = int(np.clip(math.ceil(2 * math.sqrt(top * n_pulses)), 12, 40))
        self._levels = np.linspace(0.0, math.sqrt(top), count + 1) ** 2
        # Photons of the strongest echo determine its delay; between two, it would seem longer.
        self._steps = max(_STEPS[0], _STEPS[1] * math.sqrt(top / 2 * n_pulses))
        background = max(float(known.background), 0.5 / n_pulses)
        self._known = known._replace(
            levels=self._levels,
            background=np.asarray(background),
            share=np.full(self._levels.size, 1 / self._levels.size),
            # Without pile-up, the likelihood averaged over uniform delays is the same wherever
            # the echoes lie; a distribution learned from few photons would bias it.
            depth=known.depth if capture.gated_pulses else np.ones_like(known.depth),
            own_weight=_own_weight(capture, known),
        )
        mean = max(float(known.share @ known.levels), top / 1e3)
        bright = max(mean / float(known.share[1:].sum()), mean)
        chance = math.sqrt(float(total.mean()) / n_pulses / pixels.size)
        half = min(4 * chance / background, 1.0)
        if capture.gated_pulses is not None and total.size >= 2 * _SAMPLE:
            self._known = self._sharpened(capture.pulse, math.log(background))
        fit = fit_pulse(
            lambda pulse, at: self._score(pulse, math.log(background) + at * half, self._known),
            capture.pulse,
            _BACKGROUNDS,
            capture.acquisition.bin_width_s / _SAMPLES_PER_BIN,
        )
        self.pulse, centre = fit.pulse, math.log(background) + fit.background * half
        least = math.log(1e-4 / n_pulses / pixels.size)  # beyond: no bound
        most = math.log(1000 * (background + top + capture.acquisition.n_bins))
        if self.has_own_backgrounds:
            least, most = centre - half, centre + half
        box = Box(
            low=(centre - half, 0.6 * math.sqrt(mean)),
            high=(centre + half, 1.3 * math.sqrt(mean)),
            least=(least, 0.0),
            most=(most, math.sqrt(top)),
        )
        self._tabulate(box.low[0], box.high[0])
        box, self.image = self._estimated(box, of_target=False)
        bright = min(math.sqrt(bright), box.most[1] / 2)
        box = box._replace(low=(box.low[0], 0.8 * bright), high=(box.high[0], 1.2 * bright))
        self.target = self._with_any_distribution(self._estimated(box, of_target=True)[1])

    @property
    def at_background(self) -> float | None:
        """Background of a pixel with the signals of the estimates, if they are in proportion."""
        return float(self._known.background) if self._known.is_in_proportion else None

    @property
    def brightness_of_targets(self) -> Interval:
        """Mean brightness of the pixels with an echo, relative to that of all.

        Where there is no surface, as in the sky, the background is another one. The interval is
        that of the chance by which the sample differs from the image.
        """
        share, likelihood, _ = self._with_free_shares(self._nodes[0])
        posterior = share * likelihood / (likelihood @ share)[:, np.newaxis]
        signal = (posterior * flux_model_with(self._sample, self._known).signal[:, 0].T).sum(axis=1)
        at_mean = posterior @ self._levels
        mean = float(signal.sum() / at_mean.sum())
        half = _SIGMAS * math.sqrt(((signal - mean * at_mean) ** 2).sum()) / float(at_mean.sum())
        return Interval(mean, max(mean - half, 0.0), mean + half)

    @property
    def has_own_backgrounds(self) -> bool:
        """Whether pixels differ in their backgrounds.

        That of a pixel is then about its total less its signal, of which the likelihood of a mean
        background knows nothing.
        """
        return self._known.own_weight > 0

    def _estimated(self, box: Box, of_target: bool) -> tuple[Box, FluxEstimate]:
        """Estimate the fluxes of the mean pixel, or of the mean target pixel, from a box."""
        acquisition = self._sample.acquisition

        def surface(log_background: Floats, root_signal: Floats) -> Floats:
            return self._log_likelihood(log_background, root_signal**2, of_target)

        box = zoomed(box, surface, _COARSE)
        # The tail of an echo beyond its taps is not background.
        echo, _ = self.pulse.taps(acquisition.n_bins, acquisition.bin_width_s)
        missed = max(1 - float(echo.sum()), 0.0)

        def flux_at(log_background: Floats, root_signal: Floats) -> tuple[Floats, Floats]:
            background, signal = np.meshgrid(np.exp(log_background), root_signal**2, indexing="ij")
            background = np.maximum(background - missed * signal, 0.0)
            if box.low[0] == box.least[0]:
                background[0] = 0.0
            if box.high[0] == box.most[0]:
                background[-1] = np.inf
            return signal, background

        return box, spans(box, surface(*box.grid(_FINE)), flux_at)

    def _with_any_distribution(self, target: FluxEstimate) -> FluxEstimate:
        """Return fluxes of target pixels that hold where signals are not gamma distributed.

        If another distribution of the signals is clearly likelier, the value is that of its target
        pixels, and the interval includes both.
        """
        image = self.image.signal
        background = max(self.image.background.value, math.exp(self._nodes[0]))
        log_background = float(np.clip(math.log(background), *self._nodes[[0, -1]]))
        at = np.array([log_background]), np.array([target.signal.value])
        gamma = self._log_likelihood(*at, of_target=True)[0, 0]
        share, _, free = self._with_free_shares(log_background)
        if free < gamma + _CLEARLY_LIKELIER or image.value == 0:
            return target
        mean = float(share @ self._levels)
        variance = float(share @ (self._levels - mean) ** 2) / self._sample.shape[1]
        chance = math.hypot(
            (image.high - image.low) / 2 / image.value, _SIGMAS * math.sqrt(variance) / mean
        )
        signal = mean / (1 - float(share[0]))
        ends = Interval(signal, signal * max(1 - chance, 0.0), signal * (1 + chance))
        found = ends.joined(target.signal)
        sbr = ratio_of(found, self.image.background)
        return FluxEstimate(found, target.background, sbr)

    def _with_free_shares(self, log_background: float) -> tuple[Floats, Floats, float]:
        """Return the likeliest shares of the levels, and with them the log likelihood.

        Between them the relative likelihoods of the levels of each pixel, (pixel, level).
        """
        log = self._logs_at(log_background)
        top = log.max(axis=1, keepdims=True)
        likelihood = np.exp(log - top)
        share = level_shares(likelihood)
        return share, likelihood, float(np.log(likelihood @ share).sum() + top.sum())

    def _sharpened(self, pulse: Pulse, log_background: float) -> FluxPrior:
        """Return the prior with the power of its distribution of delays that is likeliest.

        The learned distribution is blurred, since noise of pixels without an echo takes part in it.
        Their noise would count as faint echoes, those of other pixels than it was learned from.
        """
        powers = [self._known.depth**power for power in _DEPTH_POWERS]
        priors = [self._known._replace(depth=each / each.mean()) for each in powers]
        return max(priors, key=lambda prior: self._score(pulse, log_background, prior))

    def _score(self, pulse: Pulse, log_background: float, prior: FluxPrior) -> float:
        """Log likelihood of pulse and background, maximised over the shares of the levels."""
        pixels = np.arange(min(_TRIAL_SAMPLE, self._sample.shape[1]))
        log = self._level_likelihoods(pulse, log_background, prior, pixels, _TRIAL * self._steps)
        top = log.max(axis=1, keepdims=True)
        likelihood, share = np.exp(log - top), prior.share.copy()
        learn_shares(likelihood, share)
        return float(np.log(likelihood @ share).sum() + top.sum())

    def _tabulate(self, low: float, high: float) -> None:
        """Tabulate log likelihoods of the levels between two backgrounds (as logarithms)."""
        self._nodes = np.linspace(low, high, _NODES)
        pixels = np.arange(self._sample.shape[1])
        self._logs = np.stack(
            [
                self._level_likelihoods(self.pulse, each, self._known, pixels, self._steps)
                for each in self._nodes
            ]
        )

    def _level_likelihoods(
        self,
        pulse: Pulse,
        log_background: float,
        prior: FluxPrior,
        pixels: NDArray[np.intp],
        delays_per_echo: float,
    ) -> Floats:
        """Log likelihood of each level in some pixels of the sample, shape (pixel, level)."""
        sample = replace(self._sample, pulse=pulse)
        begin_s, end_s = pulse.span_s
        steps = math.ceil(
            delays_per_echo * self._sample.acquisition.bin_width_s / (end_s - begin_s)
        )
        steps = min(steps, _MOST_STEPS)
        if self.at_background is None:
            prior = prior._replace(background=np.asarray(math.exp(log_background)))
        return level_likelihoods(sample, pixels, prior, steps)

    def _log_likelihood(self, log_background: Floats, signal: Floats, of_target: bool) -> Floats:
        """Log likelihood, shape (background, signal)."""
        if log_background[0] < self._nodes[0] or log_background[-1] > self._nodes[-1]:
            self._tabulate(log_background[0], log_background[-1])
        least = np.zeros(signal.size) if of_target else signal / self._levels[-1]
        least = np.clip(least, _LEAST_SHARE, 1.0)
        rows, near = [], None
        for each in log_background:
            fit, top = self._fit(each, signal, of_target)
            found, near = largest_fit(fit, least, near)
            rows.append(found + top)
        return np.stack(rows)

    def _logs_at(self, log_background: float) -> Floats:
        """Interpolate the log likelihoods of the levels, shape (pixel, level)."""
        return np.asarray(np.tensordot(_lagrange(self._nodes, log_background), self._logs, axes=1))

    def _fit(self, log_background: float, signal: Floats, of_target: bool) -> tuple[_Fit, float]:
        """Return the log likelihood of shares and shapes for each signal, above a constant."""
        log = self._logs_at(log_background)
        top = log.max(axis=1, keepdims=True)
        # A few pixels at a time: larger products start threads, which take longer.
        parts = np.array_split(
            np.exp(log - top).astype(np.float32), math.ceil(len(log) / _PIXELS_AT_ONCE)
        )

        def fit(share: Floats, shape: Floats) -> Floats:
            bright = signal[:, np.newaxis, np.newaxis] / (1.0 if of_target else share)
            weights = _gamma_weights(self._levels, bright, share, shape)
            tried = np.swapaxes(weights.reshape(signal.size, -1, self._levels.size), 1, 2)
            tried = tried.astype(np.float32)
            found = sum(
                np.log(np.maximum(part @ tried, _LEAST_LIKELIHOOD)).sum(axis=1, dtype=float)
                for part in parts
            )
            return np.asarray(found).reshape(weights.shape[:-1])

        return fit, float(top.sum())


def _drawn(n_pixels: int) -> NDArray[np.intp]:
    """Draw pixels, as many of each part of the image as it has.

    Neighbours are alike, so that as large a share of the sample has an echo as of the image. Those
    from which the distribution of delays was learned are left out, if there are others.
    """
    rng = np.random.default_rng(0)
    others = rng.permutation(n_pixels)[max(min(SAMPLE, n_pixels - _SAMPLE), 0) :]
    if others.size <= _SAMPLE:
        return others
    ends = np.linspace(0, others.size, _SAMPLE + 1)
    at = (ends[:-1] + rng.random(_SAMPLE) * np.diff(ends)).astype(int)
    return rng.permutation(np.sort(others)[at])


_BACKGROUNDS = np.array([-5.0, -2.5, -1.0, 0.0, 1.0, 2.5])  # from the first guess
_SAMPLES_PER_BIN = 4
_TRIAL_SAMPLE = 256  # pixels to which a pulse is fitted
_DEPTH_POWERS = (1.0, 1.5, 2.0, 3.0)
_NODES = 4
_PIXELS_AT_ONCE = 128
_LEAST_SHARE = 1e-6  # of pixels with an echo
_LEAST_LIKELIHOOD = np.float32(1e-36)  # relative to the likeliest level
_STEPS = 6.0, 1.2  # delays per width of an echo, its middle 80 %; and per root of its photons
_TRIAL = 0.5  # as many to choose a pulse
_MOST_STEPS = 16  # delays per bin
_SHAPES = (0.3, 3000.0)  # of gamma distributions, from mostly faint pixels to equal ones
_FIRST_TRIED = 17  # shares and shapes; of fewer, a broad local maximum may seem the largest
_TRIED, _ZOOMS = 5, 4  # near the maximum


def _own_weight(capture: Capture, known: FluxPrior) -> float:
    """Weight of a pixel's own background; for photons, 0 unless it is significant.

    Few photons say little of the background of their pixel. The variance of the signals is that of
    a sample, and only what it leaves of the variance of the totals is due to backgrounds.
    """
    if capture.gated_pulses is not None:
        return known.own_weight
    squares = (capture.counts - capture.counts.mean()) ** 2
    chance = math.sqrt(float(squares.var()) / min(squares.size, _SAMPLE))
    return known.own_weight if known.own_weight * float(squares.mean()) > 3 * chance else 0.0


def _lagrange(nodes: Floats, x: float) -> Floats:
    """Weights of the nodes in the interpolating polynomial at `x`."""
    apart = nodes[:, np.newaxis] - nodes
    np.fill_diagonal(apart, 1.0)
    off = np.tile(x - nodes, (nodes.size, 1))
    np.fill_diagonal(off, 1.0)
    return np.asarray((off / apart).prod(axis=1))


def largest_fit(fit: _Fit, least_share: Floats, near: Floats | None) -> tuple[Floats, Floats]:
    """Maximise a function over share and shape for each signal.

    Parameters
    ----------
    fit : callable
        Function of shares (signal, share, 1) and shapes (signal, 1, shape).
    least_share : ndarray, shape (signal,)
    near : ndarray, shape (2, signal), or None
        Approximate place of the maximum, which shortens the search: one that was returned.

    Returns
    -------
    maximum : ndarray, shape (signal,)
    place : ndarray, shape (2, signal)
        Square root of the share, and logarithm of the shape.
    """
    every = np.arange(least_share.size)
    lowest = np.stack([np.sqrt(least_share), np.full(every.size, math.log(_SHAPES[0]))])
    highest = np.stack([np.ones(every.size), np.full(every.size, math.log(_SHAPES[1]))])
    low, high, best, tried = lowest, highest, np.full(every.size, -np.inf), (_TRIED,) * _ZOOMS
    if near is None:
        tried = (_FIRST_TRIED, *tried)
    else:
        spacing = (highest - lowest) / (_FIRST_TRIED - 1)
        low, high = np.maximum(near - spacing, lowest), np.minimum(near + spacing, highest)
    for n in tried:
        steps, spacing = np.linspace(0.0, 1.0, n), (high - low) / (n - 1)
        root, log = low[..., np.newaxis] + (high - low)[..., np.newaxis] * steps
        found = fit((root**2)[:, :, np.newaxis], np.exp(log)[:, np.newaxis, :])
        flat = found.reshape(every.size, -1)
        at, best = flat.argmax(axis=1), np.maximum(best, flat.max(axis=1))
        centre = np.stack([root[every, at // n], log[every, at % n]])
        low, high = np.maximum(centre - spacing, lowest), np.minimum(centre + spacing, highest)
    return best, centre


def _gamma_weights(levels: Floats, bright: Floats, share: Floats, shape: Floats) -> Floats:
    """Share of the pixels at each level, (signal, share, shape, level).

    A share of gamma distributed signals of mean `bright`, each split between its two adjacent
    levels so that the mean is preserved; the rest has no signal.
    """
    x = levels * (shape / np.maximum(bright, 1e-12 * levels[-1]))[..., np.newaxis]
    k = np.broadcast_to(shape[..., np.newaxis], x.shape)
    below = scipy.special.gammainc(k, x)  # share of the signals below each level
    norm = scipy.special.gammaln(shape + 1)[..., np.newaxis]
    at_level = np.exp(scipy.special.xlogy(k, x) - x - norm)
    moment = (below - at_level) * bright[..., np.newaxis]
    mass = np.diff(below)
    upper = (np.diff(moment) - mass * levels[:-1]) / np.diff(levels)
    weights = np.zeros(np.broadcast_shapes(x.shape, (*share.shape, 1)))
    weights[..., 1:] += upper
    weights[..., :-1] += mass - upper
    weights[..., -1] += 1 - below[..., -1]
    weights *= share[..., np.newaxis]
    weights[..., 0] += 1 - share
    return np.asarray(np.maximum(weights, 0.0))
