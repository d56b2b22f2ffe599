"""What all tests of core share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numba
import pytest
from hypothesis import settings

from core.tests.captures import real_capture_path

# The same examples on every run; a kernel's first call compiles it, so no example has a deadline.
settings.register_profile("core", derandomize=True, deadline=None)
settings.register_profile("thorough", max_examples=5000, deadline=None)
settings.load_profile("core")

# Helpers that assert, imported by the tests: without this they fail with a bare AssertionError.
pytest.register_assert_rewrite("core.tests.refusing")


def pytest_configure(config: pytest.Config) -> None:
    """Run as plain Python, uint64 numbers that wrap round, as SplitMix64 needs, make numpy warn."""
    if numba.config.DISABLE_JIT:
        config.addinivalue_line(
            "filterwarnings",
            r"ignore:overflow encountered in scalar (add|multiply)"
            r":RuntimeWarning:core\.kernels\.streams",
        )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what would take hours where nothing is compiled, and what tells nothing of kernels.

    It runs where kernels are compiled.
    """
    if numba.config.DISABLE_JIT:
        marks = ("compiled", "files")
        left_out = [item for item in items if any(map(item.get_closest_marker, marks))]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, bytes], Path]:
    """Makes a file of a name and a content."""

    def written(name: str, content: bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return written


@pytest.fixture
def real_capture() -> Callable[[str], Path]:
    """Path of a published capture."""
    return real_capture_path
