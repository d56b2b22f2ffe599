"""Trust ranges of every setting and scene parameter, as tables and plots on one page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from core.estimators import ESTIMATORS
from core.parameters import Number
from core.studies.outputs import Item, Plot, Table
from core.studies.sensitivity import sweep as trust
from core.studies.sensitivity.sweep import Sweep

TITLE = "Trust ranges"

INTRODUCTION = (
    "For every estimator and every parameter: the range in which it can be trusted, where it "
    "degrades, and what it returns beyond.",
    f"Trusted values lose at most {trust.LOSS:g} of the pixels against the best value of their "
    "sweep, with an allowance of two standard deviations of the paired difference. Where fewer "
    f"than {trust.FAILING:g} of the best value's correct estimates remain, the method fails. "
    "Depths are uniform over the gate; for methods that use neighbours they are constant in tiles "
    "of 8 x 8 pixels. An estimate is correct within 3 bins. All other parameters have their "
    "defaults; the SBR is the first at which the method restores nine pixels in ten.",
)

PIECES = sum(map(len, trust.SCENE_VALUES.values())) + trust.N_SETTINGS + 1
"""That `study` reports as done, one by one."""


def study(progress: Callable[[int, int], None]) -> tuple[list[Item], list[str]]:
    """Sweep every parameter.

    Returns
    -------
    items : list
        Tables and plots.
    unconfirmed : list of str
        A sentence for each doubtful zone in which nothing doubtful was measured, or that is too
        small.
    """
    done = 0

    def one_more() -> None:
        nonlocal done
        done += 1
        progress(done, PIECES)

    scene, settings = trust.scene_sweeps(one_more), trust.setting_sweeps(one_more)
    zones = list(trust.zone_rows())
    one_more()
    items: list[Item] = [
        zones_table(zones),
        ranges_table("settings", "Settings: where they are to be trusted", settings),
        ranges_table("scene", "Scenes: where methods are to be trusted", scene),
        *plots(settings, scene),
    ]
    unconfirmed = [
        f"Doubtful zone not confirmed: {z[0]}, {z[1]} = {z[2]}." for z in zones if z[-1] != "yes"
    ]
    return items, unconfirmed


def zones_table(rows: Sequence[tuple[str, ...]]) -> Table:
    """Doubtful zones of settings, as the app marks them, and what is measured there."""
    columns = (
        "method",
        "parameter",
        "in doubt",
        "why",
        "measured at its ends",
        "measured beyond",
        "borne out",
    )
    note = (
        f"Measured a step of {100 * trust.STEP:g} % within and beyond each end that a slider "
        f"reaches. Signs of doubt are more than {trust.LOSS:g} of the pixels lost against the "
        "settings as they come, another bin in float32 than in float64, white noise that passes "
        "the filter's linear zone undiminished, and a filter that still moves a thousand bins "
        "behind an echo. Where a zone ends in another one nothing is measured beyond."
    )
    return Table("zones", "Doubtful settings", columns, tuple(rows), note)


def ranges_table(key: str, title: str, sweeps: Sequence[Sweep]) -> Table:
    """Where each method is to be trusted, degrades and fails, and what it does at worst."""
    rows = []
    for sweep in sweeps:
        worst = sweep.worst
        rows.append(
            (
                sweep.method,
                sweep.parameter,
                f"{sweep.sbr:g}",
                sweep.ranges("trusted"),
                sweep.ranges("degraded"),
                sweep.ranges("failing"),
                f"{sweep.best.share:.3f} at {sweep.best.value:.3g}",
                f"{worst.share:.3f} at {worst.value:.3g}",
                f"{worst.answered:.2f}",
                "–" if np.isnan(worst.confidence) else f"{worst.confidence:.2f}",
            )
        )
    columns = (
        "method",
        "parameter",
        "SBR",
        "trusted",
        "degraded",
        "failing",
        "best RD",
        "worst RD",
        "answered there",
        "confidence there",
    )
    note = (
        "Values that were tried; between them nothing is known. RD is the share of pixels within 3 "
        "bins. Confidence is the mean over what is answered: where it stays low, the answers can "
        "be told from good ones; one to three pulses tell too little for that."
    )
    return Table(key, title, columns, tuple(rows), note)


def plots(settings: Sequence[Sweep], scene: Sequence[Sweep]) -> Iterator[Plot]:
    """Restoration degree along the tracker's settings, and along what a scene may be."""
    own = {each.parameter: each for each in settings if each.method == "tracking"}
    specs = {field: spec for method, field, spec, _ in trust.numbers() if method == "tracking"}
    for parameter in ("l", "n", "h", "m", "alpha"):
        yield setting_plot(own[parameter], specs[parameter])
    for parameter in ("sbr", "n_pulses", "tau_bins"):
        swept = [each for each in scene if each.parameter == parameter]
        values = [p.value for p in swept[0].points if 0 < p.value < np.inf]
        yield Plot(
            f"scene_{parameter}",
            f"Every method, everything else as it comes: {parameter}",
            parameter,
            "RD within 3 bins",
            np.array(values),
            {
                f"{each.method}, SBR {each.sbr:g}": np.array(
                    [p.share for p in each.points if p.value in values]
                )
                for each in swept
            },
            x_is_log=True,
        )


def setting_plot(sweep: Sweep, spec: Number) -> Plot:
    """What becomes of the answers along a setting's slider, with the ends of its doubtful zones."""
    shown = [p for p in sweep.points if spec.low <= p.value <= spec.high]
    ends = {
        f"end of a doubtful zone, {end:g}": float(end)
        for zone in spec.doubtful
        for end in (zone.low, zone.high)
        if spec.low < end < spec.high
    }
    unit = f" ({spec.unit})" if spec.unit else ""
    return Plot(
        f"{sweep.method}_{sweep.parameter}",
        f"{ESTIMATORS[sweep.method].title}, SBR {sweep.sbr:g}: {spec.symbol}",
        f"{spec.symbol}{unit}",
        "Share of the pixels within 3 bins",
        np.array([point.value for point in shown]),
        {
            "right": np.array([point.share for point in shown]),
            "answered": np.array([point.answered for point in shown]),
            "mean confidence": np.array([point.confidence for point in shown]),
        },
        ends,
        x_is_log=spec.log,
    )


def write_page(items: Sequence[Item], folder: Path) -> Path:
    """Write all items into a folder; returns the page."""
    from core.studies.report import write  # noqa: PLC0415 - draws, which no test needs

    return write(items, folder, TITLE, INTRODUCTION)
