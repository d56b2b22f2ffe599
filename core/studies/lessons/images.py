"""Whole images: a capture outdoors (lesson 9), and what neighbours add (lesson 10)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.estimators import RangeImage, estimate
from core.inference.posterior import posterior_of
from core.inspection import pixel_report
from core.scene import scenes
from core.studies.lessons.bench import PIXELS, Bench, captured
from core.studies.methods.neighbours import at_edges
from core.studies.outputs import Pictures, Plot

# -- A capture outdoors ----------------------------------------------------------------------------

PLACES = dict(zip(PIXELS, ((3, 24), (22, 44), (48, 36), (34, 20)), strict=True))
"""Row and column of the named pixels: sky, wall, a hot pixel, a net before the wall."""

AGREEING = ("likelihood", "coates")
"""Methods whose estimates are compared."""


def _recorded(bench: Bench) -> Capture:
    """Return the field capture; being a recording, it is the same for every seed."""
    return captured("field", replace(bench, seed=0))


def outdoor_pixel(bench: Bench) -> Plot:
    """Plot the histogram of a pixel of the field capture, with the estimates of two methods."""
    capture, (row, col) = _recorded(bench), PLACES[bench.pixel]
    bins = {name: float(_estimate(capture, name).bin[row, col]) for name in AGREEING}
    return Plot(
        "outdoor_pixel",
        f"Pixel {bench.pixel} of a generated field capture",
        "Bin (1 ns)",
        "Counts",
        np.arange(capture.acquisition.n_bins, dtype=float) + 0.5,
        {"histogram": capture.cube[row, col].astype(float)},
        bins,
        ", ".join(f"{name.capitalize()}: bin {at:.0f}" for name, at in bins.items()) + ".",
    )


def surface_probability(bench: Bench) -> Plot:
    """Plot the probability of a surface near each bin of a pixel of the field capture."""
    capture, (row, col) = _recorded(bench), PLACES[bench.pixel]
    posterior = posterior_of(capture)
    near = posterior.tolerance_probability[row, col].astype(float)
    return Plot(
        "surface_probability",
        f"Is there a surface? Pixel {bench.pixel}",
        "Bin (1 ns)",
        "Probability",
        np.arange(near.size, dtype=float),
        {"surface within 3 bins": near},
        note=f"Probability of any surface: {posterior.surface[row, col]:.3f}. "
        f"{_description(capture, row, col)}",
    )


def _description(capture: Capture, row: int, col: int) -> str:
    """Return surfaces and SBR of a pixel, and how its counts compare with its neighbours'."""
    report = pixel_report(capture, _estimate(capture, "likelihood"), row, col, "likelihood")
    surfaces = " and ".join(f"in bin {each:.0f}" for each in sorted(report.surfaces_bin)) or "none"
    sbr = report.flux.sbr
    interval = f"{sbr.value:.2g} ({sbr.low:.2g} to {sbr.high:.2g}, 95 %)"
    return f"Likely surfaces: {surfaces}. SBR {interval}. {report.verdict.why}"


def agreement(bench: Bench) -> Pictures:
    """Show where two methods agree on the field capture, and where they agree and are wrong."""
    capture = _recorded(bench)
    range_m, agreed, right = _agreement(capture)
    return Pictures(
        "agreement",
        "Pixels of a generated field capture in which two methods agree",
        "Range (m)",
        {
            "likelihood": range_m,
            "both agree": np.where(agreed, range_m, np.nan),
            "both agree, wrongly": np.where(agreed & ~right, range_m, np.nan),
        },
        float(capture.acquisition.bin_to_range_m(0)),
        float(capture.acquisition.bin_to_range_m(capture.acquisition.n_bins)),
        f"The likelihood and Coates agree within 3 bins in {agreed.sum():,} of {agreed.size:,} "
        f"pixels; in {(agreed & ~right).sum():,} of these there is no surface at that range.",
    )


@cached_per_capture
def _agreement(capture: Capture) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return ranges, whether both methods agree within 3 bins, and whether a surface is there."""
    one, other = (_estimate(capture, name) for name in AGREEING)
    agreed = np.abs(one.bin - other.bin) <= 3
    right = np.zeros(agreed.shape, bool)
    scene = scenes["field"]()
    assert scene.second_surface is not None
    for truth_m in (scene.range_m, scene.second_surface.range_m):
        right |= np.abs(one.bin - capture.acquisition.range_m_to_bin(truth_m)) <= 3
    return one.range_m, agreed, right


def share_agreed(bench: Bench) -> float:
    """Share of the pixels of the field capture in which two methods agree."""
    return float(_agreement(_recorded(bench))[1].mean())


def share_wrong_of_agreed(bench: Bench) -> float:
    """Share of the pixels in which two methods agree that have no surface there."""
    _, agreed, right = _agreement(_recorded(bench))
    return float((agreed & ~right).sum() / agreed.sum())


@cached_per_capture
def _estimate(capture: Capture, method: str) -> RangeImage:
    return estimate(capture, method)


# -- Neighbours ------------------------------------------------------------------------------------

METHODS = {"off": "likelihood", "on": "image_posterior"}
"""Method by the value of the control."""

TITLES = {"off": "each pixel alone", "on": "with neighbours"}

DISTANCES = np.arange(6.0)
"""Distances to the nearest edge in pixels; the last one includes all larger ones."""


class _Found(NamedTuple):
    """Estimates of a method on planes before a wall, each of shape (row, col)."""

    range_m: Floats
    right: NDArray[np.bool_]
    """Whether each is within 1 bin of the truth."""


@cached_per_capture
def _found(capture: Capture, method: str) -> _Found:
    image, truth_m = estimate(capture, method), np.asarray(capture.truth_range_m)
    right = np.abs(image.bin - capture.acquisition.range_m_to_bin(truth_m)) <= 1
    return _Found(image.range_m, right)


@cached_per_capture
def _edge_distance(capture: Capture) -> NDArray[np.int32]:
    """Return the distance in pixels to the nearest one next to an edge, 0 for itself."""
    return np.asarray(scipy.ndimage.distance_transform_cdt(~at_edges(capture), "chessboard"))


def neighbours_image(bench: Bench) -> Pictures:
    """Show planes before a wall, their estimate, and the true ranges of missed pixels."""
    capture = captured("piecewise", bench)
    truth_m = np.asarray(capture.truth_range_m)
    found = _found(capture, METHODS[bench.neighbours])
    return Pictures(
        "neighbours_image",
        f"Planes before a wall, {TITLES[bench.neighbours]}",
        "Range (m)",
        {
            "truth": truth_m,
            TITLES[bench.neighbours]: found.range_m,
            "missed pixels": np.where(found.right, np.nan, truth_m),
        },
        float(truth_m.min()) - 0.5,
        float(truth_m.max()) + 0.5,
        f"SBR {bench.flux.sbr:.2g}. {found.right.mean():.1%} of the pixels are within 1 bin; the "
        "last picture shows the others.",
    )


def found_by_distance(bench: Bench) -> Plot:
    """Plot the share of pixels found against their distance from the nearest edge."""
    capture = captured("piecewise", bench)
    distance = np.minimum(_edge_distance(capture), DISTANCES[-1])
    curves = {}
    for switch, title in TITLES.items():
        right = _found(capture, METHODS[switch]).right
        curves[title] = np.array([right[distance == each].mean() for each in DISTANCES])
    counts = np.bincount(distance.astype(int).ravel())
    return Plot(
        "found_by_distance",
        "Pixels found within 1 bin",
        "Distance from the nearest edge (pixels)",
        "Share of pixels",
        DISTANCES,
        curves,
        note="An edge is a step of more than 3 bins; the pixels on both of its sides have the "
        f"distance 0, the last point is {DISTANCES[-1]:g} or more. Pixels at each distance: "
        f"{', '.join(f'{each:,}' for each in counts)}.",
    )


def _share(bench: Bench, switch: str, is_edge: bool) -> float:
    capture = captured("piecewise", bench)
    right = _found(capture, METHODS[switch]).right
    return float(right[at_edges(capture) == is_edge].mean())


def share_at_edges(bench: Bench) -> float:
    """Share of pixels at edges that are found with neighbours."""
    return _share(bench, "on", is_edge=True)


def share_inside(bench: Bench) -> float:
    """Share of pixels inside surfaces that are found with neighbours."""
    return _share(bench, "on", is_edge=False)


def share_at_edges_alone(bench: Bench) -> float:
    """Share of pixels at edges that are found without neighbours."""
    return _share(bench, "off", is_edge=True)
