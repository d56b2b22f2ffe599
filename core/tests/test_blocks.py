"""Tests of the layout of cubes for kernels."""

from __future__ import annotations

import numpy as np
import pytest

from core.kernels.blocks import LANES, lane_rows, lane_spread, pixel_sums, to_blocks

DTYPES = [np.uint8, np.uint16, np.uint32]


def random_cube(n_pixels: int, n_bins: int, dtype: type = np.uint16) -> np.ndarray:
    return np.random.default_rng(n_pixels).integers(0, 200, (1, n_pixels, n_bins)).astype(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n_pixels", [1, LANES - 1, LANES, LANES + 1, 3 * LANES])
@pytest.mark.parametrize("n_bins", [1, 2, 17])
def test_blocks_hold_the_cube_and_zeros(n_pixels: int, n_bins: int, dtype: type) -> None:
    cube = random_cube(n_pixels, n_bins, dtype)
    blocks = to_blocks(cube)
    assert blocks.counts.dtype == np.uint16  # all of these counts fit
    assert blocks.n_pixels == n_pixels
    pixels = blocks.counts.transpose(0, 2, 1).reshape(-1, n_bins)
    np.testing.assert_array_equal(pixels[:n_pixels], cube[0])
    assert (pixels[n_pixels:] == 0).all()
    assert len(pixels) < n_pixels + LANES
    np.testing.assert_array_equal(blocks.largest.ravel()[:n_pixels], cube[0].max(axis=1))


def test_blocks_of_a_view_are_those_of_its_copy() -> None:
    view = random_cube(70, 6).reshape(7, 10, 6)[::2, ::-1, ::2]
    np.testing.assert_array_equal(to_blocks(view).counts, to_blocks(view.copy()).counts)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sums_of_pixels_do_not_overflow(dtype: type) -> None:
    cube = np.full((2, 3, 5), np.iinfo(dtype).max, dtype)
    assert (pixel_sums(cube) == 5 * int(np.iinfo(dtype).max)).all()
    assert cube.flags.writeable


def test_sums_of_a_view_are_those_of_its_copy() -> None:
    view = random_cube(70, 6).reshape(7, 10, 6)[::2, ::-1, ::2]
    assert pixel_sums(view).shape == view.shape[:2]
    np.testing.assert_array_equal(pixel_sums(view), view.sum(axis=2))
    np.testing.assert_array_equal(pixel_sums(view), pixel_sums(view.copy()))


def test_a_cube_may_be_kept_from_being_written() -> None:
    cube = random_cube(LANES, 6)
    to_blocks(cube)
    assert cube.flags.writeable  # it still may be, if it was
    cube.setflags(write=False)
    np.testing.assert_array_equal(to_blocks(cube).counts[0].T, cube[0])


@pytest.mark.parametrize("dtype", DTYPES)
def test_sigma_is_the_standard_deviation_over_the_gate(dtype: type) -> None:
    cube = random_cube(2 * LANES, 50, dtype)
    sigma = to_blocks(cube).sigma.ravel()
    # Fifty squares summed about another point than the mean: a few hundred roundings.
    np.testing.assert_allclose(sigma, cube[0].std(axis=1), rtol=1e-13)


@pytest.mark.parametrize("n_bins", [1, 2, 20, 50])
def test_sigma_may_look_at_the_first_bins_alone(n_bins: int) -> None:
    cube = random_cube(LANES, 50)
    sigma = lane_spread(to_blocks(cube).counts, n_bins)[1][0]
    np.testing.assert_allclose(sigma, cube[0, :, :n_bins].std(axis=1), rtol=1e-13, atol=1e-13)


def test_sigma_over_no_bins_is_zero() -> None:
    assert not np.any(lane_spread(to_blocks(random_cube(3, 5)).counts, 0))


@pytest.mark.parametrize("count", [0, 1, 3, 65_535, 65_536, 2**32 - 1])
def test_a_constant_histogram_has_no_deviation_at_all(count: int) -> None:
    assert (to_blocks(np.full((2, 3, 49), count, np.uint32)).sigma == 0).all()


def test_sigma_of_the_largest_counts_does_not_overflow() -> None:
    one_hot = np.zeros((1, 1, 1000), np.uint32)
    one_hot[0, 0, 500] = 2**32 - 1
    assert to_blocks(one_hot).sigma[0, 0] == pytest.approx(one_hot.std(), rel=1e-12)
    assert to_blocks(one_hot).largest[0, 0] == 2**32 - 1


@pytest.mark.parametrize("n_rows", [1, 10])
def test_scratch_lies_on_a_cache_line(n_rows: int) -> None:
    for _ in range(20):  # wherever memory happens to be handed out
        row = lane_rows(n_rows)
        assert row.dtype == np.float32
        assert row.shape == (n_rows * LANES,)
        assert row.ctypes.data % 64 == 0
