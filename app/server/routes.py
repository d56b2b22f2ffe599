"""Routes: the page, its socket and its files.

Routes of Panel and Bokeh that are not in `SERVED` are removed, those of later versions included.

Panel's handler of ``/components/<module>/<class>/<attribute>/<path>`` calls
``importlib.import_module`` with the module of the address before any check
(``panel.io.server.ComponentResourceHandler.parse_url_path`` in Panel 1.9.4). Importing runs code:
``/components/unittest.__main__/x/_css/y`` ends the process, and any module on the path can be run,
those in the current folder included. `ComponentFiles` uses only modules that are loaded.
"""

from __future__ import annotations

import sys
from typing import Any

from bokeh.protocol.exceptions import ProtocolError
from bokeh.server.views.ico_handler import IcoHandler
from bokeh.server.views.multi_root_static_handler import MultiRootStaticHandler
from bokeh.server.views.static_handler import StaticHandler
from bokeh.util.token import get_session_id
from panel.io.server import ComponentResourceHandler, DocHandler, WSHandler
from panel.viewable import Layoutable, Viewable
from tornado.routing import PathMatches
from tornado.web import Application, HTTPError, RequestHandler

from app.server.opening import PageHandler
from app.server.sessions import Sessions

MOST_MESSAGE_BYTES = 16 * 2**20
"""Largest message from a browser; parts of a file (`app.widgets.file_input`) are smaller."""

_COMPONENT_PACKAGE = "app."

_POLICY_VIOLATION, _TOO_BIG = 1008, 1009  # status codes of RFC 6455


class ComponentFiles(ComponentResourceHandler):
    """Serves files of components that are loaded; imports nothing."""

    def parse_url_path(self, path: str) -> str:
        """Return the path of the file that an address names."""
        module, _, rest = path.partition("/")
        name = rest.partition("/")[0]
        is_ours = module.startswith(_COMPONENT_PACKAGE) and module in sys.modules
        component = vars(sys.modules[module]).get(name) if is_ours else None
        if not (isinstance(component, type) and issubclass(component, Viewable | Layoutable)):
            raise HTTPError(404)
        try:
            return super().parse_url_path(path)
        except HTTPError:
            raise
        except Exception as error:  # an attribute that lists no files, or an incomplete address
            raise HTTPError(404) from error


class SocketHandler(WSHandler):
    """Connects a browser to the session of its page; never creates a session."""

    def initialize(self, sessions: Sessions, **options: Any) -> None:
        """Store the arguments of the route."""
        super().initialize(**options)
        self._sessions = sessions
        self._n_pending_bytes = 0

    def open(self, *arguments: Any, **options: Any) -> None:
        """Refuse a token that is malformed or expired, or has no session."""
        try:
            if not self._sessions.has(get_session_id(self._token)):
                raise ProtocolError("no such session")
            super().open(*arguments, **options)
        except Exception as error:  # a token may be malformed in many ways
            self.close(_POLICY_VIOLATION, type(error).__name__)

    async def _async_open(self, token: str) -> None:
        await super()._async_open(token)
        self._sessions.connected(self.connection.session)

    async def _receive(self, fragment: str | bytes) -> Any:
        # A message may announce any number of parts, each as large as a socket allows.
        self._n_pending_bytes += len(fragment)
        if self._n_pending_bytes > MOST_MESSAGE_BYTES:
            self.close(_TOO_BIG, f"more than {MOST_MESSAGE_BYTES} bytes")
            return None
        message = await super()._receive(fragment)
        if message is not None:
            self._n_pending_bytes = 0
        return message


SERVED: dict[tuple[str, type[RequestHandler]], type[RequestHandler]] = {
    ("/favicon.ico$", IcoHandler): IcoHandler,
    ("/ws$", WSHandler): SocketHandler,
    ("/?$", DocHandler): PageHandler,
    ("/static/(?!extensions/)(.*)$", StaticHandler): StaticHandler,
    ("/static/extensions/(.*)$", MultiRootStaticHandler): MultiRootStaticHandler,
    ("/components/(.*)$", ComponentResourceHandler): ComponentFiles,
}
"""Handler of each route, by its pattern and the handler of the libraries."""


def restrict(application: Application, sessions: Sessions) -> None:
    """Remove all routes of an application that are not in `SERVED`."""
    router = application.wildcard_router
    kept = []
    for rule in router.rules:
        path = rule.matcher.regex.pattern if isinstance(rule.matcher, PathMatches) else ""
        handler = SERVED.get((path, rule.target))
        if handler is not None:
            rule.target = handler
            if handler in (PageHandler, SocketHandler):
                rule.target_kwargs["sessions"] = sessions
            kept.append(rule)
    router.rules[:] = kept
