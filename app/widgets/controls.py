"""Controls made from the metadata of frozen dataclasses: one knob or select for each field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import panel as pn
import panel_material_ui as pmui
import param
from panel.custom import Child

from app.widgets.component import Component
from core.parameters import Number, joint_doubts, spec_of

Settings = TypeVar("Settings")


class Knob(Component):
    """A number with a slider, a field to type in, its unit, a line of help and a reset.

    Values with which answers are in doubt are marked on the slider; while one of them is set, a
    sentence below says why. Only values between `low` and `high` can be set; the field says so when
    something else is typed.
    """

    value = param.Number(default=0.0)
    initial = param.Number(default=0.0, doc="What the reset button returns to.")
    low = param.Number(default=0.0)
    high = param.Number(default=1.0)
    log = param.Boolean(default=False)
    whole = param.Boolean(default=False)
    label = param.String(default="")
    unit = param.String(default="")
    help = param.String(default="")
    doubtful = param.List(default=[], doc="Zones of values in doubt: low, high, and why.")

    # That someone drags is no news to the server's other pages, whom Panel would tell each time.
    _busy__ignore: ClassVar = ["value"]

    _esm = Path(__file__).with_name("knob.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("knob.css")]

    @classmethod
    def of(cls, spec: Number, value: float, help: str) -> Knob:
        """The knob of a field."""
        return cls(
            value=value,
            initial=value,
            low=spec.low,
            high=spec.high,
            log=spec.log,
            whole=spec.whole,
            label=spec.symbol,
            unit=spec.unit,
            help=help,
            doubtful=[[zone.low, zone.high, zone.why] for zone in spec.doubtful],
            sizing_mode="stretch_width",
            margin=(0, 8, 2, 8),
        )


# As a knob tells of its own doubts.
DOUBT = """
.note { padding: 2px 0 4px 8px; border-left: 3px solid var(--mui-palette-warning-dark, #e65100); }
"""


class SettingsPanel(Generic[Settings]):
    """The controls of one settings object.

    Parameters
    ----------
    settings : dataclass
        Frozen, its fields made by `core.parameters.parameter`.
    changed : callable
        Called with the new settings object after each change by the user.
    """

    def __init__(self, settings: Settings, changed: Callable[[Settings], None]) -> None:
        self._settings = settings
        self._changed = changed
        self._silent = False
        self.controls: dict[str, Any] = {}
        # Of settings that are sound one by one; each knob tells of its own.
        self.doubts = Sentence(
            live=True, stylesheets=[DOUBT], sizing_mode="stretch_width", margin=(0, 8, 4, 8)
        )
        self.doubts.text = " ".join(joint_doubts(settings))
        for each in fields(settings):  # type: ignore[arg-type]
            spec, value, help = spec_of(each), getattr(settings, each.name), each.metadata["help"]
            control = (
                Knob.of(spec, value, help)
                if isinstance(spec, Number)
                else pmui.Select(
                    label=spec.symbol,
                    value=value,
                    options=list(spec.options),
                    description=help,
                    size="small",
                    sizing_mode="stretch_width",
                    margin=(8, 8, 4, 8),
                )
            )
            control.param.watch(self._collect, "value")
            self.controls[each.name] = control

    @property
    def layout(self) -> pn.Column:
        """All controls, in the order of the fields, and what is to be doubted of them together."""
        content = (*self.controls.values(), self.doubts)
        return pn.Column(*content, sizing_mode="stretch_width", margin=0)

    def show(self, settings: Settings) -> None:
        """Set every control without reporting a change."""
        self._silent = True
        try:
            for name, control in self.controls.items():
                value = getattr(settings, name)
                if control.value != value:  # which costs less than to set it in vain
                    control.value = value
        finally:
            self._silent = False
        self._settle(settings)

    def _collect(self, _event: param.parameterized.Event) -> None:
        if self._silent:
            return
        values = {name: control.value for name, control in self.controls.items()}
        whole = {n for n, c in self.controls.items() if isinstance(c, Knob) and c.whole}
        values = {n: round(v) if n in whole else v for n, v in values.items()}
        self._settle(replace(self._settings, **values))  # type: ignore[type-var]
        self._changed(self._settings)

    def _settle(self, settings: Settings) -> None:
        self._settings = settings
        self.doubts.text = " ".join(joint_doubts(settings))


HEADLINE_PX, FACTS_PX, LINE_PX = 37, 32, 17
"""Heights of timed facts, of a row of others, and of a sentence; kept free from the start."""


class Facts(Component):
    """A list of named values; updating it costs the page no new layout."""

    facts = param.List(default=[], doc="Name, value and one line of help, each a string.")
    timed = param.Boolean(default=False, doc="Whether the page adds how long its drawing took.")

    _esm = Path(__file__).with_name("facts.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("facts.css")]


class Table(Component):
    """A table of numbers; its column headers are buttons that sort the rows."""

    title = param.String(default="", doc="What a screen reader says of the table.")
    columns = param.List(default=[], doc="Title, line of help, and 1 or -1: which end comes first.")
    rows = param.List(
        default=[],
        doc="""Of each row a dict of ``name``, ``note`` on it, ``color`` and ``dash`` of its line,
        ``cells`` of text, value to sort by and a smaller second line, a ``message`` in place of
        cells, and ``last``: whether it stays below the others. One with an ``action`` has a button
        of that name, which reports the row's ``key``.""",
    )
    acted = param.List(default=[], doc="Key of the row whose button was pressed, and when.")

    _esm = Path(__file__).with_name("table.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("table.css")]


class Sentence(Component):
    """Text, shown letter by letter: nothing of it, a file's name say, becomes part of the page."""

    text = param.String(default="")
    warning = param.Boolean(default=False, doc="Whether it tells of something that went wrong.")
    live = param.Boolean(default=False, doc="Whether a screen reader reads out each new text.")

    _esm = """
    export function render({ model }) {
      const root = document.createElement("div");
      if (model.warning) root.setAttribute("role", "alert");
      else if (model.live) root.setAttribute("role", "status");
      const show = () => {
        root.textContent = model.text;
        root.className = model.text === "" ? "" : model.warning ? "warning" : "note";
      };
      model.on("text", show);
      show();
      return root;
    }
    """
    _stylesheets: ClassVar = [
        """
        .note, .warning {
          font: 12px/1.4 var(--mui-font-family, Roboto, system-ui, sans-serif);
          color: var(--mui-palette-text-primary, #1c2430);
        }
        .warning {
          font-size: 14px; margin: 4px 0; padding: 8px 12px; border-radius: 4px;
          border: 1px solid #ed6c02; border-left-width: 6px;
        }
        """
    ]


class Chips(Component):
    """Small labels, each with a colour, a button of its text, and one that removes it."""

    label = param.String(default="", doc="What a screen reader says of them.")
    chips = param.List(default=[], doc="Of each chip its key, text and colour.")
    chosen = param.List(default=[], doc="Key of the chip that was pressed, and when.")
    removed = param.List(default=[], doc="Key of the chip that was removed, and when.")

    _esm = Path(__file__).with_name("chips.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("chips.css")]


class PixelKeys(Component):
    """Holds a picture that takes the keyboard: arrow keys move the pixel, with Shift by eight.

    Without a picture it gives the keyboard to the column in which it stands. Plots that come to a
    page already drawn must stand in columns alone: Bokeh would lay out those within an ESM
    component before they are there.
    """

    child = Child()
    pixel = param.List(default=[0, 0], item_type=int, doc="Row and column.")
    shape = param.List(default=[1, 1], item_type=int, doc="Rows and columns of the image.")
    label = param.String(
        default="Range image. Arrow keys move the pixel on show, with Shift by eight.",
        doc="What a screen reader says of the picture.",
    )
    letters = param.String(default="", doc="Further keys that are reported.")
    pressed = param.List(default=[], doc="The letter that was pressed, and when.")

    _busy__ignore: ClassVar = ["pixel"]  # as of a knob

    _esm = """
    export function render({ model, el }) {
      const frame = document.createElement("div");
      if (model.child) {
        frame.style.cssText = "width: 100%; height: 100%; display: flex; border-radius: 6px";
        frame.append(model.get_child("child"));
        listen(model, frame);
      } else {
        const outside = (node) => node.getRootNode().host;
        const find = () => {
          const column = outside(el) && outside(outside(el));
          column ? listen(model, column) : requestAnimationFrame(find);
        };
        find();
      }
      return frame;
    }

    function listen(model, root) {
      root.tabIndex = 0;
      root.dataset.part = "image";
      root.setAttribute("role", "application");
      const describe = () => root.setAttribute("aria-label", model.label);
      model.on("label", describe);
      describe();
      const moves = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
      root.addEventListener("keydown", (event) => {
        const [move, letter] = [moves[event.key], event.key.toLowerCase()];
        const isBare = !(event.ctrlKey || event.metaKey || event.altKey);
        if (letter.length === 1 && model.letters.includes(letter) && isBare) {
          model.pressed = [letter, Date.now()];
        }
        if (!move) return;
        event.preventDefault();
        const step = event.shiftKey ? 8 : 1;
        model.pixel = model.pixel.map((at, axis) =>
          Math.min(model.shape[axis] - 1, Math.max(0, at + step * move[axis])),
        );
      });
    }
    """
    _stylesheets: ClassVar = ["div:focus-visible { outline: 2px solid #4c8dff }"]
