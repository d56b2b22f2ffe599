"""A tour of the page Explore: five stops, each of which points at a part of it."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, NamedTuple

import param

from app.widgets.component import Component, script


class Stop(NamedTuple):
    """One stop: a part of the page, and what is said about it."""

    selectors: tuple[str, ...]
    """CSS selectors; the first one that matches an element on screen is pointed at."""
    title: str
    text: str


SCENE, PIXEL, HISTOGRAM, ESTIMATE, CONFIDENCE = (
    f"tour-{name}" for name in ("scene", "pixel", "histogram", "estimate", "confidence")
)
"""CSS classes of the parts of the page that are pointed at."""

STOPS = (
    Stop(
        (f".{SCENE}", "header .MuiIconButton-edgeStart"),  # on a phone, the list is in the menu
        "The scene",
        "A simulated scene in daylight, at first a car at 50 m. Here you choose another scene, or "
        "open a capture of your own; on a phone, in the menu.",
    ),
    Stop(
        (f".{PIXEL}",),
        "One pixel",
        "The colour of a pixel is the range that was estimated from its own photons. Click a "
        "pixel, or move the frame with the arrow keys: all plots follow.",
    ),
    Stop(
        (f".{HISTOGRAM}",),
        "Its histogram",
        "The laser fires many pulses, and of each only the first photon is counted. Sunlight piles "
        "up at the left, because early photons end the measurement. The echo is a narrow peak.",
    ),
    Stop(
        (f".{ESTIMATE}",),
        "The estimate",
        "The method turns the histogram into a curve. Its maximum, corrected for a known lag, "
        "is the estimate, the solid vertical line. The dashed one is the truth, which a "
        "simulation knows.",
    ),
    Stop(
        (f".{CONFIDENCE}",),
        "Its confidence",
        "Noise can look like an echo. Confidence is the probability that an estimate is right "
        "within 3 bins. Estimates below this value are hidden: set it to 0 to see them.",
    ),
)


class Tour(Component):
    """A card that goes from stop to stop; Esc ends it, and the browser remembers that.

    It is offered at an address without settings, until it was ended once.
    """

    stops = param.List(default=[list(each) for each in STOPS], doc="Selectors, title and text.")
    shown_with = param.String(default=f".{PIXEL}", doc="Selector of what is on this page alone.")
    onward = param.String(default="Lessons", doc="Label of the button after the last stop.")
    is_offered = param.Boolean(default=False, doc="Whether it starts by itself the first time.")
    started = param.Integer(default=0, doc="Number of times that it was asked for.")
    finished = param.Integer(default=0, doc="Number of times that the button `onward` was pressed.")

    _esm = script("tour.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("tour.css")]
