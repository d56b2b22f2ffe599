"""Simulations that stand for a capture: where a capture has no truth, its likeness has one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt

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

_AT_ONCE = 2**20  # counts whose rates are held

SURE = 0.5
"""Least confidence of an answer that `like` takes for the truth."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """A scene under some light, to be captured with any seed.

    Parameters
    ----------
    name : str
        As shown to people.
    scene : Scene
    acquisition : Acquisition
        Where the number of pulses is not known, or `detection` is ``"all"``, counts are Poisson and
        the flux is that of all pulses.
    flux : Flux
    pulse : Pulse
    detection : str
        As `Capture.detection`.
    note : str
        What to know of captures that are simulated so.
    """

    name: str
    scene: Scene
    acquisition: Acquisition
    flux: Flux
    pulse: Pulse = Pulse()
    detection: Detection = "first"
    note: str = ""

    def capture(self, seed: int) -> Capture:
        """One capture, with its truth."""
        if self.detection == "first" and self.acquisition.n_pulses is not None:
            return simulate(self.scene, self.acquisition, self.flux, self.pulse, seed)
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
        """First bin and end of the shortest window of the gate that holds the targets' echoes."""
        return window(self.scene.range_m, self.pulse, self.acquisition)

    def with_pulses(self, n_pulses: int) -> Simulation:
        """The same with another number of pulses."""
        return replace(self, acquisition=replace(self.acquisition, n_pulses=n_pulses))


def window(range_m: Floats, pulse: Pulse, acquisition: Acquisition) -> tuple[int, int]:
    """First bin and end of the shortest window that holds the echoes, `MARGIN_BINS` to spare.

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


def like(capture: Capture, name: str) -> Simulation:
    """A simulation of what a capture seems to have seen.

    The range of each pixel is the likelihood's answer where its confidence is at least `SURE`, else
    that of the nearest such pixel; pixels that more likely than not see no surface have no target.
    The levels of signal and their shares are those of `core.inference.posterior.flux_model_of`, the
    stronger ones given to the pixels that show more photons at their answer; the background is its
    mean.

    Errors measured on it are those of a scene like this one, not those of this capture: what the
    model leaves out (a second surface, a background that is not uniform, another pulse) is not in
    it, and where the answers were wrong it is rougher than the scene.

    Raises
    ------
    ValueError
        If no pixel is ranged with that confidence.
    """
    light, image = flux_model_of(capture), estimate(capture, "likelihood")
    target = posterior_of(capture).surface > SURE
    sure = target & image.valid & (image.confidence >= SURE)
    if not sure.any():
        most = float(image.confidence.max())
        raise ValueError(
            f"confidence = {most:.2f} at most is not accepted: give a capture of which some pixels "
            f"are ranged with {SURE:g} or more, since its likeness needs their ranges."
        )
    nearest = distance_transform_edt(~sure, return_distances=False, return_indices=True)
    delay_bin = image.bin[tuple(nearest)]
    signal = np.zeros(capture.shape)
    signal[target] = _shared_out(
        light.signal[1:, 0, 0], light.share[1:], _echo(capture, delay_bin)[target]
    )
    mean = float(signal[target].mean())
    return Simulation(
        name,
        Scene(
            np.where(target, capture.acquisition.bin_to_range_m(delay_bin), np.nan),
            signal / mean,
        ),
        capture.acquisition,
        Flux(mean, mean / float(light.typical_background.mean())),
        capture.pulse,
        capture.detection,
        "the capture has no truth: errors are those of a simulated scene like it",
    )


def _echo(capture: Capture, delay_bin: Floats) -> Floats:
    """Rate of each pixel over the bins that hold the middle of an echo, pile-up undone."""
    n_bins = capture.acquisition.n_bins
    ends = delay_bin[..., np.newaxis] + np.divide(
        capture.pulse.span_s, capture.acquisition.bin_width_s
    )
    first, last = np.moveaxis(np.clip(np.floor(ends), 0, n_bins - 1).astype(int), 2, 0)
    edges, echo = np.stack([first, last + 1], axis=2), np.empty(capture.shape)
    for here in patches(capture.cube.shape, _AT_ONCE):
        rate, _ = rate_and_n_armed(capture.cube[here].astype(float), capture.gated_pulses)
        until = np.pad(np.cumsum(rate, axis=2), ((0, 0), (0, 0), (1, 0)))
        echo[here] = np.diff(np.take_along_axis(until, edges[here], axis=2), axis=2)[..., 0]
    return echo


def _shared_out(levels: Floats, share: Floats, seen: Floats) -> Floats:
    """Levels in rising order, each given to its share of the pixels (n,), most to who saw most."""
    rank = (np.argsort(np.argsort(seen)) + 0.5) / seen.size
    until = np.cumsum(share) / share.sum()
    return np.asarray(levels[np.searchsorted(until[:-1], rank)])
