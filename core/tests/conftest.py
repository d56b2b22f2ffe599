"""Shared fixtures and settings of the tests of core."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import numba
import pytest
from hypothesis import settings

from core.tests.captures import real_capture_path
from core.tests.garbage import pytest_collection, pytest_collection_finish  # noqa: F401 - hooks

# The same examples on every run; a kernel's first call compiles it, so no example has a deadline.
settings.register_profile("core", derandomize=True, deadline=None, max_examples=50)
settings.register_profile("thorough", max_examples=5000, deadline=None)
settings.load_profile("core")

# Helpers that assert, imported by the tests: without this they fail with a bare AssertionError.
pytest.register_assert_rewrite("core.tests.refusing")


def pytest_configure(config: pytest.Config) -> None:
    """Ignore numpy's overflow warnings for the uint64 arithmetic of uncompiled kernels."""
    if numba.config.DISABLE_JIT:
        config.addinivalue_line(
            "filterwarnings",
            r"ignore:overflow encountered in scalar (add|multiply)"
            r":RuntimeWarning:core\.kernels\.streams",
        )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without compiled kernels, leave out tests that take hours or do not depend on kernels."""
    if numba.config.DISABLE_JIT:
        marks = ("compiled", "files")
        left_out = [item for item in items if any(map(item.get_closest_marker, marks))]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


@contextmanager
def uncounted() -> Iterator[None]:
    """Count no lines: without a tracer, Python runs about twice as fast."""
    tracer = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(tracer)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, object, object]:
    """Count lines of modules in one worker only: all import the same."""
    if os.environ.get("PYTEST_XDIST_WORKER", "gw0") == "gw0":
        return (yield)
    with uncounted():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Count no lines in tests marked so; pytest-cov's own mark has no effect in its workers."""
    if not item.get_closest_marker("uncounted"):
        return (yield)
    with uncounted():
        return (yield)


@pytest.fixture(scope="session", autouse=True)
def matplotlib_uncounted() -> Iterator[None]:
    """Count no lines while Matplotlib draws, which would take more than twice as long."""
    if numba.config.DISABLE_JIT:  # nothing is drawn
        yield
        return
    from matplotlib.figure import Figure  # noqa: PLC0415 - slow to import

    savefig = Figure.savefig

    @wraps(savefig)
    def drawn(*arguments: Any, **options: Any) -> None:
        tracer = sys.gettrace()
        sys.settrace(None)
        try:
            savefig(*arguments, **options)
        finally:
            # Python calls a tracer on the return of a frame only if the frame has one, too.
            frame = inspect.currentframe()
            assert frame is not None
            frame.f_trace = tracer
            sys.settrace(tracer)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", drawn)
        yield


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures blank: drawing takes half the time of a study in miniature."""
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig", lambda _, file, **__: file.write(b"<svg></svg>")
    )


@pytest.fixture
def threads() -> Iterator[None]:
    """Restore the number of threads after a test."""
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, bytes], Path]:
    """Function that writes a file with a given name and content."""

    def written(name: str, content: bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return written


@pytest.fixture
def real_capture() -> Callable[[str], Path]:
    """Function that returns the path of a published capture."""
    return real_capture_path
