"""The variables of a MATLAB file, of whatever version: which of them is a capture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from core.checks import require

NUMERIC = ("double", "single", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)))

_WIDTH_NAMES = {"binwidth", "binsize", "binresolution", "timeresolution", "resolution"}
_SHORTEST_S, _LONGEST_S = 1e-13, 1e-6


class Variable(NamedTuple):
    """A variable of a file.

    ``shape`` is MATLAB's, ``kind`` the class of its elements, or ``"sparse"``; ``content`` is what
    the reader of the file's version needs to load it.
    """

    name: str
    shape: tuple[int, ...]
    kind: str
    content: Any

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {' x '.join(map(str, self.shape))})"

    @property
    def fits(self) -> bool:
        """Whether it has the shape of a capture."""
        is_cube = self.kind in NUMERIC and len(self.shape) == 3
        is_list = self.kind in ("cell", "sparse") and len(self.shape) == 2
        return (is_cube or is_list) and min(self.shape) > 0

    @property
    def may_tell_bin_width(self) -> bool:
        """Whether it is one number, named like the width of a bin."""
        plain = self.name.lower().replace("_", "")
        return self.kind in NUMERIC and set(self.shape) == {1} and plain in _WIDTH_NAMES


def choose(variables: Sequence[Variable], name: str | None) -> Variable:
    """The variable asked for, or the only one that fits.

    Raises
    ------
    ValueError
        If there is none, or more than one.
    """
    for known, times in Counter(variable.name for variable in variables).items():
        require(f"variables named {known!r}", times, times == 1, "each name once")
    fitting = {variable.name: variable for variable in variables if variable.fits}
    listed = ", ".join(map(str, variables)) or "nothing"
    remedy = (
        "a cell (row, col) of arrival times, a cube (row, col, bin), or a sparse matrix "
        f"(pixel, bin); the file has {listed}"
    )
    if name is not None:
        require("variable", name, name in fitting, f"the name of {remedy}")
        return fitting[name]
    found = ", ".join(fitting) or None
    require("variable", found, len(fitting) == 1, f"as variable the name of {remedy}")
    return next(iter(fitting.values()))


def bin_width(values: Iterable[float]) -> float | None:
    """The one of some numbers that can be the width of a bin in seconds; None if not just one."""
    found = {value for value in values if _SHORTEST_S <= value <= _LONGEST_S}
    return found.pop() if len(found) == 1 else None
