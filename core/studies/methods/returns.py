"""Several surfaces in a pixel: how many are found, and how often a second one is false."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.effects import SecondSurface
from core.estimators import estimate
from core.inference import FALSE_RETURN, Returns
from core.scene import PAPER_GATE, Scene, net, scenes
from core.simulation import simulate
from core.studies.outputs import Table
from core.studies.statistics import mean_over_seeds
from core.studies.trials import mapped
from core.trigger import draw_counts

SIGNAL = 0.1041
SBRS = (0.3, 0.1, 0.06)
SEPARATIONS_BINS = (2, 3, 6, 10)
SHARES = (0.5, 0.3, 0.15)
NET_SEPARATIONS_BINS = (3, 6, 25)
NET_SBR = 0.06

_FRONT_BINS = 20.0, 30.0
_TILE = 16  # rows and columns of each share and separation
_NEAR_BINS = 2.0
_PHOTONS = 20.0  # signal of a pixel that counts all photons


def tailed_pulse() -> Pulse:
    """Return a Gaussian of 2.8 bins at half maximum, a tenth of whose photons form a long tail."""
    time = np.arange(60)
    peak, decay = np.exp(-0.5 * ((time - 8) / 3) ** 2), np.exp(-time / 12) * (time > 8)
    samples = 0.9 * peak / peak.sum() + 0.1 * decay / decay.sum()
    return Pulse.measured(samples, 0.4e-9)


def _layered(sbr: float, seed: int) -> tuple[Capture, Floats, Floats]:
    """Simulate a tile of pixels of each share (row) and separation (column), and their delays."""
    shape = len(SHARES) * _TILE, len(SEPARATIONS_BINS) * _TILE
    near = np.random.default_rng(seed).uniform(*_FRONT_BINS, shape)
    far = near + np.repeat(SEPARATIONS_BINS, _TILE)
    share = np.repeat(SHARES, _TILE)[:, np.newaxis] * np.ones(shape)
    near_m, far_m = map(PAPER_GATE.bin_to_range_m, (near, far))
    scene = Scene(near_m, acquisition=PAPER_GATE, second_surface=SecondSurface(far_m, share))
    return simulate(scene, PAPER_GATE, Flux(SIGNAL, sbr), seed=seed), near, far


def _both(returns: Returns, delays: Sequence[Floats]) -> Floats:
    """Return which pixels (row, col) have two returns, each within 2 bins of its surface."""
    shape = delays[0].shape
    right = returns.count(shape) == len(delays)
    for number, delay in enumerate(delays, 1):
        right &= np.abs(returns.image("bin", number, shape) - delay) <= _NEAR_BINS
    return np.asarray(right, float)


def alone(piece: tuple[float, int]) -> Floats:
    """Return the share of pixels with both surfaces found, (share, separation)."""
    capture, near, far = _layered(*piece)
    returns = estimate(capture, "likelihood", returns=2).returns
    assert returns is not None
    tiles = _both(returns, (near, far)).reshape(len(SHARES), _TILE, len(SEPARATIONS_BINS), _TILE)
    return np.asarray(tiles.mean(axis=(1, 3)))


class OneSurface(NamedTuple):
    """A capture of pixels with one surface each."""

    scene: str
    kind: str
    """``"first photons"``, ``"all photons"`` or ``"first photons, tail"``."""
    sbr: float
    method: str


_KINDS = ("first photons", 0.1), ("first photons, tail", 0.1), ("all photons", 1.0)

ONE_SURFACE = (
    *(OneSurface(scene, *kind, "likelihood") for scene in ("car", "uniform") for kind in _KINDS),
    OneSurface("car", "first photons", 0.06, "image_posterior"),
    OneSurface("piecewise", "first photons", 0.03, "image_posterior"),
    OneSurface("wall", "first photons", 0.03, "image_posterior"),
)
"""Captures on which second returns are false."""


def _capture(asked: OneSurface, seed: int) -> Capture:
    scene = scenes[asked.scene](64)
    pulse = tailed_pulse() if "tail" in asked.kind else Pulse()
    capture = simulate(scene, scene.acquisition, Flux(SIGNAL, asked.sbr), pulse, seed)
    if asked.kind != "all photons":
        return capture
    acquisition: Acquisition = scene.acquisition
    delay = acquisition.range_m_to_bin(scene.range_m)
    rate = _PHOTONS * pulse.bin_probability(delay, acquisition.n_bins, acquisition.bin_width_s)
    rate += _PHOTONS / asked.sbr / acquisition.n_bins
    cube = draw_counts(rate, None, np.random.default_rng(seed))
    return replace(capture, cube=cube, detection="all", signal=None, background=None)


def false(piece: tuple[OneSurface, int]) -> float:
    """Return the share of the target pixels with more than one return."""
    asked, seed = piece
    capture = _capture(asked, seed)
    returns = estimate(capture, asked.method, returns=2).returns
    assert returns is not None
    targets = np.isfinite(np.asarray(capture.truth_range_m))
    return float((returns.count(capture.shape) > 1)[targets].mean())


def with_neighbours(piece: tuple[int, int]) -> tuple[float, float, float]:
    """Return share of pixels with both surfaces, F1 and rms in bins for a net before a wall."""
    separation, seed = piece
    scene = net(64, separation)
    capture = simulate(scene, scene.acquisition, Flux(SIGNAL, NET_SBR), seed=seed)
    assert scene.second_surface is not None
    near, far = map(scene.acquisition.range_m_to_bin, (scene.second_surface.range_m, scene.range_m))
    returns = estimate(capture, "image_posterior", returns=2).returns
    assert returns is not None
    at = returns.row, returns.col
    errors = np.stack([returns.bin - near[at], returns.bin - far[at]])
    error, nearest = np.abs(errors).min(axis=0), np.abs(errors).argmin(axis=0)
    right = error <= _NEAR_BINS
    # Of two returns near one surface, one counts.
    found = np.unique(np.stack([*at, nearest])[:, right], axis=1).shape[1]
    f1 = 2 * found / (len(returns) + 2 * near.size)
    rms = float(np.sqrt((error[right] ** 2).mean()))
    return float(_both(returns, (near, far)).mean()), f1, rms


def tables(seeds: Sequence[int], processes: int = 1) -> Iterator[Table]:
    """Yield the tables; intervals are those of the mean over the seeds (95 %)."""
    n = f"Mean of {len(seeds)} captures, with 95 % intervals."
    pieces = [(sbr, seed) for sbr in SBRS for seed in seeds]
    both = dict(mapped(alone, pieces, processes))
    yield Table(
        "returns_alone",
        "Share of pixels in which both surfaces are found within 2 bins, each pixel by itself",
        ("SBR", "share of the weaker", *(f"{each} bins apart" for each in SEPARATIONS_BINS)),
        tuple(
            (
                sbr,
                share,
                *(
                    mean_over_seeds(both, sbr, seeds, itemgetter((i, j)))
                    for j in range(len(SEPARATIONS_BINS))
                ),
            )
            for sbr in SBRS
            for i, share in enumerate(SHARES)
        ),
        f"{n} Signal {SIGNAL} per pulse in all, 1000 pulses, nearer surface in bins "
        f"{_FRONT_BINS[0]:g} to {_FRONT_BINS[1]:g} of 100: farther back, pile-up leaves fewer "
        f"pulses. A second return is accepted at a false rate of {FALSE_RETURN:g}.",
        formats={"SBR": "g", "share of the weaker": "g"},
    )
    wrong = dict(mapped(false, [(each, seed) for each in ONE_SURFACE for seed in seeds], processes))
    yield Table(
        "returns_false",
        "Share of pixels with one surface that get a second return",
        ("scene", "data", "SBR", "tested", "share"),
        tuple(
            (
                each.scene,
                each.kind,
                each.sbr,
                "with neighbours" if each.method == "image_posterior" else "by itself",
                mean_over_seeds(wrong, each, seeds, float),
            )
            for each in ONE_SURFACE
        ),
        f"{n} At most {FALSE_RETURN:g} is asked for. The tail holds a tenth of the photons.",
        formats={"SBR": "g"},
    )
    several = [(separation, seed) for separation in NET_SEPARATIONS_BINS for seed in seeds]
    found = dict(mapped(with_neighbours, several, processes))
    yield Table(
        "returns_net",
        f"A net before a wall, share 0.3, SBR {NET_SBR:g}, with neighbours",
        ("bins apart", "both found", "F1", "rms in bins"),
        tuple(
            (
                separation,
                *(
                    mean_over_seeds(found, separation, seeds, itemgetter(part), most)
                    for part, most in enumerate((1.0, 1.0, np.inf))
                ),
            )
            for separation in NET_SEPARATIONS_BINS
        ),
        f"{n} 64 x 64 pixels. A return is right within 2 bins of a surface that no other return of "
        "the pixel is credited with.",
    )
