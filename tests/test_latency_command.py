"""The table of ``python -m tests.latency``; `tests.test_patches` uses its stopwatch."""

from __future__ import annotations

from tests.latency import Move, as_markdown


def test_the_table_has_medians_and_95th_percentiles():
    table = as_markdown({"SBR": [Move(1, 2, 3), Move(3, 4, 5)], "l": [Move(1, 1, 1)] * 3})
    assert table.splitlines()[2:] == [
        "| SBR | 2 (3) | 3 (4) | 4 (5) |",
        "| l | 1 (1) | 1 (1) | 1 (1) |",
    ]
