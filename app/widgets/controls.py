"""Controls made from the metadata of frozen dataclasses, and small components of text and values.

Our own components where panel-material-ui 0.16 and Panel 1.9 are worse for a person:

- `Knob`: their sliders have no logarithmic track and no marked zones; a move was painted after 90
  to 140 ms, with a native input after 76 to 81.
- `Facts`: only the browser knows when it has painted.
- `Table`: Tabulator's headers cannot be sorted by keyboard, and it loads 443 kB of script.
- `Chips`: their Chip has no button that removes it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import Field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import panel as pn
import param
from panel.custom import Child

from app.units import Scale
from app.widgets.cards import part, select
from app.widgets.component import Component, script
from core.parameters import Number, joint_doubts, spec_of

Settings = TypeVar("Settings")


class Knob(Component):
    """A number with a slider, a text field, its unit, help and a reset.

    Unreliable values are marked on the slider; while one of them is set, a sentence says why. Only
    values between `low` and `high` can be set; the field refuses others with a sentence. An
    optional number has no slider, unless its substitute is known; an empty field stands for None.

    A position along the gate is shown and typed in the unit of a `Scale`; the value itself, and its
    bounds, remain in bins or in shares of the gate.

    The `EditableFloatSlider` of panel-material-ui 0.16 follows a drag as fast, but it has no
    logarithmic track, and its marks are points, not zones.
    """

    value = param.Number(default=None)  # Panel does not send None to a new model
    initial = param.Number(default=None, doc="Value set by the reset button.")
    low = param.Number(default=0.0)
    high = param.Number(default=1.0)
    log = param.Boolean(default=False)
    whole = param.Boolean(default=False)
    optional = param.Boolean(default=False, doc="Whether the field may be empty.")
    empty = param.String(default="automatic", doc="Meaning of an empty field.")
    substitute = param.Number(default=None, doc="Number for which an empty field stands.")
    label = param.String(default="")
    unit = param.String(default="")
    along = param.List(
        default=[0.0, 1.0, None],
        doc="Number shown for the value 0, change of it for 1, and decimals; None for all of them.",
    )
    parts = param.Integer(default=0, doc="Parts of 1 to which values are rounded; 0 for none.")
    help = param.String(default="")
    doubtful = param.List(default=[], doc="Zones of unreliable values: low, high, and why.")

    # Panel would mark all pages of the server as busy with each move.
    _busy__ignore: ClassVar = ["value"]

    _esm = Path(__file__).with_name("knob.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("knob.css")]

    @classmethod
    def of(cls, spec: Number, value: float | None, help: str) -> Knob:
        """Return the knob of a field."""
        return cls(
            value=value,
            initial=value,
            low=spec.low,
            high=spec.high,
            log=spec.log,
            whole=spec.whole,
            parts=int(spec.whole),
            optional=spec.optional,
            empty=spec.none_means,
            label=spec.symbol,
            unit=spec.unit,
            help=help,
            doubtful=_zones(spec),
            sizing_mode="stretch_width",
            margin=(0, 8, 2, 8),
        )

    @classmethod
    def of_field(cls, settings: Any, name: str) -> Knob:
        """Return the knob of a numeric field of a settings object."""
        (field,) = (each for each in fields(settings) if each.name == name)
        spec = spec_of(field)
        assert isinstance(spec, Number)
        return cls.of(spec, getattr(settings, name), field.metadata["help"])

    def follow(self, along: Scale, n_bins: int = 1) -> None:
        """Show edges of bins in a unit; the values are shares of `n_bins`, or bins by default."""
        self.unit, self.parts = along.name, n_bins
        self.along = [along.origin, along.step * n_bins, along.edge_decimals]


# As in knob.css.
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

    Attributes
    ----------
    settings : dataclass
        What the controls show.
    """

    def __init__(self, settings: Settings, changed: Callable[[Settings], None]) -> None:
        self.settings = settings
        self._changed = changed
        self._silent = False
        self._doubts_hold = True
        # About combinations of settings; each knob reports its own unreliable values.
        self.doubts = Sentence(
            live=True, stylesheets=[DOUBT], sizing_mode="stretch_width", margin=(0, 8, 4, 8)
        )
        self.doubts.text = " ".join(joint_doubts(settings))
        self.controls: dict[str, Any] = {
            field.name: _control(field, getattr(settings, field.name))
            for field in fields(settings)  # type: ignore[arg-type]
        }
        for control in self.controls.values():
            control.param.watch(self._collect, "value")

    @property
    def layout(self) -> pn.Column:
        """All controls in the order of the fields, and a sentence on unreliable combinations."""
        return self.without()

    def without(self, *names: str) -> pn.Column:
        """Return the layout without some controls, which stand elsewhere."""
        kept = (each for name, each in self.controls.items() if name not in names)
        return pn.Column(*kept, self.doubts, sizing_mode="stretch_width", margin=0)

    def folded(self, title: str, *names: str, is_open: bool = False) -> pn.Column:
        """Return the layout with some controls in a part that folds, below the others."""
        rare = part(title, *(self.controls[name] for name in names), is_open=is_open)
        return pn.Column(self.without(*names), rare, sizing_mode="stretch_width", margin=0)

    def show(self, settings: Settings) -> None:
        """Set every control without reporting a change."""
        self._silent = True
        try:
            for name, control in self.controls.items():
                value = getattr(settings, name)
                if control.value != value:  # setting an equal value costs more than comparing
                    control.value = value
        finally:
            self._silent = False
        self._accept(settings)

    def mark_doubts(self, hold: bool) -> None:
        """Mark unreliable values, and explain them, if the zones hold for the data on screen."""
        if hold == self._doubts_hold:
            return
        self._doubts_hold = hold
        for field in fields(self.settings):  # type: ignore[arg-type]
            spec = spec_of(field)
            if isinstance(spec, Number):
                self.controls[field.name].doubtful = _zones(spec) if hold else []
        self._accept(self.settings)

    def _collect(self, _event: param.parameterized.Event) -> None:
        if self._silent:
            return
        values = {
            name: round(control.value) if getattr(control, "whole", False) else control.value
            for name, control in self.controls.items()
        }
        try:
            settings = replace(self.settings, **values)  # type: ignore[type-var]
        except ValueError as error:  # values that exclude each other
            text = str(error)
            for name, control in self.controls.items():
                text = re.sub(rf"\b{name}\b", control.label, text)
            self.doubts.text = text
            return
        self._accept(settings)
        self._changed(settings)

    def _accept(self, settings: Settings) -> None:
        self.settings = settings
        self.doubts.text = " ".join(joint_doubts(settings)) if self._doubts_hold else ""


def _zones(spec: Number) -> list[list[Any]]:
    return [[zone.low, zone.high, zone.why] for zone in spec.doubtful]


def _control(field: Field[Any], value: Any) -> Any:
    spec, help = spec_of(field), field.metadata["help"]
    if isinstance(spec, Number):
        return Knob.of(spec, value, help)
    return select(spec.symbol, list(spec.options), value, help)


HEADLINE_PX, FACTS_PX, LINE_PX, KNOB_PX = 37, 32, 17, 46
"""Heights of timed facts, of a row of others, a sentence and a slider; reserved from the start."""


class Facts(Component):
    """A list of named values; an update does not make the browser lay out the page again."""

    facts = param.List(default=[], doc="Name, value and one line of help, each a string.")
    leading = param.Boolean(default=False, doc="Whether the first value is written large.")
    timed = param.Boolean(default=False, doc="Whether to add the times that drawing took.")

    _esm = Path(__file__).with_name("facts.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("facts.css")]


class Table(Component):
    """A table of numbers; its column headers are buttons that sort the rows."""

    title = param.String(default="", doc="Name of the table for screen readers.")
    columns = param.List(default=[], doc="Title, line of help, and 1 or -1: the first direction.")
    rows = param.List(
        default=[],
        doc="""A dict for each row: ``name``, ``note`` below it, ``color`` and ``dash`` of its line,
        ``cells`` of text, value to sort by and a smaller second line, a ``message`` in place of
        cells, and ``last``: whether it stays below the others. A row with an ``action`` has a
        button of that name, which reports the row's ``key``.""",
    )
    acted = param.List(default=[], doc="Key of the row whose button was pressed, and when.")

    _esm = script("table.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("table.css")]


NARROW_TABLE = "tbody th { min-width: 0; } td { padding-left: 0; }"
"""Style of tables that are as wide as the sidebar."""


class Sentence(Component):
    """Plain text: a file's name, say, is never interpreted as HTML."""

    text = param.String(default="")
    warning = param.Boolean(default=False, doc="Whether it reports an error.")
    live = param.Boolean(default=False, doc="Whether screen readers read out each new text.")

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
          font: var(--type-size, 12px)/1.4 var(--mui-font-family, Roboto, system-ui, sans-serif);
          color: var(--mui-palette-text-primary, #1c2430);
        }
        .note { display: var(--note-display, block); }
        .warning {
          font-size: 14px; margin: 4px 0; padding: 8px 12px; border-radius: 4px;
          border: 1px solid #ed6c02; border-left-width: 6px;
        }
        """
    ]


def legend_line() -> Sentence:
    """Return the line below an image that says what is hidden in it."""
    # Room for two lines from the start: the image keeps its size.
    return Sentence(min_height=2 * LINE_PX, sizing_mode="stretch_width", margin=(0, 8, 4, 8))


class Chips(Component):
    """Coloured labels, each with a button that selects it and one that removes it."""

    label = param.String(default="", doc="Name of the list for screen readers.")
    chips = param.List(default=[], doc="Key, text and colour of each chip.")
    chosen = param.List(default=[], doc="Key of the chip that was pressed, and when.")
    removed = param.List(default=[], doc="Key of the chip that was removed, and when.")

    _esm = script("chips.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("chips.css")]


class PixelKeys(Component):
    """Make a picture focusable: arrow keys move the pixel, with Shift by eight.

    Without a child, the column in which this component stands becomes focusable. Plots that are
    already rendered when they reach a page need such a column: Bokeh would lay out those inside an
    ESM component before they are attached.
    """

    child = Child()
    pixel = param.List(default=[0, 0], item_type=int, doc="Row and column.")
    shape = param.List(default=[1, 1], item_type=int, doc="Rows and columns of the image.")
    label = param.String(
        default="Range image. Arrow keys move the selected pixel, with Shift by eight.",
        doc="Name of the picture for screen readers.",
    )
    letters = param.String(default="", doc="Further keys to report.")
    pressed = param.List(default=[], doc="The letter that was pressed, and when.")

    _busy__ignore: ClassVar = ["pixel"]  # as for a knob

    _esm = """
    export function render({ model, el }) {
      const frame = document.createElement("div");
      if (model.child) {
        frame.style.cssText = "width: 100%; height: 100%; display: flex; border-radius: 6px";
        frame.append(model.get_child("child"));
        listen(model, frame);
      } else {
        const host = (node) => node.getRootNode().host;
        const find = () => {
          const column = host(el) && host(host(el));
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
