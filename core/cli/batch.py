"""The command that ranges many captures: one row each, whether it succeeds or not."""

from __future__ import annotations

import argparse
import glob
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from core.capture import Capture, CaptureInfo
from core.checks import printable, require, shown
from core.cli.options import (
    add_colors,
    add_crop,
    add_filters,
    add_judge,
    add_settings,
    colors_given,
    crop_given,
    reading,
    refuse_judging,
    settings_given,
    show,
    show_progress,
    whole_from_to,
)
from core.cli.results import Incomplete
from core.cli.saving import (
    add_further_values,
    refuse_further_values,
    refused_outputs,
    save_each,
    save_ranges,
)
from core.estimators import ESTIMATORS, JUDGES, Judge, Provenance, RangeImage
from core.geometry import WHOLE, Box
from core.inspection import estimate_mean_flux
from core.io.names import changed_settings, distinct_names, file_name, named
from core.io.readers import SUFFIXES, bytes_of, open_capture, read_capture
from core.io.readers.guards import MAX_CUBE_BYTES
from core.io.readers.options import add_read_options, with_flags
from core.io.writers import CLOUD_SUFFIXES, FOLDER_WRITERS, WRITERS, RangeColors
from core.io.writers.whole import whole_file, writing
from core.labels import software
from core.pipeline import run
from core.studies.outputs import as_csv, as_markdown, without_nan
from core.studies.trials import process_pool

SUMMARY = "summary.csv"
_FORMATS = tuple(suffix.removeprefix(".") for suffix in (*WRITERS, *FOLDER_WRITERS))
_PRINTED = ("file", "shape", "photons", "valid", "confidence", "SBR", "seconds", "error")


@dataclass(frozen=True)
class Job:
    """A file to range, and where to write the estimates."""

    path: Path
    method: str
    settings: Any
    options: dict[str, Any]
    """Arguments of `core.read_capture`."""
    false_alarm: float | None = None
    judged_by: Judge = JUDGES[0]
    least_confidence: float | None = None
    """Estimates below it are not written."""
    colors: RangeColors | None = None
    """Colours of pictures."""
    box: Box = WHOLE
    """Part of the scene that clouds hold."""
    intervals: bool = False
    fit: bool = False
    """Whether intervals of ranges and p-values of the fit are written, too."""
    outputs: tuple[Path, ...] = ()
    overwrite: bool = False


@dataclass(frozen=True)
class Row:
    """Outcome of one file; None and NaN where it failed."""

    file: str
    rows: int | None = None
    cols: int | None = None
    bins: int | None = None
    photons: int | None = None
    valid_share: float = np.nan
    """Share of the pixels with an estimate."""
    mean_confidence: float = np.nan
    """Mean over these pixels."""
    sbr: float = np.nan
    """Signal over background, as in `core.inspection.estimate_mean_flux`; NaN where the capture
    exceeds memory."""
    seconds: float = np.nan
    """To read, range and write."""
    written: str = ""
    source: str = ""
    error: str = ""
    remark: str = ""
    """Why confidences mislead and what is left out of the model, as `estimate` says."""

    @property
    def shape(self) -> str:
        """Rows, columns and bins as text."""
        return "–" if self.bins is None else f"{self.rows} x {self.cols} x {self.bins}"


def add(commands: Any) -> None:
    """Add this command to a parser."""
    command = commands.add_parser(
        "batch",
        help="range many captures by one method, with one row each",
        description="Range many captures by one method. A file that fails is a row of the table "
        "with its error, and the others are ranged. Each file of a pattern is a capture of its "
        "own; `estimate --capture PATTERN` adds the files up as one sequence.",
    )
    methods = command.add_subparsers(dest="method", required=True)
    for name, estimator in ESTIMATORS.items():
        method = methods.add_parser(name, help=estimator.title, description=estimator.title)
        method.add_argument(
            "captures",
            nargs="+",
            metavar="FILE",
            help=f"files ({', '.join(SUFFIXES)}), or patterns such as 'runs/**/*.npz'",
        )
        method.add_argument("--out", type=Path, help="folder for range images; created if absent")
        method.add_argument(
            "--format",
            action="append",
            choices=_FORMATS,
            metavar="FORMAT",
            help=f"of the range images (npz): {', '.join(_FORMATS)}; repeatable",
        )
        method.add_argument(
            "--summary",
            type=Path,
            metavar="FILE",
            help=f"table as CSV ({SUMMARY} in the folder of --out)",
        )
        method.add_argument("--overwrite", action="store_true", help="replace files")
        method.add_argument(
            "--jobs",
            type=whole_from_to(1, 256),
            default=1,
            help="files at a time, each in a process of its own with one capture in memory (1, "
            "whose kernels run on all cores)",
        )
        method.add_argument("--json", action="store_true", help="one JSON object, by file")
        add_judge(method)
        add_filters(method)
        add_crop(method)
        add_colors(method)
        add_further_values(method)
        add_settings(method, estimator.parameters)
        add_read_options(method)
        method.set_defaults(work=_batch)


def _batch(chosen: argparse.Namespace) -> None:
    jobs = _jobs(chosen)
    summary = chosen.summary or (chosen.out / SUMMARY if chosen.out else None)
    if chosen.out is not None:
        with writing(chosen.out):
            chosen.out.mkdir(parents=True, exist_ok=True)
    if summary is not None:
        refused_outputs([summary], (summary.suffix.lower(),), chosen.overwrite)
    found = {}
    show_progress(0, len(jobs), "files")
    for job, row in ranged(jobs, chosen.jobs):
        found[job.path] = row
        show_progress(len(found), len(jobs), "files")
    print(file=sys.stderr)
    rows = [found[job.path] for job in jobs]
    if chosen.json:
        show({row.file: asdict(row) for row in rows}, as_json=True)
    else:
        print(as_markdown(_PRINTED, map(_cells, rows), {"seconds": ".3g", "SBR": ".3g"}))
        for row in rows:
            if row.remark:
                print(f"{row.file}: {row.remark}.")
    if summary is not None:
        with whole_file(summary, overwrite=chosen.overwrite) as file:
            file.write(_csv(rows, jobs[0]).encode())
    if failed := [row for row in rows if row.error]:
        listed = "\n".join(row.error for row in failed)
        raise Incomplete(f"{len(failed)} of {len(rows)} files failed:\n{listed}")


def _jobs(chosen: argparse.Namespace) -> list[Job]:
    """Return one job for each file, with names of output files that differ."""
    settings = settings_given(chosen, ESTIMATORS[chosen.method].parameters)
    require("format", chosen.format, chosen.out is not None or chosen.format is None, "--out, too")
    paths = list(dict.fromkeys(path for text in chosen.captures for path in _matching(text)))
    named_settings = changed_settings(settings)
    for name in ("false_alarm", "least_confidence"):
        if (value := getattr(chosen, name)) is not None:
            named_settings.append(named(name.replace("_", "-"), value))
    if chosen.judged_by != JUDGES[0]:
        named_settings.append(named("judged-by-", chosen.judged_by))
    formats = dict.fromkeys((chosen.format or ["npz"]) if chosen.out else ())
    colors, box = colors_given(chosen), crop_given(chosen)
    jobs = []
    for path, name in zip(paths, distinct_names(paths), strict=True):
        outputs = tuple(
            chosen.out
            / file_name(
                "cloud" if f".{suffix}" in CLOUD_SUFFIXES else "range image",
                suffix,
                capture=name,
                estimator=chosen.method,
                settings=named_settings,
            )
            for suffix in formats
        )
        job = Job(
            path,
            chosen.method,
            settings,
            reading(chosen),
            chosen.false_alarm,
            chosen.judged_by,
            chosen.least_confidence,
            colors,
            box,
            chosen.intervals,
            chosen.fit,
            outputs,
            chosen.overwrite,
        )
        jobs.append(job)
    return jobs


def _matching(text: str) -> list[Path]:
    """Return the files of a pattern in order; a name without any stands for itself."""
    if Path(text).exists():
        return [Path(text)]
    return sorted(map(Path, glob.glob(text, recursive=True))) or [Path(text)]


def ranged(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, Row]]:
    """Yield jobs and their rows as they finish.

    When a process ends without a result, such as for lack of memory, the jobs that are left run
    one at a time: if that was the cause, they succeed; otherwise the next process to end shows
    which job ends it.
    """
    if processes == 1:
        yield from ((job, range_one(job)) for job in jobs)
        return
    left, at_once = list(jobs), processes
    while left:
        with process_pool(min(at_once, len(left))) as pool:
            futures = {pool.submit(range_one, job): job for job in left}
            try:
                for future in as_completed(futures):
                    if not isinstance(future.exception(), BrokenProcessPool):
                        left.remove(futures[future])
                        yield futures[future], future.result()
            finally:
                pool.shutdown(cancel_futures=True)
        if left and at_once == 1:
            job = left.pop(0)
            why = "its process ended without a result: is there enough memory?"
            yield job, Row(printable(str(job.path)), error=f"{shown(job.path.name)}: {why}")
        at_once = processes if at_once == 1 else 1


def range_one(job: Job) -> Row:
    """Range a file and write the estimates; an error becomes part of the row."""
    started, name = perf_counter(), printable(str(job.path))
    try:
        refused = refused_outputs(job.outputs, (*WRITERS, *FOLDER_WRITERS), job.overwrite)
        described, image, sbr, remark = _estimate(job)
        save = save_ranges(
            described,
            image,
            job.least_confidence,
            job.overwrite,
            job.colors,
            job.intervals,
            job.fit,
            job.box,
        )
        written, refused = save_each(job.outputs, refused, save)
    except Exception as error:  # of whatever kind: the other files are ranged
        text = _one_line(error)
        known = text if job.path.name in text else f"{shown(job.path.name)}: {text}"
        return Row(name, seconds=perf_counter() - started, error=known)
    valid = image.valid
    rows, cols = valid.shape
    return Row(
        name,
        rows,
        cols,
        described.acquisition.n_bins,
        int(described.counts.sum()),
        float(valid.mean()),
        float(image.confidence[valid].mean()) if valid.any() else np.nan,
        sbr,
        perf_counter() - started,
        ", ".join(map(str, written)),
        described.source,
        "; ".join(_one_line(error) for error in refused.values()),
        remark,
    )


def _one_line(error: Exception) -> str:
    text = with_flags(" ".join(str(error).split()))
    return printable(text) or type(error).__name__


def _estimate(job: Job) -> tuple[CaptureInfo, RangeImage, float, str]:
    """Return a description, estimates, SBR and remark.

    A file larger than memory is ranged in tiles, whose SBR is not known, and without a remark.
    """
    n_bytes = bytes_of(job.path, **job.options)
    if n_bytes is None or n_bytes <= MAX_CUBE_BYTES:
        capture: Capture = read_capture(job.path, **job.options)
        found = run(capture, job.method, job.settings, job.false_alarm, job.judged_by)
        remark = ESTIMATORS[job.method].remark(capture, job.false_alarm, job.settings)
        return capture, found.image, estimate_mean_flux(capture).sbr.value, remark
    from core.out_of_core import tiles  # noqa: PLC0415 - loads Dask

    refuse_further_values(job.intervals, job.fit)
    refuse_judging(job.judged_by)
    counts = open_capture(job.path, **job.options)
    parts = tiles.estimate_large(counts, job.method, job.settings, false_alarm=job.false_alarm)
    return *tiles.as_image(parts.compute()), np.nan, ""


def _cells(row: Row) -> tuple[Any, ...]:
    """Return the cells of `_PRINTED`."""
    photons = "–" if row.photons is None else row.photons
    shares = row.valid_share, row.mean_confidence
    return row.file, row.shape, photons, *shares, row.sbr, row.seconds, row.error


def _csv(rows: Sequence[Row], job: Job) -> str:
    """Return the rows as CSV, with method, settings and version."""
    made_by = Provenance(job.method, job.settings, job.false_alarm, "", job.least_confidence)
    if job.judged_by != JUDGES[0]:
        made_by = made_by.after(judged_by=job.judged_by)
    about = made_by.facts | {"software": software()}
    table = ([*astuple(row), *about.values()] for row in rows)
    return as_csv((*(each.name for each in fields(Row)), *about), without_nan(table))
