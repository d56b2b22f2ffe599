"""Speed against accuracy, and how to acquire."""

from core.studies.tradeoff.measure import Candidate, Point, Source, candidates, study
from core.studies.tradeoff.page import (
    acquired,
    acquiring_items,
    acquisition_items,
    acquisition_sweeps,
    points_table,
)
from core.studies.tradeoff.pareto import (
    Recommendation,
    best_within,
    cheapest_reaching,
    front,
    including_flux_time,
    pareto_front,
    with_light,
)
from core.studies.tradeoff.surrogate import Simulation, like, surrogate_of

__all__ = [
    "Candidate",
    "Point",
    "Recommendation",
    "Simulation",
    "Source",
    "acquired",
    "acquiring_items",
    "acquisition_items",
    "acquisition_sweeps",
    "best_within",
    "candidates",
    "cheapest_reaching",
    "front",
    "including_flux_time",
    "like",
    "pareto_front",
    "points_table",
    "study",
    "surrogate_of",
    "with_light",
]
