"""The page: where everything stands. The only module that knows the template."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param
from panel.util import edit_readonly
from panel_material_ui.template.base import Meta

from app.model import text as words
from app.model.address import AddressBar, Wanted
from app.model.script import script_of
from app.model.state import Illumination, Less, Reading, Viewing
from app.model.store import Answer, Request, Source
from app.model.uploads import MAX_UPLOAD_BYTES, Uploads
from app.pages.compare.page import Compare
from app.pages.inspect.page import Inspector
from app.pages.navigation import Pages, View
from app.pages.paper.page import Paper
from app.pages.session import Session
from app.pages.shared.downloads import (
    CLOUD,
    IMAGE,
    PLOT,
    cloud_on_show,
    downloadable,
    downloadable_facts,
    numbers_on_show,
    pixel_plot,
    range_image,
)
from app.pages.shared.large_view import LargeView
from app.pages.tradeoff.page import Tradeoff
from app.server import garbage as collector
from app.theme import DARK, LIGHT, STYLES
from app.widgets.cards import BREAK_PX, board, card, choice, column, part, select
from app.widgets.connection import Connection
from app.widgets.controls import Sentence, SettingsPanel
from app.widgets.file_input import FileInput
from app.widgets.share import TakeAway
from core import PRESETS, TrackingParameters
from core.io import SUFFIXES
from core.studies.tradeoff import Point

CUSTOM = "custom"

READING_LABELS = {
    "time_unit_s": "Time unit (s)",
    "bin_width_s": "Bin width (s)",
    "gate_delay_s": "Gate opens after (s)",
    "n_bins": "Bins",
    "n_pulses": "Pulses sent",
    "pulse": "Echo's standard deviation (s)",
    "variable": "Variable",
    "detection": "Photons of a pulse (first, all)",
    "axes": "Axes (such as bin row col)",
    "stop_s": "Common stop after (s)",
    "shape": "Rows x columns",
    "first_detections": "First detections only",
    "no_trigger": "Frames: no trigger is",
}
THEME = {
    mode: {
        "palette": {"primary": {"main": main}, "background": {"default": page, "paper": paper}},
        "typography": {"fontSize": 13},
        "components": {
            "MuiAppBar": {"styleOverrides": {"root": {"backgroundColor": bar, "color": "#ffffff"}}},
            "MuiToolbar": {
                "styleOverrides": {
                    "root": {
                        "minHeight": "48px !important",
                        # On a phone the buttons need the room.
                        "@media (max-width: 500px)": {"& .title": {"display": "none"}},
                    }
                }
            },
        },
    }
    for mode, main, bar, page, paper in (
        ("light", "#0b6e85", "#0b566b", "#ffffff", LIGHT.paper),
        ("dark", "#4fb3cb", "#0c3a48", "#0f141a", DARK.paper),
    )
}
AS_WRITTEN = {"& .MuiToggleButton-root": {"textTransform": "none", "padding": "3px 8px"}}
IN_THE_BAR = {
    "& .MuiToggleButton-root": {
        "color": "#ffffff",
        "borderColor": "#ffffff80",
        "whiteSpace": "nowrap",
    },
    "& .MuiToggleButton-root.Mui-selected": {"color": "#0b3f4c", "backgroundColor": "#ffffff"},
    "& .MuiToggleButton-root.Mui-selected:hover": {"backgroundColor": "#e3eef1"},
    "@media (max-width: 500px)": {
        "& .MuiToggleButton-root": {
            "padding": "5px 2px",
            "fontSize": "9px",
            "letterSpacing": 0,
        },
    },
}

# Image over cloud on the left, the pixel's plots on the right.
BOARD = board(560, 125, BREAK_PX)
COLUMN = column(8, BREAK_PX)


TEMPLATE = (
    '{% extends "base.html" %}{% block postamble %}{{ super() }}<script>{% raw %}'
    + Path(__file__).with_name("bokeh.js").read_text(encoding="utf-8")
    + "{% endraw %}"
    # The widgets' module, which would be asked for when the page is there.
    + f'importShim("{pmui.Button._render_esm(server=True)}");'
    + "</script>{% endblock %}"
)


class Page(pmui.Page):
    """The template, but for two habits that do not suit this page.

    It would restyle the plots, whose sizes and colours are those of `app.theme`; and it would draw
    itself anew twice for every message, to show for a moment that the server is busy.
    """

    is_narrow = param.Boolean(
        default=False,
        doc="Whether the sidebar would cover the page, as on a phone; told by ``bokeh.js``.",
    )

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        # Params keep this watcher of the whole server's state, and with it the page, for ever.
        for _, watcher in self._param__private.ref_watchers:
            pn.state.param.unwatch(watcher)
        self._param__private.ref_watchers = []
        with edit_readonly(self):
            self.busy = False

    def get_root(self, doc: Any = None, comm: Any = None, preprocess: bool = True) -> Any:
        """The page's model, told which parts of Bokeh's plots not to restyle."""
        root = super().get_root(doc, comm, preprocess)
        root.data._custom_theme = list(STYLES)
        return root


def build_page(sources: Mapping[str, Source], uploads: Uploads) -> pmui.Page:
    """A new page with a session of its own, as its address asks for."""
    asked = {
        name: texts[-1].decode(errors="replace") for name, texts in pn.state.session_args.items()
    }
    return Layout(sources, Wanted(asked), uploads).page


class Layout:
    """Widgets around one session."""

    def __init__(
        self,
        sources: Mapping[str, Source],
        wanted: Wanted | None = None,
        uploads: Uploads | None = None,
    ) -> None:
        wanted, self._uploads = wanted or Wanted({}), uploads or Uploads()
        session = self.session = Session(self._with_upload(sources, wanted.source), wanted)
        state = session.state
        self._alert = Sentence(warning=True, sizing_mode="stretch_width", margin=0)
        self._provenance = Sentence(sizing_mode="stretch_width", margin=(4, 12))
        self._progress = pmui.LinearProgress(
            visible=False, variant="indeterminate", sizing_mode="stretch_width", margin=0
        )
        self._source = select(
            "Scene or capture",
            self._titles(),
            state.source,
            "A built-in scene to simulate, or a capture from a file.",
        )
        self._file = FileInput(
            lambda reason: self._complain(words.not_uploaded(reason, MAX_UPLOAD_BYTES)),
            label="Open a capture file",
            accept=",".join(SUFFIXES),
            max_file_size=MAX_UPLOAD_BYTES,
            variant="outlined",
            size="small",
            sizing_mode="stretch_width",
            margin=(4, 8),
        )
        self._light = SettingsPanel(Illumination(), partial(setattr, state, "light"))
        self._viewing = SettingsPanel(Viewing(), partial(setattr, state, "viewing"))
        self._tracking = SettingsPanel(TrackingParameters(), partial(setattr, state, "tracking"))
        self._less = SettingsPanel(Less(), partial(setattr, state, "less"))
        self._preset = select(
            "Preset",
            [*PRESETS, CUSTOM],
            _preset_of(state.tracking),
            "recommended: the best on random depths. as printed: the paper's text, literally.",
        )
        self._reading = {
            name: pmui.TextInput(
                label=label,
                placeholder="guess",
                size="small",
                sizing_mode="stretch_width",
                margin=(6, 8, 2, 8),
            )
            for name, label in READING_LABELS.items()
        }
        self._light.show(state.light)
        self._tracking.show(state.tracking)
        unit = choice(words.UNIT_HELP, state.param.unit)
        unit.param.update(
            label="Gate axes in", sx=AS_WRITTEN, sizing_mode="stretch_width", margin=(4, 8)
        )
        self._unit = unit
        self._announced: Source | None = None
        self._uploaded = ""
        self._address = AddressBar()
        self._takeaway = TakeAway(
            lambda: script_of(session.answer, state), sizing_mode="stretch_width", margin=8
        )
        self._is_away = self._is_built = False
        self._connection = Connection(session.page.session_context.id if session.is_served else "")
        self.pages = Pages(
            {
                "Explore": self._explore,
                "Inspect": lambda: Inspector(session).view,
                "Compare": lambda: self._compare.view,
                "Trade-off": lambda: Tradeoff(session, self._open_point).view,
                "Paper": lambda: Paper(session, self._put_away).view,
            },
            label="",
            first=state.page,
        )
        self.pages.choice.link(state, value="page", bidirectional=True)
        self.pages.choice.param.update(sx=IN_THE_BAR, margin=(0, 0, 0, 8))
        self.page = self._build()
        self._is_built = True
        self._announce(session.answer)
        self._listen()
        if session.refused:
            self._complain(words.not_restored(session.refused))

    def _listen(self) -> None:
        session = self.session
        self._address.follow(session.state, session.query, session.wait, session.tell)
        session.announce, session.complain = self._announce, self._complain
        session.waiting = partial(setattr, self._progress, "visible")
        self._source.param.watch(lambda event: self._go_to(event.new), "value")
        self._file.param.watch(lambda event: self._upload(event.new), "value")
        self._preset.param.watch(lambda event: self._preset_changed(event.new), "value")
        session.state.param.watch(lambda event: self._show_tracking(event.new), "tracking")
        self.page.param.watch(lambda event: self.pages.paint(event.new), "dark_theme")
        if session.is_served:
            pn.state.onload(collector.spare)
            pn.state.on_session_destroyed(lambda _: self._forget())
            pn.config.exception_handler = session.fail  # of this session alone

    @cached_property
    def _compare(self) -> Compare:
        """The page that puts methods side by side; made when it is first asked for."""
        return Compare(self.session)

    def _titles(self) -> dict[str, str]:
        """Key of each source by its title; of two files of one name the second is told apart."""
        titles: dict[str, str] = {}
        for key, source in self.session.sources.items():
            again = sum(title.startswith(source.title) for title in titles)
            titles[f"{source.title} ({again + 1})" if source.title in titles else source.title] = (
                key
            )
        return titles

    def _with_upload(self, sources: Mapping[str, Source], key: str) -> dict[str, Source]:
        """What can be looked at, and the upload of a key, if there is one."""
        upload = self._uploads.use(key, self)
        return {**sources, key: upload} if upload is not None else dict(sources)

    # What the session tells the page

    def _complain(self, sentence: str) -> None:
        self._alert.text = sentence[:2000]

    def _announce(self, answer: Answer) -> None:
        is_scene = answer.request.source.is_scene
        if self.session.state.source == self._uploaded:  # it could be read: look into it
            self._uploaded, self.session.state.page = "", "Inspect"
        self._source.value = self.session.state.source
        if answer.request.source is not self._announced:
            self._announced = answer.request.source
            for name, field in self._reading.items():
                field.value = answer.request.reading.as_text(name)
        self._light_card.visible, self._reading_card.visible = is_scene, not is_scene
        self._provenance.text = words.provenance(answer)[:2000]
        self._less.show(self.session.state.less)
        self._viewing.show(self.session.state.viewing)
        own = self.session.own_field_of_view_deg
        self._viewing.controls["field_of_view_deg"].initial = own
        self._tracking.controls["t_n"].high = max(answer.capture.acquisition.n_bins - 1, 1)
        self.pages.follow(answer)

    def _put_away(self, is_away: bool) -> None:
        """Put away what belongs to the session's capture, or bring it back."""
        self._is_away, self._provenance.visible = is_away, not is_away
        if self._is_built:  # a page that opens on Paper is built without its sidebar
            self.page.sidebar_open = not (is_away or self.page.is_narrow)

    # What the user does

    def _open_point(self, point: Point, measured: Request) -> None:
        """Show a measured way to range: the paper's method on Explore, others on Compare."""
        state, candidate = self.session.state, point.candidate
        seen = {
            "source": self.session.key(measured.source),
            "light": measured.light,
            "reading": measured.reading,
            "absent": measured.absent,
            "window": measured.window,
            "less": Less.of(candidate.reduction, point.shape[2]),
        }
        self._light.show(measured.light)
        self._announced = None  # how a file is read may be another
        if candidate.method.estimator == "tracking":
            state.param.update(tracking=candidate.settings, **seen)
            self.pages.choice.value = "Explore"
        else:
            state.param.update(**seen)
            self._compare.pick(candidate.method.estimator, candidate.settings)
            self.pages.choice.value = "Compare"

    def _go_to(self, key: str) -> None:
        if key != self.session.state.source:
            self.session.state.param.update(
                source=key, reading=Reading(), less=Less(), absent=frozenset(), window=None
            )

    def _show_tracking(self, settings: TrackingParameters) -> None:
        self._tracking.show(settings)
        self._preset.value = _preset_of(settings)

    def _preset_changed(self, name: str) -> None:
        if name in PRESETS:
            self.session.state.tracking = PRESETS[name]

    def _upload(self, content: bytes | None) -> None:
        if not content:
            return
        name, self._file.value = self._file.filename, None  # the same file can be chosen again
        try:
            key = self._uploads.add(name, content, self)
        except (ValueError, OSError) as error:
            self._complain(words.not_kept(error))
            return
        self.session.sources = self._with_upload(self.session.sources, key)
        self._source.options = self._titles()
        self._uploaded = self._source.value = key

    def _read_again(self) -> None:
        try:
            self.session.state.reading = Reading.from_text(
                {name: field.value for name, field in self._reading.items()}
            )
        except ValueError as error:
            self._complain(str(error))

    def _forget(self) -> None:
        """Let go of what a closed page would leave behind."""
        pn.config._session_config.pop(self.session.page, None)
        self._uploads.leave(self)

    # Where everything stands

    def _build(self) -> Page:
        head = pn.Column(
            self._address,
            self._connection,
            self._progress,
            self._alert,
            sizing_mode="stretch_width",
            margin=(4, 12, 0, 12),
        )
        return Page(
            title="firstphoton",
            template=TEMPLATE,
            sidebar=self._sidebar(),
            # In the bar, where it costs the plots no height.
            header=[self.pages.choice],
            main=[head, *self.pages.mains.values(), self._provenance],
            sidebar_width=330,
            sidebar_open=not self._is_away,
            theme_config=THEME,
            meta=Meta(title="firstphoton", description=words.ONE_LINE),
        )

    def _sidebar(self) -> list[Any]:
        read_again = pmui.Button(label="Read again", size="small", margin=(6, 8))
        read_again.on_click(lambda _: self._read_again())
        # `_announce` shows the one that suits the source.
        self._light_card = part("Light and recording", self._light.layout, is_shown=False)
        self._reading_card = part(
            "How to read the file",
            *self._reading.values(),
            read_again,
            is_open=self.session.answer.request.reading != Reading(),
            is_shown=False,
        )
        first, *others = self.pages.asides.values()
        return [
            self._source,
            self._file,
            self._unit,
            *others,
            self._light_card,
            self._reading_card,
            part("Tracking differentiator", self._preset, self._tracking.layout),
            part("Less data, faster", self._less.layout, is_open=False),
            part("Take it away", self._takeaway),
            first,
            part("What is this?", pmui.Typography(words.EXPLANATION, margin=8), is_open=False),
        ]

    def _explore(self) -> View:
        """The page that looks into the tracking differentiator."""
        session = self.session
        large = LargeView(session, session.image.figure)
        difference = pmui.Switch.from_param(
            session.state.param.difference, label="First difference", size="small", margin=(0, 8)
        )

        def show(is_on_screen: bool) -> None:
            session.show(is_on_screen)
            large.show(is_on_screen)

        return View(
            [session.figures, self._board(large)],
            [part("View", self._viewing.layout, difference)],
            show=show,
            follow=large.follow,
            paint=session.paint,
        )

    def _board(self, large: LargeView) -> pn.Column:
        session, state = self.session, self.session.state
        image_kind = choice("What the image shows", state.param.image)
        cloud_color = choice("What the cloud is coloured by", state.param.cloud_color)
        image, cloud = card(image_kind, session.image_keys), card(cloud_color, session.cloud)
        left = (
            downloadable(image, session, "image", partial(range_image, session), IMAGE),
            large.layout,
            downloadable(cloud, session, "3D cloud", partial(cloud_on_show, session), CLOUD),
        )
        plots = (
            downloadable(
                card(pane), session, what, partial(pixel_plot, session, pane.object, what), PLOT
            )
            for pane, what in zip(
                session.signals.panes, ("histogram", "residual", "enhanced"), strict=True
            )
        )
        told = downloadable_facts(session.numbers, session, partial(numbers_on_show, session))
        right = (told, *plots)
        columns = (
            pn.Column(*content, stylesheets=[COLUMN], sizing_mode="stretch_both")
            for content in (left, right)
        )
        return pn.Column(*columns, stylesheets=[BOARD], sizing_mode="stretch_both")


def _preset_of(settings: TrackingParameters) -> str:
    """Name of the preset that these are."""
    return next((name for name, preset in PRESETS.items() if preset == settings), CUSTOM)
