"""Assertions that bad files are refused: by an error that names the file, in little memory."""

from __future__ import annotations

import shutil
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from core.tests.formats import Content, put


def with_peak(call: Callable[[], Any]) -> tuple[Any, int]:
    """Return the result of a call, and the peak of the memory that it allocated, in bytes."""
    tracemalloc.start()
    try:
        return call(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def assert_refused(
    read: Callable[[Path], object],
    path: Path,
    message: str,
    error: type[ValueError],
    most_bytes: int,
) -> None:
    """Fail unless a file is refused with a message that matches, within `most_bytes` of memory."""

    def refused() -> str:
        with pytest.raises(error, match=message) as caught:
            read(path)
        return str(caught.value)

    text, peak = with_peak(refused)
    assert text.startswith(f"{path.name}: ")
    assert peak < most_bytes


def count_refused(
    read: Callable[[Path], object], path: Path, contents: Iterable[Content], error: type[ValueError]
) -> int:
    """Write and read one content after the other; return how many are refused, naming the file."""
    n_refused = 0
    for content in contents:
        shutil.rmtree(path, ignore_errors=True)
        put(path, content)
        try:
            read(path)
        except error as refusal:
            assert str(refusal).startswith(f"{path.name}: ")
            n_refused += 1
    return n_refused
