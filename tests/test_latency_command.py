"""The stopwatch of ``python -m tests.latency`` measures; how fast the app is, is not tested."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from tests.latency import STOPWATCH, Move, as_markdown, moves

pytestmark = pytest.mark.browser


def test_each_move_is_timed_from_the_key_to_the_last_stroke(page):
    new = page(prepare=STOPWATCH)
    taken = moves(new, "SBR", 3)
    assert len(taken) == 3
    for move in taken:
        assert np.isfinite(astuple(move)).all()
        assert 0 < move.server <= move.plots <= move.everything


def test_the_table_has_medians_and_95th_percentiles():
    table = as_markdown({"SBR": [Move(1, 2, 3), Move(3, 4, 5)], "l": [Move(1, 1, 1)] * 3})
    assert table.splitlines()[2:] == [
        "| SBR | 2 (3) | 3 (4) | 4 (5) |",
        "| l | 1 (1) | 1 (1) | 1 (1) |",
    ]
