"""The paper, reproduced and questioned, on one page."""

from __future__ import annotations

from pathlib import Path

from core.capture import Capture
from core.studies.paper import figures as paper
from core.studies.report import write
from core.studies.trials import Results

INTRODUCTION = (
    "Xie et al., Electronics 2026, 15(13), 2816, find the echo in first-photon histograms by the "
    "difference of two tracking differentiators. Every figure and table below is computed by "
    "`python -m core paper`; no measurement of the paper's is public, so that ours are "
    "simulations, and where the paper does not print a setting (pulses, pulse length, tolerance) "
    "they use what makes its tables come out: 1000 pulses, 1 ns, 3 bins.",
    "Printed values stand beside ours, with the difference and a 95 % interval. A difference "
    "within it is chance; a larger one has a cause, and ours is not always better: those marked "
    "as reconstructions were rebuilt from abstracts.",
    "Read first: 'The limit' (what one pixel can tell at all), 'Where the answers lie when there "
    "is no echo' (what a method assumes about range without saying so), and 'Restoration degree "
    "against the echo's place' (what a target at 50 m alone does not show).",
)


def write_page(
    results: Results, folder: Path, repetitions: int, field: Capture | None = None
) -> Path:
    """Write all items into a folder; returns the page.

    Parameters
    ----------
    results : dict
        Of `paper.plan`, over `repetitions` seeds.
    folder : path
    repetitions : int
    field : Capture, optional
        A measured capture on which to compare the methods.
    """
    items = [
        paper.table_2(results),
        paper.table_3(results),
        paper.table_5(results),
        *paper.model_items(),
    ]
    if field is not None:
        items.append(paper.agreement(field, Path(field.source.split(":")[0]).name))
    title = f"The paper, reproduced and questioned ({repetitions} repetitions)"
    return write(items, folder, title, INTRODUCTION)
