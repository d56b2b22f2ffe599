"""Captures larger than memory: estimates are those of the whole image, whatever the tiles."""

from __future__ import annotations

import logging
import os
import signal
import threading
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.estimators import ESTIMATORS, base, estimate
from core.io.readers import sample
from core.io.readers.labelled import dataset
from core.out_of_core import tiles
from core.out_of_core.tiles import IMAGES, as_image, computed, estimate_large
from core.scene import Scene, scenes
from core.simulation import simulate

pytestmark = pytest.mark.compiled

# Workers are forked from a process that has imported Dask, which each would import again.
dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"})

APART = [name for name, each in ESTIMATORS.items() if not each.whole_image and name != "oracle"]


def small_car() -> Capture:
    """Some of the car, wider than high."""
    scene = scenes["car"]()
    return simulate(Scene(scene.range_m[20:45:2, 10:50:2]), scene.acquisition, Flux(sbr=0.1))


CAPTURE = small_car()
COUNTS = dataset(CAPTURE).counts


@pytest.mark.parametrize("method", APART)
@pytest.mark.parametrize(
    ("chunks", "false_alarm"),
    [({"row": 4, "col": 7}, 0.05), ({"row": 13, "col": 1, "bin": 30}, None)],
    ids=["small chunks, some invalid pixels", "chunks of a column"],
)
def test_tiles_give_the_estimates_of_the_whole(
    method: str,
    chunks: dict[str, int],
    false_alarm: float | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(base, "NULL_SIDE", 32)  # 256 rows and columns take twenty times as long
    whole = estimate(CAPTURE, method, false_alarm=false_alarm)
    parts = estimate_large(COUNTS.chunk(chunks), method, false_alarm=false_alarm).compute()
    for name in set(IMAGES) - {"counts"}:
        np.testing.assert_array_equal(parts[name], getattr(whole, name), err_msg=name)
    np.testing.assert_array_equal(parts["counts"], CAPTURE.counts)
    assert parts["range_m"].attrs["units"] == "m"


def test_settings_are_those_of_estimate() -> None:
    whole = estimate(CAPTURE, "peak")
    np.testing.assert_array_equal(estimate_large(COUNTS, "peak").range_m, whole.range_m)
    with pytest.raises(ValueError, match="smoothing_bins = 1000"):
        estimate_large(COUNTS, "cfar", smoothing_bins=1000.0)
    with pytest.raises(ValueError, match="method = 'best'"):
        estimate_large(COUNTS, "best")


def test_the_remark_is_that_of_estimate() -> None:
    whole = estimate(CAPTURE, "kde", false_alarm=0.1).made_by
    assert whole is not None and "next to surfaces" in whole.remark
    assert estimate_large(COUNTS, "kde", false_alarm=0.1).attrs["remark"] == whole.remark


@pytest.mark.parametrize("method", [name for name in ESTIMATORS if ESTIMATORS[name].whole_image])
def test_methods_that_need_the_whole_image_are_refused(method: str) -> None:
    with pytest.raises(ValueError, match=rf"method = '{method}' .*'tracking' or .*whole image"):
        estimate_large(COUNTS, method)


def test_axes_must_be_named() -> None:
    with pytest.raises(ValueError, match=r"axes = \('x', 'col', 'bin'\) .*row, col and bin"):
        estimate_large(COUNTS.rename(row="x"), "peak")


def test_nothing_is_estimated_before_compute(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    ranged = tiles.range_part

    def counted(*arguments: Any) -> Any:
        calls.append(arguments)
        return ranged(*arguments)

    monkeypatch.setattr(tiles, "range_part", counted)
    parts = estimate_large(COUNTS.chunk(row=5), "peak")
    assert calls == []
    parts.compute(scheduler="synchronous")
    assert len(calls) == 3


def test_a_large_image_is_learned_from_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    counts = rng.poisson(1.0, (200, 300, 8)).astype(np.uint16)
    array = xr.DataArray(counts).chunk(50).data
    np.testing.assert_array_equal(sample.sample_of(array), counts)  # small: all of it
    monkeypatch.setattr(sample, "SAMPLE_COUNTS", 32 * 32 * 8 * 3)
    some = sample.sample_of(array)
    assert some.shape == (3 * 32, 32, 8)
    windows = {counts[r, c].tobytes() for r in range(200) for c in range(300)}
    assert all(pixel.tobytes() in windows for pixel in some.reshape(-1, 8))
    np.testing.assert_array_equal(some, sample.sample_of(array))


def test_a_sample_represents_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimates with the flux prior of a tenth of the image are nearly all the same."""
    scene = scenes["uniform"](128)
    capture = simulate(scene, scene.acquisition, Flux(sbr=0.1))
    whole = estimate(capture, "likelihood")
    monkeypatch.setattr(sample, "SAMPLE_COUNTS", capture.cube.size // 10)
    parts = estimate_large(dataset(capture).counts.chunk(row=32), "likelihood").compute()
    changed = np.abs(parts["bin"].to_numpy() - whole.bin) > 1
    assert changed.mean() < 0.01
    difference = np.abs(parts["confidence"].to_numpy() - whole.confidence)[~changed]
    assert np.quantile(difference, 0.99) < 0.1


def test_a_result_of_tiles_is_an_image_with_metadata(
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen, image = as_image(computed(estimate_large(COUNTS.chunk(row=9), "peak")))
    whole = estimate(CAPTURE, "peak")
    np.testing.assert_array_equal(image.range_m, whole.range_m)
    np.testing.assert_array_equal(image.valid, whole.valid)
    np.testing.assert_array_equal(seen.counts, CAPTURE.counts)
    assert seen.acquisition == CAPTURE.acquisition
    assert (seen.detection, seen.source) == (CAPTURE.detection, CAPTURE.source)
    assert seen.gated_pulses == CAPTURE.gated_pulses
    printed = capsys.readouterr()
    assert printed.out == "" and "100%" in printed.err


def test_unknown_pulses_stay_unknown() -> None:
    counts = dataset(Capture(CAPTURE.cube, Acquisition(100, n_pulses=None), detection="all"))
    seen, _ = as_image(estimate_large(counts.counts, "peak").compute())
    assert seen.acquisition.n_pulses is None and seen.gated_pulses is None


def test_a_cluster_gives_the_same_and_loses_nothing_with_a_worker(tmp_path: Path) -> None:
    """The study of 8 GB, on a capture of 8 MB."""
    from core.studies.performance import large as study  # noqa: PLC0415 - brings a cluster

    path = tmp_path / "small.zarr"
    study.generate(path, 256, 64, 64)
    assert os.listdir(tmp_path) == ["small.zarr"]
    shown: list[tuple[int, int]] = []
    found = list(study.study(path, 2, 2 * 10**9, lambda *done: shown.append(done)))
    assert [each.title for each in found] == [
        "tile by tile, without Dask",
        "1 worker",
        "2 workers",
        "2 workers, one killed",
    ]
    assert all(each.same for each in found)
    # The first ran in this process, which holds other tests' captures, too.
    assert all(0 < each.peak_bytes < 2e9 for each in found[1:])
    assert max(done for done, _ in shown) > 10


def test_a_suspended_worker_is_reported_and_loses_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from dask.distributed import LocalCluster  # noqa: PLC0415 - slow to come

    monkeypatch.setattr(tiles, "SILENT_S", 2.0)
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": ":0"},
    ) as cluster:
        (worker,) = cluster.workers.values()
        address = worker.worker_address

        def resume() -> None:
            os.kill(worker.pid, signal.SIGCONT)

        def resume_if_reported(record: logging.LogRecord) -> bool:
            if record.name == tiles.__name__:
                resume()
            return True

        caplog.handler.addFilter(resume_if_reported)
        unreported = threading.Timer(120, resume)
        unreported.start()
        os.kill(worker.pid, signal.SIGSTOP)
        found = computed(estimate_large(COUNTS.chunk(row=9), "peak"), cluster.scheduler_address)
        unreported.cancel()
        caplog.handler.removeFilter(resume_if_reported)
    reports = [each.getMessage() for each in caplog.records if each.name == tiles.__name__]
    assert reports  # several where a busy machine delays the resumed worker, too
    assert all(address in report and "worker-ttl" in report for report in reports)
    np.testing.assert_array_equal(found["range_m"], estimate(CAPTURE, "peak").range_m)
