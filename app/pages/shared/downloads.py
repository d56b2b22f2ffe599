"""Downloads of what is on screen: a button for each card, file names, and contents.

Files are made on demand. The browser makes pictures of plots and clouds as it shows them, with
heading, colour scale and description. A worker writes other files, pictures of images among them,
to a temporary file, which is sent in pieces, so that other messages pass in between, and then
deleted.

The menu is our own: that of panel-material-ui 0.16 (`MenuButton`) announces to screen readers
neither that it is a menu nor whether it is open, and loses the keyboard focus while a file is
prepared.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any, BinaryIO, cast

import panel as pn
import param

import core
from app.model import download_text
from app.model.colors import doubt
from app.model.exports import Write, image_files, report_file
from app.model.state import ALL, Crop, Viewing
from app.model.store import Answer, Request
from app.pages.session import Session
from app.tasks.scheduler import FILES
from app.widgets.component import Component
from app.widgets.figures import Layers
from core import inspection
from core.geometry import WHOLE, Box
from core.io import ColorScale, changed_settings, file_name

log = logging.getLogger(__name__)

PIECE_BYTES = 2**20
"""Size of a piece, which is one message."""

PICTURES = ("png", "svg")
"""Formats that the browser makes, unless there is a writer for them."""

PLOT = (*PICTURES, "csv")
IMAGE = (*PLOT, "npz", "tif")
IMAGE_AND_REPORT = (*IMAGE, "html")
CLOUD = ("png", "ply", "las", "laz", "csv")
TABLE = ("csv",)
"""Formats of each kind of card."""

CORNER_PX = 26
"""Height and width of a button."""

CORNER = {"position": "absolute", "top": "1px", "right": "2px", "z-index": "3"}


@dataclass(frozen=True)
class Subject:
    """Capture, estimator and settings that a file is about.

    Parameters
    ----------
    capture : str
        A scene's key, or a file's name without its suffix.
    estimator : str
        Empty for several or none.
    settings : sequence of dataclass
        Settings objects; only fields that differ from their default are named.
    source : str
        Origin of the capture.
    part : str
        Rows and columns of the capture, if not all.
    viewing : Viewing, optional
        Confidence threshold and field of view, described in files; names have those in `settings`.
    box : Box, optional
        Part of the scene, described in files.
    methods : mapping of str to str
        Settings of several estimators, described in files only.
    remark : str
        Why its confidences are unreliable, stated in files.
    """

    capture: str
    estimator: str = ""
    settings: Sequence[Any] = ()
    source: str = ""
    part: str = ""
    viewing: Viewing | None = None
    box: Box | None = None
    methods: Mapping[str, str] = field(default_factory=dict)
    remark: str = ""

    @property
    def chosen(self) -> list[str]:
        """Settings that differ from their default, as ``symbol value`` without the space."""
        return [each for settings in self.settings for each in changed_settings(settings)]

    def file_name(self, what: str, suffix: str) -> str:
        """Return the name of a file about this subject; see `core.io.file_name`."""
        return file_name(
            what,
            suffix,
            capture=self.capture,
            part=self.part,
            estimator=self.estimator,
            settings=self.chosen,
        )

    def lines(self, what: str) -> list[str]:
        """Return the description inside a file: version, method, all settings and source."""
        settings = [each for each in self.settings if not isinstance(each, Viewing | Crop)]
        return [
            f"firstphoton {core.__version__}: {what}",
            *([f"method: {self.estimator}"] if self.estimator else []),
            *(f"settings: {each}" for each in filter(None, (*settings, self.viewing))),
            *([f"box: {self.box}"] if self.box else []),
            *(f"method: {method}; settings: {each}" for method, each in self.methods.items()),
            *([f"source: {' '.join(self.source.split())}"] if self.source else []),
            *([f"remark: {self.remark}"] if self.remark else []),
        ]

    def about(self, what: str) -> str:
        """Return the description inside a picture's file."""
        return "; ".join(self.lines(what))


@dataclass(frozen=True)
class Shown:
    """The present content of a card.

    Parameters
    ----------
    subject : Subject
    what : str
        The plot, image or table that is shown; part of the files' names, except that of a report.
    files : mapping of str to callable
        A writer for each format that the browser does not make, by suffix without the point.
    heading : str
        Heading of a picture without a title.
    scale : ColorScale, optional
        Colour scale of a picture without a colour bar.
    """

    subject: Subject
    what: str
    files: Mapping[str, Write] = field(default_factory=dict)
    heading: str = ""
    scale: ColorScale | None = None


class Download(Component):
    """The button of a card; see `downloadable`."""

    what = param.String(doc="Name of the card's content for screen readers.")
    formats = param.List(doc="Suffix without the point, and a line of help, of each format.")

    # A page has many buttons: the browser fetches the code once, by its address.
    _bundle = Path(__file__).with_name("downloads.js")

    def __init__(
        self, session: Session, what: str, show: Callable[[], Shown], formats: Iterable[str]
    ) -> None:
        super().__init__(what=what, styles=CORNER, margin=0)
        self.offer(formats)
        self._session = session
        self._show = show
        self._work = session.tasks.latest(FILES)
        self._file: IO[bytes] | None = None
        self._name = ""
        self._size = 0

    def offer(self, formats: Iterable[str]) -> None:
        """Offer these formats, by their suffixes without the point."""
        self.formats = [[suffix, download_text.FORMATS[suffix]] for suffix in formats]

    def _handle_msg(self, message: Any) -> None:
        """Handle the browser's request for a format or for the next piece, or its failure."""
        try:
            if "suffix" in message:
                self._begin(message["suffix"])
            elif "from" in message:
                self._send_piece(message["from"])
            elif "failed" in message:
                self._session.failures.show(download_text.no_picture(str(message["failed"])))
        except Exception as error:  # a message may be malformed in many ways
            self._fail(error)

    def _begin(self, suffix: str) -> None:
        if suffix not in [known for known, _ in self.formats]:
            return
        shown = self._show()
        what = "report" if suffix == "html" else shown.what
        self._name = shown.subject.file_name(what, suffix)
        if suffix not in shown.files:
            self._send_msg({"picture": self._picture(shown, suffix)})
        else:
            comments = shown.subject.lines(shown.what) if suffix == "csv" else ()
            write = partial(_written, shown.files[suffix], comments)
            self._work.submit(write, self._send_first, self._fail)

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
        self._session.failures.show(download_text.not_saved(error))
        self._send_msg({"failed": True})

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def _written(write: Write, comments: Iterable[str]) -> IO[bytes]:
    """Write a temporary file, comments first; return it open, at its end. Closing it deletes it."""
    # tifffile requires a file that has a name.
    file = NamedTemporaryFile(prefix="firstphoton-")  # noqa: SIM115 - outlives this function
    try:
        file.write("".join(f"# {comment}\r\n" for comment in comments).encode())
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
        The card of a plot, a cloud or a table.
    session : Session
    what : str
        Name of the content, for the tooltip and screen readers.
    show : callable
        Returns the content when the button is pressed; raises ``ValueError`` where there is none.
    formats : iterable of str
        Suffixes without the point: "png" and "svg", and keys of `Shown.files`.
    """
    card.append(Download(session, what, show, formats))
    return card


def shown_with(card: pn.Column, content: Any, parameter: str) -> pn.Column:
    """Show the download button of a card only while a parameter of its content is not empty."""
    button = card[-1]

    def show(*_: Any) -> None:
        button.visible = bool(getattr(content, parameter))

    content.param.watch(show, parameter)
    show()
    return card


def below(table: Any) -> pn.Column:
    """Return a table with room for a download button above it."""
    table.margin = (CORNER_PX, 0, 0, 0)
    return pn.Column(table, sizing_mode="stretch_width", margin=0)


def downloadable_facts(facts: Any, session: Session, show: Callable[[], Shown]) -> pn.Column:
    """Return named values with a download button beside them."""
    facts.margin = (0, CORNER_PX, 0, 0)
    holder = pn.Column(facts, sizing_mode="stretch_width", margin=0)
    return shown_with(downloadable(holder, session, "numbers", show, TABLE), facts, "facts")


# Contents of cards


def looked_at(session: Session, request: Request) -> Subject:
    """Return the scene or capture of a request as a subject without an estimator."""
    source, window = request.source, request.window
    capture = session.key(source) if source.is_scene else Path(source.title).stem
    absent = "".join(f" without {name}" for name in sorted(request.absent))
    simulated = filter(None, (request.illumination, request.budget)) if source.is_scene else ()
    part = ""
    if window is not None:
        part = _part(*((first, end - 1) for first, end in (window.rows, window.cols)))
    return Subject(capture + absent, settings=(*simulated, request.reduction), part=part)


def _part(rows: tuple[int, int], cols: tuple[int, int]) -> str:
    """Return first and last row and column as `Subject.part`."""
    return "rows{}-{}_cols{}-{}".format(*rows, *cols)


def ranged(session: Session, answer: Answer, estimator: str, settings: Any) -> Subject:
    """Return the subject of an estimate."""
    subject = looked_at(session, answer.request)
    settings = (*subject.settings, settings)
    source, remark = answer.capture.source, doubt(answer)
    return replace(subject, estimator=estimator, settings=settings, source=source, remark=remark)


def explored(session: Session) -> Subject:
    """Return the subject of the session's own estimate."""
    answer = session.answer
    return ranged(session, answer, answer.method, answer.settings)


def viewed(session: Session, subject: Subject, viewing: Viewing) -> Subject:
    """Add confidence threshold and field of view; names state only one that the user has set."""
    described = replace(viewing, field_of_view_deg=session.answer.field_of_view_deg(viewing))
    return replace(subject, settings=(*subject.settings, viewing), viewing=described)


def cropped(session: Session, subject: Subject) -> Subject:
    """Add the box to which the cloud is cropped, if any."""
    crop, box = session.state.crop, session.state.box
    if box == WHOLE:
        return subject
    limits = replace(crop, pixels=ALL)
    part = region_on_show(session) if box.polygon else subject.part
    return replace(subject, settings=(*subject.settings, limits), part=part, box=box)


def pixel_plot(session: Session, plot: Layers, what: str) -> Shown:
    """Return the content of a plot of the session's pixel."""
    return Shown(explored(session), f"{what} {pixel_on_show(session)}", {"csv": plot.csv()})


def pixel_on_show(session: Session) -> str:
    """Return row and column of the session's pixel in its file."""
    row, col = session.answer.grid.place(*session.state.pixel)
    return f"row{row} col{col}"


def region_on_show(session: Session) -> str:
    """Return first and last row and column of the session's region in its file."""
    answer = session.answer
    inside = inspection.pixels_in(session.state.region, answer.capture.shape)
    return _part(*((each.min(), each.max()) for each in answer.grid.place(*inside.nonzero())))


def image_on_show(session: Session, kind: str, figure: Any, what: str) -> Shown:
    """Return the content of an image; `kind` is that of `app.model.exports.image_files`."""
    answer, viewing, subject = session.answer, session.state.viewing, explored(session)
    files = image_files(answer, kind, viewing, figure)
    title = ", ".join(filter(None, (answer.request.source.title, subject.part.replace("_", " "))))
    report = report_file(answer, session.state, title)
    return Shown(viewed(session, subject, viewing), what, files | {"html": report})
