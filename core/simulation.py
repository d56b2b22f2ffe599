"""Simulation of captures: exact draws of what a first-photon detector records of a scene.

The first photon of a pulse arrives after time ``t`` with probability ``exp(-Λ(t))``, where ``Λ`` is
the expected number of photons before ``t``. So ``1 - exp(-Λ)`` at the bin edges is the cumulative
distribution of the trigger bin, and one uniform number per pulse, looked up in it, is an exact
draw: over the pulses of a pixel the multinomial of Eq. 1, "no trigger" included. The optional parts
of a scene (`core.effects`) change Λ or that distribution, and nothing else.

Each pixel has its own random stream, keyed by (seed, pixel). The cube is therefore the same for any
number of threads, and similar settings share their random numbers, so that a slider changes the
scene and not the noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import prod
from numbers import Integral
from typing import TypeVar

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse, pulses_sent
from core.capture import Capture
from core.checks import require, require_type
from core.kernels.parallel import on_threads
from core.kernels.simulate import SHAPE_CODES, add_echo_photons, fire_once
from core.pulse_groups import PulseGroups, group_sizes
from core.scene import Scene, further_parts_of
from core.trigger import EXPONENTIAL, add_triggers, count_dtype, draw_triggers, to_probability

_Flux = TypeVar("_Flux", float, Floats)


def simulate(
    scene: Scene,
    acquisition: Acquisition,
    flux: Flux,
    pulse: Pulse = Pulse(),
    seed: int = 0,
    name: str = "",
    n_groups: int | None = None,
) -> Capture:
    """Draw one first-photon histogram for each pixel of a scene.

    Parameters
    ----------
    scene : Scene
        Ranges and optional parts; a pixel without a target sees no echo.
    acquisition : Acquisition
        Gate, bins and pulses.
    flux : Flux
        Signal photons per pulse at reflectivity 1, and background.
    pulse : Pulse
        Shape of the echo; its time zero is the delay of the surface.
    seed : int
        The same seed gives the same capture, for any number of threads.
    name : str, optional
        Name of the scene, which the source of the capture states.
    n_groups : int, optional
        Keep the counts of so many successive groups of pulses, `Capture.groups`. The pulses of a
        moving scene are then drawn in order, each at the range that the scene has reached
        (`core.effects.Motion.shifts_bins`), otherwise from their mean. A scene at rest has the same
        counts with groups and without, for up to `core.trigger.PULSES_DRAWN_ONE_BY_ONE` pulses.

    Returns
    -------
    Capture
        With the true range and, if pixels see only one echo over uniform background, signal and
        background.

    Raises
    ------
    ValueError
        If an argument is of another type, the number of pulses is unknown or 2**32 or more, or the
        seed is not an integer from 0 to 2**63 - 1.
    """
    require_type("scene", scene, Scene, "a core.Scene, such as core.scenes['car'](64)")
    require_type("acquisition", acquisition, Acquisition, "a core.Acquisition")
    require_type("flux", flux, Flux, "a core.Flux, such as core.Flux(sbr=0.1)")
    require_type("pulse", pulse, Pulse, "a core.Pulse, such as core.Pulse(1e-9)")
    n_pulses = pulses_sent(acquisition)
    require("n_pulses", n_pulses, n_pulses < 2**32, "fewer than 2**32")
    _require_seed(seed)
    shape = np.shape(scene.range_m)
    groups = None
    if n_groups is not None:
        groups = _draw_groups(scene, acquisition, flux, pulse, seed, n_groups)
        cube = groups.total.astype(count_dtype(n_pulses))
    else:
        triggered = cumulative_trigger_probability(scene, acquisition, flux, pulse)
        cube = draw_triggers(triggered, n_pulses, seed)
    is_plain = not further_parts_of(scene)
    source = f"simulated, seed {seed}, SBR {flux.sbr:g}, PPP {flux.signal:g}"
    return Capture(
        cube.reshape(*shape, acquisition.n_bins),
        acquisition,
        pulse,
        truth_range_m=np.array(scene.range_m, float),
        signal=next(echoes(scene, flux))[1] if is_plain else None,
        background=flux.background if is_plain else None,
        source=f"{name}, {source}" if name else source,
        groups=groups,
    )


def _draw_groups(
    scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse, seed: int, n_groups: int
) -> PulseGroups:
    """Draw the pulses of a scene in order, and count them in groups."""
    n_pulses = pulses_sent(acquisition)
    sizes = group_sizes(n_pulses, n_groups)
    counts = np.zeros(
        (n_groups, np.size(scene.range_m), acquisition.n_bins),
        count_dtype(max(sizes)),
    )
    shifts_bins, ends = _shifts_bins(scene, acquisition, pulse), np.cumsum(sizes)
    if scene.motion is not None and scene.motion.speed_m_per_s < 0:
        shifts_bins = shifts_bins[::-1]
    shift_ends = np.cumsum(group_sizes(n_pulses, shifts_bins.size))
    begin, drawn_at = 0, -1
    for end in np.union1d(ends, shift_ends).tolist():
        # The stretches of pulses that share a group and a displacement.
        group, shift = (int(np.searchsorted(each, end)) for each in (ends, shift_ends))
        if shift != drawn_at:
            at = shifts_bins[shift : shift + 1]
            triggered, drawn_at = _triggered_at(scene, acquisition, flux, pulse, at), shift
        add_triggers(triggered, begin, end, seed, counts[group])
        begin = end
    shape = (n_groups, *np.shape(scene.range_m), acquisition.n_bins)
    rate_hz = None if scene.motion is None else scene.motion.pulse_rate_hz
    return PulseGroups(counts.reshape(shape), sizes, rate_hz)


def first_photons(capture: Capture, n_pulses: int, seed: int = 0) -> Capture:
    """Draw what a first-photon detector would have recorded of the photons of a capture.

    Photons are assigned to pulses uniformly at random, and the first one of a pulse triggers. In
    order of arrival, a photon triggers with probability ``armed / n_pulses``, with the number of
    armed pulses, those that have not fired. This is exact if photons are independent.

    Parameters
    ----------
    capture : Capture
        A capture of all photons.
    n_pulses : int
        Pulses to which the photons are assigned, at least 1.
    seed : int
        The same seed gives the same capture, for any number of threads.

    Returns
    -------
    Capture
        First photons of `n_pulses` pulses per pixel; true fluxes are kept only if the capture knows
        its number of pulses.

    Raises
    ------
    ValueError
        If the capture holds first photons, or an argument is out of its range.
    """
    kind = capture.detection
    require("detection", kind, kind == "all", "a capture of all photons")
    whole = isinstance(n_pulses, Integral)
    require("n_pulses", n_pulses, whole and 1 <= n_pulses < 2**32, "an integer, 1 to 2**32 - 1")
    _require_seed(seed)
    before = capture.acquisition.n_pulses
    share = None if before is None else before / n_pulses  # old pulses per new pulse
    cube = np.zeros_like(capture.cube)
    on_threads(fire_once, len(cube), cube.size, capture.cube, n_pulses, np.uint64(seed), cube)
    source = f"{capture.source}; reduced to the first photons of {n_pulses} pulses, seed {seed}"
    return replace(
        capture,
        cube=cube,
        acquisition=replace(capture.acquisition, n_pulses=n_pulses),
        signal=_times(capture.signal, share),
        background=_times(capture.background, share),
        detection="first",
        source=source,
        flux_prior=None,
        stated_flux=None,
        groups=None,
    )


def _times(flux: _Flux | None, share: float | None) -> _Flux | None:
    return None if flux is None or share is None else flux * share


def _require_seed(seed: int) -> None:
    whole = isinstance(seed, Integral)
    require("seed", seed, whole and 0 <= seed < 2**63, "an integer from 0 to 2**63 - 1")


def cumulative_trigger_probability(
    scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse
) -> Floats:
    """Probability that a detection is recorded before each bin edge.

    ``1 - exp(-Λ)``, with the photons ``Λ`` expected before the edge, modified by motion and jitter.

    Returns
    -------
    ndarray, shape (pixel, n_bins + 1)
        From 0 at the opening of the gate to ``1 - P_none``; differences are trigger probabilities.

    Raises
    ------
    ValueError
        If the scene moves and the number of pulses is unknown.
    """
    shifts_bins = _shifts_bins(scene, acquisition, pulse)
    return _triggered_at(scene, acquisition, flux, pulse, shifts_bins)


def _shifts_bins(scene: Scene, acquisition: Acquisition, pulse: Pulse) -> Floats:
    """Displacement of the scene in bins at each of equal parts of the recording, shape (part,)."""
    if scene.motion is None:
        return np.zeros(1)
    return scene.motion.shifts_bins(pulse, acquisition, pulses_sent(acquisition))


def _triggered_at(
    scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse, shifts_bins: Floats
) -> Floats:
    """Compute the mean of `cumulative_trigger_probability` over displacements of the scene."""
    n_edges = acquisition.n_bins + 1
    share_of_gate = np.linspace(0.0, 1.0, n_edges)
    steady = flux.background * share_of_gate
    if scene.ambient is not None:
        steady = np.ravel(scene.ambient)[:, np.newaxis] * steady
    if scene.backscatter is not None:
        steady += scene.backscatter.photons_before(flux.signal, pulse, acquisition)
    onsets = [
        (np.ravel(acquisition.range_m_to_bin(range_m)), np.ravel(signal))
        for range_m, signal in echoes(scene, flux)
    ]
    faulty = scene.faulty_pixels
    if faulty is not None:
        steady = steady + faulty.photons(acquisition).reshape(-1, 1) * share_of_gate
    triggered = np.empty((np.size(scene.range_m), n_edges))
    before = triggered if shifts_bins.size == 1 else np.empty_like(triggered)
    for group, shift_bins in enumerate(shifts_bins):
        before[:] = steady
        for onset_bin, signal in onsets:
            add_echo(onset_bin + shift_bins, signal, pulse, acquisition.bin_width_s, before)
        to_probability(before)
        if group > 0:
            triggered += before
        elif before is not triggered:
            triggered[:] = before
    if shifts_bins.size > 1:
        triggered /= shifts_bins.size
    if faulty is not None:
        triggered[faulty.dead.reshape(-1)] = 0.0
    if scene.jitter is not None:
        triggered = scene.jitter.recorded(triggered, acquisition.bin_width_s)
    return triggered


def echoes(scene: Scene, flux: Flux) -> Iterator[tuple[Floats, Floats]]:
    """Range and signal photons per pulse of each surface, both of shape (row, col).

    The signal is 0 where there is no target.
    """
    reflectivity = 1.0 if scene.reflectivity is None else scene.reflectivity
    signal = np.where(np.isfinite(scene.range_m), flux.signal * reflectivity, 0.0)
    surfaces, second = [(scene.range_m, signal)], scene.second_surface
    if second is not None:
        share = second.effective_share
        surfaces = [(scene.range_m, (1 - share) * signal), (second.range_m, share * signal)]
    weakening = [part for part in (scene.falloff, scene.backscatter) if part is not None]
    for range_m, photons in surfaces:
        shares = (np.nan_to_num(part.transmission(range_m)) for part in weakening)
        yield range_m, prod(shares, start=photons)


def add_echo(
    onset_bin: Floats, signal: Floats, pulse: Pulse, bin_width_s: float, before: Floats
) -> None:
    """Add the photons of an echo before each bin edge, within the gate, to `before`.

    Parameters
    ----------
    onset_bin : ndarray, shape (pixel,)
        Delay in fractional bins; not finite means no echo.
    signal : ndarray, shape (pixel,)
        Photons per pulse.
    pulse : Pulse
    bin_width_s : float
    before : ndarray, shape (pixel, n_bins + 1)
        Expected photons before each edge, modified in place.
    """
    samples = np.cumsum((0.0, *pulse.samples))
    share = samples / (samples[-1] or 1.0)
    bin_taus = bin_width_s / pulse.tau_s
    given = onset_bin, signal, bin_taus, SHAPE_CODES[pulse.shape], share, before
    on_threads(add_echo_photons, len(before), before.size * EXPONENTIAL, *given)
