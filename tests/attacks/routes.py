"""Single requests of this machine, and of foreign pages in a browser on this machine."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count

from tests.attacks.attack import Attack, Outcome, Server, counted
from tests.browser import chromium
from tests.wire import token_in

FROM_A_FOREIGN_PAGE = {
    "Sec-Fetch-Site": "cross-site",
    "Sec-Fetch-Mode": "no-cors",
    "Sec-Fetch-Dest": "image",
}
MARKERS = map("firstphoton_marker_{}".format, count())
"""Names of modules beside the app's that write a file when they are run: Python runs each once."""

ZEN = "Beautiful is better than ugly"
"""What the module ``this`` prints."""


def ask(
    server: Server,
    path: str,
    method: str = "GET",
    body: bytes | None = None,
    limit_s: float = 20.0,
    **headers: str,
) -> tuple[int | str, str]:
    """Status and text of an answer; in place of the status, how the connection ended."""
    link = HTTPConnection("127.0.0.1", server.port, timeout=limit_s)
    try:
        link.request(method, path, body, headers)
        answer = link.getresponse()
        return answer.status, answer.read().decode(errors="replace")
    except TimeoutError:
        return f"no answer within {limit_s:.0f} s", ""
    except (OSError, HTTPException):
        return "closed", ""
    finally:
        link.close()


def is_refusal(status: int | str) -> bool:
    """Whether an answer is a refusal: a client's error, or a connection that is closed."""
    return status == "closed" or (isinstance(status, int) and 400 <= status < 500)


def mark(server: Server) -> str:
    """Put a new marker module where the server finds modules, and return its name."""
    name, target = next(MARKERS), server.folder / "marker.ran"
    target.unlink(missing_ok=True)
    (server.folder / f"{name}.py").write_text(f"open({str(target)!r}, 'w').close()\n")
    return name


def harm(server: Server, since: int) -> str:
    """What a request made the server do, in words; empty if nothing."""
    with suppress(Exception):
        server.process.wait(1.0)  # one that has been ended may take a moment
    log = server.logged(since)
    found = {
        "the server ended": not server.is_alive,
        "the module was run": ZEN in log or (server.folder / "marker.ran").exists(),
        "a traceback in the log": "Traceback" in log,
    }
    return ", ".join(name for name, is_so in found.items() if is_so)


def component(module: str | None, server: Server) -> Outcome:
    """Ask the component route for a module, as this machine and as a foreign page would.

    None stands for a module in the current folder.
    """
    module = module or mark(server)
    since = len(server.logged())
    said: list[int | str] = []
    for headers in ({}, FROM_A_FOREIGN_PAGE):
        for rest in ("x/_css/y", "x/__css__/y", "os/_css/y"):
            if server.is_alive:
                said.append(ask(server, f"/components/{module}/{rest}", **headers)[0])
    harmed = harm(server, since)
    held = not harmed and all(map(is_refusal, said))
    return Outcome(len(said), f"{counted(said)}; {harmed or 'nothing was run'}", held)


ODD = (
    ("HEAD", "/"),
    ("PUT", "/"),
    ("DELETE", "/"),
    ("OPTIONS", "/"),
    ("TRACE", "/"),
    ("NONSENSE", "/"),
    ("GET", "/static/%00"),
    ("GET", "/static/js/bokeh.min.js%00"),
    ("GET", "/static/..%2f..%2f..%2fetc/passwd"),
    ("GET", "/static/extensions/x"),
    ("GET", "/static/extensions/panel/%00"),
    ("GET", "/static/extensions/panel/../../../x"),
    ("GET", "/components/.."),
    ("GET", "/components/../../../../etc/passwd"),
    ("GET", "/components/%00/x/_css/y"),
    ("GET", "/components/.x/x/_css/y"),
    ("GET", "/components/app.widgets.component/Component/_resources"),
    ("GET", "/ws"),
    ("GET", "/autoload.js"),
    ("GET", "/%"),
    ("GET", "/%zz"),
    ("GET", "/%00"),
    ("GET", "/" + "a" * 60_000),
    ("GET", "/" + "%41" * 20_000),
    ("GET", "/no/such/page"),
)
"""Requests for what there is not: none deserves more than a refusal."""

HARMLESS = (
    ("GET", "/?source=%zz"),
    ("GET", "/?source=%ff%fe%00"),
    ("GET", "/?bokeh-session-id="),
    ("GET", "/?" + "x=1&" * 2000),
    ("GET", "/metadata"),
)
"""Requests that may be answered or refused, but must not fail."""


def odd(server: Server) -> Outcome:
    """Methods, paths and queries that no page of the app asks for."""
    wrong = []
    for method, path in (*ODD, *HARMLESS):
        since = len(server.logged())
        status, text = ask(server, path, method)
        fine = is_refusal(status) or (status == 200 and (method, path) in HARMLESS)
        if not fine or "Traceback" in text or "Traceback" in server.logged(since):
            trace = " with a traceback" if "Traceback" in server.logged(since) + text else ""
            wrong.append(f"{method} {path[:30]}: {status}{trace}")
    said = "; ".join(wrong) or "all refused without a traceback"
    return Outcome(len(ODD) + len(HARMLESS), said, not wrong)


RAW = {
    "two hosts": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nHost: evil.example\r\n\r\n",
    "no host": b"GET / HTTP/1.0\r\n\r\n",
    "a name with a space": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nA b: c\r\n\r\n",
    "negative length": b"POST / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nContent-Length: -1\r\n\r\n",
    "two lengths": b"POST / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nContent-Length: 1\r\n"
    b"Content-Length: 2\r\n\r\nx",
    "a chunk of 2⁶³ bytes": b"POST / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n8000000000000000\r\n",
    "headers of 100 kB": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nX: "
    + b"x" * 100_000
    + b"\r\n\r\n",
    "no HTTP": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),
}


ENDED_S = 30.0
"""By then the server has given up waiting for the end of a request."""


async def raw(server: Server) -> Outcome:
    """Bytes that are no request, or two at once."""
    since, said, wrong = len(server.logged()), [], []
    for name, content in RAW.items():
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(content.replace(b"%d", str(server.port).encode()))
        try:
            first = await asyncio.wait_for(reader.readline(), ENDED_S)
            status: int | str = int(first.split()[1]) if first else "closed"
        except (TimeoutError, ConnectionError) as error:
            status = "no answer" if isinstance(error, TimeoutError) else "closed"
        writer.close()
        said.append(status)
        if not is_refusal(status) and name != "no host":
            wrong.append(f"{name}: {status}")
    if "Traceback" in server.logged(since):
        wrong.append("a traceback in the log")
    return Outcome(len(RAW), "; ".join(wrong) or counted(said), not wrong)


def chosen_session(server: Server) -> Outcome:
    """A link that names a session which the server never made: who sent it could listen in."""
    from bokeh.util.token import get_session_id  # noqa: PLC0415

    chosen = "chosen-by-another"
    status, page = ask(server, f"/?bokeh-session-id={chosen}")
    is_taken = '"token"' in page and get_session_id(token_in(page)) == chosen
    said = "the session of the link is made" if is_taken else "a session of the server's own choice"
    return Outcome(1, f"{status}, {said}", not is_taken)


PAGE = """<!DOCTYPE html><title>another site</title>
<img src="{at}components/{marker}/x/_css/y">
<script src="{at}components/{marker}/x/_css/y"></script>
<link rel="stylesheet" href="{at}components/this/x/_css/y">
<iframe src="{at}"></iframe>
<form method="post" action="{at}"><input name="token"></form>
<script>
const said = window.said = [];
fetch("{at}", {{mode: "no-cors", credentials: "include"}}).catch(() => said.push("fetch failed"));
fetch("{at}").then(() => said.push("PAGE READ"), () => said.push("page not read"));
const socket = new WebSocket("{ws}ws", ["bokeh", "{token}"]);
socket.onopen = () => said.push("SOCKET OPENED");
socket.onerror = () => said.push("socket refused");
setTimeout(() => {{
  new Image().src = "{at}components/unittest.__main__/x/_css/y";
  setTimeout(() => window.done = true, 2000);
}}, 2000);
</script>"""


@contextmanager
def foreign_site(page: str) -> Iterator[int]:
    """Another server on this machine, which has this page; yields its port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(page.encode())

        def log_message(self, *_: object) -> None:
            """Print nothing."""

    site = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=site.serve_forever, daemon=True).start()
    try:
        yield site.server_port
    finally:
        site.shutdown()
        site.server_close()


def own_token() -> str:
    """A session's token as the server itself would make it."""
    from bokeh.util.token import generate_jwt_token, generate_session_id  # noqa: PLC0415

    return generate_jwt_token(generate_session_id())


def in_a_browser(host: str, server: Server) -> Outcome:
    """Visit a foreign page whose images, scripts, fetches and sockets lead to the server."""
    marker = mark(server)
    since = len(server.logged())
    at = server.address
    page = PAGE.format(at=at, ws=at.replace("http", "ws", 1), marker=marker, token=own_token())
    with foreign_site(page) as port, chromium() as browser:
        tab = browser.new_page()
        tab.goto(f"http://{host}:{port}/", wait_until="commit")
        tab.wait_for_function("window.done", timeout=20_000)
        said: Sequence[str] = tab.evaluate("window.said")
        framed = [frame.url for frame in tab.frames if frame.url.startswith(at)]
    got_in = [each for each in said if each.isupper()] + ["PAGE FRAMED"] * len(framed)
    harmed = harm(server, since)
    return Outcome(
        1, f"{', '.join([*said, *framed])}; {harmed or 'nothing was run'}", not (harmed or got_in)
    )


ATTACKS: list[Attack] = [
    Attack(
        "component route: a module that ends the process", partial(component, "unittest.__main__")
    ),
    Attack("component route: a module that prints", partial(component, "this")),
    Attack("component route: a module in the current folder", partial(component, None)),
    Attack("page of another site in Chromium", partial(in_a_browser, "localhost")),
    Attack("page of another port in Chromium", partial(in_a_browser, "127.0.0.1")),
    Attack("odd methods, paths and queries", odd),
    Attack("malformed requests", raw),
    Attack("a link that names the session", chosen_session),
]
