"""A value for each option for reading a file."""

from __future__ import annotations

from typing import Any

from core import Pulse

EXAMPLES: dict[str, Any] = {
    "time_unit_s": 1e-12,
    "bin_width_s": 1.1e-9,
    "gate_delay_s": -1e-9,
    "n_bins": 7,
    "n_pulses": 9,
    "variable": "a b&c",
    "pulse": Pulse.gaussian(3e-10),
    "pixel_angle_rad": 0.002,
    "detection": "all",
    "axes": "bin, row col",
    "shape": (3, 5),
    "stop_s": 0.5,
    "no_trigger": -1,
    "first_detections": 3,
    "records": (3, 7),
    "pulse_groups": 4,
    "pulse_rate_hz": 2e4,
}
