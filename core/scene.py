"""Scenes, with a range for every pixel, and the built-in ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats
from core.checks import require
from core.effects import Backscatter, Falloff, FaultyPixels, Jitter, Motion, SecondSurface
from core.pulse_groups import USUAL_GROUPS


@dataclass(frozen=True, eq=False)
class Scene:
    """Range of the surface that each pixel sees, and optional `PARTS`.

    Parameters
    ----------
    range_m : ndarray, shape (row, col)
        Range of the surface in metres; NaN where a pixel sees no target.
    reflectivity : ndarray, shape (row, col), optional
        Factor on the signal, finite and non-negative; None means 1 everywhere.
    acquisition : Acquisition
        Acquisition that suits this scene; `simulate` takes its own.
    ambient : ndarray, shape (row, col), optional
        Factor on the background, finite and non-negative; None means 1 everywhere.
    second_surface, backscatter, faulty_pixels, motion, jitter, falloff : optional
        Parts of `core.effects`; None for an absent one.

    Raises
    ------
    ValueError
        If the shapes differ, or a factor is negative.
    """

    range_m: Floats
    reflectivity: Floats | None = None
    acquisition: Acquisition = field(default_factory=Acquisition)
    ambient: Floats | None = None
    second_surface: SecondSurface | None = None
    backscatter: Backscatter | None = None
    faulty_pixels: FaultyPixels | None = None
    motion: Motion | None = None
    jitter: Jitter | None = None
    falloff: Falloff | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.range_m)
        require("range_m", f"shape {shape}", len(shape) == 2 and min(shape) > 0, "(row, col)")
        infinite = int(np.count_nonzero(np.isinf(self.range_m)))
        require("range_m", f"{infinite} infinite", infinite == 0, "metres, or NaN for no target")
        for name in ("reflectivity", "ambient", "second_surface", "faulty_pixels"):
            part = getattr(self, name)
            found = shape if part is None else np.shape(part)
            require(name, f"shape {found}", found == shape, f"shape {shape}, that of range_m")
        for name in ("reflectivity", "ambient"):
            factor = getattr(self, name)
            if factor is not None:
                low, high = float(np.min(factor)), float(np.max(factor))
                require(name, (low, high), 0 <= low <= high < np.inf, "finite factors >= 0")

    def groups_of(self, n_pulses: int | None) -> int | None:
        """Return the groups in which its pulses are kept; None for a scene at rest.

        Their order shows the motion (`core.Capture.groups`).
        """
        return None if self.motion is None else min(USUAL_GROUPS, n_pulses or 1)

    @property
    def surfaces_m(self) -> Floats:
        """Ranges of all surfaces that return light, (surface, row, col); NaN for fewer of them."""
        first_m, second = np.asarray(self.range_m, float), self.second_surface
        if second is None:
            return first_m[np.newaxis]
        share = second.effective_share
        return np.stack(
            [np.where(share < 1, first_m, np.nan), np.where(share > 0, second.range_m, np.nan)]
        )


PARTS = {
    "reflectivity": "reflectivity",
    "ambient": "uneven background",
    "falloff": "fall of the signal with range",
    "second_surface": "second surface",
    "backscatter": "backscatter of fog",
    "faulty_pixels": "hot and dead pixels",
    "motion": "motion during the pulses",
    "jitter": "timing jitter",
}
"""Optional parts of a scene: names of its fields and how texts call them."""


PLAIN_PARTS = ("reflectivity", "falloff")
"""Parts with which a pixel still sees one echo over uniform background, so that its signal and
background state all its fluxes."""


def parts_of(scene: Scene) -> tuple[str, ...]:
    """Return the names of the `PARTS` that a scene has."""
    return tuple(part for part in PARTS if getattr(scene, part) is not None)


def further_parts_of(scene: Scene) -> tuple[str, ...]:
    """Return the names of the parts other than `PLAIN_PARTS` that a scene has."""
    return tuple(part for part in parts_of(scene) if part not in PLAIN_PARTS)


def without(scene: Scene, *parts: str) -> Scene:
    """Return the scene without some of its `PARTS`.

    Raises
    ------
    ValueError
        If there is no part of a name.
    """
    for part in parts:
        require("part", part, part in PARTS, " or ".join(map(repr, PARTS)))
    absent: dict[str, Any] = dict.fromkeys(parts)
    return replace(scene, **absent) if parts else scene


PAPER_GATE = Acquisition(100, 1e-9, 280e-9, n_pulses=1000)
"""The paper's gate for targets at 50 m: 280 to 380 ns, 42 to 57 m."""


def _pixel_angle_rad(field_of_view_rad: float, size: int) -> float:
    """Return the angle of one of `size` pixels."""
    require("size", size, size >= 8, "8 or more rows and columns")
    return field_of_view_rad / size


def _gate_of(size: int) -> Acquisition:
    """Return the paper's gate, for images of `size` x `size` pixels over 128 mrad."""
    return replace(PAPER_GATE, pixel_angle_rad=_pixel_angle_rad(0.128, size))


def car(size: int = 64) -> Scene:
    """A car at 50 m, seen from its front quarter and a little above.

    ``assets/make_car.py`` draws it; the gate is `PAPER_GATE`.

    Parameters
    ----------
    size : int
        Rows and columns, 64 or 256, over a field of view of 90 mrad.

    Raises
    ------
    ValueError
        If `size` is another number.
    """
    require("size", size, size in (64, 256), "64 or 256")
    with resources.files("assets").joinpath("car.npz").open("rb") as file, np.load(file) as stored:
        range_m = stored[f"range_m_{size}"].astype(float)
        pixel_angle_rad = float(stored[f"pixel_angle_rad_{size}"])
    return Scene(range_m, acquisition=replace(PAPER_GATE, pixel_angle_rad=pixel_angle_rad))


def staircase(size: int = 64) -> Scene:
    """Flat steps through the whole gate, one in each of 8 x 8 tiles.

    Steps recede in reading order. Their echoes begin in bins 1 to 94 of 100, so that the gate holds
    the rise of the first and the tail of the last.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    acquisition = _gate_of(size)
    tile = np.arange(size) * 8 // size
    onset_bin = np.linspace(1.0, 94.0, 64)[8 * tile[:, np.newaxis] + tile]
    return Scene(acquisition.bin_to_range_m(onset_bin), acquisition=acquisition)


def uniform(size: int = 64, seed: int = 0, first_bin: float = 20, last_bin: float = 94) -> Scene:
    """Random depths, uniform and independent from pixel to pixel.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.
    seed : int
        Random seed.
    first_bin, last_bin : float
        Fractional bins, of the gate's 100, between which the echoes begin; the same bin for a flat
        target.

    Raises
    ------
    ValueError
        If `size` is below 8, or the bins are not in order within the gate.
    """
    acquisition = _gate_of(size)
    require(
        "first_bin, last_bin",
        (first_bin, last_bin),
        0 <= first_bin <= last_bin <= acquisition.n_bins,
        f"two positions in order, from 0 to {acquisition.n_bins}",
    )
    onset_bin = np.random.default_rng(seed).uniform(first_bin, last_bin, (size, size))
    return Scene(acquisition.bin_to_range_m(onset_bin), acquisition=acquisition)


_WALL_SPAN_BINS = 6.0


def wall(size: int = 64, seed: int = 0) -> Scene:
    """A flat wall, seen obliquely, at a random range and turned by a random angle.

    Neighbouring pixels see nearly the same range, and the walls of many seeds cover bins 20 to 94
    of the gate's 100: what methods that use neighbours assume, without edges.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.
    seed : int
        Random seed.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    acquisition = _gate_of(size)
    rng = np.random.default_rng(seed)
    half = _WALL_SPAN_BINS / 2
    middle, angle_rad = rng.uniform(20 + half, 94 - half), rng.uniform(0, 2 * np.pi)
    across = np.linspace(-half, half, size) / np.sqrt(2)
    onset_bin = middle + np.add.outer(np.sin(angle_rad) * across, np.cos(angle_rad) * across)
    return Scene(acquisition.bin_to_range_m(onset_bin), acquisition=acquisition)


# Planes of `piecewise`, in 64ths of the image: first and last row, first and last column, the bin
# of the echo in the middle, and its change from row to row and from column to column.
_PLANES: tuple[tuple[float, ...], ...] = (
    (0, 63, 0, 63, 80.0, 0.0, 0.1),  # wall
    (38, 63, 0, 63, 55.25, -2.5, 0.0),  # ground
    (16, 54, 5, 17, 47.0, 0.0, -0.3),  # front of a house
    (16, 50, 18, 24, 50.0, 0.0, 1.5),  # its side
    (16, 58, 29, 30, 36.0, 0.0, 0.0),  # pole
    (5, 18, 36, 50, 58.0, 0.8, -0.5),  # boards
    (23, 32, 34, 41, 66.0, -0.4, 0.6),
    (21, 35, 46, 49, 41.0, 0.3, 0.0),
    (25, 37, 53, 61, 62.0, -0.6, 0.4),
    (43, 60, 38, 51, 31.0, 0.0, 0.4),  # low wall
)


def piecewise(size: int = 64) -> Scene:
    """Planes before a wall, over a ground that recedes by 2.5 bins from row to row.

    Neighbouring pixels agree except at edges, which one pixel in five adjoins: a test of methods
    that use neighbours. The depths cover bins 23 to 83 of the gate's 100.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    acquisition = _gate_of(size)
    at = (np.arange(size) + 0.5) * 64 / size - 0.5
    onset_bin = np.full((size, size), np.inf)
    for top, bottom, left, right, middle_bin, per_row, per_col in _PLANES:
        row, col = at - (top + bottom) / 2, at - (left + right) / 2
        inside = np.logical_and.outer(
            np.abs(row) <= (bottom - top + 1) / 2, np.abs(col) <= (right - left + 1) / 2
        )
        plane_bin = middle_bin + np.add.outer(per_row * row, per_col * col)
        np.minimum(onset_bin, plane_bin, out=onset_bin, where=inside)
    return Scene(acquisition.bin_to_range_m(onset_bin), acquisition=acquisition)


# Axes of the building, in metres: x along its right front and y along its left front, both from the
# corner nearest to the sensor, and z upward from the ground.
_Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest, highest corner

_TURN_RAD = np.radians(35.0)  # between the right front and the image plane
_SENSOR_RIGHT_M, _SENSOR_BACK_M, _SENSOR_UP_M = 3.0, 831.5, 15.6  # from the nearest corner
_SENSOR_M = np.array(
    [
        _SENSOR_RIGHT_M * np.cos(_TURN_RAD) - _SENSOR_BACK_M * np.sin(_TURN_RAD),
        -_SENSOR_RIGHT_M * np.sin(_TURN_RAD) - _SENSOR_BACK_M * np.cos(_TURN_RAD),
        _SENSOR_UP_M,
    ]
)
_STOREY_M, _BAY_M = 3.2, 3.4
_WINDOW_DEPTH_M = 1.0  # the echo comes from the room behind the glass

_HOUSES: tuple[_Box, ...] = (
    ((0.0, 0.0, 0.0), (17.0, 15.0, 22.4)),
    ((17.0, 4.0, 0.0), (25.0, 14.0, 10.4)),
    ((-8.0, 25.0, 0.0), (8.0, 32.0, 16.8)),
)
_TRIMS: tuple[_Box, ...] = (
    ((-0.5, -0.5, 22.4), (17.5, 15.5, 23.5)),  # eaves
    ((5.0, 4.0, 23.5), (10.0, 9.0, 26.8)),  # lift house
    *(
        ((x, -1.5, storey * _STOREY_M), (x + 3.4, 0.0, storey * _STOREY_M + 1.1))
        for storey in range(1, 7)
        for x in (3.4, 10.2)
    ),  # balconies
)


def building(size: int = 64) -> Scene:
    """A corner house at 830 to 860 m: balconies, recessed windows, lower neighbours behind.

    The gate is 5470 to 5804 ns (820 to 870 m) in 1 ns bins, 10 m more than the houses on both
    sides; the paper does not state that of its field trial.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 35 mrad (30 m at the corner).

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    pixel_angle_rad = _pixel_angle_rad(0.0352, size)
    acquisition = Acquisition(334, 1e-9, 5470e-9, n_pulses=1000, pixel_angle_rad=pixel_angle_rad)
    direction = _building_rays(size, pixel_angle_rad)
    wall_m = [_wall_range_m(direction, box) for box in _HOUSES]
    trim_m = [_box_range_m(direction, box) for box in _TRIMS]
    range_m = np.min([*wall_m, *trim_m], axis=0)
    return Scene(np.where(np.isfinite(range_m), range_m, np.nan), acquisition=acquisition)


def _building_rays(size: int, pixel_angle_rad: float) -> Floats:
    """Unit line of sight of each pixel in the axes of the building, shape (3, row, col)."""
    angle = (np.arange(size) - (size - 1) / 2) * pixel_angle_rad
    right, up = np.meshgrid(angle, -angle)
    across, ahead = np.cos(up) * np.sin(right), np.cos(up) * np.cos(right)
    cos, sin = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    return np.stack([cos * across + sin * ahead, cos * ahead - sin * across, np.sin(up)])


def _box_range_m(direction: Floats, box: _Box) -> Floats:
    """Range at which rays (3, row, col) enter a box, shape (row, col); infinity if they miss."""
    corners = np.array(box) - _SENSOR_M
    with np.errstate(divide="ignore"):  # a horizontal ray meets neither floor nor roof
        crossing_m = corners[:, :, np.newaxis, np.newaxis] / direction
    enter_m, leave_m = crossing_m.min(axis=0).max(axis=0), crossing_m.max(axis=0).min(axis=0)
    return np.where(enter_m < leave_m, enter_m, np.inf)


def _wall_range_m(direction: Floats, box: _Box) -> Floats:
    """Return `_box_range_m` with rows of recessed windows in the two fronts."""
    range_m = _box_range_m(direction, box)
    hit = np.isfinite(range_m)
    x, y, z = direction * np.where(hit, range_m, 0.0) + _SENSOR_M[:, np.newaxis, np.newaxis]
    from_x_m, from_y_m = x - box[0][0], y - box[0][1]
    on_right_front = from_y_m < from_x_m
    bay = np.where(on_right_front, from_x_m, from_y_m) / _BAY_M % 1
    storey = z / _STOREY_M % 1
    window = hit & (np.abs(bay - 0.5) < 0.25) & (np.abs(storey - 0.55) < 0.25)
    facing = np.where(on_right_front, direction[1], direction[0])
    return np.where(window, range_m + _WINDOW_DEPTH_M / facing, range_m)


def net(
    size: int = 64, separation_bins: float = 6.0, share: float = 0.3, first_bin: float = 40.0
) -> Scene:
    """A net before an oblique wall: every pixel sees both, the net returns less.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.
    separation_bins : float
        Distance of the wall behind the net, in bins, positive.
    share : float
        Share of the signal that the net returns, 0 to 1.
    first_bin : float
        Delay of the net's echo in the middle of the image, in bins.

    Raises
    ------
    ValueError
        If `size` is below 8, or an argument is out of its bounds.
    """
    acquisition = _gate_of(size)
    positive = 0 < separation_bins < np.inf
    require("separation_bins", separation_bins, positive, "finite and positive")
    across = np.linspace(-_WALL_SPAN_BINS / 2, _WALL_SPAN_BINS / 2, size)
    net_bin = np.broadcast_to(first_bin + across, (size, size))
    net_m, wall_m = map(acquisition.bin_to_range_m, (net_bin, net_bin + separation_bins))
    second = SecondSurface(net_m, np.full((size, size), share))
    return Scene(wall_m, acquisition=acquisition, second_surface=second)


_RAYS = 4  # across and down a pixel
_APART_BINS = 2.0  # distance below which two surfaces return one echo


def edges(size: int = 64) -> Scene:
    """The corner house with pixels of finite area: at edges two surfaces return an echo.

    Each pixel has 16 rays. Its range is that of the surface that most of them meet, its
    reflectivity the share of them that meet any. Takes `size` and the gate of `building`.
    """
    acquisition = building(size).acquisition
    rays = building(_RAYS * size).range_m.reshape(size, _RAYS, size, _RAYS).swapaxes(1, 2)
    rays = np.sort(rays.reshape(size, size, -1))  # misses last
    step = np.nan_to_num(np.diff(rays), nan=0.0)
    near = np.arange(_RAYS**2) <= step.argmax(axis=-1)[..., np.newaxis]
    near |= step.max(axis=-1, keepdims=True) < _APART_BINS * acquisition.bin_length_m
    met = np.isfinite(rays)
    near_m, far_m = _mean(rays, near & met), _mean(rays, ~near & met)
    count, near_count = met.sum(axis=-1), (near & met).sum(axis=-1)
    far_share = 1 - near_count / np.maximum(count, 1)
    mostly_near = far_share <= 0.5
    return Scene(
        np.where(mostly_near, near_m, far_m),
        count / _RAYS**2,
        acquisition,
        second_surface=SecondSurface(
            np.where(mostly_near, far_m, near_m), np.minimum(far_share, 1 - far_share)
        ),
    )


def _mean(values: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Mean of the chosen values along the last axis; NaN where there are none."""
    count = chosen.sum(axis=-1)
    total = np.where(chosen, values, 0.0).sum(axis=-1)
    nothing = np.full(count.shape, np.nan)
    return np.asarray(np.divide(total, count, out=nothing, where=count > 0))


def fog(size: int = 64) -> Scene:
    """The car at 50 m in fog, with a gate that opens at 5 m, so that the fog triggers first.

    Visibility is 300 m, an extinction of 0.01 per metre: e⁻¹ = 37 % of an echo is transmitted to
    the car and back. Takes `size` as `car`.
    """
    clear = car(size)
    gate = replace(clear.acquisition, n_bins=350, gate_delay_s=34e-9)
    return replace(clear, acquisition=gate, backscatter=Backscatter(0.01))


def approach(size: int = 64) -> Scene:
    """The car at 50 m, approaching at 20 m/s: 1 m in 1000 pulses at 20 kHz.

    Takes `size` as `car`.
    """
    return replace(car(size), motion=Motion(speed_m_per_s=-20.0, pulse_rate_hz=20e3))


def worn(size: int = 64) -> Scene:
    """The car at 50 m through a worn instrument, with timing jitter, hot and dead pixels.

    Jitter of 1.5 ns; 2 % of the pixels, at random, are hot, with 10⁷ to 10⁹ dark counts per second,
    and 2 % are dead. Takes `size` as `car`.
    """
    new = car(size)
    drawn = np.random.default_rng(0).uniform(size=new.range_m.shape)
    hot, dead = drawn < 0.02, drawn > 0.98
    faulty = FaultyPixels(np.where(hot, 10 ** (7 + 2 * np.minimum(drawn / 0.02, 1.0)), 0.0), dead)
    return replace(new, faulty_pixels=faulty, jitter=Jitter(1.5e-9))


# Of the field capture: ranges in metres, and places as shares of the image from its top left.
_WALL_M, _GROUND_M, _NET_M = 33.0, 22.0, 26.0
_SKYLINE, _FOOT = 0.25, 0.8
_NET_ROWS, _NET_COLS = (0.4, 0.75), (0.1, 0.6)
_CORD_EVERY, _NET_SHARE = 8, 0.4


def field_capture(size: int = 64) -> Scene:
    """Simulated field scene: a net before a wall, sky, hot pixels, uneven background.

    It has typical features of outdoor captures and a known truth. Above the skyline no pixel has a
    target; below the wall is ground. Every eighth row and column of the net is a cord that fills
    the pixel; elsewhere its threads fill 40 % of it, and two echoes return. Dark panels hang on the
    wall. The sky is the brightest background, the left half of the rest lies in shadow. One pixel
    in a hundred is hot, with 10⁷ to 10⁹ dark counts per second, and one in two hundred is dead.

    The gate is 100 to 300 ns (15 to 45 m) in 1 ns bins.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    pixel_angle_rad = _pixel_angle_rad(0.128, size)
    place = (np.arange(size) + 0.5) / size
    row, col = np.meshgrid(place, place, indexing="ij")
    is_sky, is_ground = row < _SKYLINE, row > _FOOT
    down = (row - _FOOT) / (1 - _FOOT)
    behind_m = np.where(is_ground, _WALL_M + (_GROUND_M - _WALL_M) * down, _WALL_M)
    is_net = _is_between(row, *_NET_ROWS) & _is_between(col, *_NET_COLS)
    has_cord = np.arange(size) % _CORD_EVERY == 0
    is_cord = is_net & np.logical_or.outer(has_cord, has_cord)
    is_panel = _is_between(row, 0.4, 0.6) & _is_between(col, 0.7, 0.9)
    drawn = np.random.default_rng(0).uniform(size=behind_m.shape)
    hot_hz = np.where(drawn < 0.01, 10 ** (7 + 2 * np.minimum(drawn / 0.01, 1.0)), 0.0)
    return Scene(
        np.where(is_sky, np.nan, np.where(is_cord, _NET_M, behind_m)),
        np.where(is_panel, 0.4, 1.0),
        Acquisition(200, 1e-9, 100e-9, n_pulses=1000, pixel_angle_rad=pixel_angle_rad),
        second_surface=SecondSurface(
            np.where(is_net & ~is_cord, _NET_M, np.nan), np.full(behind_m.shape, _NET_SHARE)
        ),
        ambient=np.where(is_sky, 1.6, np.where(col < 0.5, 0.5, 1.2)),
        faulty_pixels=FaultyPixels(hot_hz, drawn > 0.995),
    )


def _is_between(place: Floats, low: float, high: float) -> NDArray[np.bool_]:
    return (place > low) & (place < high)


scenes: dict[str, Callable[..., Scene]] = {
    "car": car,
    "building": building,
    "staircase": staircase,
    "uniform": uniform,
    "wall": wall,
    "piecewise": piecewise,
    "edges": edges,
    "net": net,
    "fog": fog,
    "approach": approach,
    "worn": worn,
    "field": field_capture,
}
"""Built-in scenes by name; the first line of each docstring describes the scene."""
