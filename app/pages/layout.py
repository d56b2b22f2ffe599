"""The template, the sidebar and the wiring of a page; the only module that uses the template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param
from panel.util import edit_readonly
from panel_material_ui.template.base import Meta

from app.model import text
from app.model.address import Link
from app.model.reading import options_in_use
from app.model.restore import parameters_of
from app.model.script import script_of
from app.model.state import ReductionSettings
from app.model.store import Answer, Request, Source
from app.model.uploads import MAX_UPLOAD_BYTES, Uploads
from app.pages.catalog import PAGES
from app.pages.navigation import Content, Page, Pages, Shared, View
from app.pages.session import Session
from app.pages.shared.reading import ReadingForm
from app.tasks.page import PageTasks
from app.theme import DARK, LIGHT, STYLES
from app.widgets.address_bar import AddressBar
from app.widgets.cards import choice, part, select
from app.widgets.connection import Connection
from app.widgets.controls import Sentence, SettingsPanel
from app.widgets.file_input import FileInput
from app.widgets.share import Share
from core import PRESETS, TrackingParameters
from core.io import SUFFIXES, ReadOptions

CUSTOM = "custom"

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
                        # A phone has room only for the buttons.
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
UNIT_BUTTONS = {"& .MuiToggleButton-root": {"textTransform": "none", "padding": "3px 8px"}}
PAGE_BUTTONS = {
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


TEMPLATE = (
    '{% extends "base.html" %}{% block postamble %}{{ super() }}<script>{{ scripts | safe }}'
    # Load the widgets' module now, not only when the page has loaded.
    + f'importShim("{pmui.Button._render_esm(server=True)}");'
    + "</script>{% endblock %}"
)
"""Template of the page; ``scripts`` is JavaScript to run before anything is drawn."""


class Template(pmui.Page):
    """Panel's template without its theme for plots and its busy indicator.

    The theme would override the sizes and colours of `app.theme`; the indicator redraws the page
    twice for every message.
    """

    is_narrow = param.Boolean(
        default=False,
        doc="Whether the sidebar would cover the page, as on a phone; set in the browser.",
    )

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        # This watcher of the server's state would keep the page in memory for ever.
        for _, watcher in self._param__private.ref_watchers:
            pn.state.param.unwatch(watcher)
        self._param__private.ref_watchers = []
        with edit_readonly(self):
            self.busy = False

    def get_root(self, doc: Any = None, comm: Any = None, preprocess: bool = True) -> Any:
        """Return the page's model, with the parts of Bokeh's plots that keep their style."""
        root = super().get_root(doc, comm, preprocess)
        root.data._custom_theme = list(STYLES)
        return root


def build_page(sources: Mapping[str, Source], uploads: Uploads) -> pmui.Page:
    """Return a new page with a session of its own, restored from its address."""
    query = {
        name: texts[-1].decode(errors="replace") for name, texts in pn.state.session_args.items()
    }
    return Layout(sources, Link(query), uploads).page


class Layout:
    """The template, the sidebar and the pages around one session.

    The session is built first, then the controls, then the pages, which depend on the session only,
    then the template; listeners are connected last.

    Parameters
    ----------
    sources : mapping of str to Source
        Scenes and captures to choose from.
    link : Link, optional
        Settings from the link of the page.
    uploads : Uploads, optional
        Where uploaded files are stored.
    tasks : PageTasks, optional
        The page's thread; by default that of the page being built.

    Attributes
    ----------
    session : Session
    pages : Pages
        The navigation.
    contents : dict of str to object
        Contents of the pages that have been visited, by name.
    page : Template
    """

    def __init__(
        self,
        sources: Mapping[str, Source],
        link: Link | None = None,
        uploads: Uploads | None = None,
        tasks: PageTasks | None = None,
    ) -> None:
        link, self._uploads = link or Link({}), uploads or Uploads()
        session = self.session = Session(self._with_upload(sources, link.source), link, tasks)
        state = session.state
        self._pages = {each.name: each for each in PAGES}
        if state.page not in self._pages:
            session.refused.append(text.no_page(state.page, self._pages))
            state.page = "Explore" if session.answer.request.source.is_scene else "Inspect"
        self._make_controls()
        self.contents: dict[str, Content] = {}
        self.pages = Pages(
            {each.name: partial(self._view_of, each) for each in PAGES},
            label="",
            help=", ".join(f"{each.name} {each.help}" for each in PAGES) + ".",
            first=state.page,
        )
        self.pages.choice.param.update(sx=PAGE_BUTTONS, margin=(0, 0, 0, 8))
        self.page = self._template()
        self._show_answer(session.answer)
        self._listen()
        if session.refused:
            session.failures.show(text.not_restored(session.refused))

    def _view_of(self, page: Page) -> View:
        content = self.contents[page.name] = page.build(self.session)
        return content.view

    # Controls

    def _make_controls(self) -> None:
        session, state = self.session, self.session.state
        self.alert = Sentence(warning=True, sizing_mode="stretch_width", margin=0)
        self._provenance = Sentence(sizing_mode="stretch_width", margin=(4, 12))
        self._busy = pmui.LinearProgress(
            visible=False, variant="indeterminate", sizing_mode="stretch_width", margin=0
        )
        self._source = select(
            "Scene or capture",
            self._titles(),
            state.source,
            "A built-in scene to simulate, or a capture from a file.",
        )
        self._file = FileInput(
            lambda reason: session.failures.show(text.not_uploaded(reason, MAX_UPLOAD_BYTES)),
            label="Open a capture file",
            accept=",".join(SUFFIXES),
            max_file_size=MAX_UPLOAD_BYTES,
            variant="outlined",
            size="small",
            sizing_mode="stretch_width",
            margin=(4, 8),
        )
        self._panels: dict[str, SettingsPanel[Any]] = {
            name: SettingsPanel(type(getattr(state, name))(), partial(setattr, state, name))
            for name in ("light", "tracking", "less")
        }
        self._preset = select(
            "Preset",
            [*PRESETS, CUSTOM],
            _preset_of(state.tracking),
            "recommended: best on random depths. as printed: the paper's settings, literally.",
        )
        self._reading = ReadingForm(self._read, session.failures.show)
        unit = choice(text.UNIT_HELP, state.param.unit)
        unit.param.update(
            label="Gate axes in", sx=UNIT_BUTTONS, sizing_mode="stretch_width", margin=(4, 8)
        )
        self._make_parts(unit)
        self._uploaded = ""
        self._link = AddressBar()
        session_id = session.page.session_context.id if session.tasks.is_served else ""
        self._connection = Connection(session_id)

    def _make_parts(self, unit: Any) -> None:
        """Make the parts of the sidebar that pages share; `_show_answer` shows one of the first."""
        self._light_part = part("Simulation", self._panels["light"].layout, is_shown=False)
        if self.session.answer.request.reading != ReadOptions():
            self._reading.part.collapsed = False
        tracking = self._panels["tracking"]
        self._shared = {
            Shared.UNIT: unit,
            Shared.TRACKING: part("Tracking differentiator", self._preset, tracking.layout),
            Shared.REDUCTION: part("Data reduction", self._panels["less"].layout, is_open=False),
        }

    def _template(self) -> Template:
        head = pn.Column(
            self._link,
            self._connection,
            self._busy,
            self.alert,
            sizing_mode="stretch_width",
            margin=(4, 12, 0, 12),
        )
        return Template(
            title="firstphoton",
            template=TEMPLATE,
            sidebar=self._sidebar(),
            header=[self.pages.choice],  # not in `main`: plots keep the height
            main=[head, *self.pages.mains.values(), self._provenance],
            sidebar_width=330,
            theme_config=THEME,
            meta=Meta(title="firstphoton", description=text.ONE_LINE),
        )

    def _sidebar(self) -> list[Any]:
        session, asides = self.session, self.pages.asides
        share = Share(lambda: script_of(session.answer, session.state))
        return [
            self._source,
            self._file,
            self._reading.question,
            self._shared[Shared.UNIT],
            *(aside for name, aside in asides.items() if not self._pages[name].sidebar_last),
            self._light_part,
            self._reading.part,
            self._shared[Shared.TRACKING],
            self._shared[Shared.REDUCTION],
            part("Share", share.layout),
            *(aside for name, aside in asides.items() if self._pages[name].sidebar_last),
        ]

    # Wiring

    def _listen(self) -> None:
        session, state, tasks = self.session, self.session.state, self.session.tasks
        self._link.follow(state, session.query, tasks.call_later, tasks.run_next)
        session.estimate.changed.subscribe(self._show_answer)
        session.estimate.busy.subscribe(partial(setattr, self._busy, "visible"))
        session.failures.shown.subscribe(self._show_failure)
        self._source.param.watch(lambda event: self._go_to(event.new), "value")
        self._file.param.watch(lambda event: self._upload(event.new), "value")
        self._preset.param.watch(lambda event: self._preset_changed(event.new), "value")
        state.param.watch(
            lambda *_: self._show_settings("light", "tracking"), ["light", "tracking"]
        )
        self.pages.choice.link(state, value="page", bidirectional=True)
        self.pages.choice.param.watch(lambda *_: self._fit_sidebar(), "value")
        self._fit_sidebar()
        self.page.param.watch(lambda event: self.pages.paint(event.new), "dark_theme")
        if tasks.is_served:
            pn.state.on_session_destroyed(lambda _: self._close())
            pn.config.exception_handler = session.failures.report  # for this session only

    def _fit_sidebar(self) -> None:
        """Show the controls that affect the open page."""
        page = self._pages[self.pages.choice.value]
        for each, content in self._shared.items():
            content.visible = each in page.shared
        if page.is_standalone == self._provenance.visible:
            self._provenance.visible = not page.is_standalone
            self.page.sidebar_open = not (page.is_standalone or self.page.is_narrow)

    def _show_failure(self, sentence: str) -> None:
        self.alert.text = sentence[:2000]

    def _show_answer(self, answer: Answer) -> None:
        is_scene = answer.request.source.is_scene
        if self.session.state.source == self._uploaded:  # it could be read
            self._uploaded, self.session.state.page = "", "Inspect"
        self._source.value = self.session.state.source
        self._light_part.visible, self._reading.part.visible = is_scene, not is_scene
        self._show_reading(answer)
        self._provenance.text = text.provenance(answer)[:2000]
        self._show_settings()
        self._panels["tracking"].controls["t_n"].high = max(
            answer.capture.acquisition.n_bins - 1, 1
        )
        self.pages.follow(answer)

    def _show_reading(self, answer: Answer) -> None:
        refused = self.session.estimate.refused
        if refused is not None:
            is_new = refused.request.source is not answer.request.source
            self._reading.show_refused(refused.request, refused.variables, is_new)
        elif not answer.request.source.is_scene:
            self._reading.show(answer.request.reading, options_in_use(answer))

    def _show_settings(self, *names: str) -> None:
        """Show settings that were changed by a page, a preset or an estimate; all by default."""
        state = self.session.state
        for name in names or self._panels:
            self._panels[name].show(getattr(state, name))
        self._preset.value = _preset_of(state.tracking)

    # Actions of the user

    def _go_to(self, key: str) -> None:
        session, state = self.session, self.session.state
        if key != state.source:
            request = Request(
                session.sources[key],
                state.light,
                ReadOptions(),
                state.tracking,
                ReductionSettings(),
            )
            state.param.update(parameters_of(request, session.sources))

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
            self.session.failures.show(text.not_kept(error))
            return
        self.session.sources.update(self._with_upload({}, key))
        self._source.options = self._titles()
        self._uploaded = self._source.value = key

    def _read(self, options: ReadOptions) -> None:
        """Read the file that the form is for: the one on screen, or the one that was refused."""
        session, refused = self.session, self.session.estimate.refused
        request = session.answer.request if refused is None else refused.request
        again = parameters_of(replace(request, reading=options), session.sources)
        session.state.param.update(again)

    def _close(self) -> None:
        """Release what would outlive a closed page."""
        pn.config._session_config.pop(self.session.page, None)
        self._uploads.leave(self)

    # Sources

    def _titles(self) -> dict[str, str]:
        """Return the key of each source by its title; files of the same name are numbered."""
        titles: dict[str, str] = {}
        for key, source in self.session.sources.items():
            number = 1 + sum(title.startswith(source.title) for title in titles)
            is_new = source.title not in titles
            titles[source.title if is_new else f"{source.title} ({number})"] = key
        return titles

    def _with_upload(self, sources: Mapping[str, Source], key: str) -> dict[str, Source]:
        """Add the upload of a key to the sources, if there is one."""
        upload = self._uploads.use(key, self)
        return {**sources, key: upload} if upload is not None else dict(sources)


def _preset_of(settings: TrackingParameters) -> str:
    """Return the name of the preset with these settings."""
    return next((name for name, preset in PRESETS.items() if preset == settings), CUSTOM)
