"""Posterior of the image: exact likelihood of each pixel, combined with its neighbours.

Neighbouring pixels mostly see the same surface, so that at an SBR at which single pixels are
ambiguous their common evidence is not. The delay of a pixel is a hidden variable; of two
neighbours, the second lies with probability ρ on the plane of the first, and anywhere otherwise.

**Evidence.** The likelihood ratio of each delay, averaged over the signal levels, which are
estimated from pooled pixels (`core.estimators.image_model`).

Where no surface is likely although every pixel has to be estimated, its level is unknown, and any
level is as likely (`core.estimators.image_model.with_any_level`).

**Messages.** A posterior of each pixel given the others of its row, then of each given all rows by
the same along the columns: sum-product messages (`core.kernels.messages`), in which each other
pixel counts once. The same with columns first; the posterior is the mean of both.

**Planes.** Where the surface is oblique or slopes, its pixels do not share a delay but a plane. A
plane is found for each pixel, robust to other surfaces (`core.kernels.planes`), and the messages
are repeated along it with a narrower kernel, starting again from the evidence, three times. The
planes are found as if nearly every pixel had a surface; with the shares of the levels as they are,
messages pass along the same planes.

If pairs of neighbours agree no more than pairs at random, each pixel is estimated by itself, by the
likelihood with the depths of the image as their prior. If empty pixels are allowed, the probability
of a surface is then that of the pixel by itself, too.

Bins much shorter than an echo are merged first. Confidence is the mass of this posterior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.estimators.base import PIXELS, Estimator, Evidence, Pixels
from core.estimators.image_model import (
    FEWEST_PIXELS,
    Prior,
    image_model_of,
    laplace,
    merged_bins,
    merged_flux,
    states_of_image,
    states_of_pixels,
    with_any_level,
)
from core.estimators.likelihood import Depths, LikelihoodParameters, curve
from core.estimators.likelihood import locate as locate_alone
from core.inference.flux_model import Agreement, FluxModel
from core.inference.neighbours import box_sum
from core.inference.posterior import (
    States,
    mass_near,
    surface_probability,
    tolerance_probability,
)
from core.kernels.blocks import LANES
from core.kernels.messages import fill_modes, fill_posterior
from core.kernels.parallel import on_threads
from core.kernels.planes import fill_planes, fill_window_planes
from core.parameters import Number, Settings, parameter

_ROUNDS = 4
_LEAST_ODDS = 1e-12
_EMPTY_SHARE = 0.01  # of pixels without an echo, if every pixel is estimated
_UNLIKELY = 0.1  # probability of a surface below which its signal level is unknown
_FALSE_PIXELS = 0.5  # of an image, that may get a range whatever the share of empty ones
_ALONG_PLANES = 0.8, 0.2  # ρ and the scale of K in bins
_LEAST_WEIGHT = 1e-9  # of a window; 0 would have no share on a plane
_PASSES = 8  # over the bins of a pixel, for a message
_OPERATIONS = 25  # for a pixel of the window and each distance from the plane
_HALF = 5  # of the window to which a plane is fitted, without the pixel in its middle


@dataclass(frozen=True)
class ImageParameters(Settings):
    """Settings of the image posterior."""

    pixels: Pixels = parameter(
        "estimate every pixel",
        PIXELS,
        "Estimate every pixel: each gets its likeliest range, as if nearly all had a surface. "
        "Allow empty pixels: only those get a range in which a surface is likelier than none, and "
        "so likely that few empty pixels get one (see false surfaces). "
        "Confidence never assumes a surface.",
    )
    false_surface: float = parameter(
        0.01,
        Number("False surfaces", 1e-4, 0.1, log=True, least=0.0, open_below=True, most=1.0),
        "If empty pixels are allowed: largest share of them that may get a range. Most of those "
        "that do are next to a surface.",
    )


class Link(NamedTuple):
    """Relation of two neighbours, for `core.kernels.messages`."""

    kernel: NDArray[np.float32]
    """K, shape (tap,)."""
    share: np.float32
    """ρ."""
    per_prior: NDArray[np.float32]
    """1 / p(d), shape (bin,)."""
    per_nothing: np.float32
    """1 / p(nothing)."""

    @classmethod
    def of(cls, alike: float, scale_bins: float, prior: Prior) -> Link:
        """Return the relation for ρ, the scale of K and a prior."""
        return cls(
            laplace(scale_bins).astype(np.float32),
            np.float32(alike),
            (1 / prior.surface).astype(np.float32),
            np.float32(1 / prior.nothing),
        )


class ImagePosterior(NamedTuple):
    """Posterior of each pixel, given the whole image."""

    delay: Floats
    """Likeliest delay in bins, shape (row, col)."""
    by_bin: NDArray[np.float32]
    """Probability of a surface in each merged bin, shape (row, col, merged bin)."""
    factor: int
    """Bins in a merged one."""
    surface: Floats
    """Probability of a surface anywhere in the gate, shape (row, col)."""
    slopes: NDArray[np.float32]
    """Slopes along which messages passed, in merged bins: per row and per column, (2, row, col)."""


class _Filled(NamedTuple):
    """Surfaces of an image in which nearly every pixel has one, in merged bins."""

    delay: Floats
    """Shape (row, col)."""
    slopes: NDArray[np.float32]
    """As `ImagePosterior.slopes`."""


@cached_per_capture
def image_posterior_of(capture: Capture, flux: FluxModel) -> ImagePosterior:
    """Compute the posterior of an image with the flux model of `image_model_of`."""
    (merged, factor), slopes = merged_bins(capture), _filled(capture, flux).slopes
    posterior = _posterior(merged, merged_flux(flux, factor), slopes)
    delay, _ = peaks(posterior.surface)
    surface = 1.0 - posterior.nothing.astype(float)
    return ImagePosterior(delay * factor, posterior.surface, factor, surface, slopes)


@cached_per_capture
def likeliest_delays(capture: Capture, flux: FluxModel) -> Floats:
    """Find the likeliest delay of each pixel in bins if nearly all have a surface, (row, col).

    Where a surface of the levels of the image is unlikely, its level is unknown.
    """
    merged, factor = merged_bins(capture)
    found, slopes = _filled(capture, flux)
    is_faint = image_posterior_of(capture, flux).surface < _UNLIKELY
    if is_faint.any():
        flux = merged_flux(with_any_level(capture, flux, _EMPTY_SHARE), factor)
        delay, _ = peaks(_posterior(merged, flux, slopes).surface)
        found = np.where(is_faint, delay, found)
    return found * factor


@cached_per_capture
def _filled(capture: Capture, flux: FluxModel) -> _Filled:
    """Find the surfaces of an image as if nearly every pixel had one."""
    merged, factor = merged_bins(capture)
    surfaces = (1 - _EMPTY_SHARE) * flux.share[1:] / (flux.share[1:].sum() or 1.0)
    share = np.append(_EMPTY_SHARE, surfaces)
    posterior = _posterior(merged, merged_flux(replace(flux, share=share), factor))
    delay, weight = peaks(posterior.surface)
    return _Filled(delay, slopes_of(delay, weight))


def _posterior(
    capture: Capture, flux: FluxModel, slopes: NDArray[np.float32] | None = None
) -> States:
    """Compute the posterior of each pixel, given the whole image; see `solved`."""
    return solved(states_of_image(capture, flux), Prior.of(flux), flux.agreement, slopes)


def solved(
    alone: States, prior: Prior, agreement: Agreement, slopes: NDArray[np.float32] | None = None
) -> States:
    """Combine the evidence of each pixel with that of its neighbours.

    Parameters
    ----------
    alone : States
        Probabilities of the states of each pixel by itself, of shape (row, col, ...).
    prior : Prior
    agreement : Agreement
    slopes : ndarray, shape (2, row, col), optional
        Change of the delay from row to row and from column to column, if known; then messages pass
        along these planes only.
    """
    half, both, other = (States(*map(np.empty_like, alone)) for _ in range(3))
    links = Link.of(agreement.alike, agreement.scale_bins, prior), Link.of(*_ALONG_PLANES, prior)
    level = np.zeros((2, *alone.nothing.shape), np.float32)
    per_row, per_col = level if slopes is None else slopes
    for k in range(0 if slopes is None else _ROUNDS - 1, _ROUNDS):
        link = links[min(k, 1)]
        _pass_messages(alone, per_col, True, link, half)
        _pass_messages(half, per_row, False, link, both)
        _pass_messages(alone, per_row, False, link, half)
        _pass_messages(half, per_col, True, link, other)
        for one, another in zip(both, other, strict=True):
            np.multiply(np.add(one, another, out=one), np.float32(0.5), out=one)
        if k < _ROUNDS - 1:
            per_row, per_col = slopes_of(*peaks(both.surface))
    return both


def _pass_messages(
    evidence: States, slope: NDArray[np.float32], along_rows: bool, link: Link, posterior: States
) -> None:
    """Fill `posterior` with that given the other pixels of the row, or of the column."""
    n_lines = evidence.nothing.shape[0 if along_rows else 1]
    given = *evidence, slope, along_rows, link, *posterior
    work = 2 * _PASSES * evidence.surface.size  # forward and backward
    on_threads(fill_posterior, n_lines, work, *given)


def peaks(posterior: NDArray[np.float32]) -> tuple[Floats, Floats]:
    """Likeliest delay of each pixel in bins and the probability of the bins around it."""
    delay, weight = np.empty((2, *posterior.shape[:2]))
    given = posterior.reshape(-1, posterior.shape[2]), delay.ravel(), weight.ravel()
    on_threads(fill_modes, delay.size, posterior.size, *given)
    return delay, weight


def slopes_of(delay: Floats, weight: Floats) -> NDArray[np.float32]:
    """Find the slopes of each pixel from row to row and from column to column, (2, row, col)."""
    return np.ascontiguousarray(planes(delay, weight)[1:])


def planes(delay: Floats, weight: Floats) -> NDArray[np.float32]:
    """Find the plane of each pixel: delay, change per row and change per column (3, row, col)."""
    (rows, cols), size = delay.shape, 2 * _HALF + 1
    beyond, work = -cols % LANES, _OPERATIONS * delay.size * size**2

    def wide(image: Floats | NDArray[np.float32]) -> NDArray[np.float32]:
        inner, around = image[..., :cols].astype(np.float32), [(0, 0)] * (image.ndim - 2)
        return np.pad(inner, (*around, (_HALF, _HALF), (_HALF, _HALF + beyond)))

    seen, windows = wide(delay), np.empty((4, rows, cols + beyond), np.float32)
    on_threads(fill_window_planes, rows, work, seen, wide(weight), _HALF, windows)
    windows[0, :, :cols] /= np.maximum(box_sum(weight, size, "constant"), _LEAST_WEIGHT)
    plane = np.empty((3, rows, cols + beyond), np.float32)
    on_threads(fill_planes, rows, work, seen, wide(windows), _HALF, plane)
    return plane[..., :cols]


def _locate(
    capture: Capture, flux: FluxModel, parameters: ImageParameters
) -> tuple[Floats, Floats]:
    """Return the likeliest delay and the log odds of a surface.

    Where neighbours do not agree, the score is the log likelihood ratio of the pixel by itself.
    """
    allows_empty = parameters.pixels == "allow empty pixels"
    if not _neighbours_agree(flux):
        depths: Depths = "learned" if capture.counts.size >= FEWEST_PIXELS else "alike"
        delay, score = locate_alone(capture, flux, LikelihoodParameters(depths=depths))
        kept = seen = capture.counts > 0
        if allows_empty:
            kept = seen & _is_surface(surface_probability(capture), parameters.false_surface)
        return np.where(kept, delay, np.nan), np.where(seen, score, 0.0)
    found = image_posterior_of(capture, flux)
    surface = np.clip(found.surface, _LEAST_ODDS, 1 - _LEAST_ODDS)
    if allows_empty:
        delay = np.where(_is_surface(surface, parameters.false_surface), found.delay, np.nan)
    else:
        delay = likeliest_delays(capture, flux)
    return delay, np.log(surface / (1 - surface))


def _is_surface(surface: Floats, false_surface: float) -> NDArray[np.bool_]:
    """Return which pixels get a range if empty ones are allowed, by `least_probability`."""
    return np.asarray(surface >= least_probability(surface, false_surface))


def least_probability(surface: Floats, false_surface: float) -> float:
    """Return the probability of a surface, 0.5 at least, from which a pixel gets a range.

    Such that the expected share of the empty pixels that get one is at most `false_surface`, or
    half a pixel of the image: of an image that has hardly any empty pixel, few would get a range.
    """
    likeliest_first = np.sort(surface, axis=None)[::-1]
    false = np.cumsum(1 - likeliest_first)
    most = max(false_surface * false[-1], _FALSE_PIXELS)
    n_accepted = int(np.searchsorted(false, most, side="right"))
    return max(0.5, float(likeliest_first[max(n_accepted - 1, 0)]))


def probability_near(capture: Capture, flux: FluxModel, delay_bin: Floats) -> Floats:
    """Return the probability of a surface within `TOLERANCE_BINS` of delays (row, col).

    By the posterior of the image; by that of each pixel alone where neighbours do not agree.
    """
    if not _neighbours_agree(flux):
        return tolerance_probability(capture, delay_bin)
    found = image_posterior_of(capture, flux)
    return mass_near(found.by_bin, found.factor, delay_bin, capture.acquisition.n_bins)


def _evidence(capture: Capture, flux: FluxModel, row: int, col: int) -> Evidence | None:
    if not _neighbours_agree(flux):
        return None
    merged, factor = merged_bins(capture)
    own = merged_flux(flux, factor)
    prior, found = Prior.of(own), image_posterior_of(capture, flux)
    alone = _with_nothing(*states_of_pixels(merged, own, np.array([row * merged.shape[1] + col])))
    posterior = np.append(found.by_bin[row, col].astype(float), 1 - found.surface[row, col])
    message = posterior / np.maximum(alone, np.finfo(np.float32).tiny)  # 0 is an underflow
    neighbours = message * np.append(prior.surface, prior.nothing)
    by_bin = np.zeros((3, capture.acquisition.n_bins))
    for filled, states in zip(by_bin, (alone, neighbours, posterior), strict=True):
        each = np.repeat(states[:-1] / (factor * states.sum()), factor)
        filled[: each.size] = each
    return Evidence(*by_bin)


def _with_nothing(surface: NDArray[np.float32], nothing: NDArray[np.float32]) -> Floats:
    """Return the states of one pixel (1, ...) as one array, nothing last."""
    return np.append(surface[0], nothing[0]).astype(float)


def _omits(capture: Capture) -> str:
    if _neighbours_agree(image_model_of(capture)):
        return ""
    return "neighbours agree no more than pixels at random: each pixel is estimated by itself"


def _neighbours_agree(flux: FluxModel) -> bool:
    return flux.agreement.alike > 0


ESTIMATOR = Estimator(
    "Image posterior",
    ImageParameters,
    curve,
    _locate,
    finds_delay=True,
    flux_model=image_model_of,
    omits=_omits,
    own_threshold="neighbours raise it next to a surface; choose 'allow empty pixels' instead",
    undoes_pile_up=True,
    whole_image=True,
    fills=True,
    confidence=lambda capture, flux, delay_bin, _: probability_near(capture, flux, delay_bin),
    evidence=_evidence,
)
