"""Tests of lines of sight and points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.geometry import Box, distance_m, points_m, sight_lines

ANGLE = 2e-3


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2)


@pytest.mark.parametrize("shape", [(1, 1), (21, 33), (64, 64), (256, 256)])
def test_lines_of_sight_are_unit_vectors_around_the_optical_axis(shape: tuple[int, int]) -> None:
    lines = sight_lines(shape, ANGLE)
    assert lines.shape == (*shape, 3)
    np.testing.assert_allclose(np.linalg.norm(lines, axis=-1), 1)
    mean = lines.mean(axis=(0, 1))
    np.testing.assert_allclose(mean / np.linalg.norm(mean), [0, 1, 0], atol=1e-12)


def test_neighbours_at_the_centre_are_one_pixel_angle_apart() -> None:
    lines = sight_lines((21, 33), ANGLE)
    centre = lines[10, 16]
    for neighbour in (lines[9, 16], lines[11, 16], lines[10, 15], lines[10, 17]):
        assert angle_between(centre, neighbour) == pytest.approx(ANGLE, rel=1e-9)
    # The pinhole's projection onto a flat detector narrows the angle away from the axis.
    assert angle_between(lines[10, 0], lines[10, 1]) < ANGLE


def test_coordinates_are_right_handed() -> None:
    lines = sight_lines((21, 33), ANGLE)
    np.testing.assert_array_equal(lines[10, 16], [0, 1, 0])
    assert np.all(np.diff(lines[..., 0], axis=1) > 0)  # the last column is on the right
    assert np.all(np.diff(lines[..., 2], axis=0) < 0)  # row 0 is the top
    right, away, up = lines[10, 17] - lines[10, 16], lines[10, 16], lines[9, 16] - lines[10, 16]
    assert np.dot(np.cross(right, away), up) > 0  # right-handed


def test_each_point_lies_at_its_range_on_its_line_of_sight() -> None:
    row, col = np.mgrid[0:21, 0:33]
    range_m = 50 + 0.02 * row - 0.03 * col
    range_m[3, 5], range_m[20, 32] = np.nan, np.inf
    points = points_m(range_m, ANGLE)
    assert set(zip(points.row.tolist(), points.col.tolist(), strict=True)) == {
        (r, c) for r, c in np.ndindex(range_m.shape) if (r, c) not in {(3, 5), (20, 32)}
    }
    here = points.row, points.col
    np.testing.assert_allclose(np.linalg.norm(points.xyz_m, axis=1), range_m[here], rtol=1e-12)
    lines = sight_lines(range_m.shape, ANGLE)[here]
    np.testing.assert_allclose(points.xyz_m, range_m[here][:, np.newaxis] * lines, rtol=1e-12)


@given(st.integers(1, 40), st.integers(1, 40), st.floats(1e-6, 1.5))
def test_an_image_upside_down_is_the_cloud_upside_down(rows: int, cols: int, angle: float) -> None:
    range_m = np.random.default_rng(rows * 41 + cols).uniform(1, 100, (rows, cols))
    upright = points_m(range_m, angle).xyz_m.reshape(rows, cols, 3)
    turned = points_m(range_m[::-1, ::-1], angle).xyz_m.reshape(rows, cols, 3)
    np.testing.assert_allclose(turned[::-1, ::-1] * [-1, 1, -1], upright, rtol=1e-9, atol=1e-9)


def test_pixels_without_a_range_have_no_points() -> None:
    points = points_m(np.full((2, 3), np.nan), ANGLE)
    assert points.xyz_m.shape == (0, 3)
    assert points.row.shape == points.col.shape == (0,)


@pytest.mark.parametrize("angle", [0.0, -1e-3, np.pi / 2, np.nan])
def test_an_impossible_angle_is_refused(angle: float) -> None:
    with pytest.raises(ValueError, match=r"pixel_angle_rad = .* between 0 and π/2"):
        points_m(np.ones((2, 3)), angle)


def test_ranges_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"range_m = 'shape \(3,\)'.*image \(row, col\)"):
        points_m([1.0, 2.0, 3.0], ANGLE)


def test_a_distance_follows_the_law_of_cosines_and_its_margin_the_scatter() -> None:
    rng, sigma_m = np.random.default_rng(0), np.array([0.02, 0.05])
    lines = sight_lines((9, 9), 0.1)[[2, 7], [1, 6]]
    range_m, angle_rad = np.array([5.0, 6.5]), float(angle_between(*lines))
    length_m, margin_m = distance_m(lines, range_m, sigma_m)
    near, far = range_m
    assert length_m == pytest.approx(
        np.sqrt(near**2 + far**2 - 2 * near * far * np.cos(angle_rad)), rel=1e-12
    )
    drawn_m = range_m + sigma_m * rng.standard_normal((4000, 2))
    points = drawn_m[..., np.newaxis] * lines
    scatter_m = np.linalg.norm(points[:, 1] - points[:, 0], axis=1).std()
    assert margin_m == pytest.approx(scatter_m, rel=5 / np.sqrt(2 * 4000))


def test_one_point_is_as_far_from_itself_as_its_range_is_uncertain() -> None:
    line = sight_lines((3, 3), ANGLE)[1, 1]
    assert distance_m([line, line], [7.0, 7.0], [0.3, 0.4]) == (0.0, pytest.approx(0.5))


def test_a_box_contains_the_ranges_between_its_limits_in_its_polygon() -> None:
    range_m = np.array([[1.0, 2.0, 3.0], [np.nan, 5.0, 6.0]])
    corners = ((-0.5, 0.5), (-0.5, 2.5), (1.5, 2.5), (1.5, 0.5))
    assert Box().contains(range_m).tolist() == [[True] * 3, [False, True, True]]
    for _ in range(2):  # the second time from memory
        assert range_m[Box(corners).contains(range_m)].tolist() == [2, 3, 5, 6]
    assert range_m[Box(corners, 3.0).contains(range_m)].tolist() == [3, 5, 6]
    assert range_m[Box((), 2.0, 5.0).contains(range_m)].tolist() == [2, 3, 5]
    assert str(Box(((0, 1.5), (2, 3), (4, 5)), None, 48.0)) == (
        "pixels in the polygon of corners row,col 0,1.5 2,3 4,5; ranges to 48 m"
    )
    assert (str(Box(from_m=1, to_m=2)), str(Box())) == ("ranges from 1 m to 2 m", "everything")
    with pytest.raises(ValueError, match=r"to_m = 3\.0 is not accepted: give a number above"):
        Box(from_m=3.0, to_m=3.0)
