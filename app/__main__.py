"""Serve the app: ``python -m app [capture files]``."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

import panel as pn

import core
from app import latency
from app.connection import LINGER_S, serving_options
from app.layout import build_page
from app.state import Light, Reading
from app.store import built_in_sources, file_source
from app.uploads import MAX_UPLOAD_BYTES, Uploads
from core.readers import READERS


def main(arguments: list[str] | None = None) -> int:
    """Serve until interrupted; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m app", description=__doc__)
    parser.add_argument(
        "captures", nargs="*", type=Path, help=f"capture files to open ({', '.join(READERS)})"
    )
    parser.add_argument("--port", type=int, default=5006, help="default: 5006")
    parser.add_argument("--address", default="127.0.0.1", help="default: this machine only")
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
            print(source.load(Light(), Reading(), ()).source, flush=True)
        except core.CaptureError as error:
            parser.error(str(error))
    sources, uploads = given | built_in_sources(), Uploads()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # uploads are removed then, too
    print("Compiling what is not compiled yet ...", flush=True)
    core.warm_up()
    latency.tune()
    pn.extension("vtk")
    print(f"Open http://{chosen.address}:{chosen.port} in a browser; Ctrl+C stops.", flush=True)
    pn.serve(
        {"/": lambda: build_page(sources, uploads)},
        port=chosen.port,
        address=chosen.address,
        websocket_origin=[f"{host}:{chosen.port}" for host in {chosen.address, "localhost"}],
        websocket_max_message_size=2 * MAX_UPLOAD_BYTES,
        show=chosen.show,
        title="firstphoton",
        verbose=False,
        **serving_options(chosen.linger),
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
