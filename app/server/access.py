"""Who is served: only hosts that are named, and where others reach them, only who knows a token.

One rule stands before all others, so that it guards pages, sockets, scripts and whatever a library
serves beside them. Bokeh and Panel know of users too, but their static files are open to everyone.
"""

from __future__ import annotations

import hmac
import math
import secrets
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qsl, unquote, urlencode, urlsplit

from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.routing import Matcher, Rule
from tornado.web import (
    Application,
    OutputTransform,
    RequestHandler,
    create_signed_value,
    decode_signed_value,
)

from app.server.limits import Connections, WrongTokens
from app.server.messages import ASK, FOREIGN, MALFORMED, WRONG, refusal, token_form, too_many_tokens
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


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return address == "localhost" or ip_address(address).is_loopback
    except ValueError:
        return False


def is_cross_site(request: HTTPServerRequest) -> bool:
    """Whether a page of another site sends a request, other than by a link that opens this one.

    An image or a script of a foreign page brings no Origin; browsers say so in other headers (W3C,
    Fetch Metadata Request Headers), which a page cannot change.
    """
    said = request.headers.get
    is_link = said("Sec-Fetch-Mode") == "navigate" and said("Sec-Fetch-Dest") == "document"
    return said("Sec-Fetch-Site", "none") not in ("same-origin", "none") and not is_link


def is_well_formed(request: HTTPServerRequest) -> bool:
    """Whether a path has printable characters only, as the name of each file here has."""
    return unquote(request.path, errors="replace").isprintable()


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
        is_ours = origin is None or urlsplit(origin).netloc.lower() in self.hosts
        return request.host.lower() in self.hosts and is_ours and not is_cross_site(request)

    def accepts(self, token: str) -> bool:
        """Whether this is the token."""
        return self.token is not None and hmac.compare_digest(token.encode(), self.token.encode())


def _place(host: str, port: int) -> str:
    """Host and port as an address has them."""
    host = f"[{host}]" if host.count(":") > 1 and "]" not in host else host
    return host if urlsplit(f"//{host}").port else f"{host}:{port}"


class Guard(Matcher):
    """Matches the requests that `Gate` is to answer, instead of whatever they ask for."""

    def __init__(self, access: Access, connections: Connections) -> None:
        self._access, self._connections = access, connections
        self.wrong_tokens = WrongTokens()
        # A cookie is valid for one run of the server. Browsers share cookies between ports.
        self._secret = secrets.token_bytes(32)
        self._cookie = f"firstphoton-{secrets.token_hex(4)}"

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """None for a request that is welcome."""
        self._connections.completed(request)
        is_welcome = self.refusal(request) is None and (
            self._access.token is None
            or (self._is_known(request) and "token" not in request.query_arguments)
        )
        return None if is_welcome else {}

    def refusal(self, request: HTTPServerRequest) -> tuple[int, str] | None:
        """Status and sentence for a request that no token helps; None for others."""
        if not self._access.is_from_here(request):
            return 403, FOREIGN
        return None if is_well_formed(request) else (400, MALFORMED)

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
        """Refuse what no token helps."""
        refused = self._guard.refusal(self.request)
        if refused is not None:
            status, sentence = refused
            self._answer(refusal(sentence), status)

    def get(self) -> None:
        """Take the token out of the address, or ask for it."""
        token = self.get_query_argument("token", None)
        if token is None:
            self._answer(token_form(ASK))
        else:
            self._try(token)

    def post(self) -> None:
        """Take the token that was typed."""
        self._try(self.get_body_argument("token", ""))

    def _try(self, token: str) -> None:
        address, wrong = str(self.request.remote_ip), self._guard.wrong_tokens
        delay_s = wrong.delay_s(address)
        if delay_s > 0:
            self.set_header("Retry-After", str(math.ceil(delay_s)))
            self._answer(refusal(too_many_tokens(math.ceil(delay_s))), 429)
            return
        if not self._access.accepts(token):
            wrong.add(address)
            self._answer(token_form(WRONG))
            return
        wrong.forgive(address)
        self._guard.admit(self)
        others = [
            pair
            for pair in parse_qsl(self.request.query, keep_blank_values=True)
            if pair[0] != "token"
        ]
        # One slash: two of them, of whatever kind, would lead to another host.
        path = "/" + self.request.path.lstrip("/\\")
        self.redirect(path + (f"?{urlencode(others)}" if others else ""), status=303)

    def _answer(self, page: str, status: int = 403) -> None:
        self.set_status(status)
        self.set_header("Cache-Control", "no-store")
        self.finish(page)


def guard(application: Application, access: Access, connections: Connections) -> None:
    """Put the rule before all others of an application."""
    rule = Guard(access, connections)
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
