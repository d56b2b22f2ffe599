"""Tables and plots of the sensitivity study."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from core.estimators import ESTIMATORS
from core.parameters import Number
from core.studies.outputs import Item, Plot, Table, table
from core.studies.sensitivity import sweep as sensitivity
from core.studies.sensitivity.sweep import Sweep

TITLE = "Trust ranges"

INTRODUCTION = (
    "For every estimator and every parameter: the range in which it can be trusted, where it "
    "degrades, and what it returns beyond.",
    f"Trusted values lose at most {sensitivity.LOSS:g} of the pixels against the best value of "
    "their sweep, with an allowance of two standard deviations of the paired difference. Where "
    f"fewer than {sensitivity.FAILING:g} of the best value's correct estimates remain, the method "
    "fails. Depths are uniform over the gate; for methods that use neighbours they are constant in "
    "tiles of 8 x 8 pixels. An estimate is correct within 3 bins. All other parameters have their "
    "defaults, but tracking is not refined below a bin; the SBR is the first at which the method "
    "restores nine pixels in ten.",
)


def study(progress: Callable[[int, int], None]) -> tuple[list[Item], list[str]]:
    """Sweep every parameter.

    Returns
    -------
    items : list
        Tables and plots.
    unconfirmed : list of str
        A sentence for each doubtful zone that measurements do not confirm.
    """
    of = sum(map(len, sensitivity.SCENE_VALUES.values())) + len(sensitivity.numbers()) + 1
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        progress(done, of)

    scene, settings = sensitivity.scene_sweeps(advance), sensitivity.setting_sweeps(advance)
    zones = list(sensitivity.zone_rows())
    advance()
    items: list[Item] = [
        zones_table(zones),
        ranges_table("settings", "Settings", settings),
        ranges_table("scene", "Scenes", scene),
        *plots(settings, scene),
    ]
    return items, [
        f"Doubtful zone not confirmed: {z[0]}, {z[1]} = {z[2]}." for z in zones if z[-1] != "yes"
    ]


def zones_table(rows: Sequence[tuple[str, ...]]) -> Table:
    """Return the doubtful zones of settings, as the app marks them, with measurements."""
    columns = ("method", "parameter", "zone", "reason", "measured inside", "outside", "confirmed")
    note = (
        f"Measured {100 * sensitivity.STEP:g} % inside and outside each end that a slider reaches, "
        "unless the zone borders on another one. Signs of doubt: more than "
        f"{sensitivity.LOSS:g} of the pixels lost against the defaults, another bin in float32 "
        "than in float64, white noise that the filter does not reduce in its linear zone, and a "
        "filter that still moves a thousand bins after an echo."
    )
    return Table("zones", "Doubtful settings", columns, tuple(rows), note)


def ranges_table(key: str, title: str, sweeps: Sequence[Sweep]) -> Table:
    """Return where each method is trusted, degrades and fails, and its worst result."""
    return table(
        key,
        title,
        sweeps,
        {
            "method": lambda sweep: sweep.method,
            "parameter": lambda sweep: sweep.parameter,
            "SBR": lambda sweep: f"{sweep.sbr:g}",
            "trusted": lambda sweep: sweep.ranges("trusted"),
            "degraded": lambda sweep: sweep.ranges("degraded"),
            "failing": lambda sweep: sweep.ranges("failing"),
            "best RD": lambda sweep: f"{sweep.best.share:.3f} at {sweep.best.value:.3g}",
            "worst RD": lambda sweep: f"{sweep.worst.share:.3f} at {sweep.worst.value:.3g}",
            "estimated there": lambda sweep: f"{sweep.worst.answered:.2f}",
            "confidence there": lambda sweep: (
                "–" if np.isnan(sweep.worst.confidence) else f"{sweep.worst.confidence:.2f}"
            ),
        },
        "Only the listed values were measured. RD is the share of pixels within 3 bins. "
        "Confidence is its mean over all estimates: where it is low, wrong estimates can be "
        "recognized, except with one to three pulses.",
    )


def plots(settings: Sequence[Sweep], scene: Sequence[Sweep]) -> Iterator[Plot]:
    """Plot the restoration degree along tracking's settings and along scene parameters."""
    own = {each.parameter: each for each in settings if each.method == "tracking"}
    specs = {
        field: spec for method, field, spec, _ in sensitivity.numbers() if method == "tracking"
    }
    for parameter in ("l", "n", "h", "m", "alpha"):
        yield setting_plot(own[parameter], specs[parameter])
    for parameter in ("sbr", "n_pulses", "tau_bins"):
        swept = [each for each in scene if each.parameter == parameter]
        values = [p.value for p in swept[0].points if 0 < p.value < np.inf]
        yield Plot(
            f"scene_{parameter}",
            f"All methods: {parameter}",
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
    """Plot RD, coverage and confidence along a slider, with the ends of its doubtful zones."""
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
        "Share of the pixels",
        np.array([point.value for point in shown]),
        {
            "within 3 bins": np.array([point.share for point in shown]),
            "estimated": np.array([point.answered for point in shown]),
            "mean confidence": np.array([point.confidence for point in shown]),
        },
        ends,
        x_is_log=spec.log,
    )
