"""Extensions of the likelihood: neighbours, a second return, velocity.

The likelihood ranges each pixel by itself, with one surface at rest. With neighbours it is the
image posterior, with a velocity the likelihood with velocity; for a second return, the method is
asked for two of each pixel instead of one.

Where the truth is known, estimates with and without an extension are compared. A second return is
compared over all surfaces of the scene (`corrections.score`), others over the truth that the other
rows have, too. On captures without truth, the posterior with the extension judges both estimates:
its probability of being right with it, minus that without, is the expected change of the
restoration degree. Second returns are counted and compared with the false ones asked for.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np
from scipy.special import ndtri

from core.acquisition import Floats
from core.capture import Capture
from core.estimators import ESTIMATORS, estimate
from core.estimators.image_model import FEWEST_PIXELS, image_model_of
from core.estimators.image_posterior import image_posterior_of
from core.estimators.velocity import VelocityParameters, motion_of
from core.inference import faults
from core.inference.posterior import posterior_of, same_echo_bins
from core.inference.resolution import FEW
from core.inference.returns import FALSE_RETURN, fitted_echoes, least_gain
from core.metrics import Interval
from core.studies.ablation import corrections
from core.studies.ablation.criterion import UNKNOWN, Requirement, improved, tested, unknown
from core.studies.ablation.evidence import POWER, evidence_of_share
from core.studies.ablation.pooled import with_second_surfaces
from core.studies.middle import middle
from core.studies.statistics import MIN_REPEATS, mean_interval, median_interval
from core.studies.timing import time_ratio

EXTENDED = {"neighbours": "image_posterior", "velocity": "velocity"}
"""Methods that extend the likelihood."""

MARGIN_TRAVEL_BINS = 1.0
"""Smallest relevant displacement of a surface while the pulses are sent.

The car at SBR 0.04 loses 0.017 of its restoration degree if it moves by 2 bins, and a quarter of
that by one.
"""

_CERTAIN = 0.9  # confidence of a pixel that shows its surface by itself
_FEWEST_PAIRS = 20  # of such pixels, from which neighbours can be compared
_FEWEST_PIXELS = 32  # with an echo
_LIKELY = 0.5  # probability of a surface, of a pixel that has one

Ranging = Callable[[Capture], Floats]
"""Returns ranges in metres, shape (return, row, col)."""


def rangings(extension: str, method: str) -> tuple[Ranging, Ranging]:
    """Return the functions that range a capture with an extension, and without it."""
    if extension == "second_return":
        return partial(_returns_m, method=method, most=2), partial(
            _returns_m, method=method, most=1
        )
    return partial(_ranges_m, method=EXTENDED[extension]), partial(_ranges_m, method="likelihood")


def _ranges_m(capture: Capture, method: str) -> Floats:
    return corrections.ranges_m(capture, method)[np.newaxis]


def _returns_m(capture: Capture, method: str, most: int) -> Floats:
    image = estimate(capture, method, returns=most)
    found = image.returns
    if found is None:
        return image.range_m[np.newaxis]
    return np.stack([found.image("range_m", n, capture.shape) for n in range(1, most + 1)])


# -- Scenes ----------------------------------------------------------------------------------------


def judged_on_scene(
    extension: str, captures: Iterable[Capture], truth_m: Floats, method: str
) -> Requirement:
    """Judge an extension by captures of a scene, of which estimates are paired.

    Parameters
    ----------
    extension : str
        A key of `EXTENSIONS`.
    captures : iterable of Capture
    truth_m : ndarray, shape (surface, row, col)
    method : str
        Method whose second return is judged.
    """
    scores, seconds, bin_length_m, gate_m = [], [], math.nan, math.nan
    for capture in captures:
        bin_length_m, gate_m = capture.acquisition.bin_length_m, capture.acquisition.gate_length_m
        for ranging in rangings(extension, method):
            fresh = copy.copy(capture)  # without cached results
            started = perf_counter()
            range_m = ranging(fresh)
            seconds.append(perf_counter() - started)
            scores.append(corrections.score(range_m, truth_m, capture))
    paired, time_s = np.array(scores).reshape(-1, 2, 2), np.array(seconds).reshape(-1, 2)
    ratio = time_s[:, 0] / time_s[:, 1]
    return improved(
        extension,
        bin_length_m,
        *corrections.changes(paired[:, 0], paired[:, 1], gate_m),
        median_interval(ratio) if len(ratio) >= MIN_REPEATS else UNKNOWN,
    )


# -- Captures --------------------------------------------------------------------------------------


def rows(capture: Capture, method: str) -> list[Callable[[], Requirement]]:
    """Return one function per extension, which judges it on the middle of a capture."""
    part = middle(capture)
    where = "" if part is capture else "; in the middle {} x {} pixels".format(*part.shape)
    return [
        partial(_in_part, judge, part, method, where)
        for judge in (neighbours, second_return, velocity)
    ]


def _in_part(
    judge: Callable[[Capture, str], Requirement], part: Capture, method: str, where: str
) -> Requirement:
    found = judge(part, method)
    timed = found.verdict != "cannot tell"
    ratio = _time_ratio(found.part, part, method) if timed else UNKNOWN
    return replace(found, why=found.why + where, time_ratio=ratio)


def neighbours(capture: Capture, method: str = "likelihood") -> Requirement:
    """Judge whether neighbouring pixels show surfaces that single ones do not."""
    if min(capture.shape) < 2 or capture.counts.size < FEWEST_PIXELS:
        return unknown("neighbours", "the image has too few pixels")
    if capture.truth_range_m is not None:
        return _measured("neighbours", capture)
    flux = image_model_of(capture)
    if flux.agreement.alike:
        surface = image_posterior_of(capture, flux).surface
        why = f"neighbours agree more than pixels at random, by {flux.agreement.gain:.2g} a pair"
        return _expected("neighbours", capture, surface, f"{why} in log likelihood")
    why = "neighbours agree no more than pixels at random"
    sure = float(np.mean(estimate(capture, "likelihood").confidence >= _CERTAIN))
    if 2 * capture.counts.size * sure**2 < _FEWEST_PAIRS:
        return unknown("neighbours", f"{why}, but few pixels show their surface by themselves")
    return Requirement("neighbours", "not needed", why)


def second_return(capture: Capture, method: str) -> Requirement:
    """Judge whether more pixels have a second return than false ones are allowed."""
    part = "second_return"
    if capture.acquisition.n_bins < 2 * same_echo_bins(capture):
        return unknown(part, "the gate is too short for two echoes")
    has_echo = faults.ordinary_pixels(capture) & (posterior_of(capture).surface >= _LIKELY)
    n_pixels = int(np.count_nonzero(has_echo))
    if n_pixels < _FEWEST_PIXELS:
        return unknown(part, "too few pixels have an echo")
    returns = estimate(capture, method, returns=2).returns
    assert returns is not None
    found = int(np.count_nonzero(returns.count(capture.shape)[has_echo] > 1))
    echoes = fitted_echoes(capture, with_second_surfaces(capture).cube, 2, least_gain(capture))
    power = float(np.mean(echoes.number > 1)) if echoes.number.size else 0.0
    evidence = evidence_of_share(found, n_pixels, FALSE_RETURN, power)
    shown = "{} of the pixels have a second return, beyond false ones"
    return tested(part, evidence, FEW, shown, note=f"found in {found} of {n_pixels}")


def velocity(capture: Capture, method: str = "likelihood") -> Requirement:
    """Judge whether surfaces move so far that their echoes are spread."""
    if capture.groups is None:
        return unknown("velocity", "the capture keeps no order of pulses")
    if capture.truth_range_m is not None:
        return _measured("velocity", capture)
    parameters = VelocityParameters()
    motion = motion_of(capture, parameters)
    assert motion is not None
    if motion.surfaces is not None:
        moving = float(np.mean(motion.velocity.travel_bins != 0))
        surface = motion.surfaces.surface.sum(axis=2)
        return _expected("velocity", capture, surface, f"{moving:.0%} of the pixels move")
    # A velocity must outweigh the prior, which is the same for rest and for all others together.
    sigmas = math.sqrt(2 * math.log(2 * parameters.most_bins)) + float(ndtri(POWER))
    seen_bins = sigmas * float(np.median(motion.velocity.sd_bins))
    why = f"no surface moves; {seen_bins:.2g} bins while the pulses are sent would have been seen"
    if not seen_bins <= MARGIN_TRAVEL_BINS:
        return unknown("velocity", f"{why}, and {MARGIN_TRAVEL_BINS:g} matters")
    return Requirement("velocity", "not needed", why)


def _measured(extension: str, capture: Capture) -> Requirement:
    """Judge by the truth of a capture."""
    ranges_m = (ranging(capture) for ranging in rangings(extension, "likelihood"))
    changes = corrections.changes_over_rows(capture, *ranges_m)
    return improved(extension, capture.acquisition.bin_length_m, *changes)


def _expected(extension: str, capture: Capture, surface: Floats, note: str) -> Requirement:
    """Judge by the change of the restoration degree that a posterior lets expect.

    `surface` (row, col) is the probability of a surface.
    """
    estimator = ESTIMATORS[EXTENDED[extension]]
    assert estimator.confidence is not None
    settings, flux = estimator.parameters(), estimator.flux_model(capture)
    with_it, without = (
        estimator.confidence(capture, flux, corrections.delays(capture, each), settings)
        for each in (EXTENDED[extension], "likelihood")
    )
    targets_of_row = surface.mean() * capture.shape[1]
    change = mean_interval((with_it - without).sum(axis=1) / targets_of_row)
    note = f"{note}; the change of RD is that expected by the posterior"
    return improved(extension, capture.acquisition.bin_length_m, change, note=note)


def _time_ratio(extension: str, capture: Capture, method: str) -> Interval:
    """Return the ratio of the times to range the first rows of a capture."""
    n_rows = max(2, 2**18 // capture.cube[0].size)
    part = replace(
        capture,
        cube=capture.cube[:n_rows].copy(),
        **capture.images(lambda image: image[:n_rows]),
        groups=capture.groups and capture.groups.mapped(lambda cube: cube[:n_rows]),
    )

    def call(ranging: Ranging) -> Callable[[], Floats]:
        return lambda: ranging(copy.copy(part))  # a copy has no cached results

    with_it, without = map(call, rangings(extension, method))
    return time_ratio(with_it, without, MIN_REPEATS)
