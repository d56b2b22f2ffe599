"""The Explore page: the tracking differentiator's image, cloud and stages, while sliders move."""

from __future__ import annotations

from functools import partial
from time import perf_counter

import panel as pn
import panel_material_ui as pmui

from app.model.colors import cloud_of, color_values, image_of
from app.model.exports import cloud_files, facts_file
from app.model.state import Viewing
from app.model.store import Answer, inspect
from app.pages.explore import text
from app.pages.navigation import Page, View
from app.pages.session import Session
from app.pages.shared.downloads import (
    CLOUD,
    IMAGE,
    PLOT,
    Shown,
    downloadable,
    downloadable_facts,
    explored,
    image_on_show,
    pixel_on_show,
    pixel_plot,
    viewed,
)
from app.pages.shared.large_view import LargeView
from app.tasks.turns import TURNS
from app.theme import WRONG_COLOR, palette
from app.widgets.cards import BREAK_PX, board, card, choice, column, part
from app.widgets.cloud import PointCloud
from app.widgets.controls import FACTS_PX, HEADLINE_PX, Facts, PixelKeys, SettingsPanel
from app.widgets.image_view import ImageView
from app.widgets.signal_plots import SignalPlots

BOARD = board(720, 125, BREAK_PX)
COLUMN = column(8, BREAK_PX)

PICTURES_MS = 60
"""Image and cloud are drawn this long after the pixel's plots, which the eye follows."""

PICTURES_AT_MOST_S = 1.0
"""Image and cloud give way to other pages for this long."""


class Explore:
    """The page.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    figures, numbers : Facts
        Figures of the image and numbers of the pixel.
    signals : SignalPlots
        The pixel's plots.
    image : ImageView
    image_keys : PixelKeys
        The image with the keyboard.
    cloud : PointCloud
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.figures = Facts(timed=True, min_height=HEADLINE_PX, sizing_mode="stretch_width")
        self.numbers = Facts(min_height=2 * FACTS_PX, sizing_mode="stretch_width")
        self.signals = SignalPlots()
        self.image = ImageView(session.choose_pixel)
        self.image_keys = PixelKeys(child=self.image.pane, sizing_mode="stretch_both")
        self.cloud = PointCloud(wrong_color=WRONG_COLOR, sizing_mode="stretch_both")
        self._large = LargeView(session, self.image.figure)
        state = session.state
        self._viewing = SettingsPanel(Viewing(), partial(setattr, state, "viewing"))
        self._is_on_screen, self._is_outdated = False, True
        self._pictures_are_due = False
        self._asked_s = 0.0
        self._show_sidebar()
        self.image_keys.param.watch(lambda event: session.choose_pixel(*event.new), "pixel")
        self.cloud.param.watch(lambda event: session.pick(event.new), "selected")
        draw_pixel = session.tasks.soon(self._draw_pixel)
        state.param.watch(draw_pixel, ["pixel", "difference", "unit"])
        draw_pictures = partial(session.tasks.queue, self._draw_pictures)
        state.param.watch(lambda *_: draw_pictures(), ["image", "cloud_color", "viewing"])

    @property
    def view(self) -> View:
        """The page, for the navigation."""
        difference = pmui.Switch.from_param(
            self._session.state.param.difference,
            label="First difference",
            size="small",
            margin=(0, 8),
        )
        return View(
            [self.figures, self._board()],
            [
                part("View", self._viewing.layout, difference),
                part("What is this?", pmui.Typography(text.EXPLANATION, margin=8), is_open=False),
            ],
            show=self._show,
            follow=self._follow,
            paint=self._paint,
        )

    def _board(self) -> pn.Column:
        session, state = self._session, self._session.state
        image_kind = choice(text.IMAGE_HELP, state.param.image)
        cloud_color = choice(text.CLOUD_HELP, state.param.cloud_color)
        image, cloud = card(image_kind, self.image_keys), card(cloud_color, self.cloud)
        left = (
            downloadable(image, session, "image", self.image_shown, IMAGE),
            self._large.layout,
            downloadable(cloud, session, "3D cloud", self.cloud_shown, CLOUD),
        )
        plots = (
            downloadable(
                card(pane), session, what, partial(pixel_plot, session, pane.object, what), PLOT
            )
            for pane, what in zip(
                self.signals.panes, ("histogram", "residual", "enhanced"), strict=True
            )
        )
        right = (downloadable_facts(self.numbers, session, self.numbers_shown), *plots)
        columns = (
            pn.Column(*content, stylesheets=[COLUMN], sizing_mode="stretch_both")
            for content in (left, right)
        )
        return pn.Column(*columns, stylesheets=[BOARD], sizing_mode="stretch_both")

    # Downloads

    def numbers_shown(self) -> Shown:
        """Return the figures of the image and the numbers of the pixel, for a download."""
        table = facts_file([*self.figures.facts, *self.numbers.facts])
        what = f"numbers {pixel_on_show(self._session)}"
        return Shown(explored(self._session), what, {"csv": table})

    def image_shown(self) -> Shown:
        """Return the image, for a download."""
        kind = self._session.state.image
        what = "range image" if kind == "Estimate" else f"{kind} image".lower()
        return image_on_show(self._session, kind, self.image.figure, what)

    def cloud_shown(self) -> Shown:
        """Return the cloud, for a download, with the colour scale that stands beside the image."""
        session, state = self._session, self._session.state
        _, look = color_values(session.answer, state.cloud_color)
        files = cloud_files(session.answer, state.cloud_color, state.viewing)
        heading = f"3D cloud, coloured by {state.cloud_color.lower()}"
        subject = viewed(session, explored(session), state.viewing)
        return Shown(subject, "cloud", files, heading, look)

    # Notifications

    def _show(self, is_on_screen: bool) -> None:
        self._is_on_screen = is_on_screen
        if is_on_screen and self._is_outdated:
            self._is_outdated = False
            self._draw_pixel()
            self._draw_pictures()
        self._large.show(is_on_screen)

    def _follow(self, answer: Answer) -> None:
        self._show_sidebar()
        self._draw_pixel()
        if not self._session.tasks.is_served:
            self._draw_pictures()
        elif not self._pictures_are_due:
            self._pictures_are_due = True
            self._asked_s = perf_counter()
            self._session.tasks.call_later(PICTURES_MS, self._ask_pictures)
        self._large.follow(answer)

    def _paint(self, dark: bool) -> None:
        with self._session.tasks.hold():
            self.signals.paint(palette(dark))
            self.image.paint(palette(dark))
            self.cloud.dark = dark

    # Drawing; what changes off screen is drawn when the page comes back

    def _show_sidebar(self) -> None:
        self._viewing.show(self._session.state.viewing)
        own = self._session.own_field_of_view_deg
        self._viewing.controls["field_of_view_deg"].initial = own

    def _draw_pixel(self) -> None:
        """Draw the pixel's plots and numbers, and the frames that mark it."""
        if not self._is_on_screen:
            self._is_outdated = True
            return
        answer, state = self._session.answer, self._session.state
        row, col = state.pixel
        pixel = inspect(answer, row, col)
        numbers = text.pixel_numbers(answer, pixel, state.unit)
        with self._session.tasks.hold():
            self.image.fit(*answer.capture.shape, answer.grid)
            self.signals.update(pixel, answer.capture.acquisition, state.difference, state.unit)
            self.image.mark(row, col)
            self.image_keys.shape = list(answer.capture.shape)
            self.image_keys.pixel = [row, col]
            self.cloud.selected = row * answer.capture.shape[1] + col
            self.numbers.facts = numbers
            self.figures.facts = text.figure_strip(answer)

    def _ask_pictures(self) -> None:
        """Draw image and cloud, unless other pages wait to draw their plots."""
        tasks = self._session.tasks
        if TURNS.is_crowded and perf_counter() - self._asked_s < PICTURES_AT_MOST_S:
            tasks.call_later(PICTURES_MS, self._ask_pictures)
        else:
            tasks.queue(self._draw_pictures)

    def _draw_pictures(self) -> None:
        """Draw the image and the cloud."""
        self._pictures_are_due = False
        if not self._is_on_screen:
            self._is_outdated = True
            return
        answer, state = self._session.answer, self._session.state
        with self._session.tasks.hold():
            self.image.update(*image_of(answer, state.image, state.viewing.least_confidence))
            cloud, rgb, crosses = cloud_of(answer, state.cloud_color, state.viewing)
            self.cloud.draw(cloud, rgb, crosses, scene_id=self._session.scene_id())
            n_wrong = None if crosses is None else int(crosses.sum())
            self.cloud.caption = text.cloud_caption(answer, cloud.n_points, n_wrong)


PAGE = Page("Explore", Explore, "looks into one method", sidebar_last=True)
