"""The section of Inspect that compares an estimate that was kept, A, with the present one, B."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import panel as pn

from app.model.colors import DOUBTED, ERROR_SCALE_BINS, doubt, image_of, left_out
from app.model.exports import image_file, image_files
from app.model.state import Viewing
from app.model.store import Answer, Request, compute
from app.model.text import Fact, cause
from app.pages.inspect import text
from app.pages.inspect.pixel import FACTS, FILLING, stage
from app.pages.inspect.results import Pair, pair_of
from app.pages.session import Session
from app.pages.shared.downloads import IMAGE, PLOT, Shown, ranged, viewed
from app.pages.shared.section import Section
from app.theme import ERROR_COLORS
from app.widgets.cards import BREAK_PX, button
from app.widgets.controls import Facts, Sentence
from app.widgets.method_picture import Picture, ScaleBar
from core.inference import fit_of
from core.io import ColorScale, Product

HEIGHT_PX = 215
GRID = f"""
:host {{ display: grid !important; gap: 8px; grid-template-columns: repeat(2, minmax(0, 1fr)); }}
@media screen and (max-width: {BREAK_PX}px) {{
  :host {{ grid-template-columns: minmax(0, 1fr); }}
}}
"""
# Stacked maps would push the colour scales over what stands below the page.
SCROLLED = ":host { overflow-y: auto; }"


class PairSection(Section):
    """Maps of A, of B and of their difference, with one zoom and one pixel.

    Attributes
    ----------
    pair : Pair or None
        What is shown.
    a, b, difference : Picture
    facts : Facts
    note : Sentence
        What to do where there is nothing to compare, or why it cannot be; else doubts about the
        confidences that the page does not state elsewhere.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, "kept", "viewing")
        self.pair: Pair | None = None
        self.a, self.b, self.difference = self._pictures = [
            Picture(session.choose_pixel, session.pick, HEIGHT_PX) for _ in range(3)
        ]
        for picture in self._pictures:
            picture.image.join(self.a.image)
            picture.caption.stylesheets = []  # a legend has two lines, or three
        self._scale, self._difference_scale = ScaleBar(), ScaleBar()
        self._painted = [self._scale, self._difference_scale]
        self._painted += [picture.image for picture in self._pictures]
        self.facts = Facts(stylesheets=[FACTS], sizing_mode="stretch_width")
        self.note = Sentence(live=True, text=text.NO_A, sizing_mode="stretch_width", margin=0)
        self._forget = button("Forget A", text.FORGET_HELP, session.forget)
        self._of_images: list[Fact] = []
        self._content = pn.Column(
            visible=False, stylesheets=[FILLING, SCROLLED], sizing_mode="stretch_width"
        )
        session.state.param.watch(lambda *_: self._mark(), "pixel")
        session.state.param.watch(lambda *_: self._note_doubts(), "map")

    def layout(self) -> tuple[Any, Any]:
        """Return buttons, maps and numbers; nothing stands below the map of the page."""
        keep = button("Keep as A", text.KEEP_HELP, self._keep_present)
        for picture, what, formats in (
            (self.a, "A", IMAGE),
            (self.b, "B", IMAGE),
            (self.difference, "difference", PLOT),
        ):
            self.offer(picture.card, what, partial(self._shown, what), formats)
        maps = pn.Column(
            *(picture.card for picture in self._pictures),
            self.offer_facts(self.facts, lambda: "numbers of A and B"),
            stylesheets=[GRID],
            sizing_mode="stretch_width",
        )
        self._content[:] = [maps, self._scale.pane, self._difference_scale.pane]
        buttons = pn.Row(keep, self._forget, margin=0, styles={"gap": "8px"})
        return stage(buttons, self.note, self._content), pn.Column(margin=0)

    # Actions of the user

    def _keep_present(self) -> None:
        self.session.keep(self.session.request_query(), self.session.answer)

    # Computation

    def refresh(self) -> None:
        """Compare, if something was kept."""
        if not self.is_on_screen:
            return
        kept, session = self.session.state.kept, self.session
        self._forget.disabled = not kept
        if not kept:
            self._show_nothing(text.NO_A)
            return
        try:
            request = session.described(kept)
        except ValueError as error:
            self._show_nothing(cause(error))
            return
        work = partial(
            compared, session.kept_answer, request, session.answer, session.state.viewing
        )
        draw = partial(self._draw, kept)
        self.submit(work, draw, lambda error: self._show_nothing(cause(error)))

    # Drawing

    def _show_nothing(self, why: str) -> None:
        self.pair = None
        self.note.text = why
        self._content.visible = False

    def _draw(self, kept: str, pair: Pair) -> None:
        self.pair = pair
        if kept == self.session.state.kept:
            self.session.keep(kept, pair.a)
        viewing = self.session.state.viewing
        names = [text.estimate_name(each) for each in (pair.a, pair.b)]
        self._note_doubts()
        values_b, look = image_of(pair.b, "Estimate", viewing)
        values_a, _ = image_of(pair.a, "Estimate", viewing)
        of_difference = difference_scale(pair)
        why_a = left_out(pair.a, "Estimate", viewing, values_a, look)
        why_b = left_out(pair.b, "Estimate", viewing, values_b, look)
        blank = text.difference_legend(pair)
        drawn = (
            (self.a, f"A: {names[0]}", why_a, values_a, look),
            (self.b, f"B: {names[1]}", why_b, values_b, look),
            (self.difference, text.DIFFERENCE_TITLE, blank, pair.difference_m, of_difference),
        )
        for picture, title, caption, values, scale in drawn:
            picture.title.text, picture.caption.text = title, caption
            picture.image.fit(*pair.b.capture.shape, pair.b.grid)
            picture.draw_image(values, scale)
        self._scale.update(look)
        self._difference_scale.update(of_difference)
        self._content.visible = True
        self._of_images = text.pair_facts(pair)
        self._mark()

    def _note_doubts(self) -> None:
        if self.pair is not None:
            of_a, of_b = doubt(self.pair.a), doubt(self.pair.b)
            elsewhere = of_b if self.session.state.map in DOUBTED else ""  # below the map
            self.note.text = text.pair_doubts(of_a, of_b, elsewhere)

    def _mark(self) -> None:
        pair, pixel = self.pair, self.session.state.pixel
        if pair is None or not self.is_on_screen or pair.b is not self.session.answer:
            return
        with self.session.tasks.hold():
            for picture in self._pictures:
                picture.image.mark(*pixel)
            least = self.session.state.viewing.least_confidence
            row, col = pixel
            here = text.pair_pixel_facts(pair, row, col, least)
            self.facts.facts = here + self._of_images

    # Downloads

    def _shown(self, what: str) -> Shown:
        """Return one of the maps, as it is saved."""
        pair, viewing = self.pair, self.session.state.viewing
        if pair is None:
            raise ValueError(text.NO_A)
        answer = pair.a if what == "A" else pair.b
        of_answer = ranged(self.session, answer, answer.method, answer.settings)
        subject = viewed(self.session, of_answer, viewing)
        if what != "difference":
            figure, name = self.a.image.figure, text.estimate_name(answer)
            _, look = image_of(pair.b, "Estimate", viewing)
            files = image_files(answer, "Estimate", viewing, figure, look, f"{what}: {name}")
            return Shown(subject, f"estimate {what}", files)
        look = difference_scale(pair)
        figure, of_b = self.difference.image.figure, Product(pair.b.capture, pair.b.run.image)
        file = image_file(pair.difference_m, look, figure, pair.b.grid, lambda: of_b)
        return Shown(subject, f"minus {text.estimate_name(pair.a)}", {"csv": file}, scale=look)


def compared(known: Answer | None, request: Request, b: Answer, viewing: Viewing) -> Pair:
    """Compare the estimate for a request, if `known` is None, with another one.

    The model is tested on both captures: legends state where it does not fit.
    """
    a = known or compute(request, None)
    for each in (a, b):
        fit_of(each.capture)
    return pair_of(a, b, viewing.least_confidence)


def difference_scale(pair: Pair) -> ColorScale:
    """Return the scale of a difference, wide enough for most of it."""
    known = np.abs(pair.difference_m[np.isfinite(pair.difference_m)])
    least_m = ERROR_SCALE_BINS * pair.b.capture.acquisition.bin_length_m
    limit_m = max(least_m, float(np.percentile(known, 90))) if known.size else least_m
    return ColorScale(text.DIFFERENCE_TITLE, "m", -limit_m, limit_m, ERROR_COLORS)
