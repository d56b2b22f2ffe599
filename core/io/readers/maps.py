"""Images (row, col) of numbers in a file, listed before one of them is read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import NDArray


class Map(NamedTuple):
    """Image in a file."""

    name: str
    """Empty where the file names none."""
    shape: tuple[int, ...]
    """Rows and columns."""
    load: Callable[[], NDArray[Any]]
    """Reads the numbers."""
    unit: str = ""
    """Unit that the file states; empty where it states none."""

    def __str__(self) -> str:
        rows, cols = self.shape
        return f"{self.name or 'the image'} ({rows} x {cols})"
