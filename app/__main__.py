"""Serve the app: ``python -m app [capture files]``.

Only this machine reaches it, unless --address says otherwise. Then --origin must name the host
that browsers will show, and everyone needs the token in the link that is printed; to choose it
yourself, set FIRSTPHOTON_TOKEN in the environment (a command line is seen by all who are on the
machine). What is sent over a network is not encrypted: keep to your own, or go by ssh -L.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import panel as pn

import core
from app.model import text as words
from app.model.state import Illumination
from app.model.store import Source, built_in_sources, file_source
from app.model.uploads import Uploads
from app.pages.layout import build_page
from app.server import garbage as collector
from app.server.access import TOKEN_VARIABLE, Access
from app.server.patches import apply_patches, scripts
from app.server.ports import free_port, port_number
from app.server.serve import server_of
from app.server.tuning import tune
from app.tasks.scheduler import STUDIES
from app.widgets.connection import LINGER_S
from app.widgets.controls import Sentence
from core.io import SUFFIXES, ReadOptions

log = logging.getLogger(__name__)


def main(arguments: list[str] | None = None) -> int:
    """Serve until interrupted; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="firstphoton" if Path(sys.argv[0]).stem == "firstphoton" else "python -m app",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "captures", nargs="*", type=Path, help=f"capture files to open ({', '.join(SUFFIXES)})"
    )
    parser.add_argument(
        "--port", type=port_number, default=5006, help="default: 5006; 0 takes a free one"
    )
    parser.add_argument("--address", default="127.0.0.1", help="default: this machine only")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="HOST[:PORT]",
        help="how browsers reach an --address that others reach; more than one is possible",
    )
    parser.add_argument("--version", action="version", version=f"firstphoton {core.__version__}")
    parser.add_argument("--show", action="store_true", help="open a browser")
    parser.add_argument(
        "--linger",
        type=float,
        default=LINGER_S,
        metavar="SECONDS",
        help="for how long a page that is closed or cut off is kept (default: %(default)s)",
    )
    chosen = parser.parse_args(arguments)
    # The files given come first: the page opens on them.
    given = {f"path {n}": file_source(p, shared=True) for n, p in enumerate(chosen.captures)}
    for source in given.values():
        try:
            print(source.load(Illumination(), ReadOptions(), ()).source, flush=True)
        except ValueError as error:  # unreadable, or more than is held as a whole
            parser.error(str(error))
    sources, uploads = given | built_in_sources(), Uploads()
    pn.extension("vtk")
    try:
        port = chosen.port or free_port(chosen.address)
        scripts()  # refuses unknown names of patches
        token = os.environ.get(TOKEN_VARIABLE, "").strip() or None
        access = Access.of(chosen.address, port, chosen.origin, token)
        server = server_of(
            lambda: page_for(sources, uploads), access, chosen.address, port, chosen.linger
        )
    except ValueError as error:
        parser.error(str(error))
    except OSError as error:
        print(f"Cannot serve at {chosen.address}, port {chosen.port}: {error.strerror}.")
        print("Give another --port, or --port 0 for any that is free.")
        return 1
    # An exit that is raised wherever the thread happens to be can be lost there: like Ctrl+C, by
    # Panel, this ends the loop below.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    print("Compiling what is not compiled yet ...", flush=True)
    core.warm_up()
    tune()
    apply_patches()
    collector.spare()
    link = access.link(chosen.origin[0] if chosen.origin else chosen.address, port)
    print(f"Open {link} in a browser; Ctrl+C stops.", flush=True)
    if chosen.show:
        server.io_loop.add_callback(webbrowser.open, link)
    server.start()
    server.io_loop.start()  # until Ctrl+C
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the next waits for nothing
    server.stop()
    STUDIES.is_closed = True
    return 0


def page_for(sources: Mapping[str, Source], uploads: Uploads) -> Any:
    """The page of a new session, or a sentence where it cannot be built."""
    if pn.state.curdoc is not None:
        pn.state.curdoc.template_variables["scripts"] = scripts()
        pn.state.onload(collector.spare)
    try:
        return build_page(sources, uploads)
    except Exception:
        log.exception("a page could not be built")
        return Sentence(text=words.NO_PAGE, warning=True)


if __name__ == "__main__":
    sys.exit(main())
