"""Reductions of a capture: merged bins, a shorter gate, fewer pixels or fewer pulses.

Reduced captures take less time to estimate and hold less information. Each reduction returns a
`Capture` with the acquisition of the reduced data, so that every estimator accepts it. All raise
``ValueError`` if an argument does not fit the capture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats
from core.capture import Capture, Detection
from core.checks import require, require_whole
from core.kernels.parallel import COMPILED, on_threads
from core.kernels.streams import pixel_key, uniform_at
from core.pulse_groups import PulseGroups
from core.trigger import count_dtype

__all__ = [
    "Reduction",
    "coarser",
    "cut_gate",
    "first_pulses",
    "merge_bins",
    "pool_pixels",
    "share_of_pulses",
    "skip_pixels",
]

DRAWN_ONE_BY_ONE = 2**27
"""Most detections that are drawn one by one; for more, drawing bin by bin is faster."""

MOST_PULSES = 10**9 - 1
"""Most pulses of a capture that is drawn bin by bin, the limit of numpy's hypergeometric."""


def merge_bins(capture: Capture, factor: int) -> Capture:
    """Add the counts of each `factor` neighbouring bins, from 1 to the number of bins.

    Exact for first photons: a pulse fires in the merged bin if it fires in one of its parts.
    Remaining bins at the end of the gate are dropped; they hide no others.
    """
    before = capture.acquisition
    require_whole("factor", factor, before.n_bins)
    n_bins = before.n_bins // factor
    end = n_bins * factor

    def merged(cube: NDArray[np.unsignedinteger]) -> NDArray[np.unsignedinteger]:
        return _sum([cube[:, :, i:end:factor] for i in range(factor)])

    return replace(
        capture,
        cube=merged(capture.cube),
        acquisition=replace(before, n_bins=n_bins, bin_width_s=before.bin_width_s * factor),
        background=_share(capture.background, end / before.n_bins),
        source=f"{capture.source}; {factor} bins merged",
        flux_prior=None,
        groups=capture.groups and capture.groups.mapped(merged),
    )


def cut_gate(capture: Capture, first_bin: int, end_bin: int) -> Capture:
    """Keep the bins from `first_bin` to before `end_bin`.

    In first-photon data, pulses that fired before the window are not armed in it: the window of a
    pixel is an exact capture of ``A`` pulses, those armed at its opening, which differ from pixel
    to pixel. A `Capture` has one number of pulses, here the rounded mean of ``A`` over the image,
    or the most detections of a pixel if these are more. The mean expected counts are then those of
    a gate that opens later; the rates of a single pixel are off in all bins by the factor between
    its ``A`` and the mean (2 % if 700 of 1000 pulses are left). With ``first_bin=0``, and for all
    photons, the window is exact.

    The truth stays: targets whose echoes fall outside the window are lost.
    """
    before = capture.acquisition
    window = (first_bin, end_bin)
    whole = all(isinstance(each, Integral) for each in window)
    within = whole and 0 <= first_bin < end_bin <= before.n_bins
    require("first_bin, end_bin", window, within, f"two integers in order, 0 to {before.n_bins}")
    cube = np.ascontiguousarray(capture.cube[:, :, first_bin:end_bin])
    n_pulses, source = before.n_pulses, f"{capture.source}; bins {first_bin} to {end_bin - 1}"
    if capture.gated_pulses is not None and first_bin > 0:
        fired = capture.cube[:, :, :first_bin].sum(axis=2, dtype=np.int64)
        most = int(cube.sum(axis=2, dtype=np.int64).max())
        n_pulses = max(round(capture.gated_pulses - float(fired.mean())), most, 1)
        source += f", at whose opening {n_pulses} pulses are armed on average"
    groups = capture.groups and capture.groups.mapped(lambda cube: cube[:, :, first_bin:end_bin])
    return replace(
        capture,
        cube=cube,
        acquisition=replace(
            before,
            n_bins=end_bin - first_bin,
            gate_delay_s=before.gate_delay_s + first_bin * before.bin_width_s,
            n_pulses=n_pulses,
        ),
        background=_share(capture.background, (end_bin - first_bin) / before.n_bins),
        source=source,
        flux_prior=None,
        stated_flux=None,
        groups=groups and groups.resized(n_pulses or 0),
    )


def skip_pixels(capture: Capture, step: int) -> Capture:
    """Keep the middle pixel of each `step` x `step` (left and above the middle for even `step`).

    `step` is from 1 to the smaller side of the image.
    """
    require_whole("step", step, min(capture.shape))
    kept = np.ix_(*(_kept(size, step) for size in capture.shape))
    return replace(
        capture,
        cube=capture.cube[kept],
        acquisition=coarser(capture.acquisition, step),
        **capture.images(lambda image: image[kept]),
        source=f"{capture.source}; 1 pixel of each {step} x {step}",
        flux_prior=None,
        groups=capture.groups and capture.groups.mapped(lambda cube: cube[kept]),
    )


def pool_pixels(capture: Capture, side: int) -> Capture:
    """Add the histograms of each `side` x `side` neighbouring pixels.

    The sum is that of one pixel with as many times the pulses: exact if the pixels see the same,
    otherwise it holds several surfaces. Its truth and its reported range are the medians of theirs,
    its signal their mean. Remaining rows and columns are dropped. `side` is from 1 to the smaller
    side of the image.
    """
    require_whole("side", side, min(capture.shape))
    acquisition, n_pulses = coarser(capture.acquisition, side), capture.acquisition.n_pulses
    images = capture.images(lambda image: _median(_each_of_tile(image, side)))
    if capture.signal is not None:
        images["signal"] = np.mean(_each_of_tile(capture.signal, side), axis=0)
    n_pulses = n_pulses and n_pulses * side * side
    groups = capture.groups and capture.groups.mapped(lambda cube: _sum(_each_of_tile(cube, side)))
    return replace(
        capture,
        cube=_sum(_each_of_tile(capture.cube, side)),
        acquisition=replace(acquisition, n_pulses=n_pulses),
        **images,
        source=f"{capture.source}; {side} x {side} pixels added",
        flux_prior=None,
        stated_flux=None,
        groups=groups and groups.resized(n_pulses or 0),
    )


def first_pulses(capture: Capture, n_pulses: int, seed: int = 0) -> Capture:
    """Draw the capture that fewer pulses would have given, exactly.

    A histogram does not keep which pulse fired when, but pulses are exchangeable, so that any of
    them can stand for the first. For first photons, `n_pulses` of a pixel's pulses are drawn
    without replacement (multivariate hypergeometric, with "no trigger" as an outcome). For all
    photons, each photon is kept with probability ``n_pulses / sent``.

    With the same seed, the detections of fewer pulses are a subset of those of more, unless there
    are more than `DRAWN_ONE_BY_ONE`. The number of pulses must be known, and at most `MOST_PULSES`
    in that case.

    Where the capture keeps `Capture.groups`, each gives its share of the pulses, so that the
    recording lasts as long as before.
    """
    sent = capture.acquisition.n_pulses
    if sent is None:
        raise ValueError("n_pulses = None is not accepted: give a capture that knows its pulses.")
    require_whole("n_pulses", n_pulses, sent)
    groups = capture.groups and _fewer_of_each(capture.groups, n_pulses, capture.detection, seed)
    if groups is not None:
        cube: NDArray[np.unsignedinteger] = groups.total.astype(capture.cube.dtype)
    else:
        cube = _fewer(capture.cube, sent, n_pulses, capture.detection, seed)
    return replace(
        capture,
        cube=cube,
        acquisition=replace(capture.acquisition, n_pulses=n_pulses),
        source=f"{capture.source}; {n_pulses} of {sent} pulses, seed {seed}",
        flux_prior=None,
        stated_flux=None,
        groups=groups,
    )


def share_of_pulses(capture: Capture, share: float, seed: int = 0) -> Capture:
    """Draw the capture that a share of its pulses, above 0 and at most 1, would have given.

    If the number of pulses is known, this is `first_pulses` with the nearest number, at least one.
    Otherwise each detection is kept with probability `share`, as if each pulse were: the number of
    pulses then varies between pixels, and true fluxes, if known, are multiplied by `share`.
    """
    require("share", share, 0 < share <= 1, "above 0 and at most 1")
    sent = capture.acquisition.n_pulses
    if sent is not None:
        return first_pulses(capture, max(1, round(share * sent)), seed)
    return replace(
        capture,
        cube=_thinned(capture.cube, share, seed),
        signal=None if capture.signal is None else capture.signal * share,
        background=_share(capture.background, share),
        source=f"{capture.source}; {share:.3g} of the pulses, seed {seed}",
        flux_prior=None,
        stated_flux=None,
    )


def _fewer_of_each(
    groups: PulseGroups, n_pulses: int, detection: Detection, seed: int
) -> PulseGroups:
    """Draw `n_pulses` of the pulses of all groups, from each its share."""
    fewer = groups.resized(n_pulses)
    cubes = [
        _fewer(cube, sent, kept, detection, seed + group)
        for group, (cube, sent, kept) in enumerate(
            zip(groups.counts, groups.n_pulses, fewer.n_pulses, strict=True)
        )
    ]
    return replace(fewer, counts=np.stack(cubes))


def _fewer(
    cube: NDArray[np.unsignedinteger], sent: int, n_pulses: int, detection: Detection, seed: int
) -> NDArray[np.unsignedinteger]:
    """Draw `n_pulses` of the pulses of a cube."""
    if detection == "all":
        return _thinned(cube, n_pulses / sent, seed)
    return _of_pulses(cube, sent, n_pulses, seed)


def _of_pulses(
    fired_in: NDArray[np.unsignedinteger], sent: int, n_pulses: int, seed: int
) -> NDArray[np.unsignedinteger]:
    """First photons of `n_pulses` of the pulses."""
    cube = np.empty(fired_in.shape, fired_in.dtype)
    if _are_few(fired_in):
        given = fired_in, sent, n_pulses, np.uint64(seed), cube
        on_threads(_draw_pulses, len(cube), cube.size, *given)
        return cube
    require("n_pulses of the capture", sent, sent <= MOST_PULSES, f"{MOST_PULSES} or fewer")
    rng = np.random.default_rng(seed)
    rest = np.full(cube.shape[:2], sent)  # pulses not decided yet
    left = np.full(cube.shape[:2], n_pulses)  # still to be drawn among them
    for k in range(cube.shape[2]):
        fired = fired_in[:, :, k].astype(np.int64)
        rest -= fired
        found = rng.hypergeometric(fired, rest, left)
        cube[:, :, k] = found
        left -= found
    return cube


def _thinned(
    cube: NDArray[np.unsignedinteger], share: float, seed: int
) -> NDArray[np.unsignedinteger]:
    """Keep each detection with probability `share`."""
    if not _are_few(cube):
        return np.random.default_rng(seed).binomial(cube, share).astype(cube.dtype)
    kept = np.empty(cube.shape, cube.dtype)
    on_threads(_keep_by_chance, len(cube), cube.size, cube, share, np.uint64(seed), kept)
    return kept


def _are_few(cube: NDArray[np.unsignedinteger]) -> bool:
    return int(cube.sum(dtype=np.int64)) <= DRAWN_ONE_BY_ONE


_BATCH = 64  # random numbers in a loop of their own, which vectorises


@njit(**COMPILED)
def _draw_pulses(first, end, fired, sent, n_pulses, seed, drawn):  # type: ignore[no-untyped-def]
    """Selection sampling of a pixel's detections, one by one (Fan, Muller & Rezucha 1962).

    A detection is drawn with probability ``left / (sent - draw)``. With the same random numbers a
    larger `n_pulses` never has fewer of them left, and so draws a superset.
    """
    _, cols, n_bins = fired.shape
    for row in range(first, end):
        uniform = np.empty(_BATCH)
        for col in range(cols):
            key, draw, left = pixel_key(seed, row * cols + col), 0, float(n_pulses)
            for k in range(n_bins):
                before = left
                for _ in range(fired[row, col, k]):
                    if draw % _BATCH == 0:
                        for i in range(_BATCH):
                            uniform[i] = uniform_at(key, draw + i) * (sent - draw - i)
                    left -= 1.0 if uniform[draw % _BATCH] < left else 0.0
                    draw += 1
                drawn[row, col, k] = before - left


@njit(**COMPILED)
def _keep_by_chance(first, end, photons, share, seed, kept):  # type: ignore[no-untyped-def]
    _, cols, n_bins = photons.shape
    for row in range(first, end):
        for col in range(cols):
            key, draw = pixel_key(seed, row * cols + col), 0
            for k in range(n_bins):
                count = 0
                for i in range(photons[row, col, k]):
                    count += uniform_at(key, draw + i) < share
                draw += photons[row, col, k]
                kept[row, col, k] = count


@dataclass(frozen=True)
class Reduction:
    """A combination of reductions, with the mapping back to the pixels of the capture.

    Parameters
    ----------
    merge : int
        Bins merged into one.
    gate : tuple of int, optional
        First bin and end of the window, in bins of the capture.
    skip : int
        One pixel of each ``skip`` x ``skip`` is kept.
    pool : int
        Rows and columns of pixels that are added.
    pulses : float
        Share of the pulses that is kept, above 0 and at most 1.
    """

    merge: int = 1
    gate: tuple[int, int] | None = None
    skip: int = 1
    pool: int = 1
    pulses: float = 1.0

    def fits(self, shape: tuple[int, int, int]) -> bool:
        """Return whether a capture of `shape` (rows, columns, bins) is large enough."""
        side, n_bins = min(shape[:2]), shape[2]
        first, end = self.gate or (0, n_bins)
        enough_pixels = self.skip <= side and self.pool <= len(_kept(side, self.skip))
        return enough_pixels and 0 <= first < end <= n_bins and self.merge <= end - first

    def shape(self, shape: tuple[int, int, int]) -> tuple[int, int, int]:
        """Return rows, columns and bins of a reduced capture; `shape` must fit."""
        rows, cols = (len(_kept(size, self.skip)) // self.pool for size in shape[:2])
        first, end = self.gate or (0, shape[2])
        return rows, cols, (end - first) // self.merge

    def of(self, capture: Capture) -> Capture:
        """Reduce a capture: skipped pixels first, then pulses, pooled pixels, gate and bins.

        Raises
        ------
        ValueError
            If a reduction does not fit the capture.
        """
        if self.skip != 1:
            capture = skip_pixels(capture, self.skip)
        if self.pulses != 1:
            capture = share_of_pulses(capture, self.pulses)
        if self.pool != 1:
            capture = pool_pixels(capture, self.pool)
        if self.gate is not None:
            capture = cut_gate(capture, *self.gate)
        return merge_bins(capture, self.merge) if self.merge != 1 else capture

    def spread(self, image: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
        """Expand an image of the reduced capture to full resolution, with the nearest pixels.

        Parameters
        ----------
        image : ndarray, shape (row, col) of the reduced capture
        shape : tuple of int
            Rows and columns of the unreduced capture.
        """
        rows = self._source_of(shape[0], image.shape[0])
        cols = self._source_of(shape[1], image.shape[1])
        return image[np.ix_(rows, cols)]

    def _source_of(self, full: int, own: int) -> NDArray[np.intp]:
        """Row (or column) of the reduced image for each one of the full image."""
        after_skipping = np.minimum(np.arange(full) // self.skip, len(_kept(full, self.skip)) - 1)
        return np.asarray(np.minimum(after_skipping // self.pool, own - 1))

    def __str__(self) -> str:
        done = []
        if self.pulses != 1:
            done.append(f"{self.pulses:.3g} of the pulses")
        if self.skip != 1:
            done.append(f"1 pixel of {self.skip} x {self.skip}")
        if self.pool != 1:
            done.append(f"{self.pool} x {self.pool} pixels added")
        if self.gate is not None:
            done.append(f"bins {self.gate[0]} to {self.gate[1] - 1}")
        if self.merge != 1:
            done.append(f"{self.merge} bins merged")
        return ", ".join(done) or "whole"


def _kept(size: int, step: int) -> range:
    """Rows (or columns) that remain if the middle one of each `step` is kept."""
    return range((step - 1) // 2, size, step)


def _share(background: float | None, share: float) -> float | None:
    return None if background is None else background * share


def _sum(cubes: Sequence[NDArray[np.unsignedinteger]]) -> NDArray[np.unsignedinteger]:
    """Add cubes, in a type that holds the sum.

    In a loop: numpy's sum over a short axis takes ten times as long.
    """
    most = sum(int(cube.max(initial=0)) for cube in cubes)
    require("counts", most, most < 2**32, "a capture whose sums are below 2**32")
    total: NDArray[Any] = cubes[0].astype(count_dtype(most))
    for cube in cubes[1:]:
        total += cube.astype(total.dtype, copy=False)
    return total


def coarser(acquisition: Acquisition, step: int) -> Acquisition:
    """Return an acquisition with pixels `step` times as far apart."""
    angle_rad = acquisition.pixel_angle_rad
    wider_rad = None if angle_rad is None or angle_rad * step >= 1 else angle_rad * step
    return replace(acquisition, pixel_angle_rad=wider_rad)


def _each_of_tile(image: NDArray[Any], side: int) -> list[NDArray[Any]]:
    """The first pixel of each `side` x `side` tile, the second, ..., each (row, col, ...)."""
    rows, cols = (size - size % side for size in image.shape[:2])
    return [image[i:rows:side, j:cols:side] for i in range(side) for j in range(side)]


def _median(images: Sequence[Floats]) -> Floats:
    """Median of the finite values, pixel by pixel; NaN without any."""
    ordered = np.sort(images, axis=0)  # NaN last
    known = np.isfinite(ordered).sum(axis=0, keepdims=True)
    middle = np.concatenate([np.maximum(known - 1, 0) // 2, known // 2])
    return np.asarray(np.take_along_axis(ordered, middle, axis=0).mean(axis=0))
