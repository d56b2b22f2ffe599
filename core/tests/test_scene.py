"""Tests of the built-in scenes."""

from __future__ import annotations

import runpy
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from core.scene import Scene, building, car, piecewise, scenes, staircase, uniform, wall

ASSETS = Path(__file__).resolve().parents[2] / "assets"


def onset_bin(scene: Scene) -> np.ndarray:
    """Fractional bins at which the echoes of a scene begin, for the pixels with a target."""
    bins = scene.acquisition.range_m_to_bin(scene.range_m)
    return bins[np.isfinite(bins)]


def share_with_target(scene: Scene) -> float:
    return float(np.isfinite(scene.range_m).mean())


@pytest.mark.parametrize("name", scenes)
@pytest.mark.parametrize("size", [64, 256])
def test_echoes_lie_within_the_gate(name: str, size: int) -> None:
    scene = scenes[name](size)
    assert scene.range_m.shape == (size, size)
    assert scene.range_m.dtype == np.float64
    assert not np.isinf(scene.range_m).any()
    # Six bins hold all but 2 % of the paper's pulse of 1 ns.
    assert onset_bin(scene).min() >= 0
    assert onset_bin(scene).max() <= scene.acquisition.n_bins - 6 + 1e-9


@pytest.mark.parametrize("name", scenes)
def test_scenes_describe_themselves_in_one_line(name: str) -> None:
    first, second, *_ = (scenes[name].__doc__ or "").splitlines()
    assert first.endswith(".")
    assert not second.strip()


@pytest.mark.parametrize("name", scenes)
def test_field_of_view_does_not_depend_on_size(name: str) -> None:
    coarse, fine = scenes[name](64), scenes[name](256)
    assert coarse.acquisition.pixel_angle_rad == pytest.approx(4 * fine.acquisition.pixel_angle_rad)


@pytest.mark.parametrize("build", [car, building])
def test_sizes_show_the_same_surfaces(build: Callable[[int], Scene]) -> None:
    coarse, fine = build(64).range_m, build(256).range_m
    blocks = fine.reshape(64, 4, 64, 4)
    inside = np.isfinite(blocks).all(axis=(1, 3)) & np.isfinite(coarse)
    low, high = blocks.min(axis=(1, 3))[inside], blocks.max(axis=(1, 3))[inside]
    # A coarse pixel looks between the fine ones, which may straddle a narrow part.
    within = (low - 0.1 <= coarse[inside]) & (coarse[inside] <= high + 0.1)
    assert within.mean() > 0.99
    assert share_with_target(build(64)) == pytest.approx(share_with_target(build(256)), abs=0.02)


@pytest.mark.uncounted
def test_car_is_what_its_generator_writes(tmp_path: Path) -> None:
    script, written = tmp_path / "make_car.py", tmp_path / "car.npz"
    shutil.copy(ASSETS / "make_car.py", script)
    runpy.run_path(str(script), run_name="__main__")
    assert written.stat().st_size < 150_000
    with np.load(written) as stored, np.load(ASSETS / "car.npz") as shipped:
        assert sorted(stored) == sorted(shipped)
        for size in (64, 256):
            angle = f"pixel_angle_rad_{size}"
            assert stored[angle] == shipped[angle] == car(size).acquisition.pixel_angle_rad
            # Rounding may differ between processors by one step of the stored 1/1024 m.
            found_m = stored[f"range_m_{size}"]
            np.testing.assert_allclose(car(size).range_m, found_m, rtol=0, atol=1.5 / 1024)


def test_car_fills_the_frame_at_fifty_metres() -> None:
    scene = car()
    target = np.isfinite(scene.range_m)
    assert np.nanmin(scene.range_m) > 48.5
    assert np.nanmax(scene.range_m) < 53.0
    # The pavement spans the whole width, so the car alone is what stands above its far edge.
    above_pavement = target & ~target.all(axis=1, keepdims=True)
    width = np.flatnonzero(above_pavement.any(axis=0))
    assert 0.75 <= (np.ptp(width) + 1) / target.shape[1] <= 0.85
    assert np.isnan(scene.range_m[[0, -1]]).all()


def test_building_spreads_through_its_ranges_under_the_sky() -> None:
    scene = building()
    assert 830 <= np.nanmin(scene.range_m) < 832
    assert 855 < np.nanmax(scene.range_m) <= 860
    assert 0.5 < share_with_target(scene) < 0.9
    assert np.isnan(scene.range_m[0]).all()
    # Buildings stand on the ground: below any surface there is another one, never sky.
    target = np.isfinite(scene.range_m)
    hollow = ~target & np.logical_or.accumulate(target, axis=0)
    assert hollow.mean() < 0.01  # but for the shade under the overhanging eaves
    assert target[-1].all()


def test_staircase_covers_the_whole_gate() -> None:
    scene = staircase()
    levels = np.unique(onset_bin(scene).round(6))
    assert levels.size == 64
    assert levels[0] == 1
    assert levels[-1] == scene.acquisition.n_bins - 6
    assert np.diff(levels).max() < 1.5


@pytest.mark.parametrize(("first", "last"), [(20, 94), (0, 100), (40.5, 41.25)])
def test_uniform_depths_are_uniform(first: float, last: float) -> None:
    bins = onset_bin(uniform(first_bin=first, last_bin=last))
    assert bins.size == 64 * 64
    # By chance, one seed in ten thousand would fall below.
    assert stats.kstest(bins, stats.uniform(first, last - first).cdf).pvalue > 1e-4


def test_uniform_depths_ignore_their_neighbours() -> None:
    range_m = uniform().range_m
    correlation = np.corrcoef(range_m[:, :-1].ravel(), range_m[:, 1:].ravel())[0, 1]
    # Standard deviation of the correlation of n independent pairs: 1 / sqrt(n).
    assert abs(correlation) < 4 / np.sqrt(64 * 63)


def test_walls_are_smooth_and_cover_the_gate() -> None:
    found = [onset_bin(wall(seed=seed)) for seed in range(64)]
    assert 20 <= min(map(np.min, found)) < 25
    assert 89 < max(map(np.max, found)) <= 94
    for bins in found:
        assert np.ptp(bins) <= 6
        image = bins.reshape(64, 64)
        assert all(np.abs(np.diff(image, axis=axis)).max() < 0.1 for axis in (0, 1))


def test_one_in_five_pixels_of_the_planes_is_at_an_edge() -> None:
    bins = onset_bin(piecewise()).reshape(64, 64)
    below, right = (np.abs(np.diff(bins, axis=axis)) > 3 for axis in (0, 1))
    at_edge = np.zeros(bins.shape, bool)
    at_edge[1:] |= below
    at_edge[:-1] |= below
    at_edge[:, 1:] |= right
    at_edge[:, :-1] |= right
    assert at_edge.sum() == 789
    np.testing.assert_allclose(np.diff(bins[56:, 10]), -2.5)  # the ground


def test_a_flat_target_has_one_range() -> None:
    np.testing.assert_allclose(onset_bin(uniform(first_bin=53.6, last_bin=53.6)), 53.6)


REFUSED = [
    *((car, (size,), rf"size = {size} .*64 or 256") for size in (0, 63, 128)),
    *(
        (build, (7,), r"size = 7 .*8 or more")
        for build in (building, staircase, uniform, wall, piecewise)
    ),
    *(
        (uniform, (64, 0, *bins), r"first_bin, last_bin = .*from 0 to 100")
        for bins in ((-1, 50), (60, 50), (20, 101), (20, np.nan))
    ),
]


@pytest.mark.parametrize(("build", "arguments", "message"), REFUSED)
def test_wrong_arguments_are_refused(
    build: Callable[..., Scene], arguments: tuple[float, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        build(*arguments)
