"""Draw the built-in car: a hatchback seen from its front quarter, as range images.

``python assets/make_car.py`` writes ``car.npz`` beside this file, the one that ``core.scene``
loads.

The car is drawn as on an engineer's sheet: each part is the rounded solid that fits a side view, a
plan and a front view at once, and rays are marched through the parts' signed distance. Lengths are
in metres; x points ahead of the car, y to its left, z up, and the origin lies on the ground under
its middle. The car is symmetric, so plans and front views are drawn for y >= 0 only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Outline = tuple[tuple[float, ...], tuple[float, ...]]

FIELD_OF_VIEW_RAD = 0.0896  # 4.55 m at the car, so that it fills four fifths of the width
DISTANCE_M = 50.2  # along the ground, from the sensor to the middle of the car
SENSOR_HEIGHT_M = 8.0  # a second-floor window: bonnet, roof and ground all show
AIM_HEIGHT_M = 0.55  # where the middle of the image meets the car's middle
HEADING_RAD = np.radians(38.0)  # between the car's heading and the direction to the sensor
PAVEMENT_M = (48.7, 52.3)  # slant ranges between which there is ground
CLOSEST_M, FARTHEST_M = 46.0, 55.0  # no part of the car lies outside these ranges
TOUCH_M = 1e-4
MAX_STEPS = 500

# Outlines are two rows of coordinates. They run clockwise, the solid to their right, and stay open
# where another view closes the solid.
BODY_SIDE: Outline = (
    (2.02, -2.00, -2.14, -2.14, -2.02, 0.70, 1.70, 2.06, 2.14, 2.14, 2.02),
    (0.20, 0.22, 0.40, 0.66, 1.02, 1.00, 0.83, 0.68, 0.50, 0.34, 0.20),
)
BODY_PLAN: Outline = (
    (-2.14, -1.80, 0.00, 1.50, 1.95, 2.14, 2.16),
    (0.70, 0.87, 0.90, 0.87, 0.70, 0.40, 0.00),
)
BODY_FRONT: Outline = ((0.84, 0.90, 0.84), (1.00, 0.55, 0.20))
CABIN_SIDE: Outline = (
    (1.00, -2.00, -2.08, -1.62, -0.50, 0.10, 1.05, 1.00),
    (0.80, 0.80, 0.90, 1.36, 1.47, 1.43, 0.90, 0.80),
)
CABIN_PLAN: Outline = ((-2.20, -1.20, 0.20, 1.20), (0.80, 0.88, 0.88, 0.78))
CABIN_FRONT: Outline = ((0.00, 0.40, 0.62, 0.86), (1.48, 1.46, 1.40, 0.95))
WINDSCREEN_FRONT: Outline = ((0.00, 0.50, 0.70, 0.00), (1.37, 1.36, 1.02, 1.02))
FRONT_WINDOW_SIDE: Outline = ((0.60, -0.30, -0.30, 0.02, 0.60), (1.02, 1.00, 1.36, 1.36, 1.02))
REAR_WINDOW_SIDE: Outline = (
    (-0.44, -1.25, -1.60, -1.44, -0.44, -0.44),
    (1.00, 1.00, 1.12, 1.32, 1.37, 1.00),
)
GRILLE_SIDE: Outline = ((2.30, 2.00, 2.00, 2.30), (0.58, 0.58, 0.68, 0.68))
GRILLE_FRONT: Outline = ((0.00, 0.36, 0.34), (0.70, 0.68, 0.58))
INTAKE_SIDE: Outline = ((2.30, 1.95, 1.95, 2.30), (0.28, 0.28, 0.45, 0.45))
INTAKE_FRONT: Outline = ((0.00, 0.55, 0.42), (0.50, 0.45, 0.28))
LAMP_SIDE: Outline = ((2.30, 1.85, 1.85, 2.30), (0.58, 0.62, 0.75, 0.75))
LAMP_FRONT: Outline = ((0.46, 0.46, 0.90), (0.58, 0.75, 0.78))
ANY: Outline = ((), ())
GLASS_INSET_M = 0.4  # light passes the glass and returns from the seats
AXLES_X_M = (1.32, -1.30)
TYRE_RADIUS_M = 0.34


def edge_distances(u: Floats, v: Floats, outline: Outline) -> Floats:
    """Signed distances of points (n,) to the lines through an outline's edges, shape (edge, n)."""
    edges = np.array(outline)[..., np.newaxis]
    (du, dv), (u0, v0) = np.diff(edges, axis=1), edges[:, :-1]
    return np.asarray((du * (v - v0) - dv * (u - u0)) / np.hypot(du, dv))


def fitted(
    point: Floats,
    *,
    side: Outline = ANY,
    plan: Outline = ANY,
    front: Outline = ANY,
    rounding_m: float = 0.015,
) -> Floats:
    """Signed distance to the convex solid that fits the drawn views.

    Parameters
    ----------
    point : ndarray, shape (3, n)
        Positions in metres.
    side, plan, front : Outline
        In (x, z), (x, y) and (y, z); left out, that view does not bound the solid.
    rounding_m : float
        Radius scale of the edges: distances are joined by a soft maximum, whose slope never
        exceeds 1, so that a ray marched by it cannot step through a surface.

    Returns
    -------
    ndarray, shape (n,)
        In metres, negative inside.
    """
    x, y, z = point[0], np.abs(point[1]), point[2]
    views = ((x, z, side), (x, y, plan), (y, z, front))
    distances = np.concatenate([edge_distances(*view) for view in views])
    return rounding_m * np.asarray(np.logaddexp.reduce(distances / rounding_m, axis=0))


def disc(point: Floats, axle_x_m: float, radius_m: float, inner_m: float, outer_m: float) -> Floats:
    """Signed distance of points (3, n) to a cylinder on an axle, `inner_m` <= y <= `outer_m`."""
    x, y, z = point[0], np.abs(point[1]), point[2]
    radial = np.hypot(x - axle_x_m, z - TYRE_RADIUS_M) - radius_m
    return np.asarray(np.maximum(radial, np.maximum(y - outer_m, inner_m - y)))


def body(point: Floats) -> Floats:
    """Signed distance of points (3, n) to the body up to the windows, less grille and lamps."""
    cuts = (
        fitted(point, side=GRILLE_SIDE, front=GRILLE_FRONT),
        fitted(point, side=INTAKE_SIDE, front=INTAKE_FRONT),
        fitted(point, side=LAMP_SIDE, front=LAMP_FRONT),
        *(disc(point, x, TYRE_RADIUS_M + 0.11, 0.3, 2.0) for x in AXLES_X_M),
    )
    solid = fitted(point, side=BODY_SIDE, plan=BODY_PLAN, front=BODY_FRONT, rounding_m=0.025)
    return np.asarray(np.maximum(solid, -np.min(cuts, axis=0)))


def cabin(point: Floats) -> Floats:
    """Signed distance of points (3, n) to the roof, the pillars and what glass lets through."""
    solid = fitted(point, side=CABIN_SIDE, plan=CABIN_PLAN, front=CABIN_FRONT, rounding_m=0.02)
    beside = 0.2 - point[1]  # only the side seen: nothing shines through the car from behind
    glass = (
        np.maximum(fitted(point, side=FRONT_WINDOW_SIDE), beside),
        np.maximum(fitted(point, side=REAR_WINDOW_SIDE), beside),
        np.maximum(fitted(point, front=WINDSCREEN_FRONT), 0.1 - point[0]),
    )
    pillars = np.maximum(solid, -np.min(glass, axis=0))
    return np.asarray(np.minimum(pillars, solid + GLASS_INSET_M))


def wheel(point: Floats, axle_x_m: float) -> Floats:
    """Signed distance of points (3, n) to a wheel: tyre, recessed rim, hub."""
    tyre = disc(point, axle_x_m, TYRE_RADIUS_M, 0.62, 0.88)
    rim = disc(point, axle_x_m, 0.24, 0.70, 2.0)
    hub = disc(point, axle_x_m, 0.07, 0.62, 0.84)
    return np.asarray(np.minimum(np.maximum(tyre, -rim), hub))


def mirror(point: Floats) -> Floats:
    """Signed distance of points (3, n) to the door mirrors."""
    centre, radii = np.array([[0.72], [1.0], [1.0]]), np.array([[0.08], [0.13], [0.09]])
    half = np.stack([point[0], np.abs(point[1]), point[2]])
    return np.asarray((np.linalg.norm((half - centre) / radii, axis=0) - 1.0) * radii.min())


def car(point: Floats) -> Floats:
    """Signed distance in metres of points (3, n) to the whole car."""
    parts = (body(point), cabin(point), mirror(point), *(wheel(point, x) for x in AXLES_X_M))
    return np.asarray(np.min(parts, axis=0))


def lines_of_sight(size: int) -> tuple[Floats, Floats]:
    """Sensor position (3, 1) and unit directions (3, size * size), row by row, in car axes."""
    angle = (np.arange(size) - (size - 1) / 2) * FIELD_OF_VIEW_RAD / size
    pitch = np.arctan2(AIM_HEIGHT_M - SENSOR_HEIGHT_M, DISTANCE_M)
    right, up = (grid.ravel() for grid in np.meshgrid(angle, -angle))
    ahead = np.cos(pitch) * np.cos(up) * np.cos(right) - np.sin(pitch) * np.sin(up)
    rise = np.sin(pitch) * np.cos(up) * np.cos(right) + np.cos(pitch) * np.sin(up)
    across = np.cos(up) * np.sin(right)
    cos, sin = np.cos(HEADING_RAD), np.sin(HEADING_RAD)
    sensor = np.array([[DISTANCE_M * cos], [DISTANCE_M * sin], [SENSOR_HEIGHT_M]])
    return sensor, np.stack([-cos * ahead - sin * across, cos * across - sin * ahead, rise])


def march(sensor: Floats, direction: Floats) -> Floats:
    """Range in metres (n,) at which each ray (3, n) meets the car; infinity where it does not."""
    range_m = np.full(direction.shape[1], CLOSEST_M)
    hit = np.zeros(direction.shape[1], bool)
    active = np.arange(direction.shape[1])
    for _ in range(MAX_STEPS):
        step = car(sensor + range_m[active] * direction[:, active])
        range_m[active] += step
        hit[active] = step < TOUCH_M
        active = active[~hit[active] & (range_m[active] < FARTHEST_M)]
    return np.where(hit, range_m, np.inf)


def range_image(size: int) -> NDArray[np.float32]:
    """Slant range in metres, shape (size, size); NaN where there is neither car nor pavement."""
    sensor, direction = lines_of_sight(size)
    ground_m = -SENSOR_HEIGHT_M / direction[2]
    paved = (PAVEMENT_M[0] <= ground_m) & (ground_m <= PAVEMENT_M[1])
    range_m = np.minimum(march(sensor, direction), np.where(paved, ground_m, np.inf))
    # To 1/1024 m: the last byte of every float32 is then zero, and the file packs smaller.
    rounded = np.round(np.where(np.isfinite(range_m), range_m, np.nan) * 1024) / 1024
    return rounded.reshape(size, size).astype(np.float32)


def main() -> None:
    """Write ``car.npz``: for each size the range image and the angle between its pixels."""
    np.savez_compressed(
        Path(__file__).with_name("car.npz"),
        range_m_64=range_image(64),
        pixel_angle_rad_64=np.array(FIELD_OF_VIEW_RAD / 64),
        range_m_256=range_image(256),
        pixel_angle_rad_256=np.array(FIELD_OF_VIEW_RAD / 256),
    )


if __name__ == "__main__":
    main()
