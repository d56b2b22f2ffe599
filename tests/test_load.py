"""``python -m tests.load`` in short: responses arrive, memory does not grow, verdicts are right."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np

from tests.browser import serving
from tests.load import Bounds, Growth, Load, as_markdown, growth, load, server_mb, verdicts


def test_all_sessions_are_answered_and_interactions_leave_no_memory():
    with serving() as address:  # of its own, since its memory is measured
        resident_mb = server_mb(address)
        used = asyncio.run(load(address, resident_mb, sessions=2, seconds=1.5, forgotten_s=0.0))
        # Until then, what is loaded when it is first used counts, too.
        grown = asyncio.run(growth(address, resident_mb, interactions=40, warm=60))
    assert used.troubles == grown.troubles == []
    assert used.latencies_s.size > 40
    assert used.session_mb <= Bounds().session_mb
    assert grown.after_mb - grown.before_mb < 10


def test_a_missed_requirement_is_reported():
    used = Load(2, np.array([0.1, 0.2]), [], 500.0, 540.0, 510.0)
    grown = Growth(100, [], 510.0, 515.0)
    bounds = Bounds()
    assert all(reached for *_, reached in verdicts(used, grown, bounds))
    for broken in (
        (replace(used, latencies_s=np.array([2.0])), grown),
        (replace(used, with_mb=700.0), grown),
        (replace(used, troubles=["no answer"]), grown),
        (used, replace(grown, after_mb=600.0)),
    ):
        found = verdicts(*broken, bounds)
        assert sum(not reached for *_, reached in found) == 1
        assert as_markdown(found).count("missed") == 1
