"""Files of one name pattern as a sequence in time: each is a record, and records are added up.

A path with a pattern in its last part, such as ``runs/run_*.npz``, stands for the files that match
it, numbers in their order: ``run_2`` comes before ``run_10``. They must agree in size, timing and
kind of detection. The pulse is that of the first one that is read. With ``pulse_groups`` the order
of the files is kept in so many groups (`core.pulse_groups`); each must state its pulses.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from core.capture import IMAGES, Capture, CaptureError
from core.checks import refusing, require
from core.io.readers.dense import whole_counts
from core.io.readers.guards import require_fits
from core.io.readers.options import ReadOptions
from core.io.readers.records import chosen_records, described
from core.pulse_groups import PulseGroups, group_sizes

_PATTERN = re.compile(r"[*?\[]")


def files_of(path: Path) -> list[Path]:
    """Return the files that a pattern stands for, in order; none for the path of a file."""
    if not _PATTERN.search(path.name) or path.exists():
        return []
    return sorted(path.parent.glob(path.name), key=_order)


def pattern_of(names: Sequence[str]) -> str | None:
    """Return the pattern for file names that differ in numbers only; None for other names.

    Parameters
    ----------
    names : sequence of str
        At least one. A single name is its own pattern.

    Examples
    --------
    >>> pattern_of(["night_2_raw.npz", "night_10_raw.npz"])
    'night_*_raw.npz'
    """
    parts = [re.split(r"(\d+)", name) for name in names]
    if len({len(each) for each in parts}) > 1:
        return None
    columns = [sorted(set(column)) for column in zip(*parts, strict=True)]
    if any(len(column) > 1 and not column[0].isdecimal() for column in columns):
        return None
    return "".join(column[0] if len(column) == 1 else "*" for column in columns)


def _order(path: Path) -> list[tuple[bool, int, str]]:
    """Return a key that sorts numbers in a name by their value."""
    parts = re.split(r"(\d+)", path.name)
    return [(each.isdecimal(), int(each) if each.isdecimal() else 0, each) for each in parts]


def read_files(
    files: list[Path], request: ReadOptions, read: Callable[[Path, ReadOptions], Capture]
) -> Capture:
    """Read the requested files of a sequence, and add them up.

    Parameters
    ----------
    files : list of Path
        All files of the sequence.
    request : ReadOptions
        Its ``records`` are numbers of files.
    read : callable
        Reads one file.
    """
    chosen = chosen_records(request, len(files))
    one = replace(request, records=None, pulse_groups=None, pulse_rate_hz=None)
    total: Capture | None = None
    in_order: _InOrder | None = None
    if request.pulse_groups is None:
        request.refuse(["pulse_rate_hz"], "it needs pulse_groups")
    for order, file in enumerate(files[chosen.start : chosen.stop]):
        with refusing(file, CaptureError):
            found = replace(read(file, one), groups=None)
            total = found if total is None else _sum(total, found)
            if request.pulse_groups is not None:
                in_order = in_order or _InOrder(request, len(chosen), found)
                in_order.add(order, found)
        one = replace(one, pulse=total.pulse)
    assert total is not None
    if in_order is not None:
        total = replace(total, groups=in_order.groups)
    source = f"{described(chosen, len(files), 'file')}; {total.source}"
    stated = total.stated_flux if len(chosen) == 1 else None
    return replace(total, source=source, n_records=len(files), stated_flux=stated)


class _InOrder:
    """Counts of a sequence of files in groups.

    Parameters
    ----------
    request : ReadOptions
        With the number of groups.
    n_files : int
    like : Capture
        One of the files.

    Raises
    ------
    ValueError
        If there are more groups than files, or the groups take too much memory.
    """

    def __init__(self, request: ReadOptions, n_files: int, like: Capture) -> None:
        n_groups = len(group_sizes(n_files, request.pulse_groups or 1))
        n_bytes = n_groups * like.cube.size * 4
        require_fits(f"{n_groups} groups of pulses", n_bytes, "fewer pulse_groups")
        self._counts = np.zeros((n_groups, *like.cube.shape), np.uint32)
        self._n_pulses = [0] * n_groups
        self._rate_hz, self._n_files = request.pulse_rate_hz, n_files

    def add(self, order: int, capture: Capture) -> None:
        """Add a file, counted from 0; it must state its pulses."""
        group = order * len(self._n_pulses) // self._n_files
        n_pulses = capture.acquisition.n_pulses
        require("n_pulses", n_pulses, n_pulses is not None, "the pulses of a file, for groups")
        self._counts[group] += capture.cube
        self._n_pulses[group] += n_pulses or 0

    @property
    def groups(self) -> PulseGroups:
        """The groups of all files."""
        return PulseGroups(self._counts, tuple(self._n_pulses), self._rate_hz)


def _sum(total: Capture, one: Capture) -> Capture:
    """Add the counts of a file; images and fluxes remain where both are the same."""
    shape, detection = total.cube.shape, total.detection
    require("shape of the file", one.cube.shape, one.cube.shape == shape, f"{shape}")
    require("detections of the file", one.detection, one.detection == detection, detection)
    pulses = total.acquisition.n_pulses, one.acquisition.n_pulses
    n_pulses = None if None in pulses else sum(filter(None, pulses))
    before, here = (replace(each.acquisition, n_pulses=n_pulses) for each in (total, one))
    require("acquisition", here, here == before, f"{before}, that of the files before")
    cube = whole_counts(np.add(total.cube, one.cube, dtype=np.uint64), "the sum of the files")
    compared = (*IMAGES, "background")
    same: dict[str, Any] = {
        name: getattr(total, name) if _agree(total, one, name) else None for name in compared
    }
    return replace(total, cube=cube, acquisition=before, **same)


def _agree(total: Capture, one: Capture, name: str) -> bool:
    values = getattr(total, name), getattr(one, name)
    return all(each is not None for each in values) and np.array_equal(*values, equal_nan=True)
