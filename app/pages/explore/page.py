"""The Explore page: range image, point cloud and the stages of one pixel, while sliders move."""

from __future__ import annotations

from functools import partial
from time import perf_counter
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.colors import cloud_legend, cloud_of, color_values, image_of, legend
from app.model.exports import cloud_files, facts_file
from app.model.range_prior import has_range_prior, range_prior_of, slow_start
from app.model.state import Viewing
from app.model.store import Answer, inspect
from app.model.text import COMPUTING, NOT_COMPUTED
from app.pages.explore import text
from app.pages.navigation import Page
from app.pages.session import Session
from app.pages.shared.crop import CropSection
from app.pages.shared.downloads import (
    CLOUD,
    IMAGE_AND_REPORT,
    Shown,
    cropped,
    downloadable_facts,
    explored,
    image_on_show,
    pixel_on_show,
    pixel_plot,
    viewed,
)
from app.pages.shared.echo_zoom import EchoZoom
from app.pages.shared.large_view import LargeView
from app.pages.shared.measure import MeasureSection
from app.pages.shared.outputs import CurveCard
from app.pages.shared.section import Section
from app.pages.shared.viewing import show_own_width
from app.plots.gate_axes import GateAxes
from app.plots.gate_cut import Cut
from app.tasks.turns import TURNS
from app.theme import WRONG_COLOR
from app.widgets.cards import BREAK_PX, board, card, choice, column, part, sent_when_visible, steady
from app.widgets.cloud import PointCloud
from app.widgets.controls import (
    FACTS_PX,
    HEADLINE_PX,
    KNOB_PX,
    Facts,
    PixelKeys,
    Sentence,
    SettingsPanel,
    legend_line,
)
from app.widgets.figures import pane_of
from app.widgets.image_view import CONTAINER, ImageView
from app.widgets.signal_plots import BESIDE_PX, LEFT_PX, SignalPlots
from app.widgets.tour import CONFIDENCE, ESTIMATE, HISTOGRAM, PIXEL
from core.inference import fit_of, has_fit
from core.studies import outputs

# Where the numbers of the pixel need more rows, the plots keep their height.
BOARD = (
    board(820, 125, BREAK_PX)
    + f"""
@media screen and (min-width: {BREAK_PX + 1}px) and (max-width: 1280px) {{
  :host {{ height: max(940px, calc(var(--window-height, 100vh) - 125px)) !important;
    grid-template-columns: repeat(2, minmax(0, 1fr)) !important; }}
}}
"""
)
COLUMN = column(8, BREAK_PX)
IMAGE = steady(41, BREAK_PX)
"""Style of the image's card, which keeps its size; the cloud takes what the legend leaves."""
# Reserve the height of the switch, which is drawn late, so that the plots keep theirs.
ROW = (
    ":host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 0 12px; "
    "min-height: 24px; }"
)

PICTURES_DELAY_MS = 60
"""Image and cloud are drawn this long after the pixel's plots, which the eye follows."""

FIT_DELAY_MS = 250
"""The model is tested this long after image and cloud are drawn, if the estimate is still shown: it
takes longer than the estimate, and sliders come first."""

MAX_PICTURES_DELAY_S = 1.0
"""Image and cloud wait at most this long for other pages."""


class Explore(Section):
    """The page.

    Attributes
    ----------
    figures, numbers : Facts
        Figures of the image and numbers of the pixel.
    signals : SignalPlots
        The pixel's plots.
    zoom : EchoZoom
        The button that zooms these plots to the echo.
    prior : CurveCard
        Where estimates lie without an echo, in place of the stages or the score.
    remark : Sentence
        What is misleading about the small scale.
    cards : list of pn.Column
        The plots in their frames.
    image : ImageView
    image_keys : PixelKeys
        The keyboard of the image.
    legend : Sentence
        The number of pixels hidden in the image.
    cloud : PointCloud
    crop : CropSection
        The box to which the cloud is cropped.
    measure : MeasureSection
        Distances of pinned points.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.figures = Facts(timed=True, min_height=HEADLINE_PX, sizing_mode="stretch_width")
        self.numbers = Facts(leading=True, min_height=3 * FACTS_PX, sizing_mode="stretch_width")
        self.signals = SignalPlots()
        self.signals.cut.dragged.subscribe(session.cut_gate)
        self.image = ImageView(session.choose_pixel)
        self._painted = [self.signals, self.image]
        self.image_keys = PixelKeys(
            child=self.image.pane,
            stylesheets=[CONTAINER],
            css_classes=[PIXEL],
            sizing_mode="stretch_both",
        )
        self.cloud = PointCloud(wrong_color=WRONG_COLOR, sizing_mode="stretch_both")
        self.cards = [
            self.offer(card(pane_of(plot.figure)), what, partial(pixel_plot, session, plot, what))
            for plot, what in zip(
                self.signals.plots, ("histogram", "residual", "enhanced", "score"), strict=True
            )
        ]
        histogram, _, *answers = self.cards
        histogram.css_classes = [HISTOGRAM]
        for each in answers:  # only one is visible
            each.css_classes = [ESTIMATE]
        for each in self.cards[1:]:
            each.visible = False
            sent_when_visible(each)
        self.zoom = EchoZoom(self.signals.histogram.figure.x_range)
        self.cards[0].append(self.zoom.button)
        state = session.state
        self.prior = CurveCard(self.signals.histogram.figure.x_range, COMPUTING)
        self.prior.offer(session, self.about)
        self._prior_axes: GateAxes | None = None
        self._has_prior = False
        self._priors, self._fits = session.tasks.latest(), session.tasks.latest()
        self._painted.append(self.prior)
        self.remark = Sentence(margin=0)
        switch = pmui.Switch.from_param(
            state.param.echo_free, label=text.ECHO_FREE, size="small", margin=(0, 4)
        )
        self._prior_row = pn.Row(
            switch, self.remark, stylesheets=[ROW], sizing_mode="stretch_width", margin=0
        )
        self._large = LargeView(session, self.image.figure)
        self._viewing = SettingsPanel(Viewing(), partial(setattr, state, "viewing"))
        self._least_confidence = self._viewing.controls["least_confidence"]
        self._least_confidence.param.update(min_height=KNOB_PX, css_classes=[CONFIDENCE])
        self.legend = legend_line()
        self._difference = pmui.Switch.from_param(
            state.param.difference, label="First difference", size="small", margin=(0, 8)
        )
        self.crop = CropSection(session)
        self.measure = MeasureSection(session)
        self._is_outdated, self._pictures_are_due = True, False
        self._requested_s = 0.0
        self._show_sidebar()
        self.image_keys.param.watch(lambda event: session.choose_pixel(*event.new), "pixel")
        self.cloud.param.watch(lambda event: session.pick(event.new), "selected")
        draw_pixel = session.tasks.soon(self._draw_pixel)
        state.param.watch(draw_pixel, ["pixel", "pins", "difference", "unit", "echo_free"])
        state.param.watch(lambda *_: self._request_prior(), "echo_free")
        draw_pictures = partial(session.tasks.queue, self._draw_pictures)
        state.param.watch(
            lambda *_: draw_pictures(), ["image", "cloud_color", "viewing", "crop", "region"]
        )

    def layout(self) -> tuple[Any, Any]:
        """Return the two columns of the page, and its part of the sidebar."""
        state = self.session.state
        image = card(choice(text.IMAGE_HELP, state.param.image), self.image_keys)
        image.stylesheets = [*image.stylesheets, IMAGE]
        left = (
            self.offer(
                image,
                "image",
                self.image_shown,
                IMAGE_AND_REPORT,
            ),
            self.legend,
            self._least_confidence,
            self._large.layout,
            self.offer(
                card(choice(text.CLOUD_HELP, state.param.cloud_color), self.cloud),
                "3D cloud",
                self.cloud_shown,
                CLOUD,
            ),
        )
        histogram, *others = self.cards
        facts = downloadable_facts(self.numbers, self.session, self.numbers_shown)
        right = (facts, histogram, self._prior_row, self.prior.card, *others)
        columns = (
            pn.Column(*content, stylesheets=[COLUMN], sizing_mode="stretch_both")
            for content in (left, right)
        )
        main = [pn.Column(*columns, stylesheets=[BOARD], sizing_mode="stretch_both"), self.figures]
        return main, [
            part(
                "View", self._viewing.without("least_confidence"), self._difference, is_open=False
            ),
            self.measure.part,
            self.crop.part,
        ]

    # Downloads

    def numbers_shown(self) -> Shown:
        """Return the figures of the image and the numbers of the pixel, for a download."""
        table = facts_file([*self.figures.facts, *self.numbers.facts])
        return self.saved(f"numbers {pixel_on_show(self.session)}", table)

    def image_shown(self) -> Shown:
        """Return the image, for a download."""
        kind = self.session.state.image
        what = "range image" if kind == "Estimate" else f"{kind} image".lower()
        return image_on_show(self.session, kind, self.image.figure, what)

    def cloud_shown(self) -> Shown:
        """Return the cloud, for a download, with the colour scale of the image."""
        session, state = self.session, self.session.state
        _, look = color_values(session.answer, state.cloud_color, state.viewing)
        files = cloud_files(session.answer, state.cloud_color, state.viewing, state.box)
        heading = f"3D cloud, coloured by {state.cloud_color.lower()}"
        subject = cropped(session, viewed(session, explored(session), state.viewing))
        return Shown(subject, "cloud", files, heading, look)

    # Notifications

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        self.is_on_screen = is_on_screen
        if is_on_screen and self._is_outdated:
            self._is_outdated = False
            self._draw_pixel()
            self._draw_pictures()
        elif is_on_screen:  # what arrived meanwhile was dropped
            self._draw_legend()
            self._request_fit()
        self._request_prior()
        self._large.show(is_on_screen)
        self.crop.show(is_on_screen)
        self.measure.show(is_on_screen)

    def follow(self, answer: Answer) -> None:
        """Show another estimate of the session."""
        self._has_prior = False
        self._show_sidebar()
        self._draw_pixel()
        self._request_prior()
        if not self.session.tasks.is_served:
            self._draw_pictures()
        elif not self._pictures_are_due:
            self._pictures_are_due = True
            self._requested_s = perf_counter()
            self.session.tasks.call_later(PICTURES_DELAY_MS, self._request_pictures)
        self._large.follow(answer)
        self.crop.refresh()
        self.measure.follow(answer)

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        with self.session.tasks.hold():
            super().paint(dark)
            self.cloud.dark = dark

    # Drawing; changes off screen are drawn when the page comes back

    def _show_sidebar(self) -> None:
        answer = self.session.answer
        self._viewing.show(self.session.state.viewing)
        show_own_width(self._viewing, answer)
        self.remark.text = slow_start(answer)

    def _draw_pixel(self) -> None:
        """Draw the pixel's plots and numbers, and the frames that mark it."""
        if not self.is_on_screen:
            self._is_outdated = True
            return
        answer, state = self.session.answer, self.session.state
        row, col = state.pixel
        pixel = inspect(answer, row, col)
        numbers = text.pixel_numbers(answer, pixel, state.unit)
        with self.session.tasks.hold():
            self.image.fit(*answer.capture.shape, answer.grid)
            self.signals.cut.update(Cut.of(answer, state.reduction))
            self.signals.update(pixel, answer.gate, state.difference, state.unit)
            self.zoom.follow(answer.capture, pixel.answer_bin)
            if self._prior_axes is not None:
                self._prior_axes.follow(state.unit, answer.gate)
            self._show_cards(is_tracking=pixel.signals is not None)
            self.image.mark(row, col)
            self.image_keys.shape = list(answer.capture.shape)
            self.image_keys.pixel = [row, col]
            n_cols = answer.capture.shape[1]
            self.cloud.selected = row * n_cols + col
            self.cloud.pinned = [r * n_cols + c for r, c in state.pins]
            self.numbers.facts = numbers
            self.figures.facts = text.figure_strip(answer)

    def _show_cards(self, is_tracking: bool) -> None:
        """Show the stages of the tracking differentiator, or the score of another method."""
        _, residual, enhanced, score = self.cards
        self._difference.visible = is_tracking
        self._prior_row.visible = has_range_prior(self.session.answer)
        self.prior.card.visible = is_prior = self._shows_prior
        residual.visible = enhanced.visible = is_tracking and not is_prior
        score.visible = not is_tracking and not is_prior

    @property
    def _shows_prior(self) -> bool:
        return self.session.state.echo_free and has_range_prior(self.session.answer)

    def _request_prior(self) -> None:
        """Compute where estimates lie without an echo, if that is wanted and not drawn yet."""
        if self.is_on_screen and self._shows_prior and not self._has_prior:
            self.prior.clear(COMPUTING)
            work = partial(range_prior_of, self.session.answer)
            self.submit(work, self._draw_prior, self._refuse_prior, self._priors)

    def _refuse_prior(self, error: Exception) -> None:
        self.prior.clear(NOT_COMPUTED)
        self.session.failures.report(error, part=self._priors)

    def _draw_prior(self, plot: outputs.Plot) -> None:
        self._has_prior = True
        self.prior.show(plot)
        if self._prior_axes is None:
            figure = self.prior.figure
            figure.min_border_left, figure.min_border_right = LEFT_PX, BESIDE_PX
            self._prior_axes = GateAxes(figure, has_top=False)
        self._prior_axes.follow(self.session.state.unit, self.session.answer.gate)

    def _request_pictures(self) -> None:
        """Draw image and cloud, unless other pages wait to draw their plots."""
        tasks = self.session.tasks
        if TURNS.is_crowded and perf_counter() - self._requested_s < MAX_PICTURES_DELAY_S:
            tasks.call_later(PICTURES_DELAY_MS, self._request_pictures)
        else:
            tasks.queue(self._draw_pictures)

    def _draw_pictures(self) -> None:
        """Draw the image and the cloud."""
        self._pictures_are_due = False
        if not self.is_on_screen:
            self._is_outdated = True
            return
        answer, state = self.session.answer, self.session.state
        with self.session.tasks.hold():
            values, look = image_of(answer, state.image, state.viewing)
            self.image.update(values, look)
            self.legend.text = legend(answer, state.image, state.viewing, values, look)
            box, is_guessed = state.box, answer.is_width_guessed(state.viewing)
            drawn = cloud_of(answer, state.cloud_color, state.viewing, box)
            cloud, rgb, crosses, unseen = drawn
            # Another box is framed by the camera, like another scene.
            self.cloud.draw(cloud, rgb, crosses, scene_id=f"{self.session.scene_id()} {box}")
            n_wrong = None if crosses is None else int(crosses.sum())
            caption = text.cloud_caption(answer, cloud.n_points, n_wrong, box, is_guessed)
            hidden = cloud_legend(unseen, state.viewing.least_confidence)
            self.cloud.caption = f"{caption}\n{hidden}".rstrip()
        self._request_fit()

    def _draw_legend(self) -> None:
        """State what the image hides, and that the model does not fit once that is known."""
        answer, state = self.session.answer, self.session.state
        values, look = image_of(answer, state.image, state.viewing)
        self.legend.text = legend(answer, state.image, state.viewing, values, look)

    def _request_fit(self) -> None:
        """Test the model later, unless that was done."""
        answer = self.session.answer
        if not has_fit(answer.capture):
            self.session.tasks.call_later(FIT_DELAY_MS, partial(self._test_model, answer))

    def _test_model(self, answer: Answer) -> None:
        """Test the model on the capture of an estimate, if it is still shown."""
        if self.is_on_screen and answer is self.session.answer:
            work = partial(fit_of, answer.capture)
            self.submit(work, lambda _: self._draw_legend(), own=self._fits)


PAGE = Page("Explore", Explore, "shows one method in detail", text.EXPLANATION, sidebar_last=True)
