"""What all tests of core share."""

from __future__ import annotations

import numba
import pytest
from hypothesis import settings

# The same examples on every run; a kernel's first call compiles it, so no example has a deadline.
settings.register_profile("core", derandomize=True, deadline=None)
settings.load_profile("core")


def pytest_configure(config: pytest.Config) -> None:
    """Run as plain Python, uint64 numbers that wrap round, as SplitMix64 needs, make numpy warn."""
    if numba.config.DISABLE_JIT:
        config.addinivalue_line(
            "filterwarnings",
            r"ignore:overflow encountered in scalar (add|multiply):RuntimeWarning:core\.simulate",
        )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what would take hours where nothing is compiled; it runs where kernels are."""
    if numba.config.DISABLE_JIT:
        left_out = [item for item in items if item.get_closest_marker("compiled")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
