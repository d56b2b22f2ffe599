"""Routes: a page, its socket and its files, and nothing else that the libraries offer.

Of Panel's and Bokeh's routes those in `SERVED` are kept, some with a handler of our own; all others
are removed, those that a later version adds included.

Panel's own handler of ``/components/<module>/<class>/<attribute>/<path>`` calls
``importlib.import_module`` with whatever the address names before it checks anything
(``panel.io.server.ComponentResourceHandler.parse_url_path``, read in Panel 1.9.4). Importing runs
code: ``/components/unittest.__main__/x/_css/y`` ends the process, and any module on the path can be
run, those in the current folder included. `ComponentFiles` looks only at modules that are loaded.
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
"""Largest message from a browser; a part of a file (`app.widgets.file_input`) is smaller."""

_COMPONENT_PACKAGE = "app."

_POLICY_VIOLATION, _TOO_BIG = 1008, 1009  # status codes of RFC 6455


class ComponentFiles(ComponentResourceHandler):
    """Files of components that are loaded; imports nothing."""

    def parse_url_path(self, path: str) -> str:
        """Path of the file that an address names."""
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
    """Connects a browser to the session of its page, and opens no session of its own."""

    def initialize(self, sessions: Sessions, **options: Any) -> None:
        """Take over what the route was made with."""
        super().initialize(**options)
        self._sessions = sessions
        self._n_pending_bytes = 0

    def open(self, *arguments: Any, **options: Any) -> None:
        """Refuse a token that is malformed, expired, or of no session."""
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
"""Handler of each route that is kept, by its pattern and the handler that the libraries have."""


def restrict(application: Application, sessions: Sessions) -> None:
    """Keep only what is in `SERVED`."""
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
