"""Access control: accepted hosts, and a token where other machines reach the server.

One routing rule precedes all others, so that it guards pages, sockets, scripts and whatever else a
library serves. The user accounts of Bokeh and Panel leave static files open to everyone.
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
from app.server.messages import (
    FOREIGN,
    MALFORMED,
    TOKEN_REQUIRED,
    WRONG_TOKEN,
    refusal,
    token_form,
    too_many_tokens,
)
from core.checks import require

TOKEN_VARIABLE = "FIRSTPHOTON_TOKEN"
SHORTEST_TOKEN = 8
COOKIE_DAYS = 30.0

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    # Bokeh and vtk.js compile text to functions; Panel's components are modules.
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
    """Whether only this machine can reach an address."""
    try:
        return address == "localhost" or ip_address(address).is_loopback
    except ValueError:
        return False


def is_cross_site(request: HTTPServerRequest) -> bool:
    """Whether a page of another site sent a request, other than by a link to this server.

    An image or a script of a foreign page has no Origin header. Browsers describe it in other
    headers, which a page cannot change (W3C, Fetch Metadata Request Headers).
    """
    header = request.headers.get
    is_link = header("Sec-Fetch-Mode") == "navigate" and header("Sec-Fetch-Dest") == "document"
    return header("Sec-Fetch-Site", "none") not in ("same-origin", "none") and not is_link


def is_well_formed(request: HTTPServerRequest) -> bool:
    """Whether a path has printable characters only, like all paths of this server."""
    return unquote(request.path, errors="replace").isprintable()


@dataclass(frozen=True)
class Access:
    """Conditions under which a request is served.

    Parameters
    ----------
    hosts : frozenset of str
        Accepted hosts with their ports, as in the address bar of a browser. A page of another site
        has another origin; a foreign name that resolves to this machine is another host.
    token : str, optional
        Required token; None where only this machine reaches the server.
    """

    hosts: frozenset[str]
    token: str | None = None

    @classmethod
    def of(cls, address: str, port: int, origins: list[str], token: str | None) -> Access:
        """Return the conditions for a server at an address.

        Parameters
        ----------
        origins : list of str
            Host, or host and port, as browsers see them.
        token : str, optional
            The user's own token. Without one, a token is generated where other machines reach the
            server.

        Raises
        ------
        ValueError
            If other machines reach the server and no origin is given, an origin is not a host, or
            the token is too short.
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
            is_long = len(token) >= SHORTEST_TOKEN
            require(TOKEN_VARIABLE, "…", is_long, f"at least {SHORTEST_TOKEN} characters")
        elif not is_loopback(address):
            token = secrets.token_urlsafe(24)
        hosts = [*origins, *(["localhost", address] if is_loopback(address) else [])]
        # Behind a proxy the origins may have no port.
        accepted = {*origins, *(_with_port(host, port) for host in hosts)}
        return cls(frozenset(each.lower() for each in accepted), token)

    def link(self, origin: str, port: int) -> str:
        """Return the link that opens the server under one of its hosts."""
        query = f"?{urlencode({'token': self.token})}" if self.token else ""
        return f"http://{_with_port(origin, port)}/{query}"

    def is_own(self, request: HTTPServerRequest) -> bool:
        """Whether a request names this server and comes from its own pages or from no page."""
        origin = request.headers.get("Origin")
        is_ours = origin is None or urlsplit(origin).netloc.lower() in self.hosts
        return request.host.lower() in self.hosts and is_ours and not is_cross_site(request)

    def accepts(self, token: str) -> bool:
        """Whether a token is the right one."""
        return self.token is not None and hmac.compare_digest(token.encode(), self.token.encode())


def _with_port(host: str, port: int) -> str:
    host = f"[{host}]" if host.count(":") > 1 and "]" not in host else host
    return host if urlsplit(f"//{host}").port else f"{host}:{port}"


class Guard(Matcher):
    """Matches the requests that `Gate` answers in place of the route that they name."""

    def __init__(self, access: Access, connections: Connections) -> None:
        self._access, self._connections = access, connections
        self.wrong_tokens = WrongTokens()
        # Cookies are valid for one run of the server; browsers share them between ports.
        self._secret = secrets.token_bytes(32)
        self._cookie = f"firstphoton-{secrets.token_hex(4)}"

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """Return None for a request that is served."""
        self._connections.completed(request)
        is_admitted = self._access.token is None or (
            self._has_cookie(request) and "token" not in request.query_arguments
        )
        return None if is_admitted and self.refusal(request) is None else {}

    def refusal(self, request: HTTPServerRequest) -> tuple[int, str] | None:
        """Return status and sentence for a request that is refused whatever its token."""
        if not self._access.is_own(request):
            return 403, FOREIGN
        return None if is_well_formed(request) else (400, MALFORMED)

    def _has_cookie(self, request: HTTPServerRequest) -> bool:
        cookie = request.cookies.get(self._cookie)
        return cookie is not None and bool(
            decode_signed_value(self._secret, self._cookie, cookie.value, max_age_days=COOKIE_DAYS)
        )

    def admit(self, handler: RequestHandler) -> None:
        """Give a browser the cookie with which it is served."""
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
        """Store the arguments of the rule."""
        self._access, self._guard = access, guard

    def prepare(self) -> None:
        """Refuse requests of other sites."""
        if refused := self._guard.refusal(self.request):
            status, sentence = refused
            self._answer(refusal(sentence), status)

    def get(self) -> None:
        """Check the token in the address, or ask for one."""
        token = self.get_query_argument("token", None)
        if token is None:
            self._answer(token_form(TOKEN_REQUIRED))
        else:
            self._check(token)

    def post(self) -> None:
        """Check the token of the form."""
        self._check(self.get_body_argument("token", ""))

    def _check(self, token: str) -> None:
        address, wrong = str(self.request.remote_ip), self._guard.wrong_tokens
        delay_s = wrong.delay_s(address)
        if delay_s > 0:
            self.set_header("Retry-After", str(math.ceil(delay_s)))
            self._answer(refusal(too_many_tokens(math.ceil(delay_s))), 429)
            return
        if not self._access.accepts(token):
            wrong.add(address)
            self._answer(token_form(WRONG_TOKEN))
            return
        wrong.forgive(address)
        self._guard.admit(self)
        others = [
            pair
            for pair in parse_qsl(self.request.query, keep_blank_values=True)
            if pair[0] != "token"
        ]
        # Two slashes of any kind would redirect to another host.
        path = "/" + self.request.path.lstrip("/\\")
        self.redirect(path + (f"?{urlencode(others)}" if others else ""), status=303)

    def _answer(self, page: str, status: int = 403) -> None:
        self.set_status(status)
        self.set_header("Cache-Control", "no-store")
        self.finish(page)


def guard(application: Application, access: Access, connections: Connections) -> None:
    """Insert the rule before all others of an application."""
    rule = Guard(access, connections)
    arguments = {"access": access, "guard": rule}
    application.default_router.rules.insert(0, Rule(rule, Gate, arguments))


class Headers(OutputTransform):
    """Adds security headers to every response."""

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add the headers before anything is sent; called by Tornado."""
        headers.update(HEADERS)
        return status_code, headers, chunk
