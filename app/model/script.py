"""What a page shows, as a short Python script that finds it again with `core` alone.

Settings are written as the fields of their dataclasses that differ from the defaults, so that a new
field needs no line here. Whatever comes from a user goes into the code as a literal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from textwrap import indent
from typing import Any

from app.model.state import CLOUDS, Comparison, State, Viewing
from app.model.store import Answer
from core import CORRECTIONS, ESTIMATORS, PARTS, Pulse, inspection

LINE = 88
"""Letters of a line, as formatters have it; a longer call stands one argument a line."""

PICTURES = {
    "Estimate": "shown.range_m",
    "Truth": "capture.truth_range_m",
    "Error": "shown.range_m - capture.truth_range_m",
    "Confidence": "np.where(image.valid, image.confidence, np.nan)",
    "Counts": "capture.counts",
    **{name: f'core.inspection.maps["{name}"](capture)' for name in inspection.maps},
}
"""How the pictures of Explore and Inspect are found."""

ELSEWHERE = {"Trade-off": "python -m core tradeoff", "Paper": "python -m core paper"}
"""Pages whose numbers a command finds, which takes longer than a script should."""

HEAD = '''"""What firstphoton shows{where}, found again."""

{math}from dataclasses import replace

import numpy as np

import core

'''

Lines = Iterator[str]


def script_of(answer: Answer, state: State) -> str:
    """The script of what is on screen.

    Parameters
    ----------
    answer : Answer
        What is shown.
    state : State
        How it is shown.
    """
    compares = state.page == "Compare"
    has_clouds = not compares or state.comparison.kind == CLOUDS
    body = _comparison if compares else _tracking
    lines = [*_capture(answer), *_less(answer), *body(answer, state)]
    where = ""
    if state.page in ELSEWHERE:
        where = f" on Explore ({state.page}: {ELSEWHERE[state.page]})"
    head = HEAD.format(where=where, math="import math\n" if has_clouds else "")
    return head + "\n".join(lines) + "\n"


# The capture


def _capture(answer: Answer) -> Lines:
    request = answer.request
    source, light = request.source, request.light
    if source.scene is None:
        yield from _file(answer)
        return
    yield "# The scene, and its capture in this light."
    yield _assign("scene", f"core.scenes[{_literal(source.name)}]", **_literals(source.arguments))
    for part in PARTS:
        if part in request.absent:
            yield _assign("scene", "core.without", "scene", _literal(part))
    acquisition = light.acquisition(source.scene().acquisition)
    gate = "scene.acquisition"
    if acquisition != source.scene().acquisition:
        gate = "acquisition"
        pulses = _literal(light.n_pulses)
        yield _assign(gate, "replace", "scene.acquisition", n_pulses=pulses)
    flux = _call("core.Flux", **_told(light.flux))
    seed = {"seed": _literal(light.seed)} if light.seed else {}
    yield _assign("capture", "core.simulate", "scene", gate, flux, **seed)


def _file(answer: Answer) -> Lines:
    request, cutout = answer.request, answer.cutout
    yield "# The capture; put its folder before its name, if it lies elsewhere."
    yield f"path = {_literal(request.source.name)}"
    window = request.window if cutout is None else cutout.window
    reading = _told(request.reading)
    if window is None:
        yield _assign("capture", "core.read_capture", "path", **reading)
    else:
        yield _assign("counts", "core.open_capture", "path", **reading)
        yield _assign("window", "core.Window", **_told(window))
        yield _assign("capture", "core.read_window", "counts", "window")


def _less(answer: Answer) -> Lines:
    request = answer.request
    reduction = _told(request.less.reduction(answer.whole.acquisition.n_bins))
    if reduction:
        yield "\n# Less of it."
        yield _assign("reduction", "core.reductions.Reduction", **reduction)
        yield "capture = reduction.of(capture)"
    off = [name for name in CORRECTIONS if name in request.absent]
    if off:
        yield "\n# What estimators do not correct for."
    for name in off:
        yield _assign("capture", "core.without_correction", "capture", _literal(name))


# Pages that look into the tracking differentiator


def _tracking(answer: Answer, state: State) -> Lines:
    yield "\n# The range image, and what of it is shown: answers of enough confidence."
    settings = _told(answer.request.tracking)
    yield _assign("settings", "core.TrackingParameters", **settings)
    yield _assign("image", "core.estimate", "capture", '"tracking"', "settings")
    yield from _shown(state.viewing.least_confidence)
    inspected = state.page == "Inspect"
    kind = state.map if inspected else state.image
    yield f"picture = {PICTURES[kind]}"
    yield "\n# The pixel: every stage of the estimator."
    yield f"row, col = {state.pixel[0]}, {state.pixel[1]}"
    yield _signals("signals", "row, col")
    if inspected:
        yield from _inspected(state)
    elif state.difference:
        yield "difference = core.first_difference(capture.cube[row, col])"
    yield "\n# As files."
    yield _saved('"range.png"')
    yield from _angle(state.viewing)
    yield from _cloud('"cloud.ply"')
    pixel = ("capture", "row", "col", "settings", _literal("pixel.csv"))
    yield _assign("", "core.save_pixel", *pixel, overwrite="True")
    if kind != "Estimate":
        yield 'np.savetxt("picture.csv", picture, delimiter=",")'


def _angle(viewing: Viewing) -> Lines:
    yield f"half_rad = math.radians({_literal(viewing.field_of_view_deg)}) / 2"
    yield "angle_rad = math.atan(2 * math.tan(half_rad) / capture.shape[1])"


def _cloud(file: str) -> Lines:
    yield f"cloud = {file}"
    yield "if sure.any():  # a cloud needs points"
    yield indent(_saved("cloud", pixel_angle_rad="angle_rad"), "    ")


def _saved(file: str, **options: str) -> str:
    """Of a file, its name as code."""
    return _assign("", "core.save_image", "capture", "shown", file, **options, overwrite="True")


def _inspected(state: State) -> Lines:
    by = ('"tracking"', "settings")
    if state.subject == "Pixel":
        pixel = ("capture", "image", "row", "col", *by)
        yield _assign("report", "core.inspection.pixel_report", *pixel)
    if state.subject == "Capture":
        yield "\n# The capture as a whole."
        yield _assign("report", "core.inspection.capture_report", "capture")
    if state.pins:
        yield "\n# The pinned pixels."
        yield "pinned = {}"
        for row, col in state.pins:
            yield _signals(f"pinned[{row}, {col}]", f"{row}, {col}")
    if state.region:
        yield "\n# The region."
        yield _assign("corners", "", *map(_literal, state.region))
        yield _assign("mask", "core.inspection.pixels_in", "corners", "capture.shape")
        region = ("capture", "image", "mask", *by)
        yield _assign("region", "core.inspection.region_report", *region)


def _shown(least_confidence: float) -> Lines:
    """Of an image, what is shown of it."""
    yield f"sure = image.valid & (image.confidence >= {_literal(least_confidence)})"
    kept = "np.where(sure, image.range_m, np.nan)"
    yield _assign("shown", "replace", "image", range_m=kept, valid="sure")


def _signals(name: str, pixel: str) -> str:
    of = (f"capture.cube[{pixel}]", "settings", "capture.gated_pulses")
    return _assign(name, "core.tracking_signals", *of)


# The page that compares methods


def _comparison(answer: Answer, state: State) -> Lines:
    chosen: Comparison = state.comparison
    settings = {**chosen.settings, "tracking": answer.request.tracking}
    alarm = {} if chosen.false_alarm == 1 else {"false_alarm": _literal(chosen.false_alarm)}
    yield "\n# The range image of each method."
    yield "images = {}"
    for method in chosen.methods:
        try:
            ESTIMATORS[method].flux_model(answer.capture)
        except ValueError:
            yield f"# {method} has no answer: it needs to be told the true light."
        else:
            told = _told(settings[method]) | alarm
            name = _literal(method)
            yield _assign(f"images[{name}]", "core.estimate", "capture", name, **told)
    clouds = chosen.kind == CLOUDS
    yield "\n# What of them is shown, and as files: answers of enough confidence."
    if clouds:
        yield from _angle(chosen.viewing)
    yield "pictures = {}"
    yield "for method, image in images.items():"
    error = " - capture.truth_range_m" if chosen.kind == "Error" else ""
    picture = PICTURES["Confidence"] if chosen.kind == "Confidence" else f"shown.range_m{error}"
    of_each = [
        *_shown(chosen.viewing.least_confidence),
        f"pictures[method] = {picture}",
        *(_cloud('f"{method}.ply"') if clouds else [_saved('f"{method}.png"')]),
    ]
    yield indent("\n".join(of_each), "    ")


# Code


def _told(settings: Any) -> dict[str, str]:
    """The fields of a settings object that are not as they are unless told, as code."""
    told = {each: getattr(settings, each.name) for each in fields(settings)}
    return _literals({each.name: value for each, value in told.items() if value != each.default})


def _literals(values: Mapping[str, Any]) -> dict[str, str]:
    return {name: _literal(value) for name, value in values.items()}


def _literal(value: Any) -> str:
    """Code of a value; text from outside cannot become anything but a string."""
    if isinstance(value, Pulse):
        return _call("core.Pulse", **_told(value))
    if isinstance(value, tuple):
        items = [_literal(each) for each in value]
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(value, str):
        code = repr(value)
        # As formatters write it; a string without any quotation mark may have either.
        return f'"{code[1:-1]}"' if code[0] == "'" and '"' not in code else code
    if isinstance(value, bool | int | float):
        return repr(value)
    raise TypeError(f"no code for {type(value).__name__}")


def _call(function: str, *positional: str, **named: str) -> str:
    return f"{function}({', '.join(_arguments(positional, named))})"


def _assign(name: str, function: str, *positional: str, **named: str) -> str:
    """A call, its result named, on one line or on as many as it needs."""
    start = f"{name} = " if name else ""
    line = start + _call(function, *positional, **named)
    if len(line) <= LINE:
        return line
    arguments = "".join(f"    {each},\n" for each in _arguments(positional, named))
    return f"{start}{function}(\n{arguments})"


def _arguments(positional: tuple[str, ...], named: Mapping[str, str]) -> list[str]:
    return [*positional, *(f"{name}={value}" for name, value in named.items())]
