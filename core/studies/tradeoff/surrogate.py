"""Simulated scenes, and surrogates: simulations fitted to a capture that has no truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture, Detection
from core.estimators import estimate
from core.inference.flux import flux_model_of
from core.inference.likelihood import rate_and_n_armed
from core.inference.neighbours import patches
from core.inference.posterior import posterior_of
from core.scene import Scene
from core.simulation import simulate
from core.trigger import rate_per_bin

MARGIN_BINS = 5

_AT_ONCE = 2**20  # counts whose rates are held in memory

MIN_CONFIDENCE = 0.5
"""Confidence from which a surrogate takes an estimate for the truth."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """A scene and its flux, to be captured with any seed.

    Parameters
    ----------
    name : str
        Shown in tables and plots.
    scene : Scene
    acquisition : Acquisition
        If the number of pulses is unknown, or `detection` is ``"all"``, counts are Poisson and the
        flux is that of all pulses together.
    flux : Flux
    pulse : Pulse
    detection : str
        As `Capture.detection`.
    note : str
        A remark on its captures.
    """

    name: str
    scene: Scene
    acquisition: Acquisition
    flux: Flux
    pulse: Pulse = Pulse()
    detection: Detection = "first"
    note: str = ""

    @property
    def holds_first_photons(self) -> bool:
        """Whether captures hold the first photons of a known number of pulses."""
        return self.detection == "first" and self.acquisition.n_pulses is not None

    def capture(self, seed: int) -> Capture:
        """Simulate one capture, with its truth."""
        if self.holds_first_photons:
            given = self.scene, self.acquisition, self.flux, self.pulse, seed
            n_groups = self.scene.groups_of(self.acquisition.n_pulses)
            return simulate(*given, n_groups=n_groups)
        truth_m = np.asarray(self.scene.range_m, float)
        reflectivity = 1.0 if self.scene.reflectivity is None else self.scene.reflectivity
        rate = rate_per_bin(
            self.acquisition.range_m_to_bin(truth_m),
            np.broadcast_to(self.flux.signal * reflectivity, truth_m.shape),
            self.flux.background,
            self.pulse,
            self.acquisition,
        )
        return Capture(
            np.random.default_rng(seed).poisson(rate).astype(np.uint32),
            self.acquisition,
            self.pulse,
            truth_range_m=truth_m,
            source=f"simulated, seed {seed}",
            detection=self.detection,
        )

    @property
    def window(self) -> tuple[int, int]:
        """First bin and end of the shortest window that holds the targets' echoes."""
        return window(self.scene.range_m, self.pulse, self.acquisition)

    def with_pulses(self, n_pulses: int) -> Simulation:
        """Return the same simulation with another number of pulses."""
        return replace(self, acquisition=replace(self.acquisition, n_pulses=n_pulses))


def window(range_m: Floats, pulse: Pulse, acquisition: Acquisition) -> tuple[int, int]:
    """Return first bin and end of the shortest window with the echoes, plus `MARGIN_BINS`.

    Parameters
    ----------
    range_m : ndarray, shape (row, col)
        NaN where there is no target; at least one.
    """
    onset = acquisition.range_m_to_bin(range_m)
    begin_s, end_s = pulse.quantile_s(0.01), pulse.quantile_s(0.99)
    first = math.floor(np.nanmin(onset) + begin_s / acquisition.bin_width_s) - MARGIN_BINS
    end = math.ceil(np.nanmax(onset) + end_s / acquisition.bin_width_s) + MARGIN_BINS
    return max(0, first), min(acquisition.n_bins, end)


def surrogate_of(capture: Capture, name: str) -> Simulation:
    """Return a simulation fitted to a capture.

    The range of each pixel is the likelihood's estimate where its confidence is at least
    `MIN_CONFIDENCE`, else that of the nearest such pixel; pixels that are more likely to see no
    surface than one have no target. Levels of signal and their shares are those of
    `core.inference.flux.flux_model_of`, the higher ones assigned to the pixels with more photons at
    their estimate; the background is its mean.

    Errors measured on it are those of a similar scene, not of this capture: it lacks what the model
    leaves out (a second surface, a background that is not uniform, another pulse), and where
    estimates were wrong it is rougher than the scene.

    Raises
    ------
    ValueError
        If no pixel has an estimate of that confidence.
    """
    flux, image = flux_model_of(capture), estimate(capture, "likelihood")
    target = posterior_of(capture).surface > 0.5
    clear = target & image.valid & (image.confidence >= MIN_CONFIDENCE)
    if not clear.any():
        raise ValueError(
            f"confidence = {image.confidence.max():.2f} at most is not accepted: give a capture in "
            f"which some pixels are ranged with {MIN_CONFIDENCE:g} or more."
        )
    nearest = scipy.ndimage.distance_transform_edt(
        ~clear, return_distances=False, return_indices=True
    )
    delay_bin = image.bin[tuple(nearest)]
    signal = np.zeros(capture.shape)
    signal[target] = _assigned(
        flux.signal[1:, 0, 0], flux.share[1:], _echo_rate(capture, delay_bin)[target]
    )
    mean = float(signal[target].mean())
    return Simulation(
        name,
        Scene(
            np.where(target, capture.acquisition.bin_to_range_m(delay_bin), np.nan), signal / mean
        ),
        capture.acquisition,
        Flux(mean, mean / float(flux.typical_background.mean())),
        capture.pulse,
        capture.detection,
        "the capture has no truth: errors are those of a simulated scene like it",
    )


like = surrogate_of  # deprecated name, to be removed after the next release


def _echo_rate(capture: Capture, delay_bin: Floats) -> Floats:
    """Return each pixel's rate over the bins of the middle of its echo, corrected for pile-up."""
    n_bins = capture.acquisition.n_bins
    ends = delay_bin[..., np.newaxis] + np.divide(
        capture.pulse.span_s, capture.acquisition.bin_width_s
    )
    first, last = np.moveaxis(np.clip(np.floor(ends), 0, n_bins - 1).astype(int), 2, 0)
    edges, echo = np.stack([first, last + 1], axis=2), np.empty(capture.shape)
    for patch in patches(capture.cube.shape, _AT_ONCE):
        rate, _ = rate_and_n_armed(capture.cube[patch].astype(float), capture.gated_pulses)
        until = np.pad(np.cumsum(rate, axis=2), ((0, 0), (0, 0), (1, 0)))
        echo[patch] = np.diff(np.take_along_axis(until, edges[patch], axis=2), axis=2)[..., 0]
    return echo


def _assigned(levels: Floats, share: Floats, rate: Floats) -> Floats:
    """Assign rising levels to their shares of the pixels (n,), the highest to the highest rates."""
    rank = (np.argsort(np.argsort(rate)) + 0.5) / rate.size
    until = np.cumsum(share) / share.sum()
    return np.asarray(levels[np.searchsorted(until[:-1], rank)])
