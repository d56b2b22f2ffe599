"""Tests of sums over neighbourhoods against loops."""

from __future__ import annotations

import numpy as np
import pytest

from core.inference.neighbours import box_sum, neighbours, pooled, pooled_at, weighted_median

RNG = np.random.default_rng(0)
CUBE = RNG.integers(0, 200, (5, 7, 3))


def summed(cube: np.ndarray, row: int, col: int, half: int, beyond: str) -> np.ndarray:
    """The neighbourhood of one pixel, pixel by pixel."""
    rows, cols = cube.shape[:2]
    total = np.zeros(cube.shape[2:], object)
    for i in range(row - half, row + half + 1):
        for j in range(col - half, col + half + 1):
            if beyond == "edge":
                total = total + cube[min(max(i, 0), rows - 1), min(max(j, 0), cols - 1)]
            elif 0 <= i < rows and 0 <= j < cols:
                total = total + cube[i, j]
    return total.astype(float)


@pytest.mark.parametrize("window_size", [1, 3, 5, 11])
@pytest.mark.parametrize("beyond", ["edge", "constant"])
def test_box_sum_is_the_explicit_sum(window_size: int, beyond: str) -> None:
    found = box_sum(CUBE, window_size, beyond)  # type: ignore[arg-type]
    for row in range(5):
        for col in range(7):
            expected = summed(CUBE, row, col, window_size // 2, beyond)
            np.testing.assert_array_equal(found[row, col], expected)


def test_box_sum_leaves_its_argument_alone() -> None:
    before = CUBE.copy()
    for window_size in (1, 3):
        box_sum(CUBE, window_size, "edge")[:] = 0
    np.testing.assert_array_equal(CUBE, before)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
def test_pooled_counts_are_the_explicit_sum_however_narrow(dtype: type) -> None:
    cube = np.full((4, 4, 2), np.iinfo(dtype).max, dtype)
    cube[1, 2] = [0, 7]
    found = pooled(cube, 3)
    rows, cols, _ = cube.shape
    for window_size in (1, 3, 5):
        whole = pooled(cube, window_size)
        for row, col in ((0, 0), (rows - 1, 0), (rows // 2, cols // 2)):
            np.testing.assert_array_equal(pooled_at(cube, row, col, window_size), whole[row, col])
    for row in range(4):
        for col in range(4):
            np.testing.assert_array_equal(
                found[row, col].astype(float), summed(cube.astype(object), row, col, 1, "edge")
            )


def test_neighbours_are_the_eight_around() -> None:
    image = np.arange(12.0).reshape(3, 4)
    found = neighbours(image, 1, -1.0)
    assert found.shape == (8, 3, 4)
    assert found[:, 1, 1].tolist() == [0, 1, 2, 4, 6, 8, 9, 10]
    assert found[:, 0, 3].tolist() == [-1, -1, -1, 2, -1, 6, 7, -1]


def test_weighted_median_is_that_of_repeated_values() -> None:
    values = RNG.normal(size=(7, 50))
    weights = RNG.integers(0, 4, (7, 50))
    weights[0] = 1
    values[1], weights[1] = np.nan, 0
    found = weighted_median(values, weights.astype(float))
    for i in range(50):
        repeated = np.sort(np.repeat(values[:, i], weights[:, i]))
        assert found[i] == repeated[(repeated.size - 1) // 2]


def test_weighted_median_of_nothing_is_nan() -> None:
    assert np.isnan(weighted_median(np.full((8, 2), np.nan), np.zeros((8, 2)))).all()
