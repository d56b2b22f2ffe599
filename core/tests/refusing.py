"""Assertion that a bad file is refused: one type of error that names the file, little memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest


def assert_refused(
    read: Callable[[Path], object],
    path: Path,
    message: str,
    error: type[ValueError],
    most_bytes: int,
) -> None:
    """Fail unless a file is refused with a message that matches, within `most_bytes` of memory."""
    with pytest.raises(error):
        read(path)  # the first call of a format loads its library
    tracemalloc.start()
    try:
        with pytest.raises(error, match=message) as caught:
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{path.name}: ")
    assert peak < most_bytes
