"""The form of options for reading a file, and what a file may ask for: an array, a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.reading import changed_options
from app.model.store import Refused, Source
from app.model.text import cause
from app.widgets.cards import (
    button,
    filled_when_visible,
    part,
    select,
    sent_when_visible,
    typed,
)
from app.widgets.controls import Sentence
from core.io import ReadOptions, reading_options

RECORD_MS = 1500
"""Time between the records of a sequence that is played."""

# Those of panel-material-ui 0.16 are dark in the dark mode, too.
PLAYER_BUTTONS = {"& .MuiIconButton-root:not(.MuiIconButton-colorPrimary)": {"color": "inherit"}}

ALL_RECORDS_HELP = "Add up all records of the file."


class ReadingForm:
    """Fields with the options in use, guesses included; one left as it is stays a guess.

    Parameters
    ----------
    read : callable
        Called with the options that the user chose.
    complain : callable
        Called with a sentence where a text cannot be parsed.

    Attributes
    ----------
    part : Part
        The form as a part of the sidebar.
    question : Column
        A button for each way to read a file that can be read in several, and what the file has.
    player : pmui.Player
        Steps through the records of a file that is a sequence in time.
    records : Column
        The player, and a button that adds up all records.
    """

    def __init__(
        self, read: Callable[[ReadOptions], None], complain: Callable[[str], None]
    ) -> None:
        self._read, self._complain = read, complain
        self._reading, self._shown = ReadOptions(), dict.fromkeys(reading_options(), "")
        self._applied: dict[str, str] = {}
        self._about = Sentence(sizing_mode="stretch_width", margin=(4, 8), visible=False)
        self._fields: dict[str, Any] = {}
        self.part = part("Reading options", is_open=False, is_shown=False)
        filled_when_visible(self.part, self._form)
        self._choices = pn.FlexBox(margin=0)
        self._asked: Source | None = None
        self._details = Sentence(sizing_mode="stretch_width", margin=8)
        self.question = sent_when_visible(
            pn.Column(
                self._choices,
                part("Details", self._details, is_open=False),
                visible=False,
                sizing_mode="stretch_width",
                margin=0,
            )
        )
        self.player = pmui.Player(
            label="Record",
            show_value=True,
            show_loop_controls=False,
            loop_policy="loop",
            interval=RECORD_MS,
            size="small",
            sx=PLAYER_BUTTONS,
            sizing_mode="stretch_width",
            margin=(4, 8),
        )
        self._record = 0
        self.player.param.watch(lambda event: self._step(event.new), "value")
        self._all = button(
            "All records", ALL_RECORDS_HELP, partial(self._read_records, None), (0, 8)
        )
        self.records = sent_when_visible(
            pn.Column(self.player, self._all, visible=False, sizing_mode="stretch_width", margin=0)
        )

    def _form(self) -> list[Any]:
        self._fields = {name: _field(name, shown) for name, shown in self._shown.items()}
        for name, field in self._fields.items():
            if isinstance(field, pmui.TextInput):
                field.param.watch(lambda _: self._apply(), "enter_pressed")
                field.param.watch(partial(self._show_again, name), "value")
        again = pmui.Button(label="Read again", size="small", margin=(6, 8))
        again.on_click(lambda _: self._apply())
        return [self._about, *self._fields.values(), again]

    def show(
        self, reading: ReadOptions, used: Mapping[str, str], n_records: int | None = None
    ) -> None:
        """Show the options of the file on screen; keep what was typed if they are the same."""
        self._asked = None
        self.question.visible = self._about.visible = False
        self._fill(reading, used)
        # With all records it stands at the first one.
        record = reading.records if isinstance(reading.records, int) else None
        self._record, last = record or 0, max((n_records or 1) - 1, 1)
        self.player.param.update(end=last, value=self._record, show_value=record is not None)
        self._all.variant = "outlined" if reading.records is not None else "contained"
        self.records.visible = n_records is not None and n_records > 1

    def show_refused(self, refused: Refused, is_new: bool) -> None:
        """Open for a file that was refused, and offer the ways to read it if there are several.

        They stay until the file can be read: one of them may be refused, too.
        """
        name = refused.request.source.title
        if is_new:
            self._fill(refused.request.reading, {})
        self._about.param.update(text=f"For {name}, which could not be read.", visible=is_new)
        self.part.param.update(visible=True, collapsed=False)
        if refused.choices or refused.request.source is not self._asked:
            self._choices[:] = [self._choice(*each) for each in refused.choices.items()]
            self._asked = refused.request.source
        self._details.text = refused.why
        self.question.visible = bool(self._choices.objects)

    def _choice(self, title: str, options: Mapping[str, str]) -> pmui.Button:
        labels = {name: reading_options()[name].label for name in options}
        given = " and ".join(f"“{labels[name]}” = {value}" for name, value in options.items())
        help = f"{title}: read the file with {given}."
        return button(title, help, partial(self._apply, options), (2, 0, 6, 8))

    def _step(self, record: int) -> None:
        if record != self._record:  # else it is not the user who has moved the player
            self._read_records(record)

    def _read_records(self, records: int | None) -> None:
        self._read(replace(self._reading, records=records))

    def _fill(self, reading: ReadOptions, used: Mapping[str, str]) -> None:
        shown = {name: reading.as_text(name) or used.get(name, "") for name in self._shown}
        if (reading, shown) == (self._reading, self._shown):
            return
        self._reading, self._shown = reading, shown
        self._applied = {name: typed(field) for name, field in self._fields.items()}
        for name, field in self._fields.items():
            field.value = shown[name]

    def _show_again(self, name: str, event: Any) -> None:
        """Show the option in use again, where what was typed for it arrives after the answer.

        Enter arrives before the value that it completes, and a small file is read before that.
        """
        if event.new == self._applied.get(name) and event.new != self._shown[name]:
            self._fields[name].value = self._shown[name]

    def _apply(self, chosen: Mapping[str, str] | None = None) -> None:
        typed_in = {name: typed(field) for name, field in self._fields.items()}
        self._applied = {}
        texts = self._shown | typed_in | dict(chosen or {})
        try:
            self._read(changed_options(self._reading, self._shown, texts))
        except ValueError as error:
            self._complain(cause(error))


def _field(name: str, value: str) -> Any:
    option = reading_options()[name]
    if option.kind.choices:
        choices = {"as guessed": ""} | {each: each for each in option.kind.choices}
        return select(option.label, choices, value, option.help)
    return pmui.TextInput(
        label=option.label,
        value=value,
        description=option.help,
        placeholder="guess",
        size="small",
        sizing_mode="stretch_width",
        margin=(6, 8, 2, 8),
    )
