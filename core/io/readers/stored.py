"""Arrays that a file may hold many of, each with a name: what HDF5, netCDF and Zarr have in common.

Nothing of an array is read before it is asked for.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from core.checks import require
from core.io.readers.request import Request


class Numbers(Protocol):
    """An array that is read box by box."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Its size along each axis."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of its numbers."""

    @property
    def chunk(self) -> tuple[int, ...]:
        """The size of a box that is read in one go, along each axis."""

    def __getitem__(self, box: tuple[slice, ...]) -> NDArray[Any]:
        """The numbers in a box of slices, of any positive step."""


def whole(numbers: Numbers) -> NDArray[Any]:
    """All numbers of an array."""
    return numbers[(slice(None),) * len(numbers.shape)]


@dataclass(frozen=True)
class Stored:
    """An array in a file.

    Parameters
    ----------
    name : str
        Within the file, with the groups that it lies in.
    numbers : Numbers or None
        None where it is refused.
    axes : tuple of str or None
        Names of the axes, each None where the file gives none.
    attributes : dict
        Numbers, lists of numbers, and text.
    refused : str
        Why it is not read.
    references : tuple of int
        Shape of an array that refers to others, as MATLAB's cell arrays do; such are not read here.
    """

    name: str
    numbers: Numbers | None = None
    axes: tuple[str | None, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    refused: str = ""
    references: tuple[int, ...] = ()

    def __str__(self) -> str:
        size = " x ".join(map(str, self.numbers.shape)) if self.numbers is not None else ""
        return f"{self.name} ({self.refused or size or 'one number'})"

    @property
    def n_axes(self) -> int:
        """Number of axes; 0 for an array that is refused."""
        return 0 if self.numbers is None else len(self.numbers.shape)


def choose(arrays: Sequence[Stored], request: Request) -> Stored:
    """The array asked for, or ``counts``, or the only one with three axes.

    Raises
    ------
    ValueError
        If there is none, or it is refused.
    """
    for known, times in Counter(array.name for array in arrays).items():
        require(f"arrays named {known!r}", times, times == 1, "each name once")
    named = {array.name: array for array in arrays}
    listed = ", ".join(map(str, arrays[:20])) + ", ..." * (len(arrays) > 20) or "nothing"
    remedy = f"as variable the name of a (row, col, bin) array; the file has {listed}"
    name = request.variable
    if name is None:
        cubes = [array.name for array in arrays if array.n_axes == 3]
        name = "counts" if "counts" in named else cubes[0] if len(cubes) == 1 else None
        require("variable", ", ".join(cubes) or None, name is not None, remedy)
    require("variable", name, name in named, remedy)
    chosen = named[str(name)]
    within = "an array of numbers in the file itself, packed by deflate, LZF, zstd or blosc"
    require(f"variable {name}", chosen.refused, chosen.numbers is not None, within)
    return chosen
