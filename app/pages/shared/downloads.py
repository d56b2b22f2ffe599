"""Taking away what is on screen: a button for each card, the names of files, and what they hold.

Nothing is computed before it is asked for. Pictures are made by the browser, of what it shows;
other files are written by a worker to a temporary file on the disk, which travels in pieces and is
gone once it has arrived.
"""

from __future__ import annotations

import logging
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any, BinaryIO, cast

import panel as pn
import param

from app.model import download_text as words
from app.model.colors import Look
from app.model.exports import Write, image_files, plot_file
from app.model.state import Viewing
from app.model.store import Answer, Request
from app.pages.session import Session
from app.tasks.scheduler import FILES
from app.widgets.component import Component
from core import inspection
from core.parameters import spec_of

log = logging.getLogger(__name__)

PIECE_BYTES = 2**20
"""What travels at once: other messages of the page pass in between."""

PICTURES = ("png", "svg")
"""Formats that the browser makes."""

PLOT = (*PICTURES, "csv")
IMAGE = (*PLOT, "npz", "tif")
CLOUD = ("png", "ply", "las", "csv")
TABLE = ("csv",)
"""Formats of each kind of card."""

MOST_LETTERS = 120
"""In a file's name; some systems take 143 bytes at most."""

CORNER_PX = 26
"""Height and width that a button takes."""

CORNER = {"position": "absolute", "top": "1px", "right": "2px", "z-index": "3"}


@dataclass(frozen=True)
class Subject:
    """What a file is about.

    Parameters
    ----------
    capture : str
        A scene's key, or a file's name without its suffix.
    estimator : str
        Empty where several, or none, have a part in it.
    settings : sequence of dataclass
        Settings as controls are made of; only those that are not the default are told.
    told : str
        Where the capture came from.
    part : str
        Which rows and columns of the capture, if not all.
    """

    capture: str
    estimator: str = ""
    settings: Sequence[Any] = ()
    told: str = ""
    part: str = ""

    @property
    def chosen(self) -> list[str]:
        """Settings that are not the default, as ``symbol value`` without the space."""
        return [
            _told(_symbol(each), _plain(getattr(settings, each.name)))
            for settings in self.settings
            for each in fields(settings)
            if getattr(settings, each.name) != each.default
        ]

    def file_name(self, what: str, suffix: str) -> str:
        """Name of a file, of letters that harm no system and no shell.

        Parameters
        ----------
        what : str
            What the file shows of the subject.
        suffix : str
            Of the format, without the point.
        """
        capture, what = _plain(self.capture)[:40].strip("-._") or "capture", _plain(what)[:40]
        part = f"_{self.part}" if self.part else ""
        room = MOST_LETTERS - len(f"{capture}{part}_{self.estimator}_{what}.{suffix}")
        told = ""
        for each in self.chosen:
            if len(told) + len(each) < room:
                told += f"_{each}"
        method = f"_{self.estimator}" if self.estimator else ""
        return f"{capture}{part}{method}{told}_{what}.{suffix}"

    def about(self, what: str) -> str:
        """What a picture's file says of itself."""
        parts = (self.estimator.replace("_", " "), " ".join(self.chosen), self.told)
        return "; ".join([f"firstphoton: {what}", *filter(None, parts)])


def _plain(value: Any) -> str:
    """Letters without accents, digits, points, dashes and underscores."""
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    ascii_ = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[^\w.+-]+", "-", ascii_).strip("-._")


def _told(symbol: str, value: str) -> str:
    return value if value.startswith(symbol) else symbol + value


def _symbol(of: Any) -> str:
    """A setting's symbol, or its name where that is no short one of plain letters."""
    symbol = spec_of(of).symbol.replace("_", "")
    return symbol if symbol.isascii() and symbol.isalnum() else of.name.replace("_", "-")


@dataclass(frozen=True)
class Shown:
    """What a card shows at the moment, ready to be written.

    Parameters
    ----------
    subject : Subject
    what : str
        What is shown of it; ends up in the files' names.
    files : mapping of str to callable
        What writes each format that is no picture of the screen, by suffix without the point.
    heading : str
        What stands above a picture that tells it nowhere itself.
    scale : Look, optional
        Colours of a picture that has no colour bar of its own.
    """

    subject: Subject
    what: str
    files: Mapping[str, Write] = field(default_factory=dict)
    heading: str = ""
    scale: Look | None = None


class Download(Component):
    """The button of a card; see `downloadable`."""

    what = param.String(doc="What a screen reader says the card shows.")
    formats = param.List(doc="Suffix without the point, and a line of help, of each.")

    # A page has many of these: the browser fetches the code once, by its address.
    _bundle = Path(__file__).with_name("downloads.js")

    def __init__(
        self, session: Session, what: str, show: Callable[[], Shown], formats: Iterable[str]
    ) -> None:
        super().__init__(what=what, styles=CORNER, margin=0)
        self.offer(formats)
        self._session = session
        self._show = show
        self._jobs = session.tasks.latest(FILES)
        self._file: IO[bytes] | None = None
        self._name = ""
        self._size = 0

    def offer(self, formats: Iterable[str]) -> None:
        """Offer these formats, by their suffixes without the point."""
        self.formats = [[suffix, words.FORMATS[suffix]] for suffix in formats]

    def _handle_msg(self, asked: Any) -> None:
        """The browser asks for a format, for the next piece of a file, or tells what failed."""
        try:
            if "suffix" in asked:
                self._begin(asked["suffix"])
            elif "from" in asked:
                self._send_piece(asked["from"])
            elif "failed" in asked:
                self._session.failures.show(words.no_picture(str(asked["failed"])))
        except Exception as error:  # whatever it is, the page must tell it
            self._fail(error)

    def _begin(self, suffix: str) -> None:
        if suffix not in [known for known, _ in self.formats]:
            return
        shown = self._show()
        self._name = shown.subject.file_name(shown.what, suffix)
        if suffix in PICTURES:
            self._send_msg({"picture": self._picture(shown, suffix)})
        else:
            self._jobs.submit(partial(_written, shown.files[suffix]), self._send_first, self._fail)

    def _picture(self, shown: Shown, suffix: str) -> dict[str, Any]:
        scale = shown.scale and {
            "title": shown.scale.legend,
            "low": f"{shown.scale.low:.4g}",
            "high": f"{shown.scale.high:.4g}",
            "colors": shown.scale.colors,
        }
        about = shown.subject.about(shown.what)
        picture = {"suffix": suffix, "name": self._name, "about": about}
        return picture | {"heading": shown.heading, "scale": scale}

    def _send_first(self, file: IO[bytes]) -> None:
        self._close()
        self._file, self._size = file, file.tell()
        self._send_piece(0)

    def _send_piece(self, start: int) -> None:
        if self._file is None:
            return
        self._file.seek(start)
        piece = self._file.read(PIECE_BYTES)
        if start + len(piece) >= self._size:
            self._close()
        self._send_msg({"piece": piece, "size": self._size, "name": self._name})

    def _fail(self, error: Exception) -> None:
        log.warning("a download failed", exc_info=error)
        self._close()
        self._session.failures.show(words.not_saved(error))
        self._send_msg({"failed": True})

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def _written(write: Write) -> IO[bytes]:
    """A file, at its end; gone once it is closed."""
    # tifffile wants a file that has a name.
    file = NamedTemporaryFile(prefix="firstphoton-")  # noqa: SIM115 - outlives this function
    try:
        write(cast(BinaryIO, file))
        file.flush()
        file.seek(0, 2)
    except BaseException:
        file.close()
        raise
    return file


def downloadable(
    card: pn.Column,
    session: Session,
    what: str,
    show: Callable[[], Shown],
    formats: Iterable[str],
) -> pn.Column:
    """Put a download button into the corner of a card.

    Parameters
    ----------
    card : pn.Column
        What holds the plot, the cloud or the table.
    session : Session
        Whose page it is.
    what : str
        What is to be downloaded, for a tooltip and a screen reader.
    show : callable
        What the card shows when the button is pressed; raises ``ValueError`` where that is nothing.
    formats : iterable of str
        Suffixes without the point: "png" and "svg", and keys of `Shown.files`.
    """
    card.append(Download(session, what, show, formats))
    return card


def below(table: Any) -> pn.Column:
    """A table that leaves the corner above it to a download button."""
    table.margin = (CORNER_PX, 0, 0, 0)
    return pn.Column(table, sizing_mode="stretch_width", margin=0)


def downloadable_facts(facts: Any, session: Session, show: Callable[[], Shown]) -> pn.Column:
    """Named values that leave the corner beside them to a download button."""
    facts.margin = (0, CORNER_PX, 0, 0)
    holder = pn.Column(facts, sizing_mode="stretch_width", margin=0)
    return downloadable(holder, session, "numbers", show, TABLE)


# What cards show


def looked_at(session: Session, request: Request) -> Subject:
    """The scene or capture of a request, whatever is made of it."""
    source = request.source
    capture = session.key(source) if source.is_scene else Path(source.title).stem
    absent = "".join(f" without {name}" for name in sorted(request.absent))
    lit = (request.light,) if source.is_scene else ()
    window, part = request.window, ""
    if window is not None:
        part = _part(*((first, behind - 1) for first, behind in (window.rows, window.cols)))
    return Subject(capture + absent, "", (*lit, request.less), part=part)


def _part(rows: tuple[int, int], cols: tuple[int, int]) -> str:
    """First and last row and column of a part, as `Subject` takes them."""
    return "rows{}-{}_cols{}-{}".format(*rows, *cols)


def ranged(session: Session, answer: Answer, estimator: str, settings: Any) -> Subject:
    """An answer of a method with its settings."""
    of = looked_at(session, answer.request)
    told = answer.capture.source
    return replace(of, estimator=estimator, settings=(*of.settings, settings), told=told)


def explored(session: Session) -> Subject:
    """The session's own answer."""
    return ranged(session, session.answer, "tracking", session.answer.request.tracking)


def viewed(session: Session, subject: Subject, viewing: Viewing) -> Subject:
    """An answer's image or cloud, told from which confidence it is shown, and how wide it is seen.

    As wide as suits the capture is not told.
    """
    if viewing.field_of_view_deg == session.own_field_of_view_deg:
        viewing = Viewing(viewing.least_confidence)
    return replace(subject, settings=(*subject.settings, viewing))


def over_the_gate(session: Session, figure: Any, what: str) -> Shown:
    """A plot over the gate of the session's capture."""
    table = plot_file(figure, session.answer.capture.acquisition)
    return Shown(explored(session), what, {"csv": table})


def pixel_plot(session: Session, figure: Any, what: str) -> Shown:
    """A plot of the session's pixel."""
    return over_the_gate(session, figure, f"{what} {pixel_on_show(session)}")


def pixel_on_show(session: Session) -> str:
    """Row and column of the session's pixel, in its file."""
    row, col = session.answer.grid.place(*session.state.pixel)
    return f"row{row} col{col}"


def region_on_show(session: Session) -> str:
    """First and last row and column with pixels of the session's region, in its file."""
    answer = session.answer
    inside = inspection.pixels_in(session.state.region, answer.capture.shape)
    return _part(*((each.min(), each.max()) for each in answer.grid.place(*inside.nonzero())))


def image_on_show(session: Session, kind: str, figure: Any, what: str) -> Shown:
    """An image of the session's answer, as `app.model.exports.image_files` takes it."""
    viewing = session.state.viewing
    files = image_files(session.answer, kind, viewing.least_confidence, figure)
    return Shown(viewed(session, explored(session), viewing), what, files)
