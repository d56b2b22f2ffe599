"""Windows of captures larger than memory: their pixels are read, and few others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from core.acquisition import Flux
from core.capture import Capture, CaptureError
from core.estimators import estimate
from core.inference.flux import flux_prior_of
from core.io.readers import open_capture, sample
from core.io.readers.labelled import dataset
from core.out_of_core.tiles import estimate_large
from core.out_of_core.windows import Window, WindowReader, read_window, sampled_flux_prior
from core.scene import scenes
from core.simulation import simulate
from core.tests.formats import Content, put
from core.tests.labelled_files import Reads, hdf5_bytes, netcdf_bytes, zarr_files

SIDES = st.integers(1, 300)


def building() -> Capture:
    """96 x 96 pixels."""
    scene = scenes["building"](96)
    return simulate(scene, scene.acquisition, Flux(sbr=0.1))


CAPTURE = building()
STORED = dataset(CAPTURE)[["counts"]]
CHUNK = (16, 16, CAPTURE.acquisition.n_bins)

FILES: dict[str, Callable[[], Content]] = {
    "contiguous.h5": lambda: hdf5_bytes(counts=CAPTURE.cube),
    "chunked.nc": lambda: netcdf_bytes(STORED, zlib=True, chunksizes=CHUNK),
    "two.zarr": lambda: zarr_files(STORED, 2, chunks=CHUNK),
    "cut along the bins.zarr": lambda: zarr_files(STORED, 3, chunks=(16, 16, 30)),
}


@cache
def content(name: str) -> Content:
    return FILES[name]()


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of a chunk or so, as those of a large capture are."""
    monkeypatch.setattr("core.io.readers.labelled.BLOCK_BYTES", 2 * int(np.prod(CHUNK)))


@pytest.fixture
def opened(tmp_path: Path, small_blocks: None) -> xr.DataArray:
    return open_capture(put(tmp_path / "c.zarr", content("two.zarr")))


# -- geometry --------------------------------------------------------------------------------------


@given(SIDES, SIDES, st.integers(0, 50), st.integers(1, 4000))
def test_the_finest_step_that_fits_is_taken(rows: int, cols: int, first: int, most: int) -> None:
    window = Window.fitting((first, first + rows), (3, 3 + cols), most)
    kept = np.prod(window.shape)
    assert 1 <= kept <= most
    finer = Window(window.rows, window.cols, max(window.step - 1, 1))
    assert window.step == 1 or np.prod(finer.shape) > most
    for (begin, end), picked in zip((window.rows, window.cols), window.picked, strict=True):
        assert begin <= picked[0] and picked[-1] < end and picked.step == window.step
        # The pixel that represents a tile lies in its middle.
        assert picked[0] - begin <= (window.step - 1) // 2


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"rows": (3, 3)}, "rows"),
        ({"rows": (-1, 3)}, "rows"),
        ({"cols": (0, 2.5)}, "cols"),
        ({"cols": (1, 2, 3)}, "cols"),
        ({"step": 0}, "step"),
        ({"step": 1.5}, "step"),
    ],
)
def test_an_invalid_window_is_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(ValueError, match=f"^{field} = "):
        Window(**({"rows": (0, 9), "cols": (0, 9)} | changes))


@pytest.mark.parametrize("window", [Window((0, 97), (0, 9)), Window((0, 9), (90, 100))])
def test_a_window_beyond_the_image_is_refused(window: Window) -> None:
    with pytest.raises(ValueError, match="some of 0 to 96"):
        read_window(STORED.counts, window)


# -- reading ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "window",
    [Window((0, 96), (0, 96), 7), Window((30, 50), (5, 90)), Window((95, 96), (0, 96), 40)],
    ids=str,
)
def test_a_window_holds_its_pixels_and_reads_few_others(
    name: str, window: Window, tmp_path: Path, small_blocks: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = open_capture(put(tmp_path / name, content(name)))
    prior, reads = flux_prior_of(CAPTURE), Reads(monkeypatch)
    found = read_window(counts, window, flux_prior=prior)
    rows, cols = window.picked
    np.testing.assert_array_equal(found.cube, CAPTURE.cube[np.ix_(rows, cols)])
    assert found.shape == window.shape
    assert str(window) in found.source and "of 96 x 96" in found.source
    if name.startswith("contiguous"):  # bare counts
        assert reads.n_bytes == found.cube.nbytes
    else:
        angle_rad = CAPTURE.acquisition.pixel_angle_rad
        assert found.acquisition.pixel_angle_rad == pytest.approx(angle_rad * window.step)
        touched = np.zeros((6, 6), bool)
        touched[np.ix_([row // 16 for row in rows], [col // 16 for col in cols])] = True
        assert 0 < reads.n_bytes <= CAPTURE.cube.nbytes * touched.mean()


def test_progress_counts_the_pieces(opened: xr.DataArray) -> None:
    steps: list[tuple[int, int]] = []
    read_window(opened, Window((0, 96), (0, 48), 4), progress=lambda *step: steps.append(step))
    assert [of for _, of in steps] == [18] * len(steps)
    assert [done for done, _ in steps] == [*range(4, 18, 4), 18]


def test_the_pixels_read_so_far_are_a_capture(opened: xr.DataArray) -> None:
    reader = WindowReader(opened, Window((0, 96), (0, 96), 4))
    reader.read_some()
    assert not reader.is_complete
    kept = CAPTURE.cube[np.ix_(*reader.window.picked)]
    np.testing.assert_array_equal(reader.capture().cube, kept * reader.seen[..., np.newaxis])
    corners = np.argwhere(reader.seen[::4, ::4])  # 4 chunks of 36, from all over the image
    assert corners.tolist() == [[0, 0], [0, 4], [4, 0], [4, 4]]
    while not reader.is_complete:
        reader.read_some()
    np.testing.assert_array_equal(reader.capture().cube, kept)


# -- estimates ------------------------------------------------------------------------------------


@pytest.mark.compiled
def test_estimates_in_a_window_are_those_of_the_whole(
    opened: xr.DataArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the flux prior of the whole image, not its own."""
    monkeypatch.setattr(sample, "SAMPLE_COUNTS", CAPTURE.cube.size // 4)
    whole = estimate_large(opened, "likelihood").compute()
    window = Window((40, 72), (30, 62))
    here = {"row": slice(*window.rows), "col": slice(*window.cols)}
    found = read_window(opened, window)
    np.testing.assert_array_equal(flux_prior_of(found).depth, sampled_flux_prior(opened).depth)
    image = estimate(found, "likelihood")
    np.testing.assert_array_equal(image.bin, whole["bin"].isel(here))
    np.testing.assert_array_equal(image.confidence, whole["confidence"].isel(here))


def test_pixels_not_read_yet_do_not_affect_the_flux_prior(opened: xr.DataArray) -> None:
    reader = WindowReader(opened, Window((0, 96), (0, 96), 2))
    reader.read_some()
    prior = flux_prior_of(reader.capture())
    known = Capture(
        reader.capture().cube[reader.seen][np.newaxis], CAPTURE.acquisition, CAPTURE.pulse
    )
    assert prior.background == flux_prior_of(known).background


# -- failures --------------------------------------------------------------------------------------


def test_a_damaged_chunk_is_reported_and_can_be_read_again(
    tmp_path: Path, small_blocks: None
) -> None:
    path = put(tmp_path / "c.zarr", content("two.zarr"))
    reader = WindowReader(open_capture(path), Window((0, 96), (0, 96), 4))
    chunk = path / "counts" / "0.0.0"
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[:-20])
    with pytest.raises(CaptureError, match=r"c\.zarr: counts cannot be read"):
        reader.read_some()
    assert reader.done == 0 and not reader.seen.any()
    chunk.write_bytes(whole)
    reader.read_some()
    assert reader.done == 4


def test_a_deleted_file_is_reported(opened: xr.DataArray, tmp_path: Path) -> None:
    """It is not mistaken for chunks that were never written, which are zeros."""
    shutil.rmtree(tmp_path / "c.zarr")
    with pytest.raises(CaptureError, match=r"c\.zarr: .*has not gone"):
        read_window(opened, Window((0, 9), (0, 9)))
