"""What the instrument looks at: a range for every pixel, and the built-in scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats
from core.checks import require
from core.effects import Backscatter, FaultyPixels, Jitter, Motion, SecondSurface


@dataclass(frozen=True, eq=False)
class Scene:
    """Surfaces seen by each pixel, and the `PARTS` that some scenes have besides.

    Parameters
    ----------
    range_m : ndarray, shape (row, col)
        Range of the surface in metres; NaN where the pixel sees no target.
    reflectivity : ndarray, shape (row, col), optional
        Factor on the signal, non-negative; None means 1 everywhere.
    acquisition : Acquisition
        The instrument setting that suits this scene (`simulate` takes its own).
    second_surface, backscatter, faulty_pixels, motion, jitter : optional
        Parts of `core.effects`; one that is None costs nothing.

    Raises
    ------
    ValueError
        If the shapes differ, or a reflectivity is negative.
    """

    range_m: Floats
    reflectivity: Floats | None = None
    acquisition: Acquisition = field(default_factory=Acquisition)
    second_surface: SecondSurface | None = None
    backscatter: Backscatter | None = None
    faulty_pixels: FaultyPixels | None = None
    motion: Motion | None = None
    jitter: Jitter | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.range_m)
        require("range_m", f"shape {shape}", len(shape) == 2 and min(shape) > 0, "(row, col)")
        infinite = int(np.count_nonzero(np.isinf(self.range_m)))
        require("range_m", f"{infinite} infinite", infinite == 0, "metres, or NaN for no target")
        if self.reflectivity is not None:
            require(
                "reflectivity",
                f"shape {np.shape(self.reflectivity)}",
                np.shape(self.reflectivity) == shape,
                f"shape {shape}, that of range_m",
            )
            low, high = float(np.min(self.reflectivity)), float(np.max(self.reflectivity))
            require("reflectivity", (low, high), 0 <= low <= high < np.inf, "finite factors >= 0")
        for name in ("second_surface", "faulty_pixels"):
            part = getattr(self, name)
            fits = part is None or part.shape == shape
            require(name, f"shape {part and part.shape}", fits, f"shape {shape}, that of range_m")


PARTS = {
    "reflectivity": "reflectivity",
    "second_surface": "second surface",
    "backscatter": "backscatter of fog",
    "faulty_pixels": "hot and dead pixels",
    "motion": "motion during the pulses",
    "jitter": "timing jitter",
}
"""What a scene may have besides ranges, a pulse and uniform background: its fields, in words."""


def parts_of(scene: Scene) -> tuple[str, ...]:
    """Those of `PARTS` that a scene has."""
    return tuple(part for part in PARTS if getattr(scene, part) is not None)


def without(scene: Scene, part: str) -> Scene:
    """The same scene with one of `PARTS` absent.

    Raises
    ------
    ValueError
        If there is no part of that name.
    """
    require("part", part, part in PARTS, " or ".join(map(repr, PARTS)))
    absent: dict[str, Any] = {part: None}
    return replace(scene, **absent)


def _near_gate(pixel_angle_rad: float) -> Acquisition:
    """The paper's gate for targets at 50 m."""
    return Acquisition(
        n_bins=100,
        bin_width_s=1e-9,
        gate_delay_s=280e-9,
        n_pulses=1000,
        pixel_angle_rad=pixel_angle_rad,
    )


def _pixel_angle_rad(field_of_view_rad: float, size: int) -> float:
    """Share of one of `size` pixels in the field of view."""
    require("size", size, size >= 8, "8 or more rows and columns")
    return field_of_view_rad / size


def car(size: int = 64) -> Scene:
    """A car at 50 m, seen from its front quarter and a little above.

    Parameters
    ----------
    size : int
        Rows and columns, 64 or 256, over the same field of view of 90 mrad.

    Returns
    -------
    Scene
        Drawn by ``assets/make_car.py``; the gate is the paper's, 280 to 380 ns (42 to 57 m).

    Raises
    ------
    ValueError
        If there is no image of that size.
    """
    require("size", size, size in (64, 256), "64 or 256")
    with resources.files("assets").joinpath("car.npz").open("rb") as file, np.load(file) as stored:
        range_m = stored[f"range_m_{size}"].astype(float)
        pixel_angle_rad = float(stored[f"pixel_angle_rad_{size}"])
    return Scene(range_m, acquisition=_near_gate(pixel_angle_rad))


def staircase(size: int = 64) -> Scene:
    """Flat steps through the whole gate, one in each of 8 x 8 tiles.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.

    Returns
    -------
    Scene
        The steps run as one reads, the nearest at the top left. Their echoes begin in bins 1 to 94
        of 100, so that the rise of the first and the tail of the last lie within the gate.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    acquisition = _near_gate(_pixel_angle_rad(0.128, size))
    tile = np.arange(size) * 8 // size
    onset_bin = np.linspace(1.0, 94.0, 64)[8 * tile[:, np.newaxis] + tile]
    return Scene(acquisition.bin_to_range_m(onset_bin), acquisition=acquisition)


def uniform(size: int = 64, seed: int = 0, first_bin: float = 20, last_bin: float = 94) -> Scene:
    """Random depths, all equally likely and independent of their neighbours.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over a field of view of 128 mrad.
    seed : int
        The same seed gives the same depths.
    first_bin, last_bin : float
        Fractional bins, of the gate's 100, between which the echoes begin.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        If `size` is below 8, or the bins are not in order within the gate.
    """
    acquisition = _near_gate(_pixel_angle_rad(0.128, size))
    require(
        "first_bin, last_bin",
        (first_bin, last_bin),
        0 <= first_bin < last_bin <= acquisition.n_bins,
        f"two positions in rising order, from 0 to {acquisition.n_bins}",
    )
    onset_bin = np.random.default_rng(seed).uniform(first_bin, last_bin, (size, size))
    return Scene(acquisition.bin_to_range_m(onset_bin), acquisition=acquisition)


# The building's axes, in metres: x along its right front and y along its left front, both away
# from the corner nearest to the sensor, and z up from the ground.
_Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest, highest corner

_TURN_RAD = np.radians(35.0)  # of the right front, out of the image's plane
_SENSOR_RIGHT_M, _SENSOR_BACK_M, _SENSOR_UP_M = 3.0, 831.5, 15.6  # from the nearest corner
_SENSOR_M = np.array(
    [
        _SENSOR_RIGHT_M * np.cos(_TURN_RAD) - _SENSOR_BACK_M * np.sin(_TURN_RAD),
        -_SENSOR_RIGHT_M * np.sin(_TURN_RAD) - _SENSOR_BACK_M * np.cos(_TURN_RAD),
        _SENSOR_UP_M,
    ]
)
_STOREY_M, _BAY_M = 3.2, 3.4
_WINDOW_DEPTH_M = 1.0  # light passes the glass and returns from the room

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

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more, over the same field of view of 35 mrad (30 m at the corner).

    Returns
    -------
    Scene
        The gate is 5470 to 5804 ns (820 to 870 m) in 1 ns bins. It is ours, the houses with 10 m
        to spare on both sides: the paper does not print the one of its field trial.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    pixel_angle_rad = _pixel_angle_rad(0.0352, size)
    acquisition = Acquisition(
        n_bins=334,
        bin_width_s=1e-9,
        gate_delay_s=5470e-9,
        n_pulses=1000,
        pixel_angle_rad=pixel_angle_rad,
    )
    direction = _building_rays(size, pixel_angle_rad)
    wall_m = [_wall_range_m(direction, box) for box in _HOUSES]
    trim_m = [_box_range_m(direction, box) for box in _TRIMS]
    range_m = np.min([*wall_m, *trim_m], axis=0)
    return Scene(np.where(np.isfinite(range_m), range_m, np.nan), acquisition=acquisition)


def _building_rays(size: int, pixel_angle_rad: float) -> Floats:
    """Unit direction of each pixel in the building's axes, shape (3, row, col)."""
    angle = (np.arange(size) - (size - 1) / 2) * pixel_angle_rad
    right, up = np.meshgrid(angle, -angle)
    across, ahead = np.cos(up) * np.sin(right), np.cos(up) * np.cos(right)
    cos, sin = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    return np.stack([cos * across + sin * ahead, cos * ahead - sin * across, np.sin(up)])


def _box_range_m(direction: Floats, box: _Box) -> Floats:
    """Range at which rays (3, row, col) enter a box, shape (row, col); infinity where they miss."""
    corners = np.array(box) - _SENSOR_M
    with np.errstate(divide="ignore"):  # a level ray never meets floor or roof: infinity is right
        crossing_m = corners[:, :, np.newaxis, np.newaxis] / direction
    enter_m, leave_m = crossing_m.min(axis=0).max(axis=0), crossing_m.max(axis=0).min(axis=0)
    return np.where(enter_m < leave_m, enter_m, np.inf)


def _wall_range_m(direction: Floats, box: _Box) -> Floats:
    """Like `_box_range_m`, with rows of recessed windows in the two fronts."""
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


_RAYS = 4  # across and down a pixel, which sees what all of them meet
_APART_BINS = 2.0  # surfaces that are nearer to each other return one echo


def edges(size: int = 64) -> Scene:
    """The corner house, each pixel seeing its whole area: at edges two surfaces return its echo.

    Parameters
    ----------
    size : int
        Rows and columns, 8 or more; view and gate are the building's.

    Returns
    -------
    Scene
        Of 16 rays in each pixel. Its range is that of the surface which most of them meet, its
        reflectivity the share of them that meet any.

    Raises
    ------
    ValueError
        If `size` is below 8.
    """
    acquisition = building(size).acquisition
    rays = building(_RAYS * size).range_m.reshape(size, _RAYS, size, _RAYS).swapaxes(1, 2)
    rays = np.sort(rays.reshape(size, size, -1))  # those that meet nothing, last
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
    """Mean of the chosen along the last axis; NaN where there are none."""
    count = chosen.sum(axis=-1)
    total = np.where(chosen, values, 0.0).sum(axis=-1)
    nothing = np.full(count.shape, np.nan)
    return np.asarray(np.divide(total, count, out=nothing, where=count > 0))


def fog(size: int = 64) -> Scene:
    """The car at 50 m in fog, seen through a gate that opens at 5 m: the fog answers first.

    Parameters
    ----------
    size : int
        Rows and columns, 64 or 256.

    Returns
    -------
    Scene
        Visibility is 300 m, an extinction of 0.01 per metre: what passes to the car and back is
        e⁻¹ = 37 %.

    Raises
    ------
    ValueError
        If there is no image of that size.
    """
    clear = car(size)
    gate = replace(clear.acquisition, n_bins=350, gate_delay_s=34e-9)
    return Scene(clear.range_m, acquisition=gate, backscatter=Backscatter(0.01))


def approach(size: int = 64) -> Scene:
    """The car at 50 m, approached at 20 m/s: at 20,000 pulses a second it comes 1 m nearer.

    Parameters
    ----------
    size : int
        Rows and columns, 64 or 256.

    Returns
    -------
    Scene
        Its ranges are those at half the time that the pulses take.

    Raises
    ------
    ValueError
        If there is no image of that size.
    """
    still = car(size)
    return replace(still, motion=Motion(speed_m_per_s=-20.0, pulse_rate_hz=20e3))


def worn(size: int = 64) -> Scene:
    """The car at 50 m through a worn instrument: a clock that jitters, hot pixels and dead ones.

    Parameters
    ----------
    size : int
        Rows and columns, 64 or 256.

    Returns
    -------
    Scene
        Jitter of 1.5 ns; 2 % of the pixels, drawn at random, are hot, with 10⁷ to 10⁹ dark counts
        a second, and 2 % are dead.

    Raises
    ------
    ValueError
        If there is no image of that size.
    """
    new = car(size)
    drawn = np.random.default_rng(0).uniform(size=new.range_m.shape)
    hot, dead = drawn < 0.02, drawn > 0.98
    faulty = FaultyPixels(np.where(hot, 10 ** (7 + 2 * np.minimum(drawn / 0.02, 1.0)), 0.0), dead)
    return replace(new, faulty_pixels=faulty, jitter=Jitter(1.5e-9))


scenes: dict[str, Callable[..., Scene]] = {
    "car": car,
    "building": building,
    "staircase": staircase,
    "uniform": uniform,
    "edges": edges,
    "fog": fog,
    "approach": approach,
    "worn": worn,
}
"""Built-in scenes by name; the first line of a builder's docstring describes its scene."""
