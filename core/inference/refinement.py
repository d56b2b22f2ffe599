"""Refinement of delays below a bin, by the likelihood in their neighbourhood."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from core.acquisition import Floats, Pulse
from core.capture import Capture
from core.inference.flux_model import FluxModel
from core.inference.posterior import same_echo_bins
from core.kernels.blocks import LANES
from core.kernels.parallel import on_threads
from core.kernels.refinement import refine_delays

STEPS_PER_BIN = 4
FINE_STEPS_PER_BIN = 8
SHARP_BINS = 0.15
"""Standard deviation of a delay below which the error of a parabola between steps matters."""

FEWEST = 1 / 3
"""Variance of the delay of a gamma pulse from one photon in bins, over that of the pulse, about."""


def refined(capture: Capture, flux: FluxModel, delay_bin: Floats) -> Floats:
    """Move delays to the largest likelihood of the same echo.

    The likelihood ``T(d)`` of `core.inference.likelihood` with the typical fluxes of each pixel is
    computed at four delays in each bin, those less than `same_echo_bins` away; a parabola refines
    between them. From an end of this window the search goes on as long as the likelihood
    increases, since an estimator may find only the flank of an echo. Bright echoes are then
    `sharpened`.

    Parameters
    ----------
    capture : Capture
    flux : FluxModel
    delay_bin : ndarray, shape (row, col)
        In fractional bins; NaN remains.

    Returns
    -------
    ndarray, shape (row, col)
    """
    signal, reach = flux.typical_signal, same_echo_bins(capture)
    delay, _ = _moved(capture, flux, signal, delay_bin, STEPS_PER_BIN, reach)
    return sharpened(capture, flux, delay)


def sharpened(capture: Capture, flux: FluxModel, delay_bin: Floats) -> Floats:
    """Search again in finer steps, and with a signal of their own, near delays of bright echoes.

    A parabola through the logarithm of the likelihood in steps of half a bin errs by up to a tenth
    of a bin, however many photons there are. Delays known to less than `SHARP_BINS` move to the
    largest likelihood, if that is less than half a bin away. Parameters and result as `refined`.
    """
    fitted = np.full(delay_bin.shape, np.nan)
    fine, spread_bin = _moved(capture, flux, fitted, delay_bin, FINE_STEPS_PER_BIN, 1)
    is_near = (spread_bin < SHARP_BINS) & (np.abs(fine - delay_bin) < 0.5)
    return np.where(is_near, fine, delay_bin)


def _moved(
    capture: Capture,
    flux: FluxModel,
    signal: Floats,
    delay_bin: Floats,
    steps_per_bin: int,
    reach: int,
) -> tuple[Floats, Floats]:
    """Move delays as `refined` in steps; also return their standard deviations in bins.

    Where a signal (row, col) is NaN, it is fitted, too, if the echo has so many photons that its
    delay may be known to `SHARP_BINS`. The deviations follow from the curvature of the likelihood,
    and are infinite at an end of the gate.
    """
    acquisition, n_pixels = capture.acquisition, delay_bin.size
    width_s = acquisition.bin_width_s
    echo, first = _samples_of(capture.pulse, acquisition.n_bins, width_s, steps_per_bin, reach)

    def in_blocks(image: Floats) -> Floats:
        filled = np.full(-(-n_pixels // LANES) * LANES, np.nan)
        filled[:n_pixels] = image.ravel()
        return filled.reshape(-1, LANES)

    # An echo is short: over it, the background is that at its delay.
    last = acquisition.n_bins - 1
    at = np.clip(np.nan_to_num(delay_bin), 0, last).astype(np.intp)
    background = flux.typical_background / acquisition.n_bins * flux.relative_background[at]
    counts, delay = capture.blocks.counts, in_blocks(delay_bin)
    curvature = np.zeros_like(delay)
    on_threads(
        refine_delays,
        len(counts),
        capture.cube.size,
        counts,
        capture.gated_pulses or 0,
        in_blocks(signal),
        in_blocks(background),
        echo,
        steps_per_bin,
        first,
        reach,
        FEWEST * (capture.pulse.sigma_s / width_s / SHARP_BINS) ** 2,
        delay,
        curvature,
    )
    with np.errstate(divide="ignore"):
        spread = 1 / (steps_per_bin * np.sqrt(np.abs(curvature)))
    delay, spread = (x.ravel()[:n_pixels].reshape(delay_bin.shape) for x in (delay, spread))
    return delay, spread


@lru_cache(maxsize=64)
def _samples_of(
    pulse: Pulse, n_bins: int, bin_width_s: float, steps_per_bin: int, reach: int
) -> tuple[Floats, int]:
    """Return the samples of an echo for `refine_delays`, and its first tap.

    In the order in which a bin meets them while the delay grows. They must not be changed.
    """
    within = (np.arange(steps_per_bin) + 0.5) / steps_per_bin
    taps, first = pulse.taps(n_bins, bin_width_s, within)
    return np.pad(taps[:, ::-1].T.ravel(), 2 * reach * steps_per_bin), first
