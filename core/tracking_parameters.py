"""Settings of the tracking differentiators: bounds, texts and recommended presets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from core.parameters import Choice, Number, Settings, Zone, parameter

Weight = Literal["cubic", "exponential", "survival", "none"]
Start = Literal["zero", "mean"]
SigmaFrom = Literal["gate", "before T_n"]
Refine = Literal["none", "likelihood"]


# Limits of reliable settings, measured by ``python -m core stability``.
CALM_M = 0.8  # chaotic below
LINEAR = 1.0
STEEP_ALPHA = 1.6
SLOW_L = 7e-4
FEW_BINS = 4


@dataclass(frozen=True)
class TrackingParameters(Settings):
    """Settings of the dual-scale tracking differentiator, by default the recommended preset.

    Meaning, unit and bounds of each field are in its metadata (`core.parameters`).
    """

    l: float = parameter(  # noqa: E741 - the paper's letter
        0.004,
        Number(
            "l",
            1e-4,
            1.0,
            log=True,
            merge_power=2,  # an acceleration: counts per square bin
            least=0.0,
            most=1e6,
            doubtful=(Zone(0.03, 1e6, "The small scale is so fast that it follows the echo."),),
        ),
        "Speed of the small scale, r_small = l·σ: smaller follows only the slow trend.",
    )
    n: float = parameter(
        1000.0,
        Number(
            "n",
            1.0,
            1e4,
            log=True,
            least=0.0,
            most=1e9,
            doubtful=(Zone(0.0, 70.0, "The scales are too much alike; at n = 1 nothing remains."),),
        ),
        "Large scale over small scale, r_large = n·r_small: larger follows the echo's jump faster.",
    )
    h: float = parameter(
        1.0,
        Number(
            "h",
            0.25,
            4.0,
            log=True,
            least=0.0,
            most=1e6,
            open_below=True,
            unit="bins",
            merge_power=0,  # l is rescaled instead
            doubtful=(
                Zone(0.0, 0.42, "Same effect as too small an l: dim pixels get no estimate."),
                Zone(2.6, 1e6, "Same effect as too large an l: the small scale follows the echo."),
            ),
        ),
        "Step of the integration. Only (m·h)²·l matters: h and l are one setting.",
    )
    m: float = parameter(
        1.4,
        Number(
            "m",
            0.4,
            5.0,
            least=1e-3,
            most=1e6,
            doubtful=(
                Zone(1e-3, 0.5, "It never settles: at ½ and below it cycles for ever."),
                Zone(
                    0.5,
                    CALM_M,
                    "Chaotic: rounding decides, and float32 finds other echoes.",
                ),
                Zone(
                    CALM_M,
                    1.0,
                    "It smooths nothing: at 1 a pure delay, below it overshoots.",
                ),
            ),
        ),
        "Smoothing, h0 = m·h: delays by 2m - 1 bins.",
    )
    alpha: float = parameter(
        0.15,
        Number("α", 0.1, 30.0, log=True, least=0.0, most=1e6),
        "Strength of the weight. It scales the paper's cubic weight equally in all bins, which "
        "changes no range; with the exponential weight it does.",
    )
    t_n: int = parameter(
        20,
        Number("T_n", 0, 99, whole=True, least=0, most=2**31 - 1, unit="bins", is_bin_index=True),
        "First bin in which the residual may peak, about two bins after the echo's onset; earlier "
        "peaks count as noise.",
    )
    weight: Weight = parameter(
        "exponential",
        Choice("Weight", ("none", "survival", "cubic", "exponential")),
        "Factor of the residual: none, 1 / share of armed pulses (corrects the decay by pile-up), "
        "α·(k/N)³ (printed), or exp(α·(k/N)³).",
    )
    start: Start = parameter(
        "mean",
        Choice("Start", ("mean", "zero")),
        "Initial value of both scales: the mean of the first five bins, or zero, whose initial "
        "jump T_n must exclude.",
    )
    sigma_from: SigmaFrom = parameter(
        "gate",
        Choice("σ from", ("gate", "before T_n")),
        "Bins whose standard deviation is σ: the whole gate (Eq. 6) or those before T_n "
        "(Algorithm 1). The paper prints both.",
    )
    refine: Refine = parameter(
        "likelihood",
        Choice("Refine", ("none", "likelihood")),
        "Range below a bin: the largest likelihood within one pulse of the bin found, or beyond as "
        "far as it increases; or none: that bin itself, as in the paper, in about half the time.",
    )

    def joint_doubts(self) -> list[str]:
        """Return reasons why this combination of settings makes estimates unreliable."""
        linear = (self.m * self.h) ** 2 * self.l
        found = []
        if linear >= LINEAR:
            found.append(
                f"(m·h)²·l = {linear:.2g}: from about {LINEAR:g} on both scales are linear and "
                "nearly equal, which leaves little residual or none."
            )
        if self.weight == "exponential" and self.alpha >= STEEP_ALPHA:
            found.append(
                f"An exponential weight of α = {self.alpha:g}, {STEEP_ALPHA:g} or more, favours "
                "the end of the gate over any echo before it."
            )
        if self.start == "mean" and self.l <= SLOW_L:
            found.append(
                f"From the mean, a small scale of l = {self.l:g}, {SLOW_L:g} or less, is too slow: "
                "dim pixels get no estimate."
            )
        if self.start == "zero" and self.weight != "cubic":
            found.append(
                "From zero both scales first jump up to the background; only the cubic weight "
                "suppresses that jump."
            )
        if self.sigma_from == "before T_n" and self.t_n < FEW_BINS:
            found.append(
                f"σ of the {self.t_n} bins before T_n, fewer than {FEW_BINS}, is chance; for "
                "one bin or none it is 0, and no pixel gets an estimate."
            )
        return found


class _Presets(dict[str, TrackingParameters]):
    """Presets by name; also under a deprecated name, to be removed after the next release."""

    def __missing__(self, name: str) -> TrackingParameters:
        if name == "as printed":
            return replace(self["literal"], l=0.001)
        raise KeyError(name)


PRESETS: dict[str, TrackingParameters] = _Presets(
    recommended=TrackingParameters(),
    literal=TrackingParameters(
        l=0.0004,
        n=1000.0,
        h=1.0,
        m=1.5,
        alpha=1.0,
        t_n=20,
        weight="cubic",
        start="zero",
        refine="none",
    ),
)
"""``recommended`` is the best on random depths (``python -m core recommend``). ``literal`` is the
paper's equations with the printed weight and T_n, an initial value of zero, and whole bins. The
paper prints no l, n, h, m or α; this l is the best on random depths (``python -m core tuning``)."""
