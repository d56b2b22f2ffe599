"""The template, the sidebar and the wiring of a page; the only module that uses the template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from operator import is_not
from pathlib import Path
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param
from panel.util import edit_readonly
from panel_material_ui.template.base import Meta

from app.model import text
from app.model.address import Link
from app.model.glossary import linked
from app.model.lessons import Lesson
from app.model.methods import doubts_hold
from app.model.reading import options_in_use
from app.model.restore import parameters_of
from app.model.script import script_of
from app.model.state import ReductionSettings
from app.model.store import Answer, Request, Source
from app.model.truth import Truth, parts_of, with_truth
from app.model.uploads import MAX_UPLOAD_BYTES, Uploads
from app.model.watched import Arrival
from app.pages.catalog import PAGES
from app.pages.navigation import Pages, Shared
from app.pages.session import Session
from app.pages.shared.downloads import Subject, explored, looked_at, viewed
from app.pages.shared.illumination import IlluminationPanel
from app.pages.shared.method import MethodChoice
from app.pages.shared.photon_budget import PhotonBudgetForm
from app.pages.shared.reading import ReadingForm
from app.pages.shared.truth import TruthForm, TruthOffer
from app.tasks.page import PageTasks
from app.tasks.signals import Signal
from app.theme import DARK, LIGHT, STYLES
from app.units import ShownGate, scale
from app.widgets.address_bar import AddressBar
from app.widgets.cards import arriving, button, choice, part, select
from app.widgets.connection import Connection
from app.widgets.controls import Sentence, SettingsPanel
from app.widgets.file_input import file_button
from app.widgets.glossary import Glossary, explained
from app.widgets.share import Share
from app.widgets.tour import SCENE, Tour
from core import PRESETS, TrackingParameters
from core.io import ReadOptions, pattern_of

CUSTOM = "custom"
EXPLORE, LEARN = "Explore", "Learn"
"""The page of the tour, and the page with a presenter mode."""

HELP = "About this page"
MORE_TRACKING = "More tracking settings"
COMMON = ("l", "n", "alpha", "t_n")
"""Settings of the tracking differentiator that are not folded; the others are rarely changed."""

# The help of a button covers its right neighbour: it lets clicks through, and closes when the
# pointer moves on. By default it would be as narrow as its button.
TOOLTIP = {
    "defaultProps": {"disableInteractive": True},
    "styleOverrides": {"tooltip": {"width": "max-content", "maxWidth": "230px"}},
}
# In each component, for people whom motion distracts or makes ill.
STILL = {
    "@media (prefers-reduced-motion: reduce)": {
        "*, *::before, *::after": {
            "animation": "none !important",
            "transition": "none !important",
        }
    }
}
THEME = {
    mode: {
        "palette": {"primary": {"main": main}, "background": {"default": page, "paper": paper}},
        "typography": {"fontSize": 13},
        "components": {
            "MuiAppBar": {"styleOverrides": {"root": {"backgroundColor": bar, "color": "#ffffff"}}},
            "MuiCssBaseline": {"styleOverrides": STILL},
            "MuiTooltip": TOOLTIP,
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

TOUR_BUTTON = {
    "color": "#ffffff",
    "borderColor": "#ffffff80",
    "textTransform": "none",
    "@media (max-width: 500px)": {"minWidth": 0, "padding": "5px 2px", "fontSize": "9px"},
}

NOT_BUSY = {"display": "none"}  # unlike `visible`, at no layout of the page

PRINT = """
@media print {
  header, nav, .MuiToolbar-root { display: none !important; }
  .page > div > div, main, main > div, .main-content {
    display: block !important; height: auto !important; overflow: visible !important; }
  /* See `app/widgets/content.js`. */
  main { zoom: var(--print-zoom, 0.7); margin: 0 !important;
    width: var(--print-width, auto) !important; }
}
"""
"""Style of the printed page: the content alone, with all that is out of view on screen."""
PRINTED_ONLY = "@media screen { :host { display: none !important } }"

PRESENT = "header, nav, .MuiToolbar-root { display: none !important; }"
"""Style of presenter mode, which covers the window."""
ABOVE_SLIDES = {"position": "relative", "z-index": "1400"}

CONTENT = (Path(__file__).parent.parent / "widgets" / "content.js").read_text("utf-8")

TEMPLATE = (
    '{% extends "base.html" %}{% block postamble %}{{ super() }}'
    # Without its background, the dark mode would be light text on white paper.
    "<style>@page { size: landscape; margin: 8mm; } html { print-color-adjust: exact; }"
    "@media print { .screen-only { display: none; } body::after { content: attr(data-link); "
    "font: 10px sans-serif; overflow-wrap: anywhere; } }</style>"
    "<script>{{ scripts | safe }}"
    + CONTENT
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


class Arrivals(Signal[Arrival]):
    """Notification of files that have just been written to a watched folder.

    Attributes
    ----------
    refused : tuple of str
        Those of the latest arrival that could not be opened, for pages that are opened later.
    """

    def __init__(self) -> None:
        super().__init__()
        self.refused: tuple[str, ...] = ()

    def emit(self, value: Arrival) -> None:
        """Send an arrival."""
        self.refused = value.refused
        super().emit(value)


def build_page(
    sources: Mapping[str, Source],
    uploads: Uploads,
    arrivals: Arrivals | None = None,
    lessons: Mapping[str, Lesson] | None = None,
) -> pmui.Page:
    """Return a new page with a session of its own, restored from its address."""
    query = {
        name: texts[-1].decode(errors="replace") for name, texts in pn.state.session_args.items()
    }
    return Layout(sources, Link(query), uploads, arrivals=arrivals, lessons=lessons).page


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
    arrivals : Arrivals, optional
        Captures to follow.
    lessons : mapping of str to Lesson, optional
        Lessons of the page Learn; by default the built-in ones.

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
        arrivals: Arrivals | None = None,
        lessons: Mapping[str, Lesson] | None = None,
    ) -> None:
        self._arrivals = arrivals
        link, self._uploads = link or Link({}), uploads or Uploads()
        known = dict(sources)
        for key in link.sources:
            known = self._with_uploads(known, key)
        session = self.session = Session(known, link, tasks, lessons)
        state = session.state
        self._pages = {each.name: each for each in PAGES}
        if state.page not in self._pages:
            session.refused.append(text.no_page(state.page, self._pages))
            state.page = "Explore" if session.answer.request.source.is_scene else "Inspect"
        self._make_controls()
        self.pages = Pages(
            session,
            {each.name: each.build for each in PAGES},
            label="",
            help=", ".join(f"{each.name} {each.help}" for each in PAGES) + ".",
            first=state.page,
        )
        self.contents = self.pages.contents
        self.pages.choice.param.update(sx=PAGE_BUTTONS, margin=(0, 0, 0, 8))
        self.page = self._template()
        self._subject: tuple[object, ...] = ()
        self._readable: set[str] = set()
        self._unreadable: set[str] = set()
        self._fit_controls(session.answer)
        self._listen()
        if arrivals is not None:
            session.failures.remark(text.not_opened(arrivals.refused))
        if sentence := _about_link(session):
            session.failures.show(sentence)

    # Controls

    def _make_controls(self) -> None:
        session, state = self.session, self.session.state
        self.alert = Sentence(warning=True, sizing_mode="stretch_width", margin=0)
        self._provenance = Sentence(sizing_mode="stretch_width", margin=(4, 12))
        self._printed = Sentence(
            stylesheets=[PRINTED_ONLY], sizing_mode="stretch_width", margin=(4, 12)
        )
        self._busy = pmui.LinearProgress(
            variant="indeterminate", sx=NOT_BUSY, height=4, sizing_mode="stretch_width", margin=0
        )
        self._source = select(
            "Scene or capture",
            self._titles(),
            state.source,
            "A built-in scene to simulate, or a capture from a file.",
        )
        self._source.css_classes = [SCENE]
        self._file = file_button(
            "Open a capture file",
            self._upload,
            lambda reason: session.failures.show(text.not_uploaded(reason, MAX_UPLOAD_BYTES)),
            multiple=True,
        )
        self._follow = pmui.Switch(
            label="Follow new captures",
            value=True,
            size="small",
            margin=(0, 8),
        )
        self._panels: dict[str, SettingsPanel[Any]] = {
            name: SettingsPanel(type(getattr(state, name))(), partial(setattr, state, name))
            for name in ("tracking", "reduction")
        }
        self._panels["light"] = IlluminationPanel(state, lambda: session.request.illumination)
        self._budget = PhotonBudgetForm(session)
        self._preset = select(
            "Preset",
            [*PRESETS, CUSTOM],
            _preset_of(state.tracking),
            "recommended: best on random depths. literal: the paper's equations, with an l chosen "
            "here, since it prints none.",
        )
        self._method = MethodChoice(session)
        self._reading = ReadingForm(self._read, session.failures.show)
        self._truth = TruthForm(session, self._uploads, self, self._add_truth)
        self._truth_offer = TruthOffer(session, self._add_truth)
        unit = choice(text.UNIT_HELP, state.param.unit)
        unit.param.update(
            label="Gate axes in", sx=UNIT_BUTTONS, sizing_mode="stretch_width", margin=(4, 8)
        )
        self._make_parts(unit)
        refused = session.estimate.refused
        self._uploaded = ""
        if refused is not None and refused.request.source is not session.answer.request.source:
            self._uploaded = session.key(refused.request.source)
        self._link = AddressBar()
        session_id = session.page.session_context.id if session.tasks.is_served else ""
        self._connection = Connection(session_id)
        self._tour = Tour(is_offered=state.page == EXPLORE, margin=0)

    def _make_parts(self, unit: Any) -> None:
        """Make the parts of the sidebar that pages share; `_fit_controls` shows them."""
        self._light_part = part("Simulation", self._panels["light"].layout, is_shown=False)
        if self.session.answer.request.reading != ReadOptions():
            self._reading.part.collapsed = False
        self._explanation = explained("", margin=8)
        self._help = part(HELP, self._explanation, is_open=False)
        tracking = self._panels["tracking"]
        rare = [name for name in tracking.controls if name not in COMMON]
        chosen = self.session.state.tracking
        is_open = _preset_of(chosen) == CUSTOM and any(
            getattr(chosen, name) != getattr(TrackingParameters(), name) for name in rare
        )
        self._shared = {
            Shared.UNIT: unit,
            Shared.METHOD: self._method.part,
            Shared.TRACKING: part(
                "Tracking differentiator",
                self._preset,
                tracking.folded(MORE_TRACKING, *rare, is_open=is_open),
                is_shown=False,
            ),
            Shared.REDUCTION: part(
                "Data reduction", self._panels["reduction"].layout, is_open=False
            ),
        }

    def _template(self) -> Template:
        head = pn.Column(
            self._link,
            self._connection,
            Glossary(margin=0),
            self._tour,
            self._busy,
            self.alert,
            self._reading.question,
            sizing_mode="stretch_width",
            margin=(4, 12, 0, 12),
        )
        tour = button("Tour", text.TOUR_HELP, self._start_tour, (3, 0, 0, 4))
        tour.sx = TOUR_BUTTON
        return Template(
            title="firstphoton",
            template=TEMPLATE,
            # In the template itself, each part that opens would lay out the plots again.
            sidebar=[pmui.Column(*self._sidebar(), sizing_mode="stretch_width", margin=0)],
            header=[self.pages.choice, tour],  # not in `main`: plots keep the height
            main=[head, *self.pages.mains.values(), self._provenance, self._printed],
            sidebar_width=330,
            stylesheets=[PRINT],
            theme_config=THEME,
            meta=Meta(title="firstphoton", description=text.ONE_LINE),
        )

    def _sidebar(self) -> list[Any]:
        session, asides = self.session, self.pages.asides
        share = Share(lambda: script_of(session.answer, session.state, session.kept_answer))
        return [
            self._help,
            self._source,
            self._file,
            *([] if self._arrivals is None else [self._follow]),
            self._reading.records,
            self._truth_offer.layout,
            self._shared[Shared.UNIT],
            *(aside for name, aside in asides.items() if not self._pages[name].sidebar_last),
            arriving(
                self._light_part,
                self._budget.part,
                self._reading.part,
                self._truth.part,
                self._shared[Shared.METHOD],
                self._shared[Shared.TRACKING],
                self._shared[Shared.REDUCTION],
            ),
            part("Share", share.layout),
            *(aside for name, aside in asides.items() if self._pages[name].sidebar_last),
        ]

    # Wiring

    def _listen(self) -> None:
        session, state, tasks = self.session, self.session.state, self.session.tasks
        later, at_once = tasks.call_later, tasks.run_next
        self._link.follow(state, session.query, session.is_settled, later, at_once)
        self._link.param.watch(lambda event: session.recall(event.new[0]), "visited")
        session.estimate.changed.subscribe(self._show_answer)
        tasks.busy.changed.subscribe(self._show_busy)
        session.failures.shown.subscribe(self._show_failure)
        self._source.param.watch(lambda event: self._go_to(event.new), "value")
        self._preset.param.watch(lambda event: self._preset_changed(event.new), "value")
        state.param.watch(lambda *_: self._show_changed(), ["light", "budget", "tracking"])
        self.pages.choice.link(state, value="page", bidirectional=True)
        self.pages.choice.param.watch(lambda *_: self._fit_sidebar(), "value")
        self._fit_sidebar()
        state.param.watch(lambda *_: self._describe_print(), ["page", "viewing"])
        state.param.watch(lambda *_: self._follow_unit(), "unit")
        state.param.watch(lambda *_: self._show_bars(), ["page", "present"])
        self._tour.param.watch(lambda _: setattr(state, "page", LEARN), "finished")
        self._show_bars()
        self.page.param.watch(lambda _: self._paint(), "dark_theme")
        if self.page.dark_theme:  # by its address
            self._paint()
        if self._arrivals is not None:
            self._arrivals.subscribe(self._hear_of)
        if tasks.is_served:
            pn.state.on_session_destroyed(lambda _: self._close())
            pn.config.exception_handler = session.failures.report  # for this session only

    def _fit_sidebar(self) -> None:
        """Show the controls that affect the open page."""
        page = self._pages[self.pages.choice.value]
        shows_other = Shared.METHOD in page.shared and self.session.answer.method != "tracking"
        self._explanation.object = linked(page.explanation)
        self._help.visible = bool(page.explanation)
        for each, content in self._shared.items():
            is_other = each is Shared.TRACKING and shows_other
            content.visible = each in page.shared and not is_other
        if page.is_standalone == self._provenance.visible:
            self._provenance.visible = not page.is_standalone
            self.page.sidebar_open = not (page.is_standalone or self.page.is_narrow)

    def _show_bars(self) -> None:
        """Hide the header and the sidebar in presenter mode."""
        state = self.session.state
        is_presenting = state.present and state.page == LEARN
        self.page.stylesheets = [PRINT, PRESENT] if is_presenting else [PRINT]
        self.alert.styles = ABOVE_SLIDES if is_presenting else {}

    def _describe_print(self) -> None:
        """State on paper the version, and what is behind the page; the browser adds its link."""
        page, session = self._pages[self.pages.choice.value], self.session
        answer = session.answer
        if Shared.METHOD in page.shared:
            subject = viewed(session, explored(session), session.state.viewing)
        elif page.is_standalone:
            subject = Subject("")
        else:
            subject = replace(looked_at(session, answer.request), source=answer.capture.source)
        self._printed.text = subject.about("printed page")[:2000]

    def _paint(self) -> None:
        """Change between light and dark mode, which the address keeps."""
        is_dark = self._link.dark = self.page.dark_theme
        self.pages.paint(is_dark)

    def _show_busy(self, is_busy: bool) -> None:
        self._busy.sx = {} if is_busy else NOT_BUSY

    def _show_failure(self, sentence: str) -> None:
        self.alert.text = sentence[:2000]

    def _show_answer(self, answer: Answer) -> None:
        self._fit_controls(answer)
        self.pages.follow(answer)

    def _fit_controls(self, answer: Answer) -> None:
        """Show an estimate in all but the pages, which show that of the session when they open."""
        state = self.session.state
        self._note_readable(answer)
        if answer.request.source is self.session.sources.get(self._uploaded):  # it could be read
            self._uploaded, state.page = "", "Inspect"
        if self._source.value != state.source:
            self._source.value = state.source
        request = answer.request
        read = request.reading, request.absent, self.session.estimate.refused
        subject = answer.whole, answer.capture, answer.method, *read
        if not self._subject or any(map(is_not, subject, self._subject)):
            self._subject = subject
            self._fit_to(answer)
        self._method.show(answer)
        self._budget.refresh()
        self._describe_print()
        self._show_settings()

    def _note_readable(self, answer: Answer) -> None:
        """Keep which files could be read, and which could not, perhaps with other options."""
        session, refused = self.session, self.session.estimate.refused
        self._readable.add(session.key(answer.request.source))
        if refused is not None:
            self._unreadable.add(session.key(refused.request.source))

    def _fit_to(self, answer: Answer) -> None:
        """Show a capture and the kind of its estimate, which few settings change."""
        is_scene = answer.request.source.is_scene
        self._light_part.visible = is_scene
        self._reading.part.visible = not is_scene
        self._truth.show(answer)
        self._show_reading(answer)
        self._truth_offer.show(answer)
        self._provenance.text = text.provenance(answer)[:2000]
        tracking = self._panels["tracking"]
        tracking.mark_doubts(doubts_hold(answer.capture))
        tracking.controls["t_n"].high = max(answer.capture.acquisition.n_bins - 1, 1)
        self._fit_sidebar()
        self._follow_unit()

    def _follow_unit(self) -> None:
        """Show T_n and the ends of the cut gate in the unit of the axes."""
        answer, unit = self.session.answer, self.session.state.unit
        whole = ShownGate(answer.whole.acquisition)
        self._panels["tracking"].controls["t_n"].follow(scale(unit, answer.gate))
        for name in ("gate_from", "gate_to"):
            self._panels["reduction"].controls[name].follow(scale(unit, whole), whole.n_bins)

    def _show_reading(self, answer: Answer) -> None:
        refused = self.session.estimate.refused
        if refused is not None:
            is_new = refused.request.source is not answer.request.source
            self._reading.show_refused(refused, is_new)
        elif answer.request.source.is_scene:
            self._reading.question.visible = self._reading.records.visible = False
        else:
            n_records = answer.whole.n_records
            self._reading.show(answer.request.reading, options_in_use(answer), n_records)

    def _show_settings(self) -> None:
        """Show the settings of the state."""
        for name, panel in self._panels.items():
            panel.show(self._chosen(name))
        self._show_preset()

    def _show_changed(self) -> None:
        """Show settings that a page or a preset has changed, or a slider, which shows its own."""
        for name, panel in self._panels.items():
            if panel.settings != self._chosen(name):
                panel.show(self._chosen(name))
        self._show_preset()

    def _show_preset(self) -> None:
        preset = _preset_of(self.session.state.tracking)
        if self._preset.value != preset:
            self._preset.value = preset

    def _chosen(self, name: str) -> Any:
        is_light = name == "light"
        return self.session.request.illumination if is_light else getattr(self.session.state, name)

    # Actions of the user

    def _start_tour(self) -> None:
        self.session.state.page = EXPLORE
        self._tour.started += 1

    def _go_to(self, key: str) -> None:
        session, state = self.session, self.session.state
        if key != state.source:
            request = Request(
                session.sources[key],
                state.light,
                ReadOptions(),
                state.tracking,
                ReductionSettings(),
                state.method,
                state.settings,
                state.judged_by,
                state.returns,
                budget=state.budget,
            )
            state.param.update(parameters_of(request, session.sources))

    def _preset_changed(self, name: str) -> None:
        if name in PRESETS:
            self.session.state.tracking = PRESETS[name]

    def _upload(self, files: dict[str, bytes]) -> None:
        """Offer files as one sequence in time if their names say so, else each by itself.

        Earlier ones that could not be read make room.
        """
        self._remove_unreadable()
        is_sequence = pattern_of(list(files)) is not None
        keys = []
        try:
            for each in [files] if is_sequence else [{name: files[name]} for name in files]:
                keys.append(self._uploads.add(each, self))
        except (ValueError, OSError) as error:
            self.session.failures.show(text.not_kept(error))
        for key in keys:
            self.session.sources.update(self._with_uploads({}, key))
        self._source.options = self._titles()
        if keys:
            self._uploaded = self._source.value = keys[0]

    def _remove_unreadable(self) -> None:
        """Remove uploads that could never be read; other files remain in the list."""
        for key in self._unreadable - self._readable:
            if self._uploads.release(key, self):
                self.session.forget_source(key)
        self._unreadable.clear()

    def _read(self, options: ReadOptions) -> None:
        """Read the file that the form is for: the one on screen, or the one that was refused."""
        session, refused = self.session, self.session.estimate.refused
        request = session.answer.request if refused is None else refused.request
        again = parameters_of(replace(request, reading=options), session.sources)
        session.state.param.update(again)

    def _add_truth(self, truth: Truth) -> None:
        """Show the capture on screen with a truth, in place of one that was added before."""
        session, request = self.session, self.session.answer.request
        capture, _ = parts_of(session.key(request.source))
        key = truth.key_with(capture)
        session.sources.update(self._with_uploads(session.sources, key))
        self._source.options = self._titles()
        session.state.param.update(parameters_of(request, session.sources) | {"source": key})

    def _hear_of(self, arrival: Arrival) -> None:
        self.session.tasks.queue(partial(self._receive, arrival))

    def _receive(self, arrival: Arrival) -> None:
        """Offer captures that have just been written, and show the last one if it is wanted.

        Files that could not be opened are named until the next arrival.
        """
        session = self.session
        session.failures.remark(text.not_opened(arrival.refused))
        arrival.update(session.sources, kept=session.state.source)
        self._source.options = self._titles()
        if self._follow.value and arrival.found:
            session.go_on_with(arrival.newest)

    def _close(self) -> None:
        """Release what would outlive a closed page."""
        if self._arrivals is not None:
            self._arrivals.unsubscribe(self._hear_of)
        pn.config._session_config.pop(self.session.page, None)
        self._uploads.leave(self)

    # Sources

    def _titles(self) -> dict[str, str]:
        """Return the key of each source by its title; files of the same name are numbered."""
        titles: dict[str, str] = {}
        for key, source in self.session.sources.items():
            title, number = source.title, 1
            while title in titles:
                number += 1
                title = f"{source.title} ({number})"
            titles[title] = key
        return titles

    def _with_uploads(self, sources: Mapping[str, Source], key: str) -> dict[str, Source]:
        """Add the upload of a key to the sources, if there is one, and a truth added to it."""
        capture, truth = parts_of(key)
        found, upload = dict(sources), self._uploads.use(capture, self)
        if upload is not None:
            found[capture] = upload
        if truth is not None and capture in found:
            own = found[capture].path
            path = self._uploads.path(truth.key, self) if truth.key else own
            if path is not None:
                found[key] = with_truth(found[capture], truth, path)
        return found


def _about_link(session: Session) -> str:
    """Return what the page says about its link: what was not restored, and how to read the file."""
    refused = session.estimate.refused
    asked = "" if refused is None else refused.question
    return " ".join(filter(None, (text.not_restored(session.refused), asked)))


def _preset_of(settings: TrackingParameters) -> str:
    """Return the name of the preset with these settings."""
    return next((name for name, preset in PRESETS.items() if preset == settings), CUSTOM)
