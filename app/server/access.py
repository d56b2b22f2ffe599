"""Who is served: only hosts that are named, and where others reach them, only who knows a token.

One rule stands before all others, so that it guards pages, sockets, scripts and whatever a library
serves beside them. Bokeh and Panel know of users too, but their static files are open to everyone.
"""

from __future__ import annotations

import hmac
import secrets
import sys
from dataclasses import dataclass
from html import escape
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from bokeh.protocol.message import Message
from bokeh.server.connection import ServerConnection
from bokeh.server.session import ServerSession
from panel.io.state import set_curdoc, state
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.routing import Matcher, Rule
from tornado.web import (
    Application,
    OutputTransform,
    RequestHandler,
    create_signed_value,
    decode_signed_value,
)

from core.checks import require

TOKEN_VARIABLE = "FIRSTPHOTON_TOKEN"
LEAST_CHARACTERS = 8
COOKIE_DAYS = 30.0

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    # Bokeh and vtk.js make functions out of text, Panel's components are modules of their own.
    "Content-Security-Policy": "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:",
            "connect-src 'self' blob: data:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "font-src 'self' data:",
            "worker-src 'self' blob:",
            "object-src 'none'",
            "base-uri 'self'",
            "form-action 'self'",
            "frame-ancestors 'none'",
        )
    ),
}

PAGE = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><title>firstphoton</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root {{ color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif }}
body {{ max-width: 26em; margin: 15vh auto; padding: 0 1em }}
input, button {{ font: inherit; padding: .3em .6em }}
</style>
<h1>firstphoton</h1>
<p role="{role}">{sentence}</p>{form}
</html>"""

FORM = """
<form method="post">
<label>Token <input name="token" type="password" autocomplete="current-password" autofocus required>
</label> <button>Enter</button>
</form>"""

ASK = "This server asks for its token. It is in the link that was printed where it was started."
WRONG = "That is not the token of this server. It was printed where the server was started."
FOREIGN = (
    "This server answers under the addresses alone that it was told. Where it was started, "
    "--origin names others."
)


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return address == "localhost" or ip_address(address).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Access:
    """What a request must show to be served.

    Parameters
    ----------
    hosts : frozenset of str
        What the address bar of a browser may say: host and port, or a host alone where no port is
        shown. A page of another site has another origin, and a foreign name that has been led to
        this machine is another host.
    token : str, optional
        What must be known; None where only this machine reaches the server.
    """

    hosts: frozenset[str]
    token: str | None = None

    @classmethod
    def of(cls, address: str, port: int, origins: list[str], token: str | None) -> Access:
        """For a server at this address.

        Parameters
        ----------
        origins : list of str
            Host, or host and port, as browsers see them.
        token : str, optional
            One that the user has chosen; where others reach the server and there is none, one is
            made.

        Raises
        ------
        ValueError
            If others reach the server and no origin is named, an origin is no host, or the token
            is too short to be one.
        """
        for origin in origins:
            parts = urlsplit(f"//{origin}")
            is_host = parts.netloc == origin and parts.hostname not in (None, "*")
            require("--origin", origin, is_host, "HOST or HOST:PORT, such as lab.example.org:5006")
        require(
            "--origin",
            None,
            bool(origins) or is_loopback(address),
            f"the host under which browsers reach {address}, such as lab.example.org",
        )
        if token is not None:
            is_long = len(token) >= LEAST_CHARACTERS
            require(TOKEN_VARIABLE, "…", is_long, f"at least {LEAST_CHARACTERS} characters")
        elif not is_loopback(address):
            token = secrets.token_urlsafe(24)
        named = [*origins, *(["localhost", address] if is_loopback(address) else [])]
        places = {_place(host, port) for host in named}
        # A proxy in front of it may show no port.
        return cls(frozenset(each.lower() for each in {*origins, *places}), token)

    def link(self, origin: str, port: int) -> str:
        """Where a browser finds the server under one of its names."""
        query = f"?{urlencode({'token': self.token})}" if self.token else ""
        return f"http://{_place(origin, port)}/{query}"

    def is_from_here(self, request: HTTPServerRequest) -> bool:
        """Whether a request is for this server, and comes from its own pages or from no page."""
        origin = request.headers.get("Origin")
        return request.host.lower() in self.hosts and (
            origin is None or urlsplit(origin).netloc.lower() in self.hosts
        )

    def accepts(self, token: str) -> bool:
        """Whether this is the token."""
        return self.token is not None and hmac.compare_digest(token.encode(), self.token.encode())


def _place(host: str, port: int) -> str:
    """Host and port as an address has them."""
    host = f"[{host}]" if host.count(":") > 1 and "]" not in host else host
    return host if urlsplit(f"//{host}").port else f"{host}:{port}"


class Guard(Matcher):
    """Matches the requests that `Gate` is to answer, instead of whatever they ask for."""

    def __init__(self, access: Access) -> None:
        self._access = access
        # A cookie is valid for one run of the server. Browsers share cookies between ports.
        self._secret = secrets.token_bytes(32)
        self._cookie = f"firstphoton-{secrets.token_hex(4)}"

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """None for a request that is welcome."""
        is_welcome = self._access.is_from_here(request) and (
            self._access.token is None
            or (self._is_known(request) and "token" not in request.query_arguments)
        )
        return None if is_welcome else {}

    def _is_known(self, request: HTTPServerRequest) -> bool:
        kept = request.cookies.get(self._cookie)
        return kept is not None and bool(
            decode_signed_value(self._secret, self._cookie, kept.value, max_age_days=COOKIE_DAYS)
        )

    def admit(self, handler: RequestHandler) -> None:
        """Let a browser in from now on."""
        handler.set_cookie(
            self._cookie,
            create_signed_value(self._secret, self._cookie, "1"),
            expires_days=COOKIE_DAYS,
            httponly=True,
            secure=handler.request.protocol == "https",
            samesite="Lax",
        )


class Gate(RequestHandler):
    """Asks for the token, or refuses."""

    def initialize(self, access: Access, guard: Guard) -> None:
        """Take over what the rule was made with."""
        self._access, self._guard = access, guard

    def prepare(self) -> None:
        """Refuse whoever is not from here."""
        if not self._access.is_from_here(self.request):
            self._answer(FOREIGN, "")

    def get(self) -> None:
        """Take the token out of the address, or ask for it."""
        token = self.get_query_argument("token", None)
        if token is None:
            self._answer(ASK, FORM)
        else:
            self._try(token)

    def post(self) -> None:
        """Take the token that was typed."""
        self._try(self.get_body_argument("token", ""))

    def _try(self, token: str) -> None:
        if not self._access.accepts(token):
            self._answer(WRONG, FORM)
            return
        self._guard.admit(self)
        others = [
            pair
            for pair in parse_qsl(self.request.query, keep_blank_values=True)
            if pair[0] != "token"
        ]
        # One slash: two of them, of whatever kind, would lead to another host.
        path = "/" + self.request.path.lstrip("/\\")
        self.redirect(path + (f"?{urlencode(others)}" if others else ""), status=303)

    def _answer(self, sentence: str, form: str) -> None:
        self.set_status(403)
        self.set_header("Cache-Control", "no-store")
        role = "alert" if sentence != ASK else "note"
        self.finish(PAGE.format(sentence=escape(sentence), form=form, role=role))


def guard(application: Application, access: Access) -> None:
    """Put the rule before all others of an application."""
    rule = Guard(access)
    known = {"access": access, "guard": rule}
    application.default_router.rules.insert(0, Rule(rule, Gate, known))


class Headers(OutputTransform):
    """Adds to every answer what keeps browsers from lending it to others."""

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """As tornado calls it before anything is sent."""
        for name, value in HEADERS.items():
            headers[name] = value
        return status_code, headers, chunk


def keep_tracebacks() -> None:
    """Tell what goes wrong in a callback of a Bokeh model by its page, as Panel does of its own.

    Bokeh sends the traceback to the browser, which shows it to nobody but the curious.
    """
    ServerConnection.error = _told


def _told(connection: ServerConnection, message: Message[Any], text: str) -> Message[Any]:
    failure = sys.exception()
    if failure is not None:
        with set_curdoc(connection.session.document):
            state._handle_exception(failure)
    answer = connection.protocol.create("ERROR", message.header["msgid"], "It is told by the page.")
    answer.content["traceback"] = None
    return answer


def send_early_changes() -> None:
    """Send what changes on a page between its first picture and the moment it is all drawn.

    The browser has then pulled the document, but Panel takes it for not connected before it says
    that it has drawn it, and drops what changes until then.
    """
    ServerSession._handle_pull = _connecting(ServerSession._handle_pull)


def _connecting(pull: Any) -> Any:
    async def pull_now(session: ServerSession, *arguments: Any) -> Any:
        document = await pull(session, *arguments)
        state._connected[session.document] = True  # no sooner: the document goes first
        return document

    return pull_now
