"""No request runs code, ends the server or causes a traceback."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import panel as pn
import pytest
from bokeh.util.token import get_session_id
from tornado.routing import PathMatches

from app.server.routes import SERVED
from tests.browser import eventually
from tests.crowded import HTTP
from tests.site import empty_site
from tests.wire import token_in

REMOVED = {
    ("/metadata$", "MetadataHandler"),
    ("/autoload.js$", "AutoloadJsHandler"),  # gives a session to any page
    ("/?$", "RootHandler"),
    ("/static/(.*)$", "StaticHandler"),
}
RUN = "/components/{}/x/_css/y"
MARKER = "from pathlib import Path\nPath({!r}).touch()\n"


@pytest.fixture(scope="module")
def marked(tmp_path_factory):
    """A server that finds a module which writes a file when it is run, and that file."""
    folder = tmp_path_factory.mktemp("modules")
    mark = folder / "mark"
    (folder / "leaves_a_mark.py").write_text(MARKER.format(str(mark)))
    with pytest.MonkeyPatch.context() as patched, empty_site(http_limits=HTTP) as site:
        patched.syspath_prepend(folder)
        yield site, mark


@pytest.fixture
def server(marked):
    return marked[0]


def routes(server) -> Iterator[tuple[str, type]]:
    for rule in server._tornado.wildcard_router.rules:
        assert isinstance(rule.matcher, PathMatches)
        yield rule.matcher.regex.pattern, rule.target


def test_every_route_of_the_libraries_is_known():
    options = {"port": 0, "show": False, "start": False, "verbose": False}
    server = pn.serve({"/": pn.Column}, **options)
    found = {(path, handler.__name__) for path, handler in routes(server)}
    server.stop()
    assert found == {(path, handler.__name__) for path, handler in SERVED} | REMOVED


@pytest.mark.parametrize("module", ["unittest.__main__", "this", "leaves_a_mark", "..", "", "core"])
@pytest.mark.parametrize("site", [None, "cross-site"])
def test_an_address_runs_no_module(marked, module, site):
    server, mark = marked
    said = {} if site is None else {"Sec_Fetch_Site": site, "Sec_Fetch_Mode": "no-cors"}
    status, _, text = server.ask(RUN.format(module), **said)
    assert status == (404 if site is None else 403)
    assert "Traceback" not in text
    assert not mark.exists()
    assert server.ask("/favicon.ico")[0] == 200


@pytest.mark.parametrize(
    "path",
    [
        "/components/app.server.routes/ComponentFiles/_css/x",
        "/components/app.widgets.connection/Connection/_stylesheets/../__init__.py",
        "/components/app.widgets.connection/Connection/__init__/x",
        "/components/app.widgets.connection/Connection/_stylesheets",
        "/components/app.widgets.connection/Connection/modifiers/",
        "/components/app.widgets.connection/Nothing/_stylesheets/connection.css",
    ],
)
def test_only_files_of_components_are_served(server, path):
    file = "/components/app.widgets.connection/Connection/_stylesheets/connection.css"
    assert server.ask(file)[0] == 200
    status, _, text = server.ask(path)
    assert 400 <= status < 500
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("HEAD", "/"),
        ("PUT", "/"),
        ("POST", "/"),
        ("TRACE", "/"),
        ("NONSENSE", "/"),
        ("GET", "/%"),
        ("GET", "/%00"),
        ("GET", "/no/such/page"),
        ("GET", "/" + "%41" * 10_000),
        ("GET", "/static/..%2f..%2f..%2fetc/passwd"),
        ("GET", "/static/%00"),
        ("GET", "/static/js/bokeh.min.js%00"),
        ("GET", "/static/extensions/panel/%0a"),
        ("GET", "/components/.."),
        ("GET", "/components/../../x/y"),
        ("GET", "/autoload.js?bokeh-autoload-element=1"),
        ("GET", "/metadata"),
        ("GET", "/ws"),
    ],
)
def test_other_requests_are_refused_without_a_traceback(server, caplog, method, path):
    status = server.ask(path, method)[0]
    assert 400 <= status < 500
    assert server.ask("/favicon.ico")[0] == 200
    assert f"{status} {method} {path}" in caplog.text
    assert "Traceback" not in caplog.text


MALFORMED = {
    "two hosts": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nHost: evil.example\r\n\r\n",
    "a name with a space": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nA b: c\r\n\r\n",
    "negative length": b"POST / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nContent-Length: -1\r\n\r\n",
    "a chunk of 2**63 bytes": b"POST / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n8000000000000000\r\n",
    "headers of 100 kB": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nX: "
    + b"x" * 100_000
    + b"\r\n\r\n",
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_requests_are_refused_without_a_traceback(server, caplog, name):
    with socket.create_connection(("127.0.0.1", server.port), timeout=60) as link:
        link.sendall(MALFORMED[name].replace(b"%d", str(server.port).encode()))
        try:
            first = link.makefile("rb").readline()
        except ConnectionError:
            first = b""
    assert first == b"" or 400 <= int(first.split()[1]) < 500
    assert server.ask("/favicon.ico")[0] == 200
    assert "Traceback" not in caplog.text


@pytest.mark.parametrize("query", ["bokeh-session-id=", "bokeh-session-id=a%20b", "bokeh-token=a"])
def test_a_session_invented_by_an_address_is_ignored(server, caplog, query):
    status, _, text = server.ask(f"/?{query}")
    assert status == 200
    assert get_session_id(token_in(text)) != "a b"
    assert "Traceback" not in caplog.text


def test_only_its_own_page_returns_to_a_session(server):
    named = get_session_id(token_in(server.ask()[2]))

    def returned(session, **said):
        text = server.ask(f"/?bokeh-session-id={session}", **said)[2]
        return get_session_id(token_in(text)) == session

    own = f"http://127.0.0.1:{server.port}/"
    assert returned(named, Referer=own)
    assert not returned(named)
    assert not returned(named, Referer="http://evil.example.com/")
    assert not returned("x" * 44, Referer=own)


@pytest.mark.browser
def test_a_foreign_page_can_neither_load_from_here_nor_connect(browser, marked, caplog):
    """A real page on another origin: an image, a script, a stylesheet and a socket."""
    caplog.set_level(logging.WARNING, "tornado.access")  # an import of Dask's cluster silences it
    (server, mark), path = marked, RUN.format("leaves_a_mark")
    port = server.port
    asked = f"http://127.0.0.1:{port}{path}"
    content = f"""<!DOCTYPE html><img src="{asked}"><script src="{asked}"></script>
    <link rel="stylesheet" href="{asked}"><a id="here" href="http://127.0.0.1:{port}/">here</a>
    <script>
      const socket = new WebSocket("ws://127.0.0.1:{port}/ws", ["bokeh", "x"]);
      socket.onopen = () => document.title = "open";
      socket.onerror = () => document.title = "refused";
    </script>"""

    class Foreign(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(content.encode())

        def log_message(self, *_):
            pass

    foreign = ThreadingHTTPServer(("127.0.0.1", 0), Foreign)
    Thread(target=foreign.serve_forever, daemon=True).start()
    page = browser.contexts[0].new_page()
    page.goto(f"http://localhost:{foreign.server_port}/")
    eventually(lambda: page.title() == "refused")
    eventually(lambda: caplog.text.count(f"403 GET {path}") == 3)
    assert not mark.exists()
    with page.expect_navigation(wait_until="commit") as welcome:
        page.click("#here")
    assert welcome.value.status == 200
    page.close()
    foreign.shutdown()
    foreign.server_close()
