"""A capture of 8 GB on a small cluster: equal estimates, bounded memory, a worker lost."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import psutil
import xarray as xr
from dask.distributed import Client, LocalCluster, SchedulerPlugin
from numpy.typing import NDArray

from core.acquisition import Acquisition, Flux
from core.estimators import settings_of
from core.io.readers import open_capture
from core.io.readers.dense import AXES
from core.io.readers.labelled import describe
from core.io.readers.options import ReadOptions
from core.io.writers.whole import whole_folder
from core.labels import dataset
from core.out_of_core.tiles import IMAGES, estimate_large, learned, range_part
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.outputs import Table, table

METHOD = "tracking"
FLUX = Flux(sbr=0.2)
N_PULSES = 200

Progress = Callable[[int, int], None]


class Pass(NamedTuple):
    """One ranging of the whole capture."""

    title: str
    seconds: float
    pixels_per_s: float
    peak_bytes: int
    """Peak resident memory of the ranging processes together."""
    same: bool
    """Whether the estimates equal those without Dask bit for bit."""


def generate(path: Path, rows: int, n_bins: int, chunk: int) -> None:
    """Write a simulated capture of the built-in building as Zarr, completely or not at all.

    Parameters
    ----------
    path : Path
        A folder that does not exist yet.
    rows, n_bins, chunk : int
        Rows and columns of the image, bins of the gate, rows and columns of a chunk.
    """
    scene = scenes["building"](rows)
    gate_s = scene.acquisition.n_bins * scene.acquisition.bin_width_s
    acquisition = replace(
        scene.acquisition, n_bins=n_bins, bin_width_s=gate_s / n_bins, n_pulses=N_PULSES
    )
    range_m = da.from_array(scene.range_m, chunks=chunk)
    counts = range_m.map_blocks(
        _simulated,
        acquisition,
        dtype=np.uint16,
        new_axis=2,
        chunks=(*range_m.chunks, (n_bins,)),
        meta=np.empty((0, 0, 0), np.uint16),
    )
    pixel = simulate(Scene(scene.range_m[:1, :1]), acquisition, FLUX)
    like = dataset(replace(pixel, source="the built-in building, simulated")).counts
    whole = xr.Dataset({"counts": (AXES, counts, like.attrs)}, coords=like.coords)
    with whole_folder(path, overwrite=False) as folder:
        whole.to_zarr(folder, consolidated=False)


def _simulated(
    range_m: NDArray[Any], acquisition: Acquisition, block_info: Any = None
) -> NDArray[np.unsignedinteger]:
    row, col = block_info[0]["chunk-location"]
    return simulate(Scene(range_m), acquisition, FLUX, seed=10_000 * row + col).cube


def study(path: Path, workers: int, memory_bytes: int, progress: Progress) -> Iterator[Pass]:
    """Range a capture tile by tile without Dask, on one worker, on all, and with one killed.

    The worker is killed when a third of the tasks is done.

    Parameters
    ----------
    path : Path
        A capture that `core.open_capture` opens in chunks.
    workers : int
        Processes of one thread each.
    memory_bytes : int
        Limit of all workers together; Dask ends a worker that exceeds its share.
    progress : callable
        ``(tasks done, tasks in all)``.
    """
    expected: NDArray[Any] | None = None
    n_pixels = int(np.prod(open_capture(path).shape[:2]))

    def ranged(title: str, work: Callable[[], tuple[NDArray[Any], int]]) -> Pass:
        nonlocal expected
        started = perf_counter()
        images, peak = work()
        seconds = perf_counter() - started
        expected = images if expected is None else expected
        same = np.array_equal(images, expected, equal_nan=True)
        return Pass(title, seconds, n_pixels / seconds, peak, same)

    def on_cluster(workers: int, killed: bool = False) -> tuple[NDArray[Any], int]:
        with _cluster(workers, memory_bytes // workers, progress, killed) as watched:
            before = set(watched.pids())
            ranged = estimate_large(open_capture(path), METHOD).compute()
            lost = before - set(watched.pids())
        if bool(lost) != killed:
            raise ValueError(f"workers lost = {len(lost)} is not accepted: give more memory.")
        return np.stack([ranged[name].to_numpy() for name in IMAGES], axis=2), watched.peak_bytes

    yield ranged("tile by tile, without Dask", lambda: _tile_by_tile(path, progress))
    yield ranged("1 worker", lambda: on_cluster(1))
    yield ranged(f"{workers} workers", lambda: on_cluster(workers))
    yield ranged(f"{workers} workers, one killed", lambda: on_cluster(workers, killed=True))


def _tile_by_tile(path: Path, progress: Progress) -> tuple[NDArray[Any], int]:
    counts = open_capture(path)
    description, settings = describe(counts, ReadOptions()), settings_of(METHOD)
    flux_prior, calibration, _ = learned(counts.data, description, METHOD, settings, None)
    images = np.empty((*counts.shape[:2], len(IMAGES)))
    parts = list(da.core.slices_from_chunks(counts.data.chunks[:2]))
    given = description, METHOD, settings, flux_prior, calibration
    with (
        _Memory(lambda: [os.getpid()]) as memory,
        dask.config.set(scheduler="synchronous"),
        ThreadPoolExecutor(1) as reader,
    ):
        # Decompression takes a third of the time: read the next tile meanwhile.
        reading = reader.submit(counts[parts[0]].to_numpy)
        for done, (part, after) in enumerate(zip(parts, [*parts[1:], None], strict=True)):
            cube = reading.result()
            if after is not None:
                reading = reader.submit(counts[after].to_numpy)
            images[part] = range_part(cube, *given)
            progress(done + 1, len(parts))
    return images, memory.peak_bytes


class _Memory:
    """Peak memory of some processes together, sampled ten times a second."""

    def __init__(self, pids: Callable[[], list[int]]) -> None:
        self.peak_bytes = 0
        self.pids, self._over = pids, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> _Memory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._over.wait(0.1):
            self.peak_bytes = max(self.peak_bytes, sum(map(_resident_bytes, self.pids())))


def _resident_bytes(pid: int) -> int:
    try:
        return int(psutil.Process(pid).memory_info().rss)
    except psutil.NoSuchProcess:  # killed and not restarted yet
        return 0


class _Tasks(SchedulerPlugin):  # type: ignore[misc]
    """Counts tasks; calls a function once when a third of them is done."""

    def __init__(self, scheduler: Any, progress: Progress, at_a_third: Callable[[], None]) -> None:
        self._scheduler, self._progress, self._at_a_third = scheduler, progress, at_a_third
        self._done: set[Any] = set()
        self._is_past = False

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Count a task that Dask reports as done."""
        if finish != "memory":
            return
        self._done.add(key)
        known = len(self._scheduler.tasks.keys() | self._done)
        self._progress(len(self._done), known)
        if not self._is_past and len(self._done) > known / 3:
            self._is_past = True
            self._at_a_third()


@contextmanager
def _cluster(
    workers: int, memory_bytes: int, progress: Progress, killed: bool
) -> Iterator[_Memory]:
    """Open a cluster on this machine; if `killed`, one worker is killed at a third of the tasks."""

    def pids() -> list[int]:
        return [worker.pid for worker in cluster.workers.values() if worker.pid]

    def kill() -> None:
        if killed:
            os.kill(pids()[0], signal.SIGKILL)

    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=memory_bytes,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": ":0"},  # the default port may be taken
            env={"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        ) as cluster,
        Client(cluster),
        _Memory(pids) as memory,
    ):
        cluster.scheduler.add_plugin(_Tasks(cluster.scheduler, progress, kill))
        yield memory


def passes_table(passes: list[Pass]) -> Table:
    """Return time and memory of each pass."""
    return table(
        "large",
        "A capture ranged in several ways",
        passes,
        {
            "execution": lambda each: each.title,
            "s": lambda each: each.seconds,
            "pixels per s": lambda each: each.pixels_per_s,
            "peak memory MB": lambda each: each.peak_bytes / 1e6,
            "same estimates": lambda each: "bit for bit" if each.same else "NO",
        },
        formats={"s": ".1f", "pixels per s": ".0f", "peak memory MB": ".0f"},
    )
