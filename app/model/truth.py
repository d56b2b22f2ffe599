"""True ranges that a user adds to a capture: the capture with them is a source of its own."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from app.model.state import Illumination
from app.model.store import AddedTruth, Answer, Source
from core import Capture, read_truth
from core.checks import require
from core.io import ReadOptions

_BETWEEN = "|"

SUFFIXES = (".npy", ".npz", ".mat", ".tif", ".tiff", ".nc", ".h5", ".hdf5")
"""Suffixes of files that may hold true ranges, for the file dialog."""


@dataclass(frozen=True)
class Truth:
    """An uploaded file of true ranges, and how to read it."""

    key: str
    """Key of the upload."""
    unit: str = ""
    """Unit of the numbers; empty for the one that the file states."""
    variable: str = ""
    """Name of the array; empty for the one that fits."""

    @property
    def options(self) -> dict[str, str]:
        """The options of `core.read_truth` that were chosen."""
        chosen = {"truth_unit": self.unit, "truth_variable": self.variable}
        return {name: value for name, value in chosen.items() if value}

    def key_with(self, source: str) -> str:
        """Return the key of a capture with this truth, from that of the capture."""
        return _BETWEEN.join((source, self.key, self.unit, self.variable))


def parts_of(key: str) -> tuple[str, Truth | None]:
    """Return the key of a capture, and the truth that was added to it, if any."""
    source, *truth = key.rsplit(_BETWEEN, 3)
    return (source, Truth(*truth)) if len(truth) == 3 else (key, None)


def with_truth(source: Source, truth: Truth, path: Path) -> Source:
    """Return the source of a capture with a truth, whose file is at a path."""

    def load(light: Illumination, reading: ReadOptions, absent: Collection[str]) -> Capture:
        return read_truth(path, source.load(light, reading, absent), **truth.options)

    return replace(
        source,
        title=f"{source.title} with {path.name}",
        load=load,
        truth=AddedTruth(source, path.name, truth.options),
    )


def check_truth(answer: Answer, truth: Truth, path: Path) -> None:
    """Try a truth on the capture of an answer.

    Raises
    ------
    CaptureError
        As `core.read_truth`.
    ValueError
        If only a part of the capture is in memory.
    """
    is_whole = answer.cutout is None
    require("capture", answer.request.source.title, is_whole, "one that fits into memory")
    read_truth(path, answer.whole, **truth.options)
