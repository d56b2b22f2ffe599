"""Sentence on the origin of a capture and on what was guessed."""

from __future__ import annotations

from collections.abc import Iterable

from core.acquisition import Acquisition, Pulse
from core.capture import Detection
from core.checks import printable
from core.io.readers.options import ReadOptions
from core.io.readers.times import time_text


def guesses(
    request: ReadOptions,
    acquisition: Acquisition,
    pulse: Pulse,
    detection: Detection,
    time_unit_s: float | None = None,
) -> list[str]:
    """List the settings that `request` left open, and the values used.

    Parameters
    ----------
    time_unit_s : float, optional
        The unit taken for arrival times; None for a file that holds none.
    """
    found = []
    if time_unit_s is not None and request.time_unit_s is None:
        found.append(f"time unit {time_text(time_unit_s)}")
    if request.bin_width_s is None:
        found.append(f"bin width {time_text(acquisition.bin_width_s)}")
    if request.gate_delay_s is None:
        opens_ns = acquisition.gate_delay_s * 1e9
        closes_ns = opens_ns + acquisition.n_bins * acquisition.bin_width_s * 1e9
        found.append(f"gate {opens_ns:.6g}-{closes_ns:.6g} ns")
    elif request.n_bins is None:
        found.append(f"{acquisition.n_bins} bins")
    if request.pulse is None:
        shape = "Gaussian" if pulse.shape == "gaussian" else pulse.shape
        found.append(f"pulse {shape} of {time_text(pulse.tau_s)}")
    if request.detection is None:
        found.append("first photons only" if detection == "first" else "all photons of a pulse")
    return found


def sentence(origin: str, guessed: Iterable[str], *remarks: str) -> str:
    """Join the origin, the guesses and the remarks that are not empty; any encoding can hold it."""
    listed = ", ".join(guessed)
    parts = (origin, listed and f"guessed: {listed}", *remarks)
    return printable("; ".join(filter(None, parts)))
