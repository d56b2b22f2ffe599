"""What the page says: figures, numbers and sentences, as plain text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from concurrent.futures import BrokenExecutor

import numpy as np

from app.model.store import Answer
from core.studies.ablation import TITLES

Fact = tuple[str, str, str]
"""Name, value, and a line of help."""

FIELD_OF_VIEW_UNKNOWN = (
    " The file does not tell the field of view: widths and heights of the cloud are a guess (View)."
)

ONE_LINE = "Range estimation from first-photon lidar at a low signal-to-background ratio"

COMPUTING = "Computing …"

NOT_COMPUTED = "Not computed yet."

UNIT_HELP = "What axes and read-outs along the gate count in: bins, nanoseconds or metres."

NO_PAGE = (
    "This page could not be built. Reload it; if it happens again, what the server has printed "
    "tells whoever started it why."
)


def provenance(answer: Answer) -> str:
    """Where the capture came from and what was guessed, as a sentence."""
    acquisition, rows_cols = answer.capture.acquisition, answer.capture.shape
    opens_ns = acquisition.gate_delay_s * 1e9
    closes_ns = opens_ns + acquisition.n_bins * acquisition.bin_width_s * 1e9
    absent = ", ".join(TITLES[name] for name in TITLES if name in answer.request.absent)
    switched_off = f" Switched off: {absent}." if absent else ""
    return (
        f"{answer.capture.source}.{switched_off} {rows_cols[0]} × {rows_cols[1]} pixels, "
        f"{acquisition.n_bins} bins of {acquisition.bin_width_s * 1e9:.4g} ns, "
        f"gate {opens_ns:.6g} to {closes_ns:.6g} ns "
        f"({float(acquisition.bin_to_range_m(0)):.6g} to "
        f"{float(acquisition.bin_to_range_m(acquisition.n_bins)):.6g} m)."
        + (FIELD_OF_VIEW_UNKNOWN if acquisition.pixel_angle_rad is None else "")
    )


def lack(answer: Answer) -> str:
    """Why there is nothing to see, and what to do; empty where there is something."""
    if answer.run.image.valid.any():
        return ""
    n_bins, t_n = answer.capture.acquisition.n_bins, answer.request.tracking.t_n
    if t_n >= n_bins:
        return f"T_n = {t_n} leaves no bin of {n_bins} in which an echo may lie: lower it."
    return (
        "No pixel has an answer: both scales move alike, or no photon was detected. "
        "Take back the last change, or choose a preset."
    )


def failure(error: Exception) -> str:
    """What happened and what to do, without a traceback."""
    shown = f"{reason(error)} The picture still shows the last settings that worked"
    if isinstance(error, ValueError):
        return f"{shown}."
    return f"{shown}: change them back, or choose another scene."


def unfinished(error: Exception) -> str:
    """Why long work has ended, and what to do."""
    return (
        f"{reason(error)} What this part shows was computed before that. Compute begins anew; if "
        "it fails again, ask for less, or choose another scene."
    )


def cause(error: Exception) -> str:
    """What has gone wrong: what an error says that is meant to be read, or which kind it is."""
    if isinstance(error, ValueError):
        return without_folders(str(error))
    kind = type(error).__name__
    if isinstance(error, MemoryError):
        return f"the server's memory does not suffice ({kind})"
    if isinstance(error, BrokenExecutor):
        return f"a worker of the server has ended ({kind})"
    return kind


def without_folders(text: str) -> str:
    """A text in which files have their names only: where they lie on the server is its own affair.

    Names in quotes may hold spaces; others end at one.
    """
    text = re.sub(r"(['\"])/[^'\"\n]*/([^'\"/\n]*)\1", r"\1\2\1", text)
    return re.sub(r"(?<![\w.:/])/(?:[^\s/'\"]+/)+", "", text)


def number(value: float, unit: str, sign: bool = False) -> str:
    """A number with its unit; a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    text = f"{value:+.4g}" if sign else f"{value:.4g}" if abs(value) < 1000 else f"{value:,.2f}"
    return f"{text} {unit}".strip()


def share(value: float) -> str:
    """A share in percent; a dash where there is none."""
    return "–" if math.isnan(value) else f"{100 * value:.1f} %"


def milliseconds(seconds: float) -> str:
    """A duration as one reads it."""
    return f"{1000 * seconds:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"


def progress(done: int, of: int, noun: str, is_running: bool) -> str:
    """How far a study has come."""
    if of == 0:
        return ""
    if is_running:
        return f"{done} of {of} {noun}."
    if done < of:
        return f"Stopped after {done} of {of} {noun}."
    return f"Done: {of} {noun if of != 1 else noun.removesuffix('s')}."


def reason(error: Exception) -> str:
    """Why something could not be computed, without a traceback."""
    named = isinstance(error, ValueError)
    return cause(error) if named else f"This could not be computed: {cause(error)}."


def source_is_gone(key: str) -> str:
    """Of a scene or capture that an address names in vain."""
    return (
        f"There is no scene or capture {key[:40]!r} here; an uploaded file is kept only while a "
        "page has it open: open it again."
    )


def no_page(name: str, known: Iterable[str]) -> str:
    """Message about a page that a link names and the app lacks."""
    return f"page = {name[:40]!r} is not accepted: give {', '.join(known)}."


def pins_outside(rows: int, cols: int) -> str:
    """Of pinned pixels that an address names in vain."""
    return f"pins outside of {rows} × {cols} pixels are left out."


def not_restored(refused: list[str]) -> str:
    """What a page could not restore of its address; empty where it could restore all."""
    if not refused:
        return ""
    return f"The address asks for what cannot be had: {' '.join(refused)} The rest is as it says."


def not_uploaded(reason: str, most_bytes: int) -> str:
    """Why a file did not arrive, and what to do."""
    return (
        f"Could not upload the file: {reason.rstrip('.')}. Files of up to {most_bytes >> 20} MiB "
        "can be uploaded; a larger one opens by its path, when the server is started with it."
    )


def not_kept(error: ValueError | OSError) -> str:
    """Why a file could not be opened here, and what to do."""
    if isinstance(error, ValueError):
        return f"The file is not opened: {error}"
    return (
        f"The file is not opened: it cannot be kept here ({error.strerror}). Free room in the "
        "system's temporary folder, or give the file's path on the command line."
    )
