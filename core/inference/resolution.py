"""What so many pulses can tell: whether a histogram shows which of two models drew it.

Two distributions of one pulse's outcome, ``P`` and ``Q``, overlap by ``ρ = Σ √(P_k Q_k)``, the bins
and "no trigger" being the outcomes (Bhattacharyya 1943); those of n pulses overlap by ``ρⁿ``. Their
own total variation, the most by which the probability of any event can differ, lies between ``1 -
ρⁿ`` and ``√(1 - ρ²ⁿ)`` (Le Cam 1973; Tsybakov 2009, section 2.4). Where many pulses see a small
difference the logarithm of the likelihood ratio is normal, and it is ``2 Φ(z) - 1`` with ``z² / 2 =
-n ln ρ``, the evidence. Two thresholds follow.

Told: the best test, that of the likelihood ratio (Neyman & Pearson 1933), takes either model for
the other with a probability of ``Φ(-z)``, at most `ERROR`. A model that is told is wrong as the
data show.

Hidden: no event is more likely by `ERROR` under one than under the other, a right answer of any
estimator included.

Between the two a single histogram does not show the difference, but answers may move.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats

ERROR = 0.05

TOLD = NormalDist().inv_cdf(ERROR) ** 2 / 2
"""Evidence from which a difference is told: 1.35."""

HIDDEN = NormalDist().inv_cdf((1 + ERROR) / 2) ** 2 / 2
"""Evidence up to which it is hidden: 0.002."""

FEW = 0.01
"""What holds in no larger a share of the pixels does not count for an image."""


class Difference(NamedTuple):
    """How far two models lie apart, in one pulse and in all; each of shape (...)."""

    total_variation: Floats
    """``½ Σ |P_k - Q_k|``, the largest difference of any event's probability."""
    evidence: Floats
    """``-n ln ρ``."""

    @property
    def told(self) -> NDArray[np.bool_]:
        """Whether the pulses tell the models apart, shape (...)."""
        return np.asarray(self.evidence >= TOLD)

    @property
    def is_hidden(self) -> bool:
        """Whether all but a few pixels hide the difference."""
        return bool(np.mean(self.evidence > HIDDEN) <= FEW)

    @property
    def resolvable(self) -> Floats:
        """Total variation from which a difference of this shape would be told.

        ``-ln ρ`` grows with the square of a small difference. NaN where there is none.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.total_variation * np.sqrt(TOLD / self.evidence))


def difference(one: ArrayLike, other: ArrayLike, n_pulses: int | None) -> Difference:
    """Compare two models of a histogram.

    Parameters
    ----------
    one, other : array_like, shape (..., bin)
        Probability that a pulse triggers in each bin; what they lack of 1 is that of no trigger.
        Where `n_pulses` is None: the photons expected in each bin, whose counts are then Poisson
        (``½ Σ (√μ - √ν)²`` being their ``-ln ρ``, and a difference's share of all photons its total
        variation).
    n_pulses : int or None
        Pulses sent.
    """
    p, q = np.asarray(one, float), np.asarray(other, float)
    if n_pulses is None:
        photons = np.maximum(p.sum(axis=-1), q.sum(axis=-1))
        variation = np.abs(p - q).sum(axis=-1) / np.maximum(2 * photons, np.finfo(float).tiny)
        return Difference(variation, _squares(p, q))
    p, q = _with_none(p), _with_none(q)
    return _in_pulses(np.abs(p - q).sum(axis=-1) / 2, _squares(p, q), n_pulses)


def pile_up(fired: ArrayLike, n_pulses: int) -> Difference:
    """What early photons do by hiding later ones, against the same triggers spread as photons are.

    On the axis ``u`` of expected photons ``Λ u`` before each moment, triggers have the density
    ``Λ exp(-Λ u)``; without pile-up it were even. Whatever the light's course in time, the two lie
    as far apart as here, and bins can only bring them closer: ``Λ² / 8`` and, in one pulse,
    ``-ln ρ = Λ³ / 96`` where ``Λ`` is small.

    Parameters
    ----------
    fired : array_like, shape (...)
        Share of the pulses that fire, ``1 - exp(-Λ)``.
    n_pulses : int
    """
    photons = np.asarray(-np.log1p(-np.clip(np.asarray(fired, float), 0.0, 1 - 1e-12)))
    small = photons < 0.01  # where differences of nearly equal numbers would be left
    safe = np.where(small, 1.0, photons)
    share = -np.expm1(-safe)
    crossing = -np.log(share / safe) / safe
    variation = np.where(small, photons**2 / 8, 1 - share / safe - crossing * share)
    overlap = 2 * np.sqrt(share / safe) * -np.expm1(-safe / 2)
    apart = np.where(small, photons**3 / 96, share - overlap)
    return _in_pulses(variation, apart, n_pulses)


def _with_none(probability: Floats) -> Floats:
    none = np.maximum(1 - probability.sum(axis=-1, keepdims=True), 0.0)
    return np.concatenate([probability, none], axis=-1)


def _squares(p: Floats, q: Floats) -> Floats:
    """``1 - Σ √(P Q)`` of distributions, which itself would be lost in rounding."""
    return np.asarray(((np.sqrt(p) - np.sqrt(q)) ** 2).sum(axis=-1) / 2)


def _in_pulses(variation: Floats, apart: Floats, n_pulses: int) -> Difference:
    """Of one pulse's total variation and ``1 - ρ``."""
    with np.errstate(divide="ignore"):  # models that never agree
        evidence = n_pulses * -np.log1p(-np.minimum(apart, 1.0))
    return Difference(np.asarray(variation), np.asarray(evidence))
