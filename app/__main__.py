"""Serve the app: ``python -m app [capture files]``.

By default only this machine can connect. With another --address, --origin must name the host that
browsers use, and every browser needs the token in the printed link. Set FIRSTPHOTON_TOKEN in the
environment to choose it (other users of the machine can see command lines). Traffic is not
encrypted: use a trusted network, or ssh -L.
"""

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import sys
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from threading import Thread
from typing import Any

import panel as pn
from tornado.ioloop import IOLoop, PeriodicCallback

import core
from app import THRESHOLD
from app.model import text
from app.model.lessons import Lesson, add_lessons_option, read_lessons
from app.model.store import (
    Source,
    built_in_sources,
    content_key,
    file_source,
    is_ambiguous,
)
from app.model.truth import with_chosen_truth
from app.model.uploads import Uploads
from app.model.watched import LOOK_MS, WatchedFolder
from app.pages.layout import Arrivals, build_page
from app.server import garbage
from app.server.access import TOKEN_VARIABLE, Access
from app.server.patches import apply_patches, scripts
from app.server.ports import free_port, port_number
from app.server.serve import server_of
from app.server.tuning import tune
from app.tasks.scheduler import STUDIES
from app.widgets.connection import LINGER_S
from app.widgets.controls import Sentence
from core.io import (
    SUFFIXES,
    TRUTH_OPTIONS,
    ReadOptions,
    add_read_options,
    add_truth_options,
    read_options_from,
    truth_options_from,
    with_flags,
)

log = logging.getLogger(__name__)

FREEZE_AFTER_S = 1.0
"""Time after a page is built until its objects are frozen: its browser draws it then."""


def main(arguments: list[str] | None = None) -> int:
    """Serve until interrupted; return the exit code."""
    parser = parser_of_arguments()
    chosen = parser.parse_args(arguments)
    try:
        options = read_options_from(chosen)
        if not chosen.captures and chosen.watch is None:
            truth_options_from(chosen, None)
        add_truth = partial(with_chosen_truth, chosen)
        lessons = read_lessons(chosen.lessons)
        files = readable(chosen.captures, options, add_truth)
        watched = None if chosen.watch is None else WatchedFolder(chosen.watch, options, add_truth)
    except ValueError as error:
        parser.error(with_flags(str(error), *TRUTH_OPTIONS))
    newest = None if watched is None else watched.look()
    # Files come first: the page opens on the first source.
    sources = {**(newest.found if newest else {}), **files, **built_in_sources()}
    uploads = Uploads()
    arrivals = None if watched is None else Arrivals()
    if arrivals is not None and newest is not None:
        arrivals.emit(newest)
    pn.extension("vtk")
    try:
        port = chosen.port or free_port(chosen.address)
        scripts()  # raises for unknown names of patches
        token = os.environ.get(TOKEN_VARIABLE, "").strip() or None
        access = Access.of(chosen.address, port, chosen.origin, token)
        server = server_of(
            # Panel would draw a partial as an object.
            lambda: page_for(sources, uploads, arrivals, lessons),
            access,
            chosen.address,
            port,
            chosen.linger,
        )
    except ValueError as error:
        parser.error(str(error))
    except OSError as error:
        print(f"Cannot serve at {chosen.address}, port {chosen.port}: {error.strerror}.")
        print("Choose another --port, or --port 0 for a free one.")
        return 1
    # An exception raised at an arbitrary place can be lost: handle SIGTERM like Ctrl+C, for which
    # Panel stops the loop below.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    with ended_at_once():
        prepare()
    link = access.link(chosen.origin[0] if chosen.origin else chosen.address, port)
    print(f"Open {link} in a browser; Ctrl+C stops.", flush=True)
    if chosen.show:
        server.io_loop.add_callback(webbrowser.open, link)
    server.start()
    Thread(target=core.warm_up, name="compiler", daemon=True).start()
    if watched is not None and arrivals is not None:
        PeriodicCallback(partial(look, watched, sources, arrivals), LOOK_MS).start()
    server.io_loop.start()  # until Ctrl+C
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a second Ctrl+C exits at once
    server.stop()
    STUDIES.is_closed = True
    return 0


@contextmanager
def ended_at_once() -> Iterator[None]:
    """Let Ctrl+C and SIGTERM end the process at once.

    Panel's handler ends a loop, which has not begun while kernels are compiled: that may take
    minutes.
    """
    handlers = {
        each: signal.signal(each, signal.SIG_DFL) for each in (signal.SIGINT, signal.SIGTERM)
    }
    yield
    for each, handler in handlers.items():
        signal.signal(each, handler)


def prepare() -> None:
    """Prepare this process for serving: compile what the first page shows, and leave the rest."""
    core.warm_up(say_compiled, only="tracking")
    tune()
    apply_patches()
    garbage.freeze_all()
    gc.set_threshold(*THRESHOLD)
    gettempdir()  # is chosen by writing to it: on a full disk, Python would find no folder at all


def say_compiled(done: int, of: int) -> None:
    """Draw a progress bar of what `core.warm_up` has compiled."""
    end = "\n" if done == of else ""
    print(f"\rCompiling kernels that are not cached [{'#' * done:<{of}}]", end=end, flush=True)


def parser_of_arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="firstphoton" if Path(sys.argv[0]).stem == "firstphoton" else "python -m app",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "captures",
        nargs="*",
        type=Path,
        help=f"capture files to open ({', '.join(SUFFIXES)}); a quoted pattern such as "
        "'run_*.npz' opens all that match as one sequence in time",
    )
    parser.add_argument(
        "--port", type=port_number, default=5006, help="default: 5006; 0 chooses a free one"
    )
    parser.add_argument("--address", default="127.0.0.1", help="default: this machine only")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="HOST[:PORT]",
        help="host that browsers use to reach --address; may be repeated",
    )
    parser.add_argument("--version", action="version", version=f"firstphoton {core.__version__}")
    parser.add_argument("--show", action="store_true", help="open a browser")
    parser.add_argument(
        "--linger",
        type=float,
        default=LINGER_S,
        metavar="SECONDS",
        help="time for which a closed or disconnected page is kept (default: %(default)s)",
    )
    parser.add_argument(
        "--watch",
        type=Path,
        metavar="FOLDER",
        help="open each capture that is written to this folder, beginning with the newest there",
    )
    add_lessons_option(parser)
    add_truth_options(parser)
    add_read_options(parser)
    return parser


def readable(
    paths: Sequence[Path],
    options: ReadOptions,
    change: Callable[[Source], Source] = lambda source: source,
) -> dict[str, Source]:
    """Return the files that can be read, by their key, and report the others.

    Last come the files of which the user must choose an array: the page asks for it.

    Parameters
    ----------
    paths : sequence of Path
    options : ReadOptions
    change : callable, optional
        Returns the source of a capture to serve in place of the one that was read.

    Raises
    ------
    ValueError
        If none can be read.
    """
    found: dict[str, Source] = {}
    asked: dict[str, Source] = {}
    refused: list[ValueError] = []
    for path in paths:
        try:
            source = change(file_source(path, given=options, shared=True))
            print(source.read().source, flush=True)
            found[content_key(path)] = source
        except ValueError as error:  # unreadable, too large, or of several arrays
            if is_ambiguous(error):
                asked[content_key(path)] = source
                _report(f"The page asks: {error}")
            else:
                refused.append(error)
    if refused and not (found or asked):
        raise ValueError("\n".join(map(str, refused)))
    for why in refused:
        _report(f"Not opened: {why}")
    return found | asked


def _report(why: str) -> None:
    print(with_flags(why, *TRUTH_OPTIONS), file=sys.stderr, flush=True)


async def look(watched: WatchedFolder, sources: dict[str, Source], arrivals: Arrivals) -> None:
    """Offer captures that have just been written to all pages, open ones and later ones."""
    arrival = await IOLoop.current().run_in_executor(None, watched.look)
    if arrival is not None:
        arrival.update(sources)
        arrivals.emit(arrival)


def page_for(
    sources: Mapping[str, Source],
    uploads: Uploads,
    arrivals: Arrivals | None = None,
    lessons: Mapping[str, Lesson] | None = None,
) -> Any:
    """Return the page of a new session, or a sentence if it cannot be built."""
    if pn.state.curdoc is not None:
        pn.state.curdoc.template_variables["scripts"] = scripts()
        freeze_later = partial(IOLoop.current().call_later, FREEZE_AFTER_S, garbage.freeze_all)
        pn.state.onload(freeze_later)
    try:
        return build_page(sources, uploads, arrivals, lessons)
    except Exception:
        log.exception("could not build a page")
        return Sentence(text=text.NO_PAGE, warning=True)


if __name__ == "__main__":
    sys.exit(main())
