"""The view of a page as a short Python script that computes the same arrays with `core` alone.

`core.scripts` writes settings, so that a new field needs no line here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields
from itertools import chain
from textwrap import indent

from app.model.state import CLOUDS, MOST_PROBABLE, NEIGHBOURS, VELOCITY, State, Viewing
from app.model.store import Answer
from core import CORRECTIONS, ESTIMATORS, inspection, without
from core.estimators import JUDGES
from core.geometry import WHOLE, Box
from core.io import RangeColors
from core.scripts import assign, changed_fields, literal

IMAGES = {
    "Estimate": "shown.range_m",
    "Truth": "capture.truth_range_m",
    "Error": "shown.range_m - capture.truth_range_m",
    "Reported": "capture.reported_range_m",
    "Confidence": "np.where(image.valid, image.confidence, np.nan)",
    "Counts": "capture.counts",
    VELOCITY: "np.where(shown.valid, image.velocity.values, np.nan)",
    **{name: f'core.inspection.maps["{name}"](capture)' for name in inspection.maps},
}
"""Code of the images of Explore and Inspect."""

COMMANDS = {"Trade-off": "python -m core tradeoff", "Paper": "python -m core paper"}
"""Pages whose numbers take longer than a script should, and the command that computes them."""

Lines = Iterator[str]


def script_of(answer: Answer, state: State, kept: Answer | None = None) -> str:
    """Return the script of what is on screen.

    Parameters
    ----------
    answer : Answer
        The estimate that is shown.
    state : State
        How it is shown.
    kept : Answer, optional
        The estimate that was kept as A, if it is known.
    """
    title = "View of firstphoton"
    if state.page in COMMANDS:
        title = f"Explore view of firstphoton ({state.page}: {COMMANDS[state.page]})"
    if kept is not None and _shows_pair(state) and kept.capture.shape == answer.capture.shape:
        lines = _pair(kept, answer, state)
    else:
        estimate = _comparison if state.page == "Compare" else _single_estimate
        lines = chain(_capture(answer), estimate(answer, state))
    body = "\n".join(lines)
    return f'"""{title}."""\n\n{_imports(body)}\n{body}\n'


def _shows_pair(state: State) -> bool:
    return bool(state.page == "Inspect" and state.subject == "A/B")


def _imports(body: str) -> str:
    """Return the imports that some code needs, in the order of linters."""
    known = {
        "replace(": "from dataclasses import replace\n",
        "np.": "import numpy as np\n",
        "core.": "import core\n",
    }
    return "\n".join(
        line for use, line in known.items() if re.search(rf"(?<![\w.]){re.escape(use)}", body)
    )


# The capture


def _capture(answer: Answer) -> Lines:
    request = answer.request
    yield from _file(answer) if request.source.scene is None else _simulation(answer)
    reduction = request.reduction.in_bins(answer.whole.acquisition.n_bins)
    if changed := changed_fields(reduction):
        yield "\n# Reduce the capture."
        yield assign("reduction", "core.reductions.Reduction", **changed)
        yield "capture = reduction.of(capture)"
    off = [name for name in CORRECTIONS if name in request.absent]
    if off:
        yield "\n# Switch corrections off."
    for name in off:
        yield assign("capture", "core.without_correction", "capture", literal(name))


def _simulation(answer: Answer) -> Lines:
    request = answer.request
    source, light = request.source, request.light
    assert source.scene is not None
    yield "# Simulate a capture of the scene."
    arguments = {name: literal(value) for name, value in source.arguments.items()}
    yield assign("scene", f"core.scenes[{literal(source.name)}]", **arguments)
    flux = literal(light.flux)
    if request.budget is not None:
        flux = "flux"
        yield assign("budget", "core.PhotonBudget", **changed_fields(request.budget))
        yield "scene, flux = budget.apply(scene)"
    parts = request.absent_parts
    if parts:
        yield assign("scene", "core.without", "scene", *map(literal, parts))
    own, acquisition = source.scene().acquisition, "scene.acquisition"
    if light.acquisition(own) != own:
        pulses = literal(light.n_pulses)
        yield assign("acquisition", "replace", acquisition, n_pulses=pulses)
        acquisition = "acquisition"
    seed = {"seed": literal(light.seed)} if light.seed else {}
    groups = without(source.scene(), *parts).groups_of(light.acquisition(own).n_pulses)
    order = {"n_groups": literal(groups)} if groups else {}
    yield assign("capture", "core.simulate", "scene", acquisition, flux, **seed, **order)


def _file(answer: Answer) -> Lines:
    request, cutout = answer.request, answer.cutout
    yield "# Read the capture. Add the folder to the path if necessary."
    yield f"path = {literal(request.source.name)}"
    window = request.window if cutout is None else cutout.window
    options = changed_fields(request.reading.completed_by(request.source.given))
    if window is None:
        yield assign("capture", "core.read_capture", "path", **options)
        if (truth := request.source.truth) is not None:
            named = {name: literal(value) for name, value in truth.options.items()}
            yield assign("capture", "core.read_truth", literal(truth.name), "capture", **named)
    else:
        yield assign("counts", "core.open_capture", "path", **options)
        yield assign("window", "core.Window", **changed_fields(window))
        yield assign("capture", "core.read_window", "counts", "window")


# Pages that show one method


def _single_estimate(answer: Answer, state: State) -> Lines:
    is_inspect = state.page == "Inspect"
    kind = state.map if is_inspect else state.image
    method = literal(answer.method)
    yield from _estimate(answer, state)
    yield from _angle(answer, state.viewing)
    yield f"picture = {IMAGES[kind]}"
    yield "\n# Signals of one pixel."
    yield f"row, col = {state.pixel[0]}, {state.pixel[1]}"
    yield _signals(answer.method, "signals", "row, col")
    if is_inspect:
        yield from _reports(answer, state)
    elif state.difference:
        yield "difference = core.first_difference(capture.cube[row, col])"
    yield "\n# Save image, point cloud and pixel."
    yield from _saved_picture('"range.png"', state.viewing)
    yield from _saved_cloud('"cloud.ply"', state.box)
    pixel = ("capture", "row", "col", "settings", '"pixel.csv"')
    chosen = {} if answer.method == "tracking" else {"method": method}
    yield assign("", "core.save_pixel", *pixel, **chosen, overwrite="True")
    if kind != "Estimate":
        yield 'np.savetxt("picture.csv", picture, delimiter=",")'


def _estimate(answer: Answer, state: State) -> Lines:
    method, settings = literal(answer.method), changed_fields(answer.settings)
    yield "\n# Estimate the ranges. `shown` has only pixels of sufficient confidence."
    yield assign("settings", f"core.ESTIMATORS[{method}].parameters", **settings)
    several = {} if answer.request.returns == MOST_PROBABLE else {"returns": "2"}
    yield assign(
        "image", "core.estimate", "capture", method, "settings", **_judged(answer), **several
    )
    yield from _shown(state.viewing.least_confidence)


def _judged(answer: Answer) -> dict[str, str]:
    judged_by = answer.request.judged_by
    return {} if judged_by == JUDGES[0] else {"judged_by": literal(judged_by)}


def _pair(a: Answer, b: Answer, state: State) -> Lines:
    """Estimate A, then B as if it were alone, and subtract A."""
    capture_a, capture_b = list(_capture(a)), list(_capture(b))
    yield "# A is the estimate that was kept."
    yield from capture_a
    yield from _estimate(a, state)
    yield from _saved_picture('"range_a.png"', state.viewing)
    yield "shown_a = shown"
    yield "\n# B is the estimate on screen."
    if capture_b != capture_a:
        yield from capture_b
    yield from _single_estimate(b, state)
    yield "\n# Subtract A from B."
    yield "difference_m = shown.range_m - shown_a.range_m"
    yield 'np.savetxt("difference.csv", difference_m, delimiter=",")'


def _reports(answer: Answer, state: State) -> Lines:
    method = (literal(answer.method), "settings")
    if state.subject == "Pixel":
        pixel = ("capture", "image", "row", "col", *method)
        yield assign("report", "core.inspection.pixel_report", *pixel)
        yield from _plot(state.plot, "report", "np.array([row * capture.shape[1] + col])")
    if state.subject == "Capture":
        yield "\n# Report on the capture."
        yield assign("report", "core.inspection.capture_report", "capture")
    if state.pins:
        yield "\n# Signals of the pinned pixels."
        yield "pinned = {}"
        for row, col in state.pins:
            yield _signals(answer.method, f"pinned[{row}, {col}]", f"{row}, {col}")
    if state.subject == "Profile" and len(state.pins) > 1:
        yield "\n# Profile along the line through the pinned pixels."
        yield assign("points", "", *map(literal, state.pins))
        line = ("capture", "shown", "points", "angle_rad")
        yield assign("profile", "core.inspection.line_profile", *line)
    if state.region:
        yield "\n# Report on the region."
        yield assign("corners", "", *map(literal, state.region))
        yield assign("mask", "core.inspection.pixels_in", "corners", "capture.shape")
        region = ("capture", "image", "mask", *method)
        yield assign("region", "core.inspection.region_report", *region)
        if state.subject == "Region":
            yield from _plot(state.plot, "region.pixel", "np.flatnonzero(mask)")


def _plot(name: str, report: str, pixels: str) -> Lines:
    """Compute what is plotted below the histogram, unless it is the score."""
    if name == "Rate":
        yield f"rate = {report}.rate"
    if name == "Fit":
        yield f"pixels = {pixels}"
        yield assign("expected", "core.inference.predictive_of", "capture", "pixels")
    if name == NEIGHBOURS:
        yield f"evidence = {report}.evidence"


def _signals(method: str, name: str, pixel: str) -> str:
    """Return the stages of the tracking differentiator, or the score of another method."""
    if method != "tracking":
        score = f"core.ESTIMATORS[{literal(method)}].curves"
        return assign(name, score, "capture", pixel, "settings")
    arguments = (f"capture.cube[{pixel}]", "settings", "capture.gated_pulses")
    return assign(name, "core.tracking_signals", *arguments)


def _shown(least_confidence: float) -> Lines:
    yield assign("shown", "image.confident", literal(least_confidence))


def _angle(answer: Answer, viewing: Viewing) -> Lines:
    if answer.is_width_guessed(viewing):
        yield "\n# The horizontal field of view in degrees is a guess: the capture states none."
    arguments = literal(answer.field_of_view_deg(viewing)), "capture.shape[1]"
    yield assign("angle_rad", "core.geometry.pixel_angle_of", *arguments)


def _saved_picture(path: str, viewing: Viewing) -> Lines:
    """Save a picture in the colours on screen, unless they are the default."""
    chosen = RangeColors(**{each.name: getattr(viewing, each.name) for each in fields(RangeColors)})
    changed = changed_fields(chosen)
    if changed:
        yield assign("colors", "core.io.RangeColors", **changed)
    yield _saved(path, **({"colors": "colors"} if changed else {}))


def _saved(path: str, image: str = "shown", **options: str) -> str:
    return assign("", "core.save_image", "capture", image, path, **options, overwrite="True")


def _saved_cloud(path: str, box: Box = WHOLE) -> Lines:
    image = "shown"
    if box != WHOLE:
        image = "cropped"
        yield assign("box", "core.geometry.Box", **changed_fields(box))
        yield "cropped = shown.cropped(box)"
    yield f"cloud = {path}"
    yield f"if {image}.valid.any():  # a point cloud needs points"
    yield indent(_saved("cloud", image, pixel_angle_rad="angle_rad"), "    ")


# The page that compares methods


def _comparison(answer: Answer, state: State) -> Lines:
    chosen = state.comparison
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
            options = changed_fields(answer.request.settings_of(method))
            options |= false_alarm | _judged(answer)
            yield assign(f"images[{name}]", "core.estimate", "capture", name, **options)
    has_clouds = chosen.kind == CLOUDS
    yield "\n# Save the images. `shown` has only pixels of sufficient confidence."
    if has_clouds:
        yield from _angle(answer, chosen.viewing)
    yield "pictures = {}"
    yield "for method, image in images.items():"
    kind = chosen.kind if chosen.kind in ("Error", "Confidence") else "Estimate"
    of_each = [
        *_shown(chosen.viewing.least_confidence),
        f"pictures[method] = {IMAGES[kind]}",
        *(
            _saved_cloud('f"{method}.ply"')
            if has_clouds
            else _saved_picture('f"{method}.png"', chosen.viewing)
        ),
    ]
    yield indent("\n".join(of_each), "    ")
