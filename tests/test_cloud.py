"""Point clouds: their geometry, and the buffers for the browser."""

import numpy as np
import pytest

from app.model.mesh import pixel_index, point_cloud, spacing_m, view_bounds
from app.theme import palette
from app.widgets.cloud import PointCloud
from core.geometry import sight_lines

ANGLE = 2e-3


@pytest.fixture
def range_m():
    """A slanted surface with two holes, odd sizes so that one pixel looks straight ahead."""
    row, col = np.mgrid[0:21, 0:33]
    image = 50 + 0.02 * row - 0.03 * col
    image[3, 5] = np.nan
    image[20, 32] = np.inf
    return image


@pytest.fixture
def cloud(range_m):
    counts = np.arange(range_m.size, dtype=np.uint16).reshape(range_m.shape)
    rgb = np.stack([counts % 256, counts // 256, 0 * counts], axis=-1).astype(np.uint8)
    return point_cloud(range_m, ANGLE, error_m=range_m - 50, counts=counts, rgb=rgb)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_each_finite_pixel_is_a_point_at_its_range_on_its_line_of_sight(cloud, range_m):
    points, row, col = np.asarray(cloud.points), cloud["row"], cloud["col"]
    assert cloud.n_points == cloud.n_verts == np.isfinite(range_m).sum()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), cloud["range_m"], rtol=1e-12)
    lines = sight_lines(range_m.shape, ANGLE)[row, col]
    np.testing.assert_allclose(points, range_m[row, col][:, np.newaxis] * lines, rtol=1e-12)
    np.testing.assert_array_equal(pixel_index(cloud), 33 * row + col)
    np.testing.assert_array_equal(pixel_index(cloud), cloud["counts"])
    np.testing.assert_allclose(cloud["error_m"], cloud["range_m"] - 50)


def test_an_image_of_another_size_is_refused(range_m):
    with pytest.raises(ValueError, match=r"error_m has shape \(2, 2\).*\(21, 33\)"):
        point_cloud(range_m, ANGLE, error_m=np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"range_m = .shape \(3,\)"):
        point_cloud([1, 2, 3], ANGLE)


def test_spacing_is_the_distance_between_neighbours():
    wall = point_cloud(np.full((9, 9), 840.0), ANGLE)
    points = np.asarray(wall.points).reshape(9, 9, 3)
    assert spacing_m(wall) == pytest.approx(np.linalg.norm(points[4, 4] - points[4, 5]), rel=1e-4)


def test_bounds_contain_the_target_without_scattered_points(rng):
    row, col = np.mgrid[0:64, 0:64]
    truth = np.where(col < 32, 50 + 0.02 * row, 55.0)
    range_m = np.where(rng.random(truth.shape) < 0.5, rng.uniform(30, 300, truth.shape), truth)
    bounds = np.array(view_bounds(point_cloud(range_m, ANGLE)))
    exact = np.array(point_cloud(truth, ANGLE).bounds)
    assert np.all(bounds[::2] <= exact[::2] + 0.2)
    assert np.all(bounds[1::2] >= exact[1::2] - 0.2)
    assert bounds[3] - bounds[2] < 2 * (exact[3] - exact[2])


def test_bounds_contain_a_slope_before_a_wall_of_more_points(rng):
    row, col = np.mgrid[0:64, 0:64]
    truth = np.where(col < 24, 50 + 0.05 * row, 56.0)
    false = rng.random(truth.shape) < 0.005
    range_m = np.where(false, rng.uniform(30, 300, truth.shape), truth)
    cloud = point_cloud(range_m, ANGLE, confidence=np.where(false, 0.1, 0.95))
    _, _, near, far, _, _ = view_bounds(cloud)
    assert (near, far) == (pytest.approx(50, abs=0.5), pytest.approx(56, abs=0.5))


def test_bounds_of_a_target_that_fills_the_gate_contain_nearly_all(rng):
    _, _, near, far, _, _ = view_bounds(point_cloud(rng.uniform(100, 200, (64, 64)), ANGLE))
    assert (near, far) == (pytest.approx(100, abs=1.5), pytest.approx(200, abs=1.5))


def test_bounds_are_those_of_the_points_to_keep_and_have_a_volume(cloud):
    assert view_bounds(cloud, cloud["col"] < 10)[1] < view_bounds(cloud)[1]
    assert view_bounds(cloud, np.zeros(cloud.n_points, bool)) == view_bounds(cloud)
    flat = np.array(view_bounds(point_cloud(np.full((1, 1), 21e3), ANGLE)))
    assert np.all(flat[1::2] > flat[::2])


def test_a_cloud_without_points():
    cloud = point_cloud(np.full((4, 4), np.nan), ANGLE, counts=np.zeros((4, 4)))
    assert (cloud.n_points, view_bounds(cloud), spacing_m(cloud)) == (0, [], 0)
    pane = PointCloud()
    pane.draw(cloud, np.zeros((0, 3), np.uint8), scene_id="empty")
    assert pane.positions == pane.pixels == pane.wrong == b""
    assert pane.bounds == []
    wall = point_cloud(np.full((4, 4), 50.0), ANGLE)
    pane.draw(wall, np.zeros((16, 3), np.uint8), scene_id="empty")
    assert pane.bounds == view_bounds(wall)


def test_a_cloud_is_drawn_in_one_update(cloud):
    pane, updates = PointCloud(), []
    wrong = cloud["row"] == 4
    names = ["positions", "colors", "pixels", "wrong", "spacing_m", "bounds", "scene_id"]
    pane.param.watch(lambda *events: updates.append({event.name for event in events}), names)
    pane.draw(cloud, cloud["rgb"], wrong, scene_id="slope")
    assert len(updates) == 1
    positions = np.frombuffer(pane.positions, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(positions, cloud.points, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(np.frombuffer(pane.colors, "u1").reshape(-1, 3), cloud["rgb"])
    np.testing.assert_array_equal(np.frombuffer(pane.pixels, "<i4"), pixel_index(cloud))
    np.testing.assert_array_equal(np.frombuffer(pane.wrong, bool), wrong)


def test_bounds_change_with_the_scene_or_when_given(cloud, range_m):
    pane = PointCloud()
    pane.draw(cloud, cloud["rgb"], scene_id="first")
    first = pane.bounds
    farther = point_cloud(range_m + 100, ANGLE, rgb=np.zeros((*range_m.shape, 3), np.uint8))
    pane.draw(farther, farther["rgb"], scene_id="first")
    assert pane.bounds == first
    pane.draw(farther, farther["rgb"], scene_id="second")
    assert pane.bounds[2] > first[3]
    pane.draw(farther, farther["rgb"], bounds=(0, 1, 2, 3, 4, 5))
    assert pane.bounds == [0, 1, 2, 3, 4, 5]


def test_colours_and_marks_must_match_the_points(cloud):
    with pytest.raises(ValueError, match="rgb has shape"):
        PointCloud().draw(cloud, np.zeros((2, 3), np.uint8))
    with pytest.raises(ValueError, match="wrong has shape"):
        PointCloud().draw(cloud, cloud["rgb"], np.zeros(2, bool))


def test_colours_follow_the_theme():
    pane = PointCloud(dark=True)
    for dark in (True, False):
        pane.dark = dark
        assert (pane.ink, pane.paper) == (palette(dark).text, palette(dark).paper)
