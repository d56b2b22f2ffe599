"""Access control, by plain HTTP and websocket clients."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from urllib.parse import urlencode

import numpy as np
import pytest

from app.__main__ import main
from app.server.access import TOKEN_VARIABLE, Access
from app.widgets.connection import serving_options
from tests.browser import ROOT
from tests.site import NAME, TOKEN, Site, empty_site
from tests.wire import token_in

STATIC = "/static/js/bokeh.min.js"
PARTS = ("/", "/favicon.ico", STATIC, "/ws", "/metadata", "/no/such/page")


@pytest.fixture(scope="module")
def here():
    """A server with the app's default options."""
    with empty_site() as site:
        yield site


@pytest.fixture(scope="module")
def away():
    """A server on a network."""
    with empty_site("0.0.0.0", [NAME], TOKEN) as site:
        yield site


@pytest.fixture(scope="module")
def cookie(away):
    """The cookie of a browser that opened the link."""
    status, headers, _ = away.ask(f"/?{urlencode({'token': TOKEN})}", Host=NAME)
    assert status == 303
    return headers["Set-Cookie"].partition(";")[0]


# -- this machine only -----------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_this_machine_needs_no_token(here, host):
    status, _, page = here.ask(Host=f"{host}:{here.port}")
    assert status == 200
    own = {"Host": f"{host}:{here.port}", "Origin": f"http://{host}:{here.port}"}
    assert here.socket(token_in(page), **own) == 101


REBOUND = {"Host": "rebound.example.com"}


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        *((path, REBOUND) for path in PARTS),
        ("/", {"Host": "127.0.0.1:1"}),
        ("/", {"Origin": "http://evil.example.com"}),
        ("/", {"Origin": "null"}),
        ("/", {"Origin": "http://localhost:1"}),
    ],
)
def test_requests_of_foreign_pages_and_hosts_are_refused(here, path, headers):
    status, _, text = here.ask(path, **headers)
    assert status == 403
    assert "--origin" in text
    assert "Traceback" not in text


def test_a_foreign_page_gets_no_socket(here):
    token = token_in(here.ask()[2])
    assert here.socket(token, Origin="http://evil.example.com") == 403
    assert here.socket(token, Host="rebound.example.com") == 403


def test_responses_have_security_headers(here):
    for path in PARTS:
        headers = here.ask(path)[1]
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["Referrer-Policy"] == "same-origin"


# -- other machines --------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PARTS)
def test_without_the_token_nothing_is_served(away, path):
    status, headers, text = away.ask(path, Host=NAME)
    assert status == 403
    assert "Set-Cookie" not in headers
    assert 'type="password"' in text
    assert TOKEN not in text


def test_without_the_token_there_is_no_socket(away, here, cookie):
    token = token_in(here.ask()[2])
    assert away.socket(token, Host=NAME) == 403
    assert away.socket(token, Host=NAME, Cookie="firstphoton=1") == 403
    forged = cookie.partition("=")[0] + "=" + cookie.partition("=")[2][::-1]
    assert away.socket(token, Host=NAME, Cookie=forged) == 403


def test_the_link_sets_a_cookie_and_drops_the_token(away):
    query = urlencode({"token": TOKEN, "sbr": "0.05", "scene": "a b"})
    status, headers, _ = away.ask(f"/?{query}", Host=NAME)
    assert status == 303
    assert headers["Location"] == "/?sbr=0.05&scene=a+b"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Lax" in headers["Set-Cookie"]


def test_a_browser_with_the_cookie_is_served(away, cookie):
    known = {"Host": NAME, "Cookie": cookie, "Origin": f"http://{NAME}"}
    status, _, page = away.ask(**known)
    assert status == 200
    assert away.ask(STATIC, **known)[0] == 200
    assert away.socket(token_in(page), **known) == 101
    foreign = known | {"Origin": "http://evil.example.com"}
    assert away.ask(**foreign)[0] == 403
    assert away.socket(token_in(page), **foreign) == 403
    assert away.ask(**(known | {"Host": f"localhost:{away.port}"}))[0] == 403


@pytest.mark.parametrize("wrong", ["", "a", TOKEN[:-1], TOKEN.upper(), "ü"])
def test_a_wrong_token_is_refused(away, wrong):
    asked = away.ask(f"/?{urlencode({'token': wrong})}", Host=NAME)
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    typed = away.ask("/", "POST", urlencode({"token": wrong}), Host=NAME, **form)
    for status, headers, text in (asked, typed):
        assert status == 403
        assert "Set-Cookie" not in headers
        assert "Wrong token" in text


def test_the_form_accepts_the_token_and_redirects_to_this_server(away):
    form = {"Content-Type": "application/x-www-form-urlencoded", "Host": NAME}
    status, headers, _ = away.ask(
        "//evil.example.com/", "POST", urlencode({"token": TOKEN}), **form
    )
    assert status == 303
    assert headers["Location"].startswith("/evil.example.com")
    assert "firstphoton-" in headers["Set-Cookie"]
    foreign = form | {"Origin": "http://evil.example.com"}
    assert away.ask("/", "POST", urlencode({"token": TOKEN}), **foreign)[0] == 403


# -- how it is started -----------------------------------------------------------------------------


def test_origins_and_tokens_are_required_on_a_network():
    assert Access.of("127.0.0.1", 5006, [], None).token is None
    made = Access.of("0.0.0.0", 5006, ["lab:80", "lab.example.org"], None)
    assert len(made.token) >= 32
    assert made.token != Access.of("0.0.0.0", 5006, ["lab"], None).token
    assert made.hosts == {"lab:80", "lab.example.org", "lab.example.org:5006"}
    assert Access.of("::1", 5006, [], None).hosts == {"[::1]:5006", "localhost:5006"}
    assert Access.of("127.0.0.1", 5006, [], "long enough").token == "long enough"
    for address, origins, token, named in (
        ("0.0.0.0", [], None, "--origin"),
        ("192.0.2.1", [], "long enough", "--origin"),
        ("0.0.0.0", ["*"], None, "--origin"),
        ("0.0.0.0", ["http://lab"], None, "--origin"),
        ("127.0.0.1", ["lab/x"], None, "--origin"),
        ("127.0.0.1", [], "short", TOKEN_VARIABLE),
    ):
        with pytest.raises(ValueError, match=named) as refusal:
            Access.of(address, 5006, origins, token)
        assert "short" not in str(refusal.value)


@contextmanager
def run(*arguments):
    with subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as started:
        try:
            yield started
        finally:
            started.kill()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of tornado
def test_a_port_in_use_is_reported(here, capsys):
    assert main(["--port", str(here.port)]) == 1
    printed = capsys.readouterr().out
    assert "in use" in printed and "--port" in printed


@pytest.mark.parametrize("seconds", [-1.0, 0.0, 1.0, np.nan, np.inf])
def test_a_session_is_kept_until_a_page_can_connect(seconds):
    with pytest.raises(ValueError, match="--linger"):
        serving_options(seconds)


def test_a_network_address_requires_an_origin(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["--address", "0.0.0.0", "--port", "0"])
    assert "--origin" in capsys.readouterr().err


FORKING = """
import os, sys
from app import __main__
print("ready", flush=True)
for script in sys.stdin:
    if not os.fork():
        exec(eval(script), {})
    _, status = os.wait()
    print("status", os.waitstatus_to_exitcode(status), flush=True)
"""


@pytest.fixture(scope="module")
def forking():
    """A process that runs scripts: importing the app, which it has done, takes seconds."""
    with run("-c", FORKING) as process:
        assert next(process.stdout) == "ready\n"
        yield process


def begin(forking, script):
    forking.stdin.write(f"{script!r}\n")
    forking.stdin.flush()


def ended(forking):
    """Return what the last script has printed until it ended, and its status."""
    printed = []
    for line in forking.stdout:
        if line.startswith("status"):
            return "".join(printed), int(line.split()[1])
        printed.append(line)
    raise AssertionError("".join(printed))


ON_A_NETWORK = """
import os, sys
import core
from app.__main__ import main

core.warm_up = lambda *_, **__: None
print("process", os.getpid(), flush=True)
sys.exit(main(["--address", "0.0.0.0", "--origin", "127.0.0.1", "--port", "0"]))
"""


def test_the_printed_link_has_a_token_and_ctrl_c_stops(forking):
    begin(forking, ON_A_NETWORK)
    _, process = next(forking.stdout).split()
    line = next(line for line in forking.stdout if line.startswith("Open"))
    link = re.search(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{20,})", line)
    site = Site(f"http://127.0.0.1:{link[1]}/")
    assert site.ask()[0] == 403
    assert site.ask(f"/?token={link[2]}")[0] == 303
    os.kill(int(process), signal.SIGINT)
    printed, status = ended(forking)
    assert status == 0
    assert "Traceback" not in printed


STOPPED_AT_A_BAD_MOMENT = """
import os, signal, sys, time
from contextlib import suppress
from types import SimpleNamespace
import core
from app import __main__ as started
from app.tasks.scheduler import Cancelled, LongWork

def nothing(*_, **__):
    pass

def long_work(progress):
    print("begun", flush=True)
    with suppress(Cancelled):
        while True:
            progress(0, 1)
            time.sleep(0.01)
    print("ended", flush=True)

class Last:
    def __del__(self):  # Python ignores exceptions raised here
        print("now", flush=True)
        os.kill(os.getpid(), signal.SIGTERM)

def page_for(*_):
    page = SimpleNamespace(queue=nothing, is_gone=False, is_away=False)
    LongWork(page, lambda: None, nothing).start_piece(long_work, nothing)
    Last()

core.warm_up = nothing
started.page_for = page_for
sys.exit(started.main(["--port", "0"]))
"""


def test_sigterm_stops_at_any_time_and_cancels_long_work(forking):
    begin(forking, STOPPED_AT_A_BAD_MOMENT)
    line = next(line for line in forking.stdout if line.startswith("Open"))
    Site(line.split()[1]).ask()
    printed, status = ended(forking)
    for word in ("begun", "now", "ended"):  # written by two threads, so that lines may run together
        assert word in printed
    assert status == 0


COMPILING = """
import os, sys, time
import core
from app.__main__ import main

def compiling(progress=None, only=None):
    if only == {only!r}:
        print("compiling", os.getpid(), flush=True)
        time.sleep(600)

core.warm_up = compiling
sys.exit(main(["--port", "0"]))
"""


@pytest.mark.parametrize(
    ("only", "number"),
    [
        ("tracking", signal.SIGINT),  # before the first page
        ("tracking", signal.SIGTERM),
        (None, signal.SIGTERM),  # meanwhile, when both have one handler
    ],
)
def test_what_ends_the_app_does_so_while_kernels_are_compiled(forking, only, number):
    begin(forking, COMPILING.format(only=only))
    line = next(line for line in forking.stdout if line.startswith("compiling"))
    os.kill(int(line.split()[1]), number)
    assert ended(forking)[1] == (0 if only is None else -number)
