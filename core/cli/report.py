"""The command that writes a report on a capture: one HTML file that needs no network."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from core.checks import printable
from core.cli.options import (
    add_colors,
    add_crop,
    add_false_alarm,
    add_judge,
    add_pixel,
    add_settings,
    colors_given,
    crop_given,
    probability,
    reading,
    settings_given,
    show,
)
from core.cli.saving import refused_outputs
from core.estimators import ESTIMATORS, JUDGES, estimate
from core.geometry import WHOLE
from core.io.readers import read_capture
from core.io.readers.options import add_read_options, read_options_from
from core.io.readers.truth import add_truth_options, read_truth, truth_options_from
from core.report import LEAST_CONFIDENCE, save_report
from core.scripts import assign, call, changed_fields, literal


def add(commands: Any) -> None:
    """Add this command to a parser."""
    command = commands.add_parser(
        "report",
        help="write a report on a capture as one HTML file",
        description="Range a capture by one method, and write a report as one HTML file that opens "
        "without a network: what was read, fluxes with intervals, maps, one pixel, a point cloud "
        "to turn, settings, and a Python script.",
    )
    methods = command.add_subparsers(dest="method", required=True)
    for name, estimator in ESTIMATORS.items():
        method = methods.add_parser(name, help=estimator.title, description=estimator.title)
        method.add_argument("capture", type=Path, help="a file that `info` can read")
        method.add_argument("out", type=Path, help="the report, .html")
        add_pixel(
            method,
            "pixel to show; by default the one nearest to the centre with a target or a confident "
            "estimate",
        )
        method.add_argument(
            "--least-confidence",
            type=probability,
            default=LEAST_CONFIDENCE,
            help=f"maps and cloud hide estimates of less confidence ({LEAST_CONFIDENCE:g})",
        )
        add_false_alarm(method)
        add_judge(method)
        add_crop(method)
        add_colors(method)
        method.add_argument("--overwrite", action="store_true", help="replace the file")
        method.add_argument("--json", action="store_true", help="one JSON object instead of lines")
        add_truth_options(method)
        add_settings(method, estimator.parameters)
        add_read_options(method)
        method.set_defaults(work=_report)


def _report(chosen: argparse.Namespace) -> None:
    refused_outputs([chosen.out], (".html",), chosen.overwrite)
    truth = truth_options_from(chosen, chosen.capture)
    settings = settings_given(chosen, ESTIMATORS[chosen.method].parameters)
    box, colors = crop_given(chosen), colors_given(chosen)
    capture = read_capture(chosen.capture, **reading(chosen))
    if truth:
        capture = read_truth(capture=capture, **truth)
    print(capture.source, file=sys.stderr)  # with assumptions, before anything depends on them
    given = {"false_alarm": chosen.false_alarm, "judged_by": chosen.judged_by}
    image = estimate(capture, chosen.method, settings, **given)
    save_report(
        capture,
        image,
        chosen.out,
        overwrite=chosen.overwrite,
        pixel=chosen.pixel and tuple(chosen.pixel),
        least_confidence=chosen.least_confidence,
        box=box,
        colors=colors,
        title=chosen.capture.name,
        script=_script(chosen, settings),
    )
    show({"source": capture.source, "written": printable(str(chosen.out))}, chosen.json)


def _script(chosen: argparse.Namespace, settings: Any) -> str:
    """Return the Python script that writes the same report."""
    return "\n".join(_lines(chosen, settings))


def _lines(chosen: argparse.Namespace, settings: Any) -> Iterator[str]:
    yield '"""Report of firstphoton."""\n\nimport core\n'
    yield "# Add the folder to the paths if necessary."
    options = changed_fields(read_options_from(chosen))
    yield assign("capture", "core.read_capture", literal(chosen.capture.name), **options)
    if truth := truth_options_from(chosen, chosen.capture):
        name = literal(truth.pop("path").name)
        given = {option: literal(value) for option, value in truth.items() if value is not None}
        yield assign("capture", "core.read_truth", name, "capture", **given)
    method = literal(chosen.method)
    yield assign("settings", f"core.ESTIMATORS[{method}].parameters", **changed_fields(settings))
    given = {} if chosen.false_alarm is None else {"false_alarm": literal(chosen.false_alarm)}
    if chosen.judged_by != JUDGES[0]:
        given["judged_by"] = literal(chosen.judged_by)
    yield assign("image", "core.estimate", "capture", method, "settings", **given)
    view = {"least_confidence": literal(chosen.least_confidence)}
    if chosen.pixel is not None:
        view["pixel"] = literal(tuple(chosen.pixel))
    if (box := crop_given(chosen)) != WHOLE:
        view["box"] = call("core.geometry.Box", **changed_fields(box))
    if colors := changed_fields(colors_given(chosen)):
        view["colors"] = call("core.io.RangeColors", **colors)
    out, title = literal(chosen.out.name), literal(chosen.capture.name)
    yield assign("", "core.save_report", "capture", "image", out, title=title, **view)
