"""Refinement of delays below a bin, by the likelihood in their neighbourhood."""

from __future__ import annotations

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.inference.flux_model import FluxModel
from core.inference.posterior import same_echo_bins
from core.kernels.blocks import LANES
from core.kernels.parallel import entering
from core.kernels.refinement import refine_delays

STEPS_PER_BIN = 4


def refined(capture: Capture, flux: FluxModel, delay_bin: Floats) -> Floats:
    """Move delays to the largest likelihood of the same echo.

    The likelihood ``T(d)`` of `core.inference.likelihood` with the typical fluxes of each pixel is
    computed at four delays in each bin, those less than `same_echo_bins` away; a parabola refines
    between them. From an end of this window the search goes on as long as the likelihood
    increases, since an estimator may find only the flank of an echo.

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
    acquisition, n_pixels = capture.acquisition, delay_bin.size
    reach = same_echo_bins(capture)
    within = (np.arange(STEPS_PER_BIN) + 0.5) / STEPS_PER_BIN
    taps, first = capture.pulse.taps(acquisition.n_bins, acquisition.bin_width_s, within)
    # In the order in which a bin meets it while the delay grows.
    echo = np.pad(taps[:, ::-1].T.ravel(), 2 * reach * STEPS_PER_BIN)

    def in_blocks(image: Floats) -> Floats:
        filled = np.full(-(-n_pixels // LANES) * LANES, np.nan)
        filled[:n_pixels] = image.ravel()
        return filled.reshape(-1, LANES)

    # An echo is short: over it, the background is that at its delay.
    last = acquisition.n_bins - 1
    at = np.clip(np.nan_to_num(delay_bin), 0, last).astype(np.intp)
    background = flux.typical_background / acquisition.n_bins * flux.relative_background[at]
    counts, delay = capture.blocks.counts, in_blocks(delay_bin)
    with entering(capture.cube.size):
        refine_delays(
            counts,
            capture.gated_pulses or 0,
            in_blocks(flux.typical_signal),
            in_blocks(background),
            echo,
            STEPS_PER_BIN,
            first,
            reach,
            delay,
        )
    return delay.ravel()[:n_pixels].reshape(delay_bin.shape)
