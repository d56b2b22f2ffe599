"""The view of a page as a short Python script that computes the same arrays with `core` alone.

Settings are written as the ``repr`` of their dataclasses without fields at their default, so that a
new field needs no line here. Text from outside can only become a string literal.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from textwrap import indent
from typing import Any

from app.model.state import CLOUDS, State, Viewing
from app.model.store import Answer
from core import CORRECTIONS, ESTIMATORS, PARTS, inspection

LINE_LENGTH = 88
"""Characters of a line; a longer call has one argument per line, as formatters write it."""

IMAGES = {
    "Estimate": "shown.range_m",
    "Truth": "capture.truth_range_m",
    "Error": "shown.range_m - capture.truth_range_m",
    "Confidence": "np.where(image.valid, image.confidence, np.nan)",
    "Counts": "capture.counts",
    **{name: f'core.inspection.maps["{name}"](capture)' for name in inspection.maps},
}
"""Code of the images of Explore and Inspect."""

COMMANDS = {"Trade-off": "python -m core tradeoff", "Paper": "python -m core paper"}
"""Pages whose numbers take longer than a script should, and the command that computes them."""

Lines = Iterator[str]


def script_of(answer: Answer, state: State) -> str:
    """Return the script of what is on screen.

    Parameters
    ----------
    answer : Answer
        The estimate that is shown.
    state : State
        How it is shown.
    """
    compares = state.page == "Compare"
    imports = "from dataclasses import replace\n\nimport numpy as np\n\nimport core\n"
    if not compares or state.comparison.kind == CLOUDS:
        imports = f"import math\n{imports}"
    title = "View of firstphoton"
    if state.page in COMMANDS:
        title = f"Explore view of firstphoton ({state.page}: {COMMANDS[state.page]})"
    body = _comparison if compares else _single_estimate
    lines = [f'"""{title}."""\n', imports, *_capture(answer), *body(answer, state)]
    return "\n".join(lines) + "\n"


# The capture


def _capture(answer: Answer) -> Lines:
    request = answer.request
    yield from _file(answer) if request.source.scene is None else _simulation(answer)
    reduction = request.less.reduction(answer.whole.acquisition.n_bins)
    if changed := changed_fields(reduction):
        yield "\n# Reduce the capture."
        yield _assign("reduction", "core.reductions.Reduction", **changed)
        yield "capture = reduction.of(capture)"
    off = [name for name in CORRECTIONS if name in request.absent]
    if off:
        yield "\n# Switch corrections off."
    for name in off:
        yield _assign("capture", "core.without_correction", "capture", literal(name))


def _simulation(answer: Answer) -> Lines:
    request = answer.request
    source, light = request.source, request.light
    assert source.scene is not None
    yield "# Simulate a capture of the scene."
    arguments = {name: literal(value) for name, value in source.arguments.items()}
    yield _assign("scene", f"core.scenes[{literal(source.name)}]", **arguments)
    for part in PARTS:
        if part in request.absent:
            yield _assign("scene", "core.without", "scene", literal(part))
    own, acquisition = source.scene().acquisition, "scene.acquisition"
    if light.acquisition(own) != own:
        pulses = literal(light.n_pulses)
        yield _assign("acquisition", "replace", acquisition, n_pulses=pulses)
        acquisition = "acquisition"
    seed = {"seed": literal(light.seed)} if light.seed else {}
    yield _assign("capture", "core.simulate", "scene", acquisition, literal(light.flux), **seed)


def _file(answer: Answer) -> Lines:
    request, cutout = answer.request, answer.cutout
    yield "# Read the capture. Add the folder to the path if necessary."
    yield f"path = {literal(request.source.name)}"
    window = request.window if cutout is None else cutout.window
    options = changed_fields(request.reading.completed_by(request.source.given))
    if window is None:
        yield _assign("capture", "core.read_capture", "path", **options)
    else:
        yield _assign("counts", "core.open_capture", "path", **options)
        yield _assign("window", "core.Window", **changed_fields(window))
        yield _assign("capture", "core.read_window", "counts", "window")


# Pages that show the tracking differentiator


def _single_estimate(answer: Answer, state: State) -> Lines:
    is_inspect = state.page == "Inspect"
    kind = state.map if is_inspect else state.image
    settings = changed_fields(answer.request.tracking)
    yield "\n# Estimate the ranges. `shown` has only pixels of sufficient confidence."
    yield _assign("settings", "core.TrackingParameters", **settings)
    yield _assign("image", "core.estimate", "capture", '"tracking"', "settings")
    yield from _shown(state.viewing.least_confidence)
    yield f"picture = {IMAGES[kind]}"
    yield "\n# Signals of one pixel."
    yield f"row, col = {state.pixel[0]}, {state.pixel[1]}"
    yield _signals("signals", "row, col")
    if is_inspect:
        yield from _reports(state)
    elif state.difference:
        yield "difference = core.first_difference(capture.cube[row, col])"
    yield "\n# Save image, point cloud and pixel."
    yield _saved('"range.png"')
    yield from _angle(state.viewing)
    yield from _saved_cloud('"cloud.ply"')
    pixel = ("capture", "row", "col", "settings", '"pixel.csv"')
    yield _assign("", "core.save_pixel", *pixel, overwrite="True")
    if kind != "Estimate":
        yield 'np.savetxt("picture.csv", picture, delimiter=",")'


def _reports(state: State) -> Lines:
    method = ('"tracking"', "settings")
    if state.subject == "Pixel":
        pixel = ("capture", "image", "row", "col", *method)
        yield _assign("report", "core.inspection.pixel_report", *pixel)
    if state.subject == "Capture":
        yield "\n# Report on the capture."
        yield _assign("report", "core.inspection.capture_report", "capture")
    if state.pins:
        yield "\n# Signals of the pinned pixels."
        yield "pinned = {}"
        for row, col in state.pins:
            yield _signals(f"pinned[{row}, {col}]", f"{row}, {col}")
    if state.region:
        yield "\n# Report on the region."
        yield _assign("corners", "", *map(literal, state.region))
        yield _assign("mask", "core.inspection.pixels_in", "corners", "capture.shape")
        region = ("capture", "image", "mask", *method)
        yield _assign("region", "core.inspection.region_report", *region)


def _signals(name: str, pixel: str) -> str:
    arguments = (f"capture.cube[{pixel}]", "settings", "capture.gated_pulses")
    return _assign(name, "core.tracking_signals", *arguments)


def _shown(least_confidence: float) -> Lines:
    yield f"confident = image.valid & (image.confidence >= {literal(least_confidence)})"
    range_m = "np.where(confident, image.range_m, np.nan)"
    yield _assign("shown", "replace", "image", range_m=range_m, valid="confident")


def _angle(viewing: Viewing) -> Lines:
    yield f"half_rad = math.radians({literal(viewing.field_of_view_deg)}) / 2"
    yield "angle_rad = math.atan(2 * math.tan(half_rad) / capture.shape[1])"


def _saved(path: str, **options: str) -> str:
    return _assign("", "core.save_image", "capture", "shown", path, **options, overwrite="True")


def _saved_cloud(path: str) -> Lines:
    yield f"cloud = {path}"
    yield "if confident.any():  # a point cloud needs points"
    yield indent(_saved("cloud", pixel_angle_rad="angle_rad"), "    ")


# The page that compares methods


def _comparison(answer: Answer, state: State) -> Lines:
    chosen = state.comparison
    settings = {**chosen.settings, "tracking": answer.request.tracking}
    false_alarm = {} if chosen.false_alarm == 1 else {"false_alarm": literal(chosen.false_alarm)}
    yield "\n# Estimate the ranges with each method."
    yield "images = {}"
    for method in chosen.methods:
        name = literal(method)
        try:
            ESTIMATORS[method].flux_model(answer.capture)
        except ValueError:
            yield f"# {method} is left out: it needs the true signal and background."
        else:
            options = changed_fields(settings[method]) | false_alarm
            yield _assign(f"images[{name}]", "core.estimate", "capture", name, **options)
    has_clouds = chosen.kind == CLOUDS
    yield "\n# Save the images. `shown` has only pixels of sufficient confidence."
    if has_clouds:
        yield from _angle(chosen.viewing)
    yield "pictures = {}"
    yield "for method, image in images.items():"
    kind = chosen.kind if chosen.kind in ("Error", "Confidence") else "Estimate"
    of_each = [
        *_shown(chosen.viewing.least_confidence),
        f"pictures[method] = {IMAGES[kind]}",
        *(_saved_cloud('f"{method}.ply"') if has_clouds else [_saved('f"{method}.png"')]),
    ]
    yield indent("\n".join(of_each), "    ")


# Code


def changed_fields(settings: Any) -> dict[str, str]:
    """Return the fields of a dataclass object that differ from their default, as code."""
    values = {each: getattr(settings, each.name) for each in fields(settings)}
    return {each.name: literal(value) for each, value in values.items() if value != each.default}


def literal(value: Any) -> str:
    """Return the code of a value: a literal, or the call that makes a dataclass of `core`."""
    if is_dataclass(value):
        return _call(f"core.{type(value).__name__}", **changed_fields(value))
    if isinstance(value, tuple):
        items = [literal(each) for each in value]
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(value, str):
        code = repr(value)
        # Formatters prefer double quotes where the text has none.
        return f'"{code[1:-1]}"' if code[0] == "'" and '"' not in code else code
    if isinstance(value, bool | int | float):
        return repr(value)
    raise TypeError(f"no code for {type(value).__name__}")


def _call(function: str, *positional: str, **named: str) -> str:
    return f"{function}({', '.join(_arguments(*positional, **named))})"


def _assign(name: str, function: str, *positional: str, **named: str) -> str:
    """Return a call whose result is assigned to a name, on as many lines as it needs."""
    start = f"{name} = " if name else ""
    line = start + _call(function, *positional, **named)
    if len(line) <= LINE_LENGTH:
        return line
    arguments = "".join(f"    {each},\n" for each in _arguments(*positional, **named))
    return f"{start}{function}(\n{arguments})"


def _arguments(*positional: str, **named: str) -> list[str]:
    return [*positional, *(f"{name}={value}" for name, value in named.items())]
