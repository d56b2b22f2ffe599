"""Evidence of an effect in a capture: its size, its p-value, and what would have been seen.

An effect that was not seen is absent only if it would have been seen. Each test therefore states
the smallest effect that it sees with a probability of `POWER`.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used

from core.inference.fit import Deviation

SIZE = 0.05
"""Largest probability that an absent effect is seen."""

POWER = 0.8
"""Probability with which the smallest effect is seen."""

Verdict = Literal["needed", "not needed", "cannot tell"]


class Evidence(NamedTuple):
    """Result of a test; effects are in the unit of the test."""

    p_value: float
    """Probability of as much evidence if there is no effect."""
    effect: float
    """Estimate of the effect, at least 0."""
    smallest: float
    """Effect that is seen with a probability of `POWER`; infinite if there is none."""
    largest: float
    """Effect of which evidence as small as this has a probability of 1 - `POWER`."""

    @property
    def is_seen(self) -> bool:
        """Whether the evidence is significant."""
        return self.p_value < SIZE

    def verdict(self, margin: float, explained: float = 0.0) -> Verdict:
        """Decide whether an effect of at least `margin` exists.

        Parameters
        ----------
        margin : float
            Smallest effect that matters.
        explained : float
            Largest effect that another part of the model may cause, which is seen, too.
        """
        if self.is_seen and self.effect >= margin + explained:
            return "needed"
        excluded = self.largest if self.is_seen else self.smallest
        return "not needed" if excluded <= margin else "cannot tell"


def evidence_of_deviation(deviation: Deviation) -> Evidence:
    """Return the evidence that pooled residuals deviate from a model, relative to the model."""
    squares, freedom, unit = deviation
    if freedom == 0:
        return Evidence(1.0, 0.0, math.inf, math.inf)

    def effect(least_squares: float) -> float:
        """Effect for which squares are smaller than these with a probability of 1 - `POWER`."""
        return math.sqrt(scipy.special.chndtrinc(least_squares, freedom, 1 - POWER)) / unit

    critical = float(scipy.special.chdtri(freedom, SIZE))
    return Evidence(deviation.p_value, deviation.effect, effect(critical), effect(squares))


def evidence_of_share(found: int, n_pixels: int, false_alarm: float, power: float) -> Evidence:
    """Return the evidence that a share of the pixels have a property.

    Parameters
    ----------
    found : int
        Pixels that seem to have it.
    n_pixels : int
        Pixels examined.
    false_alarm, power : float
        Probability that a pixel without it, and one with it, seems to have it.
    """
    binomial = scipy.special
    p_value = float(binomial.bdtrc(found - 1, n_pixels, false_alarm)) if found else 1.0
    if power <= false_alarm:
        return Evidence(p_value, 0.0, math.inf, math.inf)

    def share(seeming: float) -> float:
        return max(seeming - false_alarm, 0.0) / (power - false_alarm)

    def most(count: int) -> float:
        """Share with which as few pixels seem to have it with a probability of 1 - `POWER`."""
        return share(float(binomial.bdtri(count, n_pixels, 1 - POWER)) if count < n_pixels else 1.0)

    counts = np.arange(n_pixels + 1)
    critical = int(np.argmax(binomial.bdtrc(counts, n_pixels, false_alarm) < SIZE))
    # More than `critical` pixels are significant.
    smallest = most(critical)
    return Evidence(
        p_value,
        min(share(found / n_pixels), 1.0),
        smallest if smallest <= 1 else math.inf,
        min(most(found), 1.0),
    )
