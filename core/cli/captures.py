"""Commands for captures: inspect, range, simulate and convert them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from core.acquisition import Floats
from core.capture import Capture, CaptureError, CaptureInfo
from core.checks import printable, require
from core.cli.options import (
    FLUX_OPTIONS,
    add_capture,
    add_colors,
    add_crop,
    add_filters,
    add_flux,
    add_judge,
    add_pixel,
    add_returns,
    add_settings,
    angle,
    colors_given,
    crop_given,
    flux_of,
    reading,
    refuse_judging,
    require_none,
    settings_given,
    show,
    whole_from_to,
)
from core.cli.saving import (
    Refused,
    add_further_values,
    refuse_further_values,
    refused_outputs,
    require_all,
    save_each,
    save_ranges,
)
from core.estimators import (
    ESTIMATORS,
    RangeImage,
    estimate,
    suitable_method,
    with_returns,
)
from core.inference import FALSE_RETURN
from core.inspection import (
    CaptureReport,
    PixelReport,
    capture_report,
    faulty_pixels,
    pixel_report,
    reported_check,
)
from core.io.readers import SUFFIXES, bytes_of, open_capture, read_capture
from core.io.readers.guards import MAX_CUBE_BYTES
from core.io.readers.labelled import describe
from core.io.readers.options import MOST_PULSE_GROUPS, ReadOptions, add_read_options
from core.io.readers.truth import (
    add_truth_options,
    possible_truths,
    read_truth,
    truth_of,
    truth_options_from,
)
from core.io.scene_files import read_scene
from core.io.writers import (
    CAPTURE_SUFFIXES,
    CLOUD_SUFFIXES,
    FOLDER_WRITERS,
    WRITERS,
    save_capture,
    save_pixel,
)
from core.io.writers.product import guessed_view
from core.metrics import Interval
from core.parameters import doubts
from core.pipeline import figures_of, run
from core.pulse_groups import USUAL_GROUPS
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tracking import PRESETS
from core.tuning import is_tunable, tuned

_CONFIDENT = 0.9
_MAX_REPORTED = 2**27  # counts; a report on more takes minutes
_CLOUD_HELP = "; a cloud of a file without a pixel angle gets about as wide as it is deep"
_TUNED_HELP = (
    "choose the settings for this capture: the default ones, unless others restore clearly more of "
    "a simulated capture that resembles it"
)
_VIEW = ("unit_m", "distance_m", "pixel_angle_rad")


def add(commands: Any) -> None:
    """Add these commands to a parser."""
    for add_one in (_add_info, _add_estimate, _add_simulate, _add_export):
        add_one(commands)


# -- info ------------------------------------------------------------------------------------------


def _add_info(commands: Any) -> None:
    command = commands.add_parser(
        "info", help="show what a capture file contains and what is assumed about it"
    )
    command.add_argument("capture", type=Path, help=f"a file: {', '.join(SUFFIXES)}")
    add_pixel(
        command,
        "report on one pixel, ranged by tracking, or by the likelihood where the capture holds all "
        "photons, with default settings",
    )
    _add_json(command)
    add_read_options(command)
    command.set_defaults(work=_info)


def _info(chosen: argparse.Namespace) -> None:
    if chosen.pixel is not None:
        capture = read_capture(chosen.capture, **reading(chosen))
        show(_pixel_facts(capture, *chosen.pixel), chosen.json)
        return
    counts = open_capture(chosen.capture, **reading(chosen))
    acquisition, pulse, detection, source = describe(counts, ReadOptions())
    rows, cols, n_bins = counts.shape
    begin_m, end_m = acquisition.bin_to_range_m([0, n_bins])
    facts: dict[str, Any] = {
        "source": source,
        "rows": rows,
        "cols": cols,
        "bins": n_bins,
        "bin_width_s": acquisition.bin_width_s,
        "gate_delay_s": acquisition.gate_delay_s,
        "range_from_m": float(begin_m),
        "range_to_m": float(end_m),
        "pulse": pulse.shape,
        "pulse_tau_s": pulse.tau_s,
        "n_pulses": acquisition.n_pulses,
        "pixel_angle_rad": acquisition.pixel_angle_rad,
        "detection": detection,
        "bytes": counts.nbytes,
    }
    if counts.nbytes <= MAX_CUBE_BYTES:
        photons = counts.sum("bin", dtype=np.int64).to_numpy()
        facts |= {
            "photons": int(photons.sum()),
            "photons_per_pixel": float(photons.mean()),
            "photons_in_one_pixel_at_most": int(photons.max()),
            "share_of_pixels_empty": float((photons == 0).mean()),
        }
    if counts.size <= _MAX_REPORTED:
        capture = read_capture(chosen.capture, **reading(chosen))
        facts |= _truth_facts(chosen.capture, capture) | _capture_facts(capture)
    show(facts, chosen.json)


def _truth_facts(path: Path, capture: Capture) -> dict[str, Any]:
    """Return the images of the file that may be the truth, and the options that take one."""
    if capture.truth_range_m is not None:
        return {}
    try:
        possible = possible_truths(path, capture)
    except CaptureError:  # the capture itself is readable
        return {}
    options = []
    for each in possible:
        unit = "" if each.is_unit_stated else f" --truth-unit {' or '.join(each.units)}"
        options.append(f"--truth-variable {each.name}{unit}")
    return {"possible_truths": options} if possible else {}


def _capture_facts(capture: Capture) -> dict[str, Any]:
    report = capture_report(capture)
    suggestion, faulty = report.suggestion, faulty_pixels(capture)
    free, target = report.echo_free_background, report.target_flux
    hot, dead = (
        [each._asdict() for each in faulty if each.health == health] for health in ("hot", "dead")
    )
    return {
        "flux_mean_over": "all pixels but hot and dead ones, empty ones included",
        **_flux_facts(report),
        "target_flux_mean_over": "target pixels, those with an echo",
        **_interval("target_signal", target.signal),
        **_interval("target_sbr", target.sbr),
        **({} if free is None else _interval("echo_free_background", free)),
        "flux_remark": report.flux_remark,
        **_stated_facts(report),
        **_reported_facts(capture),
        "hot_pixels": report.n_hot,
        "hot_pixels_at": hot,
        "dead_pixels": report.n_dead,
        "dead_pixels_at": dead,
        "suggested_gate_first_bin": suggestion.gate[0],
        "suggested_gate_end_bin": suggestion.gate[1],
        "why_gate": suggestion.why_gate,
        "suggested_t_n": suggestion.t_n,
        "why_t_n": suggestion.why_t_n,
    }


def _stated_facts(report: CaptureReport) -> dict[str, float]:
    facts: dict[str, float] = {}
    for each in report.stated:
        name = f"stated_{each.name}"
        facts |= {name: each.stated, **_interval(f"{name}_estimate", each.estimate)}
        facts |= {f"{name}_difference": each.difference}
    return facts


def _reported_facts(capture: Capture) -> dict[str, Any]:
    """Return how estimates by the likelihood differ from the ranges that the file reports."""
    if capture.reported_range_m is None:
        return {}
    method = "likelihood"
    found = reported_check(capture, estimate(capture, method))
    assert found is not None
    return {
        "reported_range_compared_with": method,
        "reported_range_pixels_compared": found.n_pixels,
        "reported_range_median_difference_m": found.median_m,
        "reported_range_difference_spread_m": found.spread_m,
    }


def _pixel_facts(capture: Capture, row: int, col: int) -> dict[str, Any]:
    method = suitable_method(capture)
    report = pixel_report(capture, estimate(capture, method), row, col, method)
    facts: dict[str, Any] = {
        "source": capture.source,
        "method": method,
        "row": report.row,
        "col": report.col,
        "photons": int(report.counts.sum()),
        "range_m": report.answer_m,
        "confidence": report.confidence,
        "interval": report.interval_text,
        "surfaces": report.surfaces_text,
        **_interval_facts(report),
        **_reported_pixel_facts(capture, report),
        **_flux_facts(report),
        "verdict": report.verdict.health,
        "why_verdict": report.verdict.why,
    }
    for rank, candidate in enumerate(report.candidates, 1):
        facts |= {f"candidate_{rank}_{name}": value for name, value in vars(candidate).items()}
    return facts


def _reported_pixel_facts(capture: Capture, report: PixelReport) -> dict[str, float]:
    if capture.reported_range_m is None:
        return {}
    reported_m = float(capture.reported_range_m[report.row, report.col])
    difference_m = report.answer_m - reported_m
    return {"reported_range_m": reported_m, "reported_range_difference_m": difference_m}


def _interval_facts(report: PixelReport) -> dict[str, float]:
    facts: dict[str, float] = {}
    for name, each in (("68_", report.interval_68_m), ("", report.interval_95_m)):
        facts |= {f"range_low_{name}m": each.low, f"range_high_{name}m": each.high}
    return facts


def _flux_facts(report: Any) -> dict[str, Any]:
    facts: dict[str, Any] = {"flux_unit": report.flux_unit}
    for name, found in report.flux._asdict().items():
        facts |= _interval(name, found)
    return facts | {"flux_method": report.flux_method}


def _interval(name: str, found: Interval) -> dict[str, float]:
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


# -- estimate --------------------------------------------------------------------------------------


def _add_estimate(commands: Any) -> None:
    command = commands.add_parser("estimate", help="range a capture or a scene by one method")
    methods = command.add_subparsers(dest="method", required=True)
    for name, estimator in ESTIMATORS.items():
        method = methods.add_parser(name, help=estimator.title, description=estimator.title)
        subject = method.add_mutually_exclusive_group()
        add_capture(subject)
        subject.add_argument("--scene", choices=scenes, default="car", help="to simulate (car)")
        add_truth_options(method)
        add_flux(method)
        add_filters(method)
        add_judge(method)
        add_returns(method)
        add_crop(method)
        add_colors(method)
        _add_out(method, "the range image", (*WRITERS, *FOLDER_WRITERS), more=_CLOUD_HELP)
        add_further_values(method)
        method.add_argument(
            "--scheduler", help="address of a Dask cluster to use, such as tcp://host:8786"
        )
        _add_json(method)
        if is_tunable(name):
            method.add_argument("--tuned", action="store_true", help=_TUNED_HELP)
        method.set_defaults(tuned=False)
        add_settings(method, estimator.parameters)
        add_read_options(method)
        method.set_defaults(work=_estimate)


def _estimate(chosen: argparse.Namespace) -> None:
    refused = _refused(chosen)
    truth_options_from(chosen, chosen.capture)
    settings = settings_given(chosen, ESTIMATORS[chosen.method].parameters)
    colors, box = colors_given(chosen), crop_given(chosen)
    in_tiles = chosen.scheduler or _exceeds_memory(chosen)
    if chosen.tuned and (in_tiles or settings != type(settings)()):
        why = "a capture larger than memory" if in_tiles else "other settings"
        raise ValueError(f"--tuned cannot be combined with {why}.")
    if chosen.false_return is not None and chosen.returns == 1:
        given = f"--false-return {chosen.false_return:g}"
        raise ValueError(f"{given} has no effect on one return: give --returns 2 or more, too.")
    if in_tiles:
        refuse_further_values(chosen.intervals, chosen.fit)
        one = chosen.returns == 1
        require("returns", chosen.returns, one, "1 for a capture that is ranged in tiles")
        refuse_judging(chosen.judged_by)
    described, image, facts = (_range_in_tiles if in_tiles else _range_at_once)(chosen, settings)
    save = save_ranges(
        described,
        image,
        chosen.least_confidence,
        chosen.overwrite,
        colors,
        chosen.intervals,
        chosen.fit,
        box,
    )
    written, refused = save_each(chosen.out, refused, save)
    has_cloud = any(path.suffix.lower() in CLOUD_SUFFIXES for path in written)
    view = guessed_view(described, image) if has_cloud else {}
    used = settings if image.made_by is None else image.made_by.settings
    known = {
        "source": described.source,
        "remark": facts.pop("remark"),
        "settings": str(used),
        "in_doubt": " ".join(doubts(used)),
        "pixels": image.valid.size,
        "pixels_estimated": int(image.valid.sum()),
        f"pixels_at_confidence_{_CONFIDENT}": int((image.confidence >= _CONFIDENT).sum()),
        "median_range_m": float(np.median(image.range_m[image.valid])) if image.valid.any() else "",
        **facts,
        "cloud": view.get("remark", ""),
        "written": _names(written),
    }
    show({name: value for name, value in known.items() if value != ""}, chosen.json)
    require_all(chosen.out, refused)


def _exceeds_memory(chosen: argparse.Namespace) -> bool:
    n_bytes = chosen.capture and bytes_of(chosen.capture, **reading(chosen))
    return n_bytes is not None and n_bytes > MAX_CUBE_BYTES


def _range_at_once(
    chosen: argparse.Namespace, settings: Any
) -> tuple[CaptureInfo, RangeImage, dict[str, Any]]:
    capture = _capture(chosen)
    if truth := truth_options_from(chosen, chosen.capture):
        capture = read_truth(capture=capture, **truth)
    print(capture.source, file=sys.stderr)  # with assumptions, before anything depends on them
    if chosen.tuned:
        tuning = tuned(capture, chosen.method)
        print(tuning.why, file=sys.stderr)
        settings = tuning.settings
    found = run(capture, chosen.method, settings, chosen.false_alarm, chosen.judged_by)
    facts: dict[str, Any] = found.figures | {
        "remark": ESTIMATORS[chosen.method].remark(capture, chosen.false_alarm, settings),
        "flux_s": found.flux_time_s,
        "estimate_s": found.estimate_s,
    }
    if capture.truth_range_m is not None:
        facts |= _targets(capture.truth_range_m)
    image = found.image
    if chosen.returns > 1:
        share = FALSE_RETURN if chosen.false_return is None else chosen.false_return
        image = with_returns(capture, image, chosen.returns, share)
        assert image.returns is not None
        several = image.returns.count(capture.shape) > 1
        facts["pixels_with_several_returns"] = int(several.sum())
    return capture, image, facts | _velocity_facts(image)


def _velocity_facts(image: RangeImage) -> dict[str, float]:
    """Return the median velocities of confident pixels, in each unit."""
    if image.velocity is None:
        return {}
    kept = image.velocity.planes(image.confidence >= _CONFIDENT)
    return {
        f"median_{name}": float(np.nanmedian(plane.values))
        for name, plane in kept.items()
        if np.isfinite(plane.values).any()
    }


def _range_in_tiles(
    chosen: argparse.Namespace, settings: Any
) -> tuple[CaptureInfo, RangeImage, dict[str, Any]]:
    from core.out_of_core import tiles  # noqa: PLC0415 - loads Dask, which small captures do not need

    if chosen.capture is None:
        raise ValueError("scheduler needs a --capture: a scene is simulated and ranged here.")
    counts = open_capture(chosen.capture, **reading(chosen))
    print(counts.attrs.get("source", ""), file=sys.stderr)
    acquisition = describe(counts, ReadOptions()).acquisition
    truth_m, origin = None, ""
    if truth := truth_options_from(chosen, chosen.capture):
        truth_m, origin = truth_of(shape=counts.shape[:2], acquisition=acquisition, **truth)
        print(origin, file=sys.stderr)
    started = perf_counter()
    parts = tiles.estimate_large(counts, chosen.method, settings, false_alarm=chosen.false_alarm)
    described, image = tiles.as_image(tiles.computed(parts, chosen.scheduler))
    facts = {"remark": parts.attrs["remark"], "seconds": perf_counter() - started}
    if truth_m is not None:
        facts |= figures_of(image.range_m, truth_m, acquisition.bin_length_m) | _targets(truth_m)
        described = replace(described, source="; ".join(filter(None, (described.source, origin))))
    return described, image, facts


def _targets(truth_m: Floats) -> dict[str, int]:
    return {"pixels_with_a_target": int(np.isfinite(truth_m).sum())}


# -- simulate and export ---------------------------------------------------------------------------


def _add_simulate(commands: Any) -> None:
    command = commands.add_parser("simulate", help="simulate a capture of a scene")
    names = ", ".join(scenes)
    command.add_argument(
        "--scene", default="car", help=f"{names}, or a file: a mesh or a depth map (car)"
    )
    command.add_argument("--size", type=whole_from_to(8, 4096), help="rows and columns")
    command.add_argument(
        "--pulses", type=whole_from_to(1, 2**32 - 1), help="by default the scene's own"
    )
    group = command.add_argument_group("view of a scene file; what is not given is assumed")
    for flag, name, kind, help in (
        ("--unit", "unit_m", float, "of the file, in metres"),
        ("--distance", "distance_m", float, "to the nearest point of a mesh, in metres"),
        ("--pixel-angle", "pixel_angle_rad", angle, "between neighbouring pixels, such as 1mrad"),
    ):
        group.add_argument(flag, dest=name, type=kind, help=help)
    add_flux(command)
    command.add_argument(
        "--pulse-groups",
        type=whole_from_to(1, MOST_PULSE_GROUPS),
        help="groups in which the order of the pulses is kept, such as 40, for scenes that move",
    )
    _add_out(command, "the capture", CAPTURE_SUFFIXES, required=True)
    _add_json(command)
    command.set_defaults(work=_simulate)


def _simulate(chosen: argparse.Namespace) -> None:
    refused = _refused(chosen)
    scene = _scene(chosen)
    acquisition = scene.acquisition
    if chosen.pulses is not None:
        acquisition = replace(acquisition, n_pulses=chosen.pulses)
    capture = simulate(
        scene, acquisition, flux_of(chosen), seed=chosen.seed or 0, n_groups=chosen.pulse_groups
    )
    given = {"unit": chosen.unit_m, "distance": chosen.distance_m}
    options = [f"{name} {value:g}" for name, value in given.items() if value is not None]
    source = ", ".join((printable(chosen.scene), capture.source, *options))
    _save_captures(replace(capture, source=source), chosen, refused)


def _scene(chosen: argparse.Namespace) -> Scene:
    size = chosen.size
    if chosen.scene not in scenes:
        known = " or ".join(scenes)
        require("scene", chosen.scene, Path(chosen.scene).suffix != "", f"{known}, or a file")
        view = {name: getattr(chosen, name) for name in _VIEW}
        return read_scene(chosen.scene, size=None if size is None else (size, size), **view)
    require_none(vars(chosen), _VIEW, "a built-in scene has a view of its own")
    return scenes[chosen.scene](**({} if size is None else {"size": size}))


def _add_export(commands: Any) -> None:
    command = commands.add_parser(
        "export", help="convert a capture, or write a pixel's signals as CSV"
    )
    command.add_argument("capture", type=Path, help="a file that `info` can read")
    suffixes = ", ".join(CAPTURE_SUFFIXES)
    command.add_argument("out", type=Path, nargs="+", help=f"{suffixes}; .csv with --pixel")
    add_pixel(command, "write the signals of this pixel")
    command.add_argument(
        "--preset", choices=PRESETS, default="recommended", help="of these signals (recommended)"
    )
    command.add_argument("--overwrite", action="store_true", help="replace files")
    _add_json(command)
    add_read_options(command)
    command.set_defaults(work=_export, suffixes=(*CAPTURE_SUFFIXES, ".csv"))


def _export(chosen: argparse.Namespace) -> None:
    refused = _refused(chosen)
    capture = read_capture(chosen.capture, **reading(chosen))
    if chosen.pixel is None:
        _save_captures(capture, chosen, refused)
        return
    settings = PRESETS[chosen.preset]
    row, col = chosen.pixel
    save = partial(save_pixel, capture, row, col, settings, overwrite=chosen.overwrite)
    written, refused = save_each(chosen.out, refused, save)
    show({"source": capture.source, "written": _names(written)}, chosen.json)
    require_all(chosen.out, refused)


def _save_captures(capture: Capture, chosen: argparse.Namespace, refused: Refused) -> None:
    save = partial(save_capture, capture, overwrite=chosen.overwrite)
    written, refused = save_each(chosen.out, refused, save)
    photons = int(capture.counts.sum())
    facts = {"source": capture.source, "photons": photons, "written": _names(written)}
    show(facts, chosen.json)
    require_all(chosen.out, refused)


# -- Shared ----------------------------------------------------------------------------------------


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


def _add_out(
    command: Any, what: str, suffixes: Sequence[str], required: bool = False, more: str = ""
) -> None:
    command.add_argument(
        "--out",
        type=Path,
        action="append",
        default=[],
        required=required,
        help=f"a file for {what} in the format of its suffix: {', '.join(suffixes)}; "
        f"repeatable{more}",
    )
    command.add_argument("--overwrite", action="store_true", help="replace files")
    command.set_defaults(suffixes=suffixes)


def _add_json(command: Any) -> None:
    command.add_argument("--json", action="store_true", help="one JSON object instead of lines")


def _refused(chosen: argparse.Namespace) -> Refused:
    """Return outputs that cannot be written before anything is computed."""
    return refused_outputs(chosen.out, chosen.suffixes, chosen.overwrite)


def _capture(chosen: argparse.Namespace) -> Capture:
    if chosen.capture:
        require_none(vars(chosen), FLUX_OPTIONS, "a capture has its own flux")
        return read_capture(chosen.capture, **reading(chosen))
    options = reading(chosen)
    n_groups = options.pop("pulse_groups")
    if ESTIMATORS[chosen.method].follows_motion:
        n_groups = n_groups or USUAL_GROUPS
    require_none(options, list(options), "a scene is not read from a file")
    scene = scenes[chosen.scene]()
    seed = chosen.seed or 0
    return simulate(scene, scene.acquisition, flux_of(chosen), seed=seed, n_groups=n_groups)
