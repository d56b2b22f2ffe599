"""Estimate ranges of captures larger than memory in tiles, on threads or on a cluster.

The flux prior and an estimator's calibration, which all pixels share, are learned from a sample of
the image first. A tile is then processed like any capture, so that the result depends neither on
the tiling nor on the worker that processes a tile.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats
from core.capture import Capture, Detection
from core.checks import require
from core.estimators import ESTIMATORS, RangeImage, settings_of
from core.estimators.base import Calibration, Provenance
from core.inference.flux import flux_prior_of
from core.inference.flux_model import FluxPrior
from core.io.readers.dense import AXES, Description, capture_of, whole_counts
from core.io.readers.labelled import describe
from core.io.readers.options import ReadOptions
from core.io.readers.sample import sample_of

if TYPE_CHECKING:
    import xarray as xr

IMAGES = {
    "range_m": ("range of the surface", "m"),
    "bin": ("delay of the echo", "bins"),
    "score": ("score of the estimate", "1"),
    "confidence": ("probability that the estimate is right within 3 bins", "1"),
    "counts": ("detections", "1"),
}
"""Images of a result, each with its description and unit."""

log = logging.getLogger(__name__)

_CONNECT_S = 10.0  # longest wait for a cluster

SILENT_S = 30.0
"""Silence after which a worker is reported; workers report every few seconds."""


def estimate_large(
    counts: xr.DataArray,
    method: str,
    settings: Any = None,
    *,
    false_alarm: float | None = None,
    **parameters: Any,
) -> xr.Dataset:
    """Estimate the range of every pixel of a labelled array, tile by tile.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `core.open_capture` returns them, in Dask's chunks or in memory; chunks along ``bin`` are
        joined.
    method, settings, false_alarm, **parameters
        As `core.estimate` takes them.

    Returns
    -------
    Dataset
        `IMAGES`, each of shape (row, col), NaN without an estimate; its attributes describe the
        acquisition, the detection, the source and, as ``remark``, what the method neglects.
        A sample of the image is read at once, all else by ``.compute()`` or a ``.to_…()``: on
        threads, or on the cluster of the `dask.distributed.Client` that is open.

    Raises
    ------
    ValueError
        As `core.estimate`; if the method needs the whole image for each of its pixels; or if the
        array is not described as in `core.io.readers.labelled`.
    """
    import dask.array as da  # noqa: PLC0415 - half a second that others should not pay

    settings = settings_of(method, settings, **parameters)
    estimator = ESTIMATORS[method]
    apart = [name for name, each in ESTIMATORS.items() if not each.whole_image]
    accepted = " or ".join(map(repr, apart)) + ", which range a pixel without the whole image"
    require("method", method, not estimator.whole_image, accepted)
    require("axes", counts.dims, counts.dims == AXES, "row, col and bin")
    description = describe(counts, ReadOptions())
    array = da.asarray(counts.data).rechunk({2: -1})
    flux_prior, calibration, remark = learned(array, description, method, settings, false_alarm)
    margin = estimator.window_size(settings) // 2
    around = {0: margin, 1: margin, 2: 0}
    # Chunks of an edge may be narrower than the margin: Dask joins them.
    parts = da.overlap.overlap(array, depth=around, boundary="none")
    ranged = parts.map_blocks(
        range_part,
        description,
        method,
        settings,
        flux_prior,
        calibration,
        dtype=float,
        chunks=(*parts.chunks[:2], (len(IMAGES),)),
        meta=np.empty((0, 0, 0)),
    )
    images = da.overlap.trim_internal(ranged, around, boundary="none")
    made_by = Provenance(method, settings, false_alarm, remark)
    return _dataset(images, description, made_by)


def learned(
    array: Any, description: Description, method: str, settings: Any, false_alarm: float | None
) -> tuple[FluxPrior, Calibration, str]:
    """Learn from a sample of a Dask array what all pixels share; with `Estimator.remark`."""
    sample, estimator = captured(sample_of(array), description), ESTIMATORS[method]
    calibration = estimator.calibration(sample, settings, false_alarm)
    return flux_prior_of(sample), calibration, estimator.remark(sample, false_alarm, settings)


def range_part(
    cube: NDArray[Any],
    description: Description,
    method: str,
    settings: Any,
    flux_prior: FluxPrior,
    calibration: Calibration,
) -> Floats:
    """Estimate the ranges of a part of an image; shape (row, col, len(IMAGES))."""
    part = captured(cube, description, flux_prior)
    image = ESTIMATORS[method].ranged(part, settings, calibration)
    known = {name: getattr(image, name) for name in IMAGES if hasattr(image, name)}
    return np.stack([known.get(name, part.counts) for name in IMAGES], axis=2).astype(float)


def captured(
    cube: NDArray[Any], description: Description, flux_prior: FluxPrior | None = None
) -> Capture:
    """Return counts that are in memory as a capture, with copied and checked counts."""
    return capture_of(whole_counts(cube, "counts"), description, flux_prior)


def _dataset(images: Any, description: Description, made_by: Provenance) -> xr.Dataset:
    import xarray as xr  # noqa: PLC0415

    acquisition, _, detection, source = description
    about = {**vars(acquisition), "detection": detection, "source": source}
    about |= {"remark": made_by.remark, **made_by.facts}
    return xr.Dataset(
        {
            name: (AXES[:2], images[..., k], {"long_name": meaning, "units": unit})
            for k, (name, (meaning, unit)) in enumerate(IMAGES.items())
        },
        attrs={name: value for name, value in about.items() if value is not None},
    )


def computed(parts: xr.Dataset, scheduler: str | None = None) -> xr.Dataset:
    """Compute all tiles, with a progress bar on standard error.

    Parameters
    ----------
    parts : Dataset
        As `estimate_large` returns it.
    scheduler : str, optional
        Address of a Dask cluster, such as ``tcp://host:8786``; this machine's threads where None.

    Raises
    ------
    ValueError
        If the address is invalid.
    OSError
        If there is no cluster at the address, or it has no workers.
    """
    from dask.diagnostics import ProgressBar  # noqa: PLC0415 - slow to import

    with contextlib.redirect_stdout(sys.stderr):
        if scheduler is None:
            with ProgressBar():
                return parts.compute()
        from dask.distributed import Client, progress  # noqa: PLC0415

        try:
            client = Client(scheduler, timeout=_CONNECT_S)
        except ValueError as error:
            accepted = "the address of a cluster, such as tcp://host:8786"
            message = f"scheduler = {scheduler!r} is not accepted: give {accepted}."
            raise ValueError(message) from error
        with client, _reporting_silent_workers(client):
            client.wait_for_workers(1, timeout=_CONNECT_S)
            begun = client.persist(parts)
            progress(begun, notebook=False)
            done: xr.Dataset = begun.compute()
            return done


@contextlib.contextmanager
def _reporting_silent_workers(client: Any) -> Iterator[None]:
    """Log each worker that stops reporting, such as a suspended process or a lost machine.

    Dask waits for such a worker until ``distributed.scheduler.worker-ttl`` has passed, 5 to 10
    minutes by default, and logs nothing until then.
    """
    over = threading.Event()
    reports: dict[str, tuple[float, float]] = {}  # the scheduler's time, and ours when it was new
    silent: set[str] = set()

    def check() -> None:
        for address, worker in client.scheduler_info()["workers"].items():
            last_seen, now = worker["last_seen"], monotonic()
            if reports.get(address, (None,))[0] != last_seen:
                reports[address] = last_seen, now
                silent.discard(address)
            elif now - reports[address][1] > SILENT_S and address not in silent:
                silent.add(address)
                log.warning(
                    "The worker %s has not reported for %.0f s, and its tiles wait for it. Resume "
                    "it, or end its process so that other workers take over. Otherwise the "
                    "scheduler drops it after its worker-ttl, by default 5 to 10 minutes.",
                    address,
                    SILENT_S,
                )

    def watch() -> None:
        while not over.wait(SILENT_S / 4):
            with contextlib.suppress(OSError, RuntimeError):  # which the client reports itself
                check()

    thread = threading.Thread(target=watch, name="firstphoton-workers", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@dataclass(frozen=True, eq=False)
class Overview:
    """Description of a capture of which not all counts are in memory."""

    counts: NDArray[np.int64]
    """Detections of each pixel, shape (row, col)."""
    acquisition: Acquisition
    detection: Detection
    source: str

    @property
    def gated_pulses(self) -> int | None:
        """As `Capture.gated_pulses`."""
        return self.acquisition.n_pulses if self.detection == "first" else None


def as_image(ranged: xr.Dataset) -> tuple[Overview, RangeImage]:
    """Convert a computed dataset of `estimate_large` to the arguments of `core.save_image`."""
    images: dict[str, Any] = {name: ranged[name].to_numpy() for name in IMAGES}
    counts = images.pop("counts").astype(np.int64)
    known: dict[str, Any] = {each.name: ranged.attrs.get(each.name) for each in fields(Acquisition)}
    overview = Overview(
        counts, Acquisition(**known), ranged.attrs["detection"], ranged.attrs["source"]
    )
    made_by = _made_by(ranged.attrs)
    return overview, RangeImage(**images, valid=np.isfinite(images["range_m"]), made_by=made_by)


def _made_by(known: Mapping[Any, Any]) -> Provenance | None:
    """Return the provenance that the attributes of a dataset state; None if they do not."""
    if "method" not in known:
        return None
    settings = settings_of(known["method"], **json.loads(known["settings"]))
    return Provenance(known["method"], settings, known.get("false_alarm"), known["remark"])
