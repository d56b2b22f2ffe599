"""Views and checks of lessons: named functions of one simulated pixel or image.

A lesson names them (`VIEWS`, `CHECKS`); nothing in its text is evaluated.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

from core.checks import require
from core.studies.lessons import accuracy, falloff, images, pile_up, tracking
from core.studies.lessons.bench import Bench
from core.studies.outputs import Pictures, Plot
from core.studies.pulses import Pulses

__all__ = [
    "CHECKS",
    "NEED_SIGNAL",
    "PLOTS",
    "VIEWS",
    "Bench",
    "arguments_of",
    "require_signal",
]


def number(bench: Bench, value: float) -> float:
    """Return a number as it is, for a hint."""
    return value


def share_of_gate(bench: Bench, first: float, end: float) -> float:
    """Share of the gate between two bins."""
    return (end - first) / bench.acquisition.n_bins


PLOTS: Mapping[str, Callable[[Bench], Plot]] = {
    each.__name__: each
    for each in (
        pile_up.light,
        pile_up.first_photons,
        pile_up.still_armed,
        pile_up.accuracy_by_exposure,
        pile_up.corrected,
        pile_up.noise_along_gate,
        tracking.both_scales,
        tracking.both_scales_without_echo,
        tracking.estimates_without_echo,
        tracking.weight_along_gate,
        tracking.pixels_moved,
        tracking.found_by_t_n,
        accuracy.accuracy_by_pulses,
        accuracy.found_along_gate,
        accuracy.reliability_diagram,
        accuracy.kept_by_confidence,
        images.outdoor_pixel,
        images.surface_probability,
        images.found_by_distance,
        falloff.fluxes_by_range,
    )
}
"""Views on which a prediction can be drawn."""

VIEWS: Mapping[str, Callable[[Bench], Plot | Pictures | Pulses]] = {
    **PLOTS,
    **{
        each.__name__: each
        for each in (
            pile_up.car_image,
            pile_up.pulse_by_pulse,
            images.agreement,
            images.neighbours_image,
        )
    },
}
"""Views that a lesson can name."""

CHECKS: Mapping[str, Callable[..., float]] = {
    each.__name__: each
    for each in (
        number,
        share_of_gate,
        falloff.signal_at,
        pile_up.share_armed,
        pile_up.share_fired,
        pile_up.best_attenuation,
        pile_up.sbr,
        pile_up.noise_ratio,
        pile_up.noise_ratio_of_counts,
        pile_up.armed_ratio,
        tracking.share_without_echo,
        tracking.share_moved,
        tracking.share_moved_by_cubic,
        accuracy.pulses_ratio,
        accuracy.place_of_half,
        accuracy.share_kept,
        accuracy.share_right,
        images.share_agreed,
        images.share_wrong_of_agreed,
        images.share_at_edges,
        images.share_inside,
        images.share_at_edges_alone,
    )
}
"""Functions that compute the answer to a question of a lesson, or a typical wrong one."""


def arguments_of(name: str) -> list[str]:
    """Return the names of the arguments of a check, besides the bench.

    Raises
    ------
    ValueError
        If there is no such check.
    """
    require("check", name, name in CHECKS, " or ".join(map(repr, CHECKS)))
    return list(inspect.signature(CHECKS[name]).parameters)[1:]


NEED_SIGNAL = frozenset({*VIEWS, *CHECKS}) - {
    each.__name__
    for each in (
        number,
        share_of_gate,
        falloff.fluxes_by_range,
        falloff.signal_at,
        pile_up.light,
        pile_up.first_photons,
        pile_up.pulse_by_pulse,
        pile_up.still_armed,
        pile_up.share_armed,
        pile_up.share_fired,
        pile_up.sbr,
        pile_up.corrected,
        pile_up.noise_along_gate,
        pile_up.noise_ratio,
        pile_up.noise_ratio_of_counts,
        pile_up.armed_ratio,
        tracking.estimates_without_echo,
        tracking.share_without_echo,
        tracking.weight_along_gate,
    )
}
"""Views and checks that raise ``ValueError`` without a signal."""


def require_signal(name: str, bench: Bench) -> None:
    """Raise ``ValueError`` if a view or check needs a signal and the bench has none."""
    accepted = bench.signal > 0 or name not in NEED_SIGNAL
    require("signal", bench.signal, accepted, f"a number above 0, which {name!r} needs")
