"""Sentences and formatted numbers that several pages show, without markup."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from concurrent.futures import BrokenExecutor

from app.model.large import Grid
from app.model.methods import METHOD_TITLES
from app.model.state import AUTOMATIC
from app.model.store import Answer, Pixel, Refused
from app.units import Quantity, Scale, plus_minus, with_margin
from app.units import milliseconds as milliseconds  # noqa: PLC0414
from app.units import number as number  # noqa: PLC0414
from app.units import share as share  # noqa: PLC0414
from core.io import TRUTH_OPTIONS, with_labels
from core.metrics import Interval
from core.studies.ablation import TITLES
from core.typesetting import typeset

Fact = tuple[str, str, str]
"""Name, value and help; a value that is a number is an `app.units.Quantity`."""

Cell = tuple[str, float | None, str]
"""Text of a table's cell, the value to sort by, and a smaller second line."""

FIELD_OF_VIEW_UNKNOWN = (
    " The file does not state the field of view: the width of the cloud is a guess unless set "
    "under View."
)

ONE_LINE = "Range estimation from first-photon lidar at a low signal-to-background ratio"

TOUR_HELP = "Tour: five stops that explain the page Explore."

CONFIDENCE_HELP = (
    "Probability of a surface within 3 bins of the estimate, from the counts of the pixel or of "
    "the image (Confidence from, under Method). In a pixel of several surfaces, the report's "
    "confidence may exceed that of the map, which assumes one."
)

RANGE_HELP = (
    "Range of the surface from the photons of this pixel, if there is one within 3 bins of the "
    "estimate: the middle of its 95 % interval and half the width."
)

ESTIMATE_HELP = (
    "Estimate of the method, corrected for its lag. It may lie outside the interval, which "
    "describes the surface whatever the method."
)

PER_PULSE, PER_PIXEL = "PPP", "Photons per pixel"
"""Signal flux per pulse, and of all pulses together where their number is not known. Elsewhere PPP
often stands for photons per pixel; here it never does."""

TRUTH_HELP = "True range of the surface."

AUTOMATIC_TITLE = "Automatic, by the capture"

METHOD_HELP = "Estimator of the image, the cloud, the plots of a pixel, and everything saved."

JUDGE_HELP = (
    "What the confidence of an estimate is computed from: the counts of its pixel alone, or those "
    "of the neighbouring pixels, too, by the posterior of the image. At a low SBR the image knows "
    "much better which estimates are right. Takes up to a second."
)

RETURNS_HELP = (
    "Surfaces of a pixel in the 3D cloud, on Inspect and in files: the most probable one, or up to "
    "two, where the second is accepted in 1 % of the pixels with one surface. Takes a second or "
    "more."
)

COMPUTING = "Computing …"

NOT_COMPUTED = "Not computed yet."

UNIT_HELP = "Unit of axes and positions along the gate: bins, nanoseconds or metres."

NO_PAGE = (
    "This page could not be built. Reload it. If that does not help, the server's log states the "
    "cause."
)

WIDTH_GUESSED = "Lengths across the line of sight follow from the field of view, which is a guess."


def provenance(answer: Answer) -> str:
    """Return the source of the capture, its size and its gate."""
    acquisition, (rows, cols) = answer.capture.acquisition, answer.capture.shape
    opens_ns = acquisition.gate_delay_s * 1e9
    closes_ns = opens_ns + acquisition.n_bins * acquisition.bin_width_s * 1e9
    opens_m, closes_m = (float(acquisition.bin_to_range_m(at)) for at in (0, acquisition.n_bins))
    absent = ", ".join(TITLES[name] for name in TITLES if name in answer.request.absent)
    switched_off = f" Switched off: {absent}." if absent else ""
    return (
        f"{answer.capture.source}.{switched_off} {rows} × {cols} pixels, "
        f"{acquisition.n_bins} bins of {acquisition.bin_width_s * 1e9:.4g} ns, "
        f"gate {opens_ns:.6g} to {closes_ns:.6g} ns ({opens_m:.6g} to {closes_m:.6g} m)."
        + (FIELD_OF_VIEW_UNKNOWN if acquisition.pixel_angle_rad is None else "")
    )


def why_method(answer: Answer) -> str:
    """Return which estimator suits the capture, and why; empty where the user has chosen one."""
    if answer.request.method != AUTOMATIC:
        return ""
    title = METHOD_TITLES[answer.method]
    if answer.method == "tracking":
        return f"{title}: the paper's method, for first photons."
    return (
        f"{title}: the capture holds all photons, not only the first of each pulse, so there is no "
        "pile-up, for which the tracking differentiator is made. Of the methods that look at one "
        "pixel at a time, this one finds most surfaces."
    )


def no_estimates(answer: Answer) -> str:
    """Return why no pixel has an estimate, and what to do; empty if any has one."""
    if answer.run.image.valid.any():
        return ""
    if answer.method != "tracking":
        return "No pixel has an estimate: no photon was detected."
    n_bins, t_n = answer.capture.acquisition.n_bins, answer.settings.t_n
    if t_n >= n_bins:
        return f"T_n excludes all {n_bins} bins of the gate: reduce it."
    return (
        "No pixel has an estimate: both scales are equal everywhere, or no photon was detected. "
        "Undo the last change, or choose a preset."
    )


def failure(error: Exception) -> str:
    """Return what failed and what to do, without a traceback."""
    shown = f"{reason(error)} The page still shows the last settings that worked"
    if isinstance(error, ValueError):
        return f"{shown}."
    return f"{shown}: undo the change, or choose another scene."


def refusal(refused: Refused) -> str:
    """Return the question how a file is to be read, else why it could not be."""
    return refused.question or refused.why


def unfinished(error: Exception, button: str) -> str:
    """Return why long work ended, and what to do; `button` starts it."""
    return (
        f"{reason(error)} Results shown before that are kept. Press “{button}” to run it again; if "
        "it fails again, reduce the settings, or choose another scene."
    )


def cause(error: Exception) -> str:
    """Return the message of a ``ValueError``, which is written for users, or the type of others.

    Options are named by their labels.
    """
    if isinstance(error, ValueError):
        return without_folders(with_labels(str(error), TRUTH_OPTIONS))
    kind = type(error).__name__
    if isinstance(error, MemoryError):
        return f"not enough memory on the server ({kind})"
    if isinstance(error, BrokenExecutor):
        return f"a worker process of the server has ended ({kind})"
    return kind


def cause_in(name: str, error: Exception) -> str:
    """Return the `cause` of an error with a file, named once."""
    why = cause(error)
    return why if name in why else f"{name}: {why}"


def reason(error: Exception) -> str:
    """Return why something could not be computed, as a sentence."""
    is_message = isinstance(error, ValueError)
    return cause(error) if is_message else f"The computation failed: {cause(error)}."


def without_folders(text: str) -> str:
    """Remove the folders of paths, which only the server's owner may see.

    Paths in quotes may contain spaces; others end at one.
    """
    text = re.sub(r"(['\"])/[^'\"\n]*/([^'\"/\n]*)\1", r"\1\2\1", text)
    return re.sub(r"(?<![\w.:/])/(?:[^\s/'\"]+/)+", "", text)


def cell(value: float, form: str = "{:.4g}", below: str = "") -> Cell:
    """Return a table's cell; a dash if the value is not finite."""
    known = math.isfinite(value)
    return (typeset(form.format(value)), value, below) if known else ("–", None, below)


def percent_cell(value: float, below: str = "") -> Cell:
    """Return a share as a table's cell, sorted by the share."""
    return share(value), value if math.isfinite(value) else None, below


def interval_cell(found: Interval, form: str) -> Cell:
    """Return an estimate as a table's cell, with its interval below."""
    if math.isnan(found.value):
        return "–", None, ""
    low, high = (typeset(form.removesuffix(" %").format(end)) for end in (found.low, found.high))
    return cell(found.value, form, f"{low} to {high}")


def estimate_facts(pixel: Pixel, along: Scale, has_truth: bool) -> list[Fact]:
    """Return name, value and help of a pixel's estimate, compared with the truth if it is known."""
    interval_m = pixel.interval_95_m
    decimals = interval_m.decimals
    facts: list[Fact] = [
        ("Range (95 %)", plus_minus(interval_m.low, interval_m.high, "m"), RANGE_HELP),
        ("Estimate", number(pixel.range_m, "m", decimals=decimals), ESTIMATE_HELP),
    ]
    if along.name != "m":
        facts.append(("Position", along.place(pixel.answer_bin), "The estimate along the gate."))
    if has_truth:
        error = number(pixel.range_m - pixel.truth_m, "m", sign=True, decimals=decimals)
        facts += [
            ("Truth", target(pixel.truth_m, decimals), TRUTH_HELP),
            ("Error", error, "Estimate minus truth."),
        ]
    return [*facts, ("Confidence", share(pixel.confidence), CONFIDENCE_HELP)]


def estimate_text(range_m: Interval, confidence: float, least_confidence: float) -> Quantity:
    """Format an estimate in metres, with its 95 % interval unless its confidence is too low."""
    if confidence >= least_confidence:
        return with_margin(range_m, "m", "95 %")
    return number(range_m.value, "m", decimals=range_m.decimals)


def target(truth_m: float, decimals: int | None = None) -> str:
    """Format the true range of a pixel, which may have no target."""
    return "no target" if math.isnan(truth_m) else number(truth_m, "m", decimals=decimals)


def progress(done: int, of: int, noun: str, is_running: bool) -> str:
    """Return the progress of a study; empty before its start."""
    if of == 0:
        return ""
    if is_running:
        return f"{done} of {of} {noun}."
    if done < of:
        return f"Stopped after {done} of {of} {noun}."
    return f"Done: {of} {noun if of != 1 else noun.removesuffix('s')}."


def source_is_gone(key: str, known: Iterable[str]) -> str:
    """Return the message about a scene or capture of a link that is not among the known keys."""
    name = key.partition("~")[0]
    if any(each.startswith(f"{name}~") for each in known):
        return (
            f"The link is to another {name[:40]!r} than the one here, or does not state which. "
            "Choose the one here in the list, or open the other."
        )
    return (
        f"There is no scene or capture {key[:40]!r} here. Uploaded files are removed when no page "
        "uses them: upload the file again."
    )


def no_page(name: str, known: Iterable[str]) -> str:
    """Return the message about a page of a link that does not exist."""
    return f"page = {name[:40]!r} is not accepted: give {', '.join(known)}."


def pins_outside(rows: int, cols: int) -> str:
    """Return the message about pins of a link that lie outside the image."""
    return f"Pins outside the {rows} × {cols} pixels were removed."


def not_restored(refused: list[str]) -> str:
    """Return the message about settings of a link that were refused; empty if there are none."""
    if not refused:
        return ""
    sentences = " ".join(with_labels(each) for each in refused)
    return f"Some settings in this link could not be restored. {sentences}"


def not_uploaded(reason: str, most_bytes: int) -> str:
    """Return why the upload of a file failed, and what to do."""
    return (
        f"Could not upload the file: {reason.rstrip('.')}. The limit is {most_bytes >> 20} MiB. To "
        "open a larger file, start the server with its path."
    )


def not_opened(refused: Iterable[str]) -> str:
    """Return which files of a watched folder could not be opened, and why; empty without any."""
    why = " ".join(f"{each.rstrip('.')}." for each in refused)
    return f"Could not open a new file of the watched folder. {why}" if why else ""


def not_kept(error: ValueError | OSError) -> str:
    """Return why an uploaded file was not opened, and what to do."""
    if isinstance(error, ValueError):
        return f"Could not open the file: {error}"
    return (
        f"Could not store the uploaded file ({error.strerror}). Free space in the system's "
        "temporary folder, or start the server with the file's path."
    )


def pixel_name(pixel: tuple[int, int], grid: Grid) -> str:
    """Return row and column of a pixel in its file."""
    row, col = grid.place(*pixel)
    return f"{row}, {col}"
