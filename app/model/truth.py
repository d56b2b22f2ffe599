"""True ranges that a user adds to a capture: the capture with them is a source of its own."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path

from app.model.store import AddedTruth, Answer, Request, Source
from app.model.uploads import cached_while_used
from core import Capture, read_truth
from core.checks import require
from core.io import PossibleTruth, possible_truths, truth_options_from

_BETWEEN = "|"


@dataclass(frozen=True)
class Truth:
    """A file of true ranges, and how to read it."""

    key: str
    """Key of the upload; empty for the file of the capture itself."""
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
    """Return the source of a capture with a truth, whose file is at a path, in place of another."""
    source = source.without_truth
    name = (path == source.path and truth.variable) or path.name

    def load(request: Request) -> Capture:
        return read_truth(path, source.load(request), **truth.options)

    return replace(
        source,
        title=f"{source.title} with {name}",
        load=load,
        truth=AddedTruth(source, path.name, truth.options),
    )


def with_chosen_truth(chosen: Namespace, source: Source) -> Source:
    """Return the source of a file with the truth that the command line gives, if any.

    Raises
    ------
    ValueError
        If options for a truth contradict each other.
    """
    given = truth_options_from(chosen, source.path)
    if not given:
        return source
    truth = Truth("", given["truth_unit"] or "", given["truth_variable"] or "")
    known = with_truth(source, truth, given["path"])
    return replace(known, load=cached_while_used(known.load))


def offered_truths(answer: Answer) -> list[PossibleTruth]:
    """Return the images of a capture's own file that may be its truth, if it has none.

    Raises
    ------
    CaptureError
        As `core.io.possible_truths`.
    """
    path = answer.request.source.path
    if path is None or answer.cutout is not None or answer.whole.truth_range_m is not None:
        return []
    return possible_truths(path, answer.whole)


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
