"""Speed against accuracy."""

from core.studies.tradeoff.measure import Cancelled, Candidate, Point, Source, candidates, study
from core.studies.tradeoff.page import acquired, acquiring_items, points_table
from core.studies.tradeoff.pareto import (
    Recommendation,
    best_within,
    cheapest_reaching,
    front,
    with_light,
)
from core.studies.tradeoff.surrogate import Simulation, like

__all__ = [
    "Cancelled",
    "Candidate",
    "Point",
    "Recommendation",
    "Simulation",
    "Source",
    "acquired",
    "acquiring_items",
    "best_within",
    "candidates",
    "cheapest_reaching",
    "front",
    "like",
    "points_table",
    "study",
    "with_light",
]
