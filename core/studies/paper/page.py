"""All reproduced figures and tables of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from core.capture import Capture
from core.studies.outputs import Item
from core.studies.paper import figures as paper
from core.studies.trials import Results

INTRODUCTION = (
    "Xie et al., Electronics 2026, 15(13), 2816, find the echo in first-photon histograms by the "
    "difference of two tracking differentiators. Every figure and table below is computed by "
    "`python -m core paper`. The paper's measurements are not public, so these are simulations; "
    "settings that it does not print (pulses, pulse length, tolerance) have the values that "
    "reproduce its tables: 1000 pulses, 1 ns, 3 bins.",
    "Printed values are shown with the difference and a 95 % interval. A difference within the "
    "interval is chance. Methods marked as reconstructions were rebuilt from abstracts.",
    "Start with the limits (what the likelihood of a single pixel finds), the estimates without "
    "an echo (which ranges a method prefers) and the restoration degree against the position of "
    "the echo (which a target at 50 m alone does not show).",
)


def items(results: Results, measured: Capture | None = None) -> Iterator[Item]:
    """Yield all items; `results` are those of `figures.plan`.

    On a measured capture, the agreement of the methods is added.
    """
    yield paper.table_2(results)
    yield paper.table_3(results)
    yield paper.table_5(results)
    yield from paper.model_items()
    if measured is not None:
        yield paper.agreement(measured, Path(measured.source.split(":")[0]).name)
