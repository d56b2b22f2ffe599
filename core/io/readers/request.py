"""What the caller knows of a file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import get_args

import numpy as np

from core.acquisition import LONGEST_S, MOST_BINS, MOST_PULSES, SHORTEST_BIN_S, Pulse, require_time
from core.capture import Detection
from core.checks import require, require_whole

_LEAST_S = {"time_unit_s": SHORTEST_BIN_S, "bin_width_s": SHORTEST_BIN_S}
_LEAST_S |= {"gate_delay_s": -LONGEST_S, "stop_s": -LONGEST_S}
_MOST = {"n_bins": MOST_BINS, "n_pulses": MOST_PULSES, "first_detections": MOST_PULSES}


@dataclass(frozen=True)
class Request:
    """The caller's word on a capture; it goes before the file's own, and None leaves it to that.

    The fields are the arguments of `core.io.readers.read_capture`.

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
    detection: Detection | None = None
    axes: str | None = None
    shape: tuple[int, int] | None = None
    stop_s: float | None = None
    no_trigger: int | None = None
    first_detections: int | None = None

    def __post_init__(self) -> None:
        for name, least_s in _LEAST_S.items():
            if (value_s := getattr(self, name)) is not None:
                require_time(name, value_s, least_s)
        for name, most in _MOST.items():
            if (value := getattr(self, name)) is not None:
                require_whole(name, value, most)
        angle = self.pixel_angle_rad
        require("pixel_angle_rad", angle, angle is None or 0 < angle < 1, "between 0 and 1 radian")
        kinds = get_args(Detection)
        kind = self.detection
        require("detection", kind, kind is None or kind in kinds, " or ".join(map(repr, kinds)))
        value = self.no_trigger
        whole = isinstance(value, int | np.integer)
        require("no_trigger", value, value is None or whole, "a whole number")
        shape = self.shape
        pair = (
            isinstance(shape, tuple)
            and len(shape) == 2
            and all(isinstance(size, int | np.integer) and size >= 1 for size in shape)
        )
        require("shape", shape, shape is None or pair, "rows and columns, each at least 1")

    def order(self, canonical: tuple[str, ...]) -> tuple[int, ...] | None:
        """Where each of the axes that a reader wants lies in the file, as `numpy.transpose` takes.

        Parameters
        ----------
        canonical : tuple of str
            Names of the axes as the reader wants them, such as ``("row", "col", "bin")``.

        Returns
        -------
        tuple of int or None
            None where `axes` is not told.

        Raises
        ------
        ValueError
            If `axes` names others, or not each of them once.
        """
        if self.axes is None:
            return None
        named = re.split(r"[\s,]+", self.axes.strip())
        fits = sorted(named) == sorted(canonical)
        require("axes", self.axes, fits, f"{' '.join(canonical)!r} in the order of the file")
        return tuple(named.index(name) for name in canonical)

    def refuse(self, names: Iterable[str], why: str) -> None:
        """Raise ``ValueError`` if one of the fields is told, for which a file has no use."""
        for name in names:
            require(name, getattr(self, name), getattr(self, name) is None, f"None: {why}")
