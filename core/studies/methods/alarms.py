"""False alarms on echo-free pixels over backgrounds of several shapes.

The lower half of each image sees the car; the upper half has no echo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.inference.background import shape_text
from core.inference.flux import flux_prior_of, flux_prior_over
from core.metrics import Interval, wilson
from core.scene import scenes
from core.studies.methods.fit import decay, ramp, shaped_capture
from core.studies.outputs import Table, table
from core.studies.trials import mapped

ASKED = (0.01, 0.1)
METHODS = ("likelihood", "coates", "tracking", "peak")
BACKGROUNDS: dict[str, Callable[[Floats], Floats]] = {
    "uniform": ramp(0.0),
    "rises by 20 %": ramp(0.2),
    "falls by 20 %": ramp(-0.2),
    "rises by 50 %": ramp(0.5),
    "falls by 50 %": ramp(-0.5),
    "+50 % that decays over 10 bins": decay,
}
SURE = 0.9999
"""Level of the interval that must contain the share asked for: of 48 shares, all do."""

_SBR = 0.06


@dataclass(frozen=True)
class Alarms:
    """Estimates of a method on the echo-free pixels of some captures."""

    background: str
    """Key of `BACKGROUNDS`."""
    method: str
    asked: float
    reported: int
    if_uniform: int
    """Likewise, by a method that takes the background for uniform."""
    pixels: int
    found: str
    """Shape found in the first capture."""

    @property
    def holds(self) -> bool:
        """Whether the share asked for is that of the estimates, but for chance."""
        interval = wilson(self.reported, self.pixels, SURE)
        return interval.low <= self.asked <= interval.high

    @property
    def share(self) -> Interval:
        """Share of the pixels with an estimate."""
        return wilson(self.reported, self.pixels)


def alarms(piece: tuple[str, range]) -> list[Alarms]:
    """Count the false alarms of each method over one background, with some seeds."""
    name, seeds = piece
    scene = scenes["car"]()
    range_m = scene.range_m.copy()
    empty = np.arange(len(range_m)) < len(range_m) // 2
    range_m[empty] = np.nan
    measured = list(product(METHODS, ASKED))
    counts = np.zeros((len(measured), 2), int)
    texts = []
    for seed in seeds:
        capture = shaped_capture(range_m, scene.acquisition, _SBR, BACKGROUNDS[name], seed)
        texts.append(shape_text(flux_prior_of(capture).background_shape))
        uniform = replace(capture, flux_prior=flux_prior_over(capture, None))
        for count, (method, asked) in zip(counts, measured, strict=True):
            count += [_reported(each, method, asked, empty) for each in (capture, uniform)]
    pixels = len(seeds) * int(np.count_nonzero(empty)) * range_m.shape[1]
    return [
        Alarms(name, method, asked, int(reported), int(if_uniform), pixels, texts[0])
        for (method, asked), (reported, if_uniform) in zip(measured, counts, strict=True)
    ]


def _reported(capture: Capture, method: str, asked: float, rows: NDArray[np.bool_]) -> int:
    """Count the estimates in some rows of a capture."""
    estimator = ESTIMATORS[method]
    delay_bin, _ = estimator.delays(capture, estimator.parameters(), asked)
    return int(np.isfinite(delay_bin[rows]).sum())


def outcomes(captures: int, processes: int = 1) -> Iterator[Alarms]:
    """Yield the false alarms over each of `BACKGROUNDS`, of each of `METHODS` and `ASKED`."""
    pieces = [(name, range(captures)) for name in BACKGROUNDS]
    found = dict(mapped(alarms, pieces, processes))
    for piece in pieces:
        yield from found[piece]


def alarms_table(found: list[Alarms]) -> Table:
    """Return the shares of echo-free pixels with an estimate."""
    reported, uniform = "reported", "reported, background taken as uniform"
    return table(
        "false_alarms",
        "False alarms over backgrounds of several shapes",
        found,
        {
            "background": lambda of: of.background,
            "found in the first capture": lambda of: of.found,
            "method": lambda of: of.method,
            "pixels": lambda of: of.pixels,
            "asked": lambda of: f"{of.asked:g}",
            reported: lambda of: of.share,
            uniform: lambda of: of.if_uniform / of.pixels,
        },
        note="Share of the echo-free pixels with an estimate, with 95 % intervals. Unmixing does "
        "not control it.",
        formats={reported: ".4f", uniform: ".4f"},
    )
