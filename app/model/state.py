"""Everything that a user can choose in a session, as frozen objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any

import param

from app.model.methods import FIRST_METHODS, OTHERS, default_settings
from core import (
    CORRECTIONS,
    ESTIMATORS,
    PARTS,
    Acquisition,
    Flux,
    PhotonBudget,
    TrackingParameters,
    Window,
)
from core.checks import require
from core.estimators import FALSE_ALARM, JUDGES
from core.geometry import Box
from core.io import RangeColors, ReadOptions
from core.parameters import Choice, Number, Settings, parameter
from core.reductions import Reduction


@dataclass(frozen=True)
class Illumination(Settings):
    """Illumination and recording of a built-in scene."""

    sbr: float = parameter(
        0.06,
        Number("SBR", 0.01, 10.0, log=True, least=0.0, open_below=True),
        "Signal flux divided by background flux over the whole gate. Daylight: below 0.1.",
    )
    ppp: float = parameter(
        0.1041,
        Number("Signal", 0.001, 10.0, log=True, least=0.0, unit="per pulse"),
        "Signal flux (PPP, photons per pulse), detected if the detector were always armed. "
        "Elsewhere PPP often means photons per pixel, summed over all pulses.",
    )
    n_pulses: int = parameter(
        1000,
        Number("Pulses", 10, 50_000, log=True, whole=True, least=1),
        "Pulses per pixel. More make the histogram smoother, and take longer to record.",
    )
    seed: int = parameter(
        0,
        Number("Seed", 0, 999, whole=True, least=0),
        "Random seed: the same seed gives the same capture.",
    )

    @property
    def flux(self) -> Flux:
        """Signal and background."""
        return Flux(self.ppp, self.sbr)

    def with_background(self, background: float) -> Illumination:
        """Return the same signal over another background, in photons per pulse."""
        # The SBR stands in fields and links: without the last digits, which are rounding errors.
        return replace(self, sbr=float(f"{self.ppp / background:.12g}"))

    def acquisition(self, of_scene: Acquisition) -> Acquisition:
        """Return a scene's acquisition with this number of pulses."""
        return replace(of_scene, n_pulses=self.n_pulses)


@dataclass(frozen=True)
class Visibility:
    """Estimates that are shown, and the width of the cloud."""

    least_confidence: float = parameter(
        0.9,
        Number("Show from confidence", 0.0, 1.0, least=0.0, most=1.0),
        "Estimates with less confidence are hidden in image and cloud, but count in the figures. "
        "0 also shows estimates from noise alone.",
    )
    field_of_view_deg: float | None = parameter(
        None,
        Number(
            "Field of view",
            0.001,
            120.0,
            log=True,
            unit="degrees",
            least=0.0,
            open_below=True,
            optional=True,
        ),
        "Horizontal field of view of the sensor; determines the width of the cloud in metres. "
        "Empty: as the capture states it, else a guess.",
    )


@dataclass(frozen=True)
class Viewing(RangeColors, Visibility):
    """Display of the estimate; does not affect it."""


ALL, REGION = "all", "region"
"""Pixels that `Crop` keeps."""


def _range_limit(symbol: str) -> Number:
    bounds: dict[str, Any] = {"unit": "m", "least": -1e9, "most": 1e9}
    return Number(symbol, 0.0, 1e5, optional=True, none_means="no limit", **bounds)


@dataclass(frozen=True)
class Crop(Settings):
    """Part of the scene that the 3D cloud of the estimate and its files hold.

    Raises
    ------
    ValueError
        If a field is out of its bounds, or the limits are not in ascending order.
    """

    pixels: str = parameter(
        ALL,
        Choice("Pixels", (ALL, REGION)),
        "Pixels of the cloud: all, or those of the region that is selected on Inspect.",
    )
    from_m: float | None = parameter(
        None,
        _range_limit("Range from"),
        "Shortest range in the cloud.",
    )
    to_m: float | None = parameter(
        None,
        _range_limit("Range to"),
        "Longest range in the cloud.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.box(())

    def box(self, region: tuple[tuple[float, float], ...]) -> Box:
        """Return the box that is kept, for the corners (row, col) of the selected region."""
        return Box(region if self.pixels == REGION else (), self.from_m, self.to_m)


@dataclass(frozen=True)
class ReductionSettings(Settings):
    """Reduction of a capture: faster to process, or with more photons per pixel, but coarser."""

    merge: int = parameter(
        1,
        Number("Bins merged", 1, 8, whole=True, least=1, unit="bins"),
        "Neighbouring bins summed to one: faster and coarser. T_n counts merged bins.",
    )
    gate_from: float = parameter(
        0.0,
        Number("Gate from", 0.0, 1.0, least=0.0, most=1.0, unit="of the gate"),
        "Earlier bins are cut, with the pulses that fired in them. Drag the edges on a pixel's "
        "histogram, or enter a position in the unit of the axes; bins are those of the whole gate.",
    )
    gate_to: float = parameter(
        1.0,
        Number("Gate to", 0.0, 1.0, least=0.0, most=1.0, unit="of the gate"),
        "Later bins are cut, with the echoes in them. As for “Gate from”.",
    )
    pool: int = parameter(
        1,
        Number("Pixels summed", 1, 8, whole=True, least=1, unit="rows and columns"),
        "Histograms of this many rows and columns summed to one: more photons per pixel, and a "
        "blurred image.",
    )
    skip: int = parameter(
        1,
        Number("Pixel step", 1, 8, whole=True, least=1, unit="rows and columns"),
        "Keep one pixel of this many rows and columns.",
    )
    pulses: float = parameter(
        1.0,
        Number(
            "Pulses used",
            1e-3,
            1.0,
            log=True,
            unit="of all",
            least=0.0,
            most=1.0,
            open_below=True,
        ),
        "Share of the pulses to use, as if the recording had ended earlier. A smaller share is a "
        "subset of a larger one.",
    )

    @classmethod
    def of(cls, reduction: Reduction, n_bins: int) -> ReductionSettings:
        """Return the settings that make this reduction of a capture with `n_bins` bins."""
        first, end = reduction.gate or (0, n_bins)
        return cls(
            reduction.merge,
            first / n_bins,
            end / n_bins,
            reduction.pool,
            reduction.skip,
            reduction.pulses,
        )

    def gate(self, n_bins: int) -> tuple[int, int]:
        """Return the first of `n_bins` bins that is kept, and the end of the last."""
        first = min(round(self.gate_from * n_bins), n_bins - 1)
        return first, max(round(self.gate_to * n_bins), first + 1)

    def with_gate(self, first: int, end: int, n_bins: int) -> ReductionSettings:
        """Return the settings that keep some of `n_bins` bins, from `first` to before `end`."""
        return replace(self, gate_from=first / n_bins, gate_to=end / n_bins)

    def in_bins(self, n_bins: int) -> Reduction:
        """Return the reduction for a capture with `n_bins` bins."""
        ends = self.gate(n_bins)
        gate = None if ends == (0, n_bins) else ends
        return Reduction(
            merge=self.merge, gate=gate, skip=self.skip, pool=self.pool, pulses=self.pulses
        )


AUTOMATIC = "automatic"
"""Stands for the method that suits the capture."""

CLOUDS = "3D clouds"

MOST_PROBABLE, ALL_RETURNS = "most probable", "all returns"
RETURNS = (MOST_PROBABLE, ALL_RETURNS)
"""Surfaces of a pixel that the 3D cloud, Inspect and files hold."""

KINDS = ("Range", "Error", "Confidence", CLOUDS)
"""Kinds of pictures of methods."""


@dataclass(frozen=True)
class Comparison:
    """The methods that are compared, and the kind of their pictures."""

    methods: tuple[str, ...] = tuple(each for each in ESTIMATORS if each in FIRST_METHODS)
    false_alarm: float = 1.0
    kind: str = KINDS[0]
    viewing: Viewing = Viewing()

    def __post_init__(self) -> None:
        known = isinstance(self.methods, tuple) and all(each in ESTIMATORS for each in self.methods)
        require("methods", self.methods, known, "some of " + ", ".join(ESTIMATORS))
        FALSE_ALARM.check("false_alarm", self.false_alarm)
        require("kind", self.kind, self.kind in KINDS, " or ".join(map(repr, KINDS)))


@dataclass(frozen=True)
class Learning:
    """Progress of a learner in a lesson of the Learn page; empty strings mean not yet."""

    lesson: str = ""
    """Key of the lesson; empty for the first one."""
    prediction: str = ""
    moved: str = ""
    """Value of the lesson's control."""
    answer: str = ""
    """Answer to the lesson's check."""
    step: int = 0
    """Slide in presenter mode."""

    def __post_init__(self) -> None:
        accepted = isinstance(self.step, int) and self.step >= 0
        require("learning.step", self.step, accepted, "an integer, 0 or more")


IMAGES = ("Estimate", "Truth", "Error", "Counts")
FIT = "Goodness of fit"
"""The map of the p-values of pixels."""

VELOCITY = "Velocity"
"""The map of radial velocities, of methods that estimate them."""

MAPS = (
    *("Estimate", "Truth", "Error", "Reported", VELOCITY),
    *("Confidence", "Counts", "Peak", "Fired", "SBR", "Returns"),
    FIT,
)
UNITS = ("bins", "ns", "m")
HELD = ("background", "SBR")
NEIGHBOURS = "Neighbours"
"""The plot of what neighbours tell about a pixel."""

PLOTS = ("Score", "Rate", "Fit", NEIGHBOURS)
SUBJECTS = ("Pixel", "Region", "Pins", "Profile", "A/B", "Capture")
STUDIES = ("Speed and accuracy", "Acquisition", "Ablation", "Sensitivity")
PAPER_SECTIONS = (
    "Figures 1, 2: the jump",
    "Figure 4: two scales",
    "Figures 5, 6: pile-up",
    "The weights",
    "Table 2: six SBRs",
    "Table 3: all methods",
    "Figures 8, 9, 11, 12: images",
    "What the paper does not report",
)
CLOUD_COLORS = ("Range", "Error", "Counts")
NEEDED = {
    "Truth": "truth_range_m",
    "Error": "truth_range_m",
    "Reported": "reported_range_m",
}
"""Image of the capture without which a kind of image does not exist."""


MOST_PINS = 4

MOST_CORNERS = 1000


class Checked(param.Parameter):
    """A parameter whose values are checked by a function of its name and a value.

    The function raises ``ValueError``.
    """

    __slots__ = ("check",)

    def __init__(self, default: Any, check: Callable[[str, Any], None], **options: Any) -> None:
        self.check = check
        super().__init__(default, **options)

    def _validate(self, val: Any) -> None:
        self.check(self.name, val)


def _check_page(name: str, value: Any) -> None:
    named = isinstance(value, str) and value.replace("-", "").isalpha() and len(value) <= 20
    require(name, value, named, "the name of a page")


def _check_pixel(name: str, value: Any) -> None:
    require(name, value, _is_pair(value, Integral, 0), "a row and a column, both from 0")


def _check_pins(name: str, value: Any) -> None:
    pixels = isinstance(value, tuple) and all(_is_pair(each, Integral, 0) for each in value)
    few = pixels and len(value) <= MOST_PINS
    require(name, value, few, f"rows and columns of at most {MOST_PINS} pixels")


def _check_region(name: str, value: Any) -> None:
    corners = isinstance(value, tuple) and all(_is_pair(each, Real, -(2**31)) for each in value)
    fit = corners and (len(value) == 0 or 3 <= len(value) <= MOST_CORNERS)
    require(name, value, fit, f"rows and columns of 3 to {MOST_CORNERS} corners, or nothing")


def _check_settings(name: str, value: Any) -> None:
    known = isinstance(value, Mapping) and tuple(value) == OTHERS
    fit = known and all(isinstance(value[each], ESTIMATORS[each].parameters) for each in OTHERS)
    require(name, value, fit, f"settings of {', '.join(OTHERS)}")


def _is_pair(value: Any, kind: type, least: int) -> bool:
    numbers = isinstance(value, tuple) and all(isinstance(each, kind) for each in value)
    return numbers and len(value) == 2 and all(least <= each < 2**31 for each in value)


def _check_absent(name: str, value: Any) -> None:
    can_be = [*CORRECTIONS, *PARTS]
    known = isinstance(value, frozenset) and value <= set(can_be)
    require(name, value, known, "some of " + ", ".join(can_be))


class State(param.Parameterized):
    """Everything that a user can choose.

    `app.model.address` and `app.model.script` follow from the parameters and from the fields of
    their values. Those of `app.model.store.Request` are what an estimate is computed from.
    """

    source = param.String(default="car", doc="Key of a scene or capture.")
    light = param.ClassSelector(class_=Illumination, default=Illumination())
    budget = param.ClassSelector(
        class_=PhotonBudget,
        default=None,
        doc="Laser, optics and sunlight that give the flux of a scene; None for that of `light`.",
    )
    held = param.Selector(
        default=HELD[0], objects=list(HELD), doc="What stays when the signal moves."
    )
    reading = param.ClassSelector(class_=ReadOptions, default=ReadOptions())
    window = param.ClassSelector(
        class_=Window,
        default=None,
        doc="Part of a capture larger than memory; None for its preview.",
    )
    reduction = param.ClassSelector(class_=ReductionSettings, default=ReductionSettings())
    absent: Any = Checked(
        frozenset(), _check_absent, doc="Parts and corrections that are switched off."
    )
    method = param.Selector(
        default=AUTOMATIC,
        objects=[AUTOMATIC, *ESTIMATORS],
        doc="Key of the estimator that pages show, or `AUTOMATIC`.",
    )
    tracking = param.ClassSelector(class_=TrackingParameters, default=TrackingParameters())
    settings: Any = Checked(
        default_settings(), _check_settings, doc="Settings of each other estimator."
    )
    judged_by = param.Selector(
        default=JUDGES[0],
        objects=list(JUDGES),
        doc="What determines confidence: the pixel alone, or its neighbours, too.",
    )
    returns = param.Selector(
        default=MOST_PROBABLE,
        objects=list(RETURNS),
        doc="Surfaces of a pixel that are shown: the most probable, or up to two.",
    )
    pixel: Any = Checked((31, 24), _check_pixel, doc="Selected row and column.")
    image = param.Selector(default="Estimate", objects=list(IMAGES))
    cloud_color = param.Selector(default="Range", objects=list(CLOUD_COLORS))
    viewing = param.ClassSelector(class_=Viewing, default=Viewing())
    crop = param.ClassSelector(class_=Crop, default=Crop())
    difference = param.Boolean(default=False, doc="Whether the first difference is drawn.")
    echo_free = param.Boolean(
        default=False, doc="Whether Explore shows where estimates lie without an echo."
    )
    page: Any = Checked("Explore", _check_page, doc="Name of a page of `app.pages.catalog`.")
    unit = param.Selector(default="bins", objects=list(UNITS), doc="Unit of axes along the gate.")
    map = param.Selector(default="Estimate", objects=list(MAPS), doc="Image of the Inspect page.")
    subject = param.Selector(
        default="Pixel", objects=list(SUBJECTS), doc="Subject of the Inspect page."
    )
    plot = param.Selector(
        default=PLOTS[0],
        objects=list(PLOTS),
        doc="Plot below the histogram of a pixel or a region on the Inspect page.",
    )
    study = param.Selector(
        default=STUDIES[0], objects=list(STUDIES), doc="Section of the Trade-off page."
    )
    reported = param.Selector(
        default=PAPER_SECTIONS[0], objects=list(PAPER_SECTIONS), doc="Section of the Paper page."
    )
    pins: Any = Checked((), _check_pins, doc="Up to four pixels (row, col) to compare.")
    region: Any = Checked(
        (),
        _check_region,
        doc="Corners (row, col) of a polygon of pixels whose counts are added.",
    )
    kept = param.String(default="", doc="Query of the estimate that was kept as A.")
    unread = param.String(
        default="", doc="Query of the file that was requested last and could not be read."
    )
    comparison = param.ClassSelector(class_=Comparison, default=Comparison())

    learning = param.ClassSelector(class_=Learning, default=Learning())
    present = param.Selector(
        default=0,
        objects=[0, 1],  # written by hand into links
        doc="Whether the Learn page shows one slide, in the whole window.",
    )

    @property
    def box(self) -> Box:
        """The part of the scene that the cloud shows."""
        return self.crop.box(self.region)
