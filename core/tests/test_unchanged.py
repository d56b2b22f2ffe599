"""Results are those stored: to the last bit on the machine that stored them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.tests import unchanged
from core.tests.unchanged import CASES, Record

pytestmark = [pytest.mark.compiled, pytest.mark.uncounted]

STORED, WRITTEN_BY = unchanged.stored()
SAME_MACHINE = unchanged.fingerprint() == WRITTEN_BY

STEP = 2.0**-23  # of single precision
ELSEWHERE = {"bin": (0.0, 5e-5), "range_m": (STEP, 7.5e-6), "confidence": (0.0, 5e-5)}
"""Relative and absolute tolerance on another machine, by the last part of a name; that in metres is
5e-5 bins of 1 ns, and the step in which files store ranges. Kernels use single precision: without
AVX and FMA delays changed by up to 8.2e-6 bins, and confidences by up to 3.6e-6."""
OTHERS = (1e-4, 1e-9)
MEAN_FLUXES = (0.02, 1e-9)
"""Those in reports on captures: the fit of their pulse ends within 0.2 of the largest likelihood's
logarithm, and rounding decides where. With AVX-512 they changed by up to 0.0123."""
LEAST_ALIKE = 0.99  # of the numbers of one name: rounding decides between equal scores


def differing(found: Record, stored: Record) -> list[str]:
    """Return the names of arrays that differ in any bit."""
    return [
        name
        for name, was in stored.items()
        if found[name].dtype != was.dtype or not np.array_equal(found[name], was, equal_nan=True)
    ]


def shares_alike(
    found: Record, stored: Record, others: tuple[float, float] = OTHERS
) -> dict[str, float]:
    """Return the share within tolerance of the numbers of each kind, such as ``range_m``."""
    alike: dict[str, list[np.ndarray]] = {}
    for name, was in stored.items():
        assert (found[name].dtype, found[name].shape) == (was.dtype, was.shape), name
        kind = name.rpartition(".")[2]
        rtol, atol = ELSEWHERE.get(kind, others)
        close = np.isclose(found[name], was, rtol, atol, equal_nan=True)
        alike.setdefault(kind, []).append(close.ravel())
    joined = {kind: np.concatenate(each) for kind, each in alike.items()}
    return {kind: float(each.mean()) for kind, each in joined.items() if each.size}


@pytest.mark.parametrize("case", CASES)
def test_results_are_those_stored(case: str, tmp_path: Path) -> None:
    found, stored = unchanged.answers(case, tmp_path), STORED[case]
    assert list(found) == list(stored)
    if SAME_MACHINE:
        assert differing(found, stored) == []
    else:
        others = MEAN_FLUXES if case == "capture reports" else OTHERS
        shares = shares_alike(found, stored, others)
        assert {kind: share for kind, share in shares.items() if share < LEAST_ALIKE} == {}


def test_the_file_holds_all_cases_and_no_others() -> None:
    assert set(STORED) == set(CASES)


def test_a_change_of_one_bit_is_noticed() -> None:
    was = {"range_m": np.array([[42.0, np.nan]])}
    assert differing({"range_m": was["range_m"].copy()}, was) == []
    for other in ([[np.nextafter(42.0, 43.0), np.nan]], [[42.0, 0.0]], [42.0, np.nan]):
        assert differing({"range_m": np.array(other)}, was) == ["range_m"]
    assert differing({"range_m": was["range_m"].astype(np.float32)}, was) == ["range_m"]
    assert shares_alike({"range_m": was["range_m"] + 2e-5}, was) == {"range_m": 0.5}
