"""What the caller knows of a file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.acquisition import Pulse
from core.checks import require


@dataclass(frozen=True)
class Request:
    """The caller's word on a capture; it goes before the file's own, and None leaves it to that.

    The fields are the arguments of `core.readers.read_capture`.

    Raises
    ------
    ValueError
        If a field is out of its range.
    """

    time_unit_s: float | None = None
    bin_width_s: float | None = None
    gate_delay_s: float | None = None
    n_bins: int | None = None
    n_pulses: int | None = None
    variable: str | None = None
    pulse: Pulse | None = None
    pixel_angle_rad: float | None = None

    def __post_init__(self) -> None:
        for name in ("time_unit_s", "bin_width_s"):
            value = getattr(self, name)
            require(name, value, value is None or 0 < value < np.inf, "positive, in seconds")
        for name in ("n_bins", "n_pulses"):
            value = getattr(self, name)
            whole = isinstance(value, int | np.integer) and value >= 1
            require(name, value, value is None or bool(whole), "a whole number, at least 1")
        delay = self.gate_delay_s
        require("gate_delay_s", delay, delay is None or bool(np.isfinite(delay)), "finite, seconds")
        angle = self.pixel_angle_rad
        require("pixel_angle_rad", angle, angle is None or 0 < angle < 1, "between 0 and 1 radian")
