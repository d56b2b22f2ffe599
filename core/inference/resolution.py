"""Resolution of models: whether a histogram shows which of two models it was drawn from.

Two distributions ``P`` and ``Q`` of the outcome of a pulse (a bin or "no trigger") overlap by ``ρ =
Σ √(P_k Q_k)`` (Bhattacharyya 1943), those of n pulses by ``ρⁿ``. Their total variation, the largest
difference in the probability of any event, lies between ``1 - ρⁿ`` and ``√(1 - ρ²ⁿ)`` (Le Cam 1973;
Tsybakov 2009, section 2.4). For many pulses and a small difference the logarithm of the likelihood
ratio is normal, and the total variation is ``2 Φ(z) - 1`` with the evidence ``z² / 2 = -n ln ρ``.
Two thresholds follow.

Resolved: the best test, that of the likelihood ratio (Neyman & Pearson 1933), confuses the models
with a probability of ``Φ(-z)``, at most `ERROR`.

Hidden: the probability of any event, including that of a right estimate, differs by at most
`ERROR` between the models.

In between, a single histogram does not show the difference, but estimates may change.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats

ERROR = 0.05

RESOLVED = NormalDist().inv_cdf(ERROR) ** 2 / 2
"""Least evidence of a resolved difference, 1.35."""

HIDDEN = NormalDist().inv_cdf((1 + ERROR) / 2) ** 2 / 2
"""Largest evidence of a hidden difference, 0.002."""

FEW = 0.01
"""Share of the pixels that is negligible in an image."""


class Difference(NamedTuple):
    """Difference of two models, in one pulse and in all; each of shape (...)."""

    total_variation: Floats
    """``½ Σ |P_k - Q_k|``, the largest difference in the probability of any event."""
    evidence: Floats
    """``-n ln ρ``."""

    @property
    def is_resolved(self) -> NDArray[np.bool_]:
        """Whether the pulses resolve the difference, shape (...)."""
        return np.asarray(self.evidence >= RESOLVED)

    @property
    def is_hidden(self) -> bool:
        """Whether the difference is hidden in all but a negligible share of the pixels."""
        return bool(np.mean(self.evidence > HIDDEN) <= FEW)

    @property
    def resolvable(self) -> Floats:
        """Least total variation of a resolved difference of this shape; NaN for no difference.

        ``-ln ρ`` is proportional to the square of a small difference.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.total_variation * np.sqrt(RESOLVED / self.evidence))


def difference(one: ArrayLike, other: ArrayLike, n_pulses: int | None) -> Difference:
    """Compare two models of a histogram.

    Parameters
    ----------
    one, other : array_like, shape (..., bin)
        Probability that a pulse triggers in each bin; the remainder to 1 is that of no trigger. If
        `n_pulses` is None: expected photons in each bin of Poisson counts, with ``½ Σ (√μ - √ν)²``
        as ``-ln ρ`` and the differing share of all photons as total variation.
    n_pulses : int or None
        Pulses sent.

    Returns
    -------
    Difference
    """
    p, q = np.asarray(one, float), np.asarray(other, float)
    if n_pulses is None:
        photons = np.maximum(p.sum(axis=-1), q.sum(axis=-1))
        variation = np.abs(p - q).sum(axis=-1) / np.maximum(2 * photons, np.finfo(float).tiny)
        return Difference(variation, _squares(p, q))
    p, q = _with_none(p), _with_none(q)
    return _in_pulses(np.abs(p - q).sum(axis=-1) / 2, _squares(p, q), n_pulses)


def pile_up(fired: ArrayLike, n_pulses: int) -> Difference:
    """Compare triggers with pile-up to as many triggers distributed as the photons.

    With ``Λ u`` expected photons before a time, triggers have the density ``Λ exp(-Λ u)`` in u, and
    without pile-up a uniform one. The difference does not depend on the temporal shape of the flux,
    and binning can only reduce it. For small ``Λ`` it is ``Λ² / 8`` and, in one pulse, ``-ln ρ =
    Λ³ / 96``.

    Parameters
    ----------
    fired : array_like, shape (...)
        Share of the pulses that fire, ``1 - exp(-Λ)``.
    n_pulses : int

    Returns
    -------
    Difference
    """
    photons = np.asarray(-np.log1p(-np.clip(np.asarray(fired, float), 0.0, 1 - 1e-12)))
    small = photons < 0.01  # avoids cancellation
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
    """Compute ``1 - Σ √(P Q)`` of distributions without cancellation."""
    return np.asarray(((np.sqrt(p) - np.sqrt(q)) ** 2).sum(axis=-1) / 2)


def _in_pulses(variation: Floats, apart: Floats, n_pulses: int) -> Difference:
    """Difference from the total variation and ``1 - ρ`` of one pulse."""
    with np.errstate(divide="ignore"):  # disjoint distributions
        evidence = n_pulses * -np.log1p(-np.minimum(apart, 1.0))
    return Difference(np.asarray(variation), np.asarray(evidence))
