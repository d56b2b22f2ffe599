"""The ends of a cut gate on a plot, where they can be dragged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from bokeh.models import BoxAnnotation, BoxInteractionHandles, CustomJS, Range1d
from bokeh.models.annotations.geometry import AreaVisuals

from app.model.state import ReductionSettings
from app.model.store import Answer
from app.tasks.signals import Signal
from app.theme import Palette

WHOLE = "whole gate"

FOLLOW = """
const [first, merge] = whole.tags;
whole.setv({start: first + merge * bins.start, end: first + merge * bins.end});
"""

SNAP = """
for (const side of ["left", "right"]) box[side] = Math.round(box[side]);
"""


@dataclass(frozen=True)
class Cut:
    """The part of a gate that is shown, and the part that is asked for.

    Parameters
    ----------
    n_bins : int
        Bins of the whole gate; those below are counted in it.
    first : int
        First bin that is shown.
    merge : int
        Bins of the whole gate in one that is shown.
    wanted : tuple of int
        First bin that is asked for, and the end of the last.
    """

    n_bins: int
    first: int
    merge: int
    wanted: tuple[int, int]

    @classmethod
    def of(cls, answer: Answer, wanted: ReductionSettings) -> Cut:
        """Return the cut of an estimate, and that of the present settings."""
        n_bins, gate = answer.whole.acquisition.n_bins, answer.gate
        return cls(n_bins, gate.first, gate.merge, wanted.gate(n_bins))

    def within(self, position: float) -> float:
        """Convert a position in the whole gate to one in the gate that is shown."""
        return (position - self.first) / self.merge

    def in_whole(self, position: float) -> float:
        """Convert a position in the gate that is shown to one in the whole gate."""
        return self.first + self.merge * position


class GateCut:
    """The ends of a cut gate: two handles on a plot, outside of which it is shaded.

    The axis covers the whole gate. Its zoom is kept while an end is dragged, and no end moves under
    the pointer when an earlier estimate arrives.

    Parameters
    ----------
    figure : bokeh.plotting.figure
    bins : Range1d
        Its axis, in bins of the gate that is shown.

    Attributes
    ----------
    dragged : Signal of Cut
        Emitted with the cut that is wanted while an end is dragged.
    box : BoxAnnotation
        The part that is kept, in bins of the whole gate.
    """

    def __init__(self, figure: Any, bins: Range1d) -> None:
        self.dragged: Signal[Cut] = Signal()
        self._bins = bins
        self._shown: Cut | None = None
        self._is_silent = False
        # Tags, since arguments with models would make Bokeh go through the whole page.
        self._whole = Range1d(0, 1, tags=[0, 1])
        figure.extra_x_ranges = {WHOLE: self._whole}
        self._handle = AreaVisuals(line_width=1.5)
        self.box = BoxAnnotation(
            left=0,
            right=1,
            left_limit=0,
            min_width=1,
            x_range_name=WHOLE,
            editable=True,
            movable="none",
            resizable="x",
            use_handles=True,
            handles=BoxInteractionHandles(all=self._handle),
            inverted=True,
            fill_alpha=0.15,
            line_alpha=0.6,
        )
        figure.add_layout(self.box)
        follow = CustomJS(args={"whole": self._whole, "bins": bins}, code=FOLLOW)
        snap = CustomJS(args={"box": self.box}, code=SNAP)
        for model, names, code in (
            (bins, ("start", "end"), follow),
            (self.box, ("left", "right"), snap),
        ):
            for name in names:
                model.js_on_change(name, code)
        for side in ("left", "right"):
            self.box.on_change(side, self._moved)

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self.box.update(fill_color=colors.muted, line_color=colors.muted)
        self._handle.update(
            fill_color=colors.paper, line_color=colors.text, hover_fill_color=colors.muted
        )

    def update(self, cut: Cut) -> None:
        """Show a cut."""
        before, self._shown = self._shown, cut
        if cut.wanted != self._ends:
            self._is_silent = True
            self.box.update(left=cut.wanted[0], right=cut.wanted[1])
            self._is_silent = False
        if before is None or replace(before, wanted=cut.wanted) != cut:
            self._fit(before, cut)

    def _fit(self, before: Cut | None, cut: Cut) -> None:
        """Fit the axis to the whole gate; keep its zoom in a gate of as many bins."""
        ends = {"start": cut.within(0), "end": cut.within(cut.n_bins)}
        whole = {f"reset_{name}": end for name, end in ends.items()}
        if before is not None and before.n_bins == cut.n_bins:
            ends = {n: cut.within(before.in_whole(getattr(self._bins, n))) for n in ends}
        self.box.right_limit = cut.n_bins
        self._whole.tags = [cut.first, cut.merge]
        self._bins.update(**ends, **whole)
        in_whole = {name: cut.in_whole(end) for name, end in ends.items()}
        self._whole.update(**in_whole, reset_start=0, reset_end=cut.n_bins)

    @property
    def _ends(self) -> tuple[int, int]:
        return round(self.box.left), round(self.box.right)

    def _moved(self, _side: str, _old: float, _new: float) -> None:
        if self._shown is not None and not self._is_silent:
            self.dragged.emit(replace(self._shown, wanted=self._ends))
