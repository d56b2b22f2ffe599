"""Options for reading a file, as a form shows and returns them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from app.model.store import Answer
from core import Pulse
from core.io import ReadOptions


def options_in_use(answer: Answer) -> dict[str, str]:
    """Return the options that describe a capture as text, whether stated by its file or guessed."""
    capture, acquisition = answer.whole, answer.whole.acquisition
    used = replace(
        ReadOptions(**capture.guesses),
        bin_width_s=acquisition.bin_width_s,
        gate_delay_s=acquisition.gate_delay_s,
        n_bins=acquisition.n_bins,
        n_pulses=acquisition.n_pulses,
        pulse=Pulse.gaussian(float(f"{capture.pulse.sigma_s:.4g}")),
        detection=capture.detection,
        # The pixels of a preview are not those of the file.
        pixel_angle_rad=acquisition.pixel_angle_rad if answer.cutout is None else None,
        shape=capture.shape if answer.cutout is None else None,
    )
    return {name: used.as_text(name) for name in vars(used)}


def changed_options(
    reading: ReadOptions, shown: Mapping[str, str], typed: Mapping[str, str]
) -> ReadOptions:
    """Return the options of a form; a field that still has the text it showed keeps its value.

    Parameters
    ----------
    reading : ReadOptions
        Those that the form was filled from.
    shown, typed : mapping of str to str
        Text of each field when it was filled, and now.

    Raises
    ------
    ValueError
        If a text cannot be parsed, or a value is out of its range.
    """
    same = {name: reading.as_text(name) for name, text in typed.items() if text == shown[name]}
    return ReadOptions.from_text({**typed, **same})
