"""The page of a report: its sections as HTML."""

from __future__ import annotations

import math
import platform
from base64 import b64encode
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from hashlib import sha256
from html import escape
from importlib.metadata import version
from importlib.resources import files
from typing import Any

import numpy as np

from core import metrics
from core.acquisition import Floats
from core.capture import Capture
from core.estimators import ESTIMATORS, JUDGES, Provenance, RangeImage
from core.geometry import WHOLE, Box
from core.inference import fit_of, fit_p_values_of, share_below
from core.inspection import (
    CONFIDENT,
    CaptureReport,
    FluxEstimate,
    PixelReport,
    StatedFluxCheck,
    capture_report,
    echo_view,
    pixel_report,
    reported_check,
)
from core.io.writers.colors import (
    ColorScale,
    RangeColors,
    colors_of,
    p_value_scale,
    range_scale,
)
from core.io.writers.product import guessed_view, plain
from core.labels import software
from core.metrics import Interval
from core.parameters import doubts, spec_of
from core.pipeline import figures_of
from core.report.cloud import cloud_of
from core.report.figures import (
    ESTIMATE,
    SUGGESTED,
    TRUTH,
    Mark,
    gate_svg,
    image_svg,
)
from core.tracking import tracking_signals
from core.typesetting import probability_text, three_digits, typeset

MOST_PIXELS = 2**16
"""Pixels of maps and cloud; larger images are thinned."""

_WIDTHS = {
    "gamma": "time constant",
    "gaussian": "standard deviation",
    "measured": "sample spacing",
}
_FLUXES = {"signal": "Signal", "background": "Background", "sbr": "SBR"}
_LIBRARIES = ("numpy", "scipy", "numba")

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
style-src 'unsafe-inline'; script-src 'sha256-{digest}'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<main>
{body}
</main>
<script>{code}</script>
</body>
</html>
"""

_PROBABILITY = (
    "Probability: that of a surface at the candidate, where a pixel may have several. The map of "
    "confidence assumes one surface, so its value may be lower."
)
_ASSUMED = " It assumes the pulse, which the echoes do not have."
_ERRORS = {
    "rmse_m": ("Root mean square error", "m"),
    "inlier_rmse_m": ("Root mean square error within 3 bins", "m"),
    "mae_m": ("Mean absolute error", "m"),
    "bias_m": ("Mean error", "m"),
    "median_error_m": ("Median error", "m"),
    "coverage": ("Share of targets with an estimate", ""),
}


def page_of(
    capture: Capture,
    image: RangeImage,
    pixel: tuple[int, int],
    least_confidence: float,
    pixel_angle_rad: float | None,
    box: Box,
    colors: RangeColors | None,
    *,
    title: str,
    script: str,
) -> str:
    """Return the page of `core.report.save_report`, whose arguments these are."""
    assert image.made_by is not None
    made_by = image.made_by
    method, has_t_n = ESTIMATORS[made_by.method].title, made_by.method == "tracking"
    step = math.ceil(math.sqrt(capture.counts.size / MOST_PIXELS))
    pixel_found = pixel_report(capture, image, *pixel, made_by.method, made_by.settings)
    capture_found = capture_report(capture)
    shown = image.confident(least_confidence)
    scale = range_scale(capture, shown, colors)
    # Before plots, which take seconds: it refuses an angle that is out of range.
    cloud = [*_cloud(capture, image, shown, scale, pixel_angle_rad, box, step)]
    body = [
        *_heading(capture, image, title, method),
        *_recording(capture),
        *_fluxes(capture, capture_found, has_t_n),
        *_maps(capture, image, shown, scale, pixel, step),
        *_all_pixels(capture, capture_found, has_t_n),
        *_pixel(capture, image, made_by, pixel_found),
        *cloud,
        *_reported(capture, image, made_by),
        *_accuracy(capture, image),
        *_settings(made_by, least_confidence),
        *_script(script),
    ]
    code = _text_of("cloud.js")
    return _PAGE.format(
        title=_text(" · ".join(filter(None, (title, method)))),
        digest=b64encode(sha256(code.encode()).digest()).decode(),
        style=_text_of("page.css"),
        body="\n".join(body),
        code=code,
    )


# Sections


def _heading(capture: Capture, image: RangeImage, title: str, method: str) -> Iterator[str]:
    yield f"<h1>{_text(title or 'Report on a capture')}</h1>"
    n_valid, n_pixels = int(image.valid.sum()), image.valid.size
    yield _paragraph(f"Ranges by {method}: {n_valid:,} of {n_pixels:,} pixels have an estimate.")
    if image.made_by and image.made_by.remark:
        yield _paragraph(f"Remark on the method: {image.made_by.remark}.")
    if not capture.counts.any():
        yield _paragraph("The capture has no detection.")


def _recording(capture: Capture) -> Iterator[str]:
    acquisition, pulse = capture.acquisition, capture.pulse
    opens_s = acquisition.gate_delay_s
    closes_s = opens_s + acquisition.n_bins * acquisition.bin_width_s
    angle_rad = acquisition.pixel_angle_rad
    known = dict(capture.facts)
    source = known.pop("source")
    known |= {
        "gate": f"{opens_s * 1e9:.6g} to {closes_s * 1e9:.6g} ns after the pulse",
        "pulse": f"{pulse.shape}, {_WIDTHS[pulse.shape]} {pulse.tau_s * 1e12:.4g} ps",
        "pixel angle": "not known" if angle_rad is None else f"{angle_rad * 1e6:.6g} µrad",
    }
    yield _heading_2("What was read")
    yield _facts((name.capitalize(), _text(fact)) for name, fact in known.items())
    yield "<h3>Source and assumptions</h3>"
    clauses = filter(None, source.split("; "))
    yield f"<ul>{''.join(f'<li>{_text(clause)}</li>' for clause in clauses)}</ul>"


def _fluxes(capture: Capture, report: CaptureReport, has_t_n: bool) -> Iterator[str]:
    unit, suggestion = report.flux_unit, report.suggestion
    first, end = suggestion.gate
    begin_m, end_m = capture.acquisition.bin_to_range_m([first, end]).tolist()
    counts = [
        (name, "not known" if n is None else _number(n))
        for name, n in (("Hot pixels", report.n_hot), ("Dead pixels", report.n_dead))
    ]
    yield _heading_2("Signal, background and suggestions")
    targets = "Mean of the target pixels, those with an echo, with 95 % intervals"
    yield _intervals(report.target_flux, unit, targets)
    yield _intervals(report.flux, unit, "Mean of all pixels, with 95 % intervals")
    yield f'<p class="note">Method: {_text(report.flux_method)}. {_text(report.flux_remark)}</p>'
    yield _stated(report.stated)
    yield _facts(counts)
    yield "<h3>Suggested settings</h3>"
    yield "<ul>"
    yield (
        f"<li>Gate: bins {_number(first)} to {_number(end)}, {_metres(begin_m, capture)} to "
        f"{_metres(end_m, capture)}. {_text(suggestion.why_gate)}</li>"
    )
    if has_t_n:
        yield f"<li>T_n: {_number(suggestion.t_n)}. {_text(suggestion.why_t_n)}</li>"
    yield "</ul>"


def _maps(
    capture: Capture,
    image: RangeImage,
    shown: RangeImage,
    scale: ColorScale,
    pixel: tuple[int, int],
    step: int,
) -> Iterator[str]:
    range_m, counts = shown.range_m, capture.counts
    confidence = np.where(image.valid, image.confidence, np.nan)
    beyond = scale.n_outside(range_m)
    grey = f" Grey: {beyond:,} beyond the colours." if beyond else ""
    least, most = int(counts.min()), int(counts.max())
    is_drawn = np.zeros(counts.shape, bool)
    is_drawn[::step, ::step] = True
    p_values = np.full(counts.shape, np.nan)
    p_values[is_drawn] = fit_p_values_of(capture, np.flatnonzero(is_drawn))
    colors = colors_of("inferno")
    yield _heading_2("Maps")
    if step > 1:
        yield _paragraph(f"Maps show 1 of {step} rows and 1 of {step} columns.")
    plots = (
        (
            "Range",
            range_m,
            scale,
            f"{_hidden(image, shown)}{grey} The square marks the pixel below.",
        ),
        *_map_reported(capture, scale),
        *_map_velocity(shown),
        (
            "Confidence",
            confidence,
            ColorScale("Confidence", "", 0.0, 1.0, colors),
            "Probability of a surface within 3 bins of the estimate; nothing is hidden.",
        ),
        (
            "Counts",
            counts,
            ColorScale("Detections", "", least, max(most, least + 1), colors),
            f"Detections of each pixel, {least:,} to {most:,}.",
        ),
        (
            "Goodness of fit",
            p_values,
            p_value_scale(),
            f"{share_below(p_values[is_drawn])} {fit_of(capture).verdict}",
        ),
    )
    drawn = [
        _figure(image_svg(values, colors, step, pixel, name), f"Map of {name.lower()}", caption)
        for name, values, colors, caption in plots
    ]
    yield f'<div class="plots">{"".join(drawn)}</div>'


def _map_reported(
    capture: Capture, scale: ColorScale
) -> Iterator[tuple[str, Floats, ColorScale, str]]:
    if capture.reported_range_m is None:
        return
    n_blank = int(np.isnan(capture.reported_range_m).sum())
    caption = f"Distance that the sensor itself found; {n_blank:,} pixels without one."
    of_sensor = replace(scale, title="Reported distance")
    yield "Reported distance", capture.reported_range_m, of_sensor, caption


def _map_velocity(shown: RangeImage) -> Iterator[tuple[str, Floats, ColorScale, str]]:
    if shown.velocity is None or not shown.valid.any():
        return
    values = np.where(shown.valid, shown.velocity.values, np.nan)
    limit = float(np.nanmax(np.abs(values))) or 1.0
    scale = ColorScale("Radial velocity", shown.velocity.unit, -limit, limit, colors_of("viridis"))
    yield "Radial velocity", values, scale, "Positive where the surface recedes."


def _all_pixels(capture: Capture, report: CaptureReport, has_t_n: bool) -> Iterator[str]:
    acquisition, suggestion = capture.acquisition, report.suggestion
    begin_m, end_m = acquisition.bin_to_range_m(suggestion.gate).tolist()
    gate = Mark(begin_m, end_m, SUGGESTED)
    marks = {"suggested gate": gate}
    if has_t_n:
        t_n_m = float(acquisition.bin_to_range_m(suggestion.t_n))
        marks["suggested T_n"] = _line(t_n_m, ESTIMATE)
    curves = {"counts": report.histogram.astype(float)}
    yield _heading_2("Histogram of all pixels")
    drawn = gate_svg(acquisition, curves, marks, "Detections", "all pixels")
    caption = f"{int(report.histogram.sum()):,} detections in {capture.counts.size:,} pixels."
    yield _figure(drawn, "Histogram of the detections of all pixels over range", caption)


def _pixel(
    capture: Capture, image: RangeImage, made_by: Provenance, report: PixelReport
) -> Iterator[str]:
    acquisition, row, col = capture.acquisition, report.row, report.col
    truth_m = None if capture.truth_range_m is None else float(capture.truth_range_m[row, col])
    interval_m = report.interval_95_m
    marks = {
        "95 % interval": Mark(interval_m.low, interval_m.high, ESTIMATE),
        "estimate": _line(report.answer_m, ESTIMATE),
        **({} if truth_m is None else {"truth": _line(truth_m, TRUTH)}),
    }
    histogram, stages = {"counts": report.counts}, {"score": report.curve}
    if report.method == "tracking":
        signals = tracking_signals(report.counts, made_by.settings, capture.gated_pulses)
        histogram |= {"small scale": signals.small, "large scale": signals.large}
        stages = {"enhanced": signals.enhanced, "residual": signals.residual}
    decimals, where = interval_m.decimals, f"row {row}, column {col}"
    yield _heading_2(f"Pixel in {where}")
    yield f'<p class="lead">Range: {_text(report.interval_text)}</p>'
    facts = [
        ("Estimate", _metres(report.answer_m, capture, decimals)),
        ("95 % interval", _between(interval_m, capture, decimals)),
        ("Confidence", _number(report.confidence)),
        *(
            [("Radial velocity", _text(image.velocity.text_at(row, col)))]
            if image.velocity is not None
            else []
        ),
        ("Detections", _number(int(report.counts.sum()))),
        ("Verdict", _text(f"{report.verdict.health}. {report.verdict.why}")),
    ]
    if truth_m is not None:
        known = "no target" if math.isnan(truth_m) else _metres(truth_m, capture, decimals)
        facts.insert(2, ("Truth", known))
    if capture.reported_range_m is not None:
        reported_m = float(capture.reported_range_m[row, col])
        difference = _metres(report.answer_m - reported_m, capture, decimals)
        facts[2:2] = [
            ("Reported by the sensor", _metres(reported_m, capture, decimals)),
            ("Estimate minus reported", difference),
        ]
    yield _facts(facts)
    yield (
        '<p class="note">The interval is that of the range of the surface, given that there is '
        "one within 3 bins of the estimate, which is what the confidence says.</p>"
    )
    drawn = [
        ("Histogram of the pixel", gate_svg(acquisition, histogram, marks, "Detections", "pixel")),
        (_stages_title(report), gate_svg(acquisition, stages, marks, "Score", "score")),
    ]
    if not math.isnan(report.answer_bin):
        view_bins = echo_view(capture, report.answer_bin)
        near = gate_svg(acquisition, histogram, marks, "Detections", "near", view_bins)
        drawn.append(("Histogram around the estimate", near))
    plots = (_figure(svg, f"{title}, {where}", f"{title}.") for title, svg in drawn)
    yield f'<div class="plots">{"".join(plots)}</div>'
    yield _intervals(report.flux, report.flux_unit, "Flux of the pixel, with 95 % intervals")
    yield f'<p class="note">Method: {_text(report.flux_method)}.</p>'
    yield _candidates(capture, report)


def _stages_title(report: PixelReport) -> str:
    lag = f", before its lag of {report.lag_bins:.3g} bins is corrected"
    name = "Residual and enhanced residual" if report.method == "tracking" else "Score of each bin"
    return f"{name}{lag if abs(report.lag_bins) >= 0.005 else ''}"


def _candidates(capture: Capture, report: PixelReport) -> str:
    if not report.candidates:
        return _paragraph("There are no candidates: the score has no peak.")
    rows = [
        (
            str(rank),
            _number(each.bin, f"{each.bin:.2f}"),
            _metres(each.range_m, capture),
            _number(each.score),
            _number(each.relative),
            _number(each.probability, probability_text(each.probability)),
        )
        for rank, each in enumerate(report.candidates, 1)
    ]
    columns = ("Candidate", "Bin", "Range", "Score", "Relative score", "Probability")
    table = _table("Candidates: highest peaks of the score", columns, rows)
    several = f"{report.surfaces_text}. " if len(report.surfaces_bin) > 1 else ""
    assumed = _ASSUMED if report.may_be_one_echo else ""
    return f'{table}<p class="note">{_text(several)}{_PROBABILITY}{assumed}</p>'


def _cloud(
    capture: Capture,
    image: RangeImage,
    shown: RangeImage,
    scale: ColorScale,
    pixel_angle_rad: float | None,
    box: Box,
    step: int,
) -> Iterator[str]:
    remark = ""
    angle_rad = pixel_angle_rad or capture.acquisition.pixel_angle_rad
    if angle_rad is None:
        view = guessed_view(capture, image)
        angle_rad, remark = view["pixel_angle_rad"], f" Note that {view['remark']}."
    inside = np.where(box.contains(shown.range_m), shown.range_m, np.nan)
    cloud = cloud_of(inside, scale, angle_rad, step)
    yield _heading_2("Point cloud")
    if cloud is None:
        where = "" if box == WHOLE else f" in the box: {box}"
        yield _paragraph(f"There are no points: no estimate is confident enough{_text(where)}.")
        return
    thinned = f", of 1 of {step} rows and 1 of {step} columns" if step > 1 else ""
    data = {name: getattr(cloud, name) for name in ("xyz", "rgb", "unit", "spacing")}
    attributes = " ".join(f'data-{name}="{value}"' for name, value in data.items())
    width, depth, height = (f"{three_digits(each)} m" for each in cloud.size_m)
    where = "" if box == WHOLE else f" in the box ({_text(box)})"
    label = f"Point cloud of {cloud.n_points:,} estimates{where}"
    yield (
        f'<figure><canvas id="cloud" tabindex="0" role="img" aria-label="{label}" {attributes}>'
        f"</canvas><figcaption>{label}{thinned}, in the colours of the map of range, "
        f"{width} wide, {height} high and {depth} deep.{_text(remark)} Drag "
        "to turn, with Shift to move; pinch, or click and use the wheel, to zoom. Keys: arrows, "
        "+ and −, 0 for the first view.</figcaption></figure>"
    )
    yield "<noscript><p>The cloud needs JavaScript.</p></noscript>"


def _reported(capture: Capture, image: RangeImage, made_by: Provenance) -> Iterator[str]:
    found = reported_check(capture, image)
    if found is None:
        return
    rows = [
        ("Median difference", _metres(found.median_m, capture)),
        ("Half the central 68 % range", _metres(found.spread_m, capture)),
    ]
    yield _heading_2("Distances reported by the sensor")
    yield _paragraph(
        f"Estimate by {ESTIMATORS[made_by.method].title} minus reported distance, in the "
        f"{found.n_pixels:,} pixels that have both and a confidence of {CONFIDENT:g} or more."
    )
    yield _facts(rows)


def _accuracy(capture: Capture, image: RangeImage) -> Iterator[str]:
    truth_m, bin_m = capture.truth_range_m, capture.acquisition.bin_length_m
    if truth_m is None:
        return
    figures = figures_of(image.range_m, truth_m, bin_m)
    rows = [
        (title, f"{_number(figures[name])} {unit}".strip())
        for name, (title, unit) in _ERRORS.items()
    ]
    for n_bins in (1, 2, 3):
        hits, targets = metrics.restored(image.range_m, truth_m, n_bins * bin_m)
        title = f"Restoration degree, {n_bins} bin{'s' if n_bins > 1 else ''}"
        rows.append((title, _interval(metrics.wilson(hits, targets)) if targets else "–"))
    yield _heading_2("Accuracy")
    n_targets = int(np.isfinite(truth_m).sum())
    yield _paragraph(
        f"Errors of all estimates of the {n_targets:,} pixels with a target, hidden ones included; "
        "the restoration degree with its 95 % interval."
    )
    yield _facts(rows)


def _settings(made_by: Provenance, least_confidence: float) -> Iterator[str]:
    settings = made_by.settings
    rows = [
        (_text(spec_of(each).symbol), _text(getattr(settings, each.name)), _help_of(each))
        for each in fields(settings)
    ]
    alarm = made_by.false_alarm
    facts = [
        ("Method", _text(ESTIMATORS[made_by.method].title)),
        ("False-alarm rate", "not limited" if alarm is None else _number(alarm)),
        ("Confidence from", made_by.judged_by or JUDGES[0]),
        ("Shown from confidence", _number(least_confidence)),
        ("Software", _text(software())),
        ("Python", platform.python_version()),
        *((name, _text(version(name))) for name in _LIBRARIES),
    ]
    yield _heading_2("Settings and versions")
    if rows:
        yield _table("Settings of the method", ("Setting", "Value", "Meaning"), rows)
    yield from map(_paragraph, doubts(settings))
    yield _facts(facts)


def _help_of(setting: Any) -> str:
    return _text(f"{setting.metadata['help']} Default: {setting.default}.")


def _script(script: str) -> Iterator[str]:
    if script:
        yield _heading_2("Python script")
        yield _paragraph("It computes the same estimates with the package core.")
        yield f'<pre tabindex="0"><code>{escape(script)}</code></pre>'


# Elements


def _text(value: object) -> str:
    """Return text on one line, escaped for elements and attributes."""
    return escape(plain(str(value)))


def _heading_2(title: str) -> str:
    return f"<h2>{_text(title)}</h2>"


def _paragraph(text: str) -> str:
    return f"<p>{_text(text)}</p>"


def _figure(svg: str, alt: str, caption: str) -> str:
    label = f'<svg role="img" aria-label="{_text(alt)}"'
    return (
        f"<figure>{svg.replace('<svg', label, 1)}<figcaption>{_text(caption)}</figcaption></figure>"
    )


def _facts(rows: Iterable[tuple[str, str]]) -> str:
    """Return named values, which are HTML, as a table."""
    lines = (f'<tr><th scope="row">{name}</th><td>{value}</td></tr>' for name, value in rows)
    return f'<div class="scroll"><table><tbody>{"".join(lines)}</tbody></table></div>'


def _table(caption: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows of cells, which are HTML, as a table; the first cell of a row is its name."""
    head = "".join(f'<th scope="col">{_text(name)}</th>' for name in columns)
    lines = (
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in others)}</tr>'
        for first, *others in rows
    )
    return (
        f'<div class="scroll"><table><caption>{_text(caption)}</caption><thead><tr>{head}</tr>'
        f"</thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _number(value: float, text: str = "") -> str:
    """Return a number with all its digits as its value; by default four of them are its text."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if not text and abs(value) >= 1000:
        text = f"{value if isinstance(value, int) else float(f'{value:.4g}'):,.0f}"
    return f'<data value="{value}">{_text(text) or typeset(f"{value:.4g}")}</data>'


def _metres(value_m: float, capture: Capture, decimals: int | None = None) -> str:
    """Return a range, by default with the decimals that resolve a hundredth of a bin."""
    if decimals is None:
        decimals = max(0, 2 - math.floor(math.log10(capture.acquisition.bin_length_m)))
    text = typeset(f"{value_m:,.{decimals}f}")
    return "–" if math.isnan(value_m) else f"{_number(value_m, text)}\u00a0m"


def _between(interval: Interval, capture: Capture, decimals: int | None) -> str:
    ends = (_metres(end, capture, decimals) for end in (interval.low, interval.high))
    return " to ".join(ends) if math.isfinite(interval.low) else "–"


def _interval(found: Interval) -> str:
    value, ends = _value_and_ends(found)
    return f"{value} [{ends}]"


def _value_and_ends(found: Interval) -> tuple[str, str]:
    """Return a number and its interval; where it is infinite, the lower end alone."""
    if math.isinf(found.value):
        return "–", f"&gt; {_number(found.low)}"
    return _number(found.value), f"{_number(found.low)} to {_number(found.high)}"


def _intervals(flux: FluxEstimate, unit: str, caption: str) -> str:
    """Return signal, background and their ratio with their intervals as a table."""
    units = (unit, unit, "")
    rows = [
        (title, *_value_and_ends(each), of)
        for title, of, each in zip(_FLUXES.values(), units, flux, strict=True)
    ]
    return _table(caption, ("Quantity", "Value", "Interval", "Unit"), rows)


def _stated(found: Sequence[StatedFluxCheck]) -> str:
    """Return the fluxes that the file states beside their estimates; empty without any."""
    if not found:
        return ""
    rows = [
        (
            _FLUXES[each.name],
            _number(each.stated),
            _interval(each.estimate),
            _number(each.difference),
            each.unit,
        )
        for each in found
    ]
    titles = ("Quantity", "Stated", "Estimate", "Estimate minus statement", "Unit")
    return _table("Stated by the file for the mean of all pixels", titles, rows)


def _line(range_m: float, color: str) -> Mark:
    return Mark(range_m, range_m, color)


def _hidden(image: RangeImage, shown: RangeImage) -> str:
    """Return how many estimates a map shows, and why the others are hidden."""
    n_valid, n_shown = int(image.valid.sum()), int(shown.valid.sum())
    sentences = [f"{n_shown:,} of {n_valid:,} estimates are shown."]
    if n_shown < n_valid:
        assert shown.made_by is not None
        least = shown.made_by.least_confidence
        sentences.append(f"{n_valid - n_shown:,} are hidden: confidence below {least:g}.")
    if n_valid < image.valid.size:
        sentences.append(f"{image.valid.size - n_valid:,} pixels have no estimate.")
    return " ".join(sentences)


def _text_of(name: str) -> str:
    return files("core.report").joinpath(name).read_text(encoding="utf-8")
