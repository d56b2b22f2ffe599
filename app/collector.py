"""Python's collector of garbage, kept from walking through every open page time and again.

A page is some ten thousands of objects. With twenty of them a full collection takes more than half
a second, in which nobody is answered, and it comes every few seconds while sliders are dragged.
"""

from __future__ import annotations

import gc

from tornado.ioloop import IOLoop

SOON_S = 5.0
"""How long after a page is gone all is looked through: others may be about to go, too."""


class Collector:
    """Lets full collections pass over what is there to stay, until a page is gone."""

    def __init__(self) -> None:
        self._soon: object = None

    def spare(self) -> None:
        """From now on pass over all that is in use."""
        self._soon = None
        gc.collect()
        gc.freeze()

    def page_is_gone(self) -> None:
        """Look for what it has left behind; from the loop's own thread."""
        gc.unfreeze()
        loop = IOLoop.current()
        if self._soon is not None:
            loop.remove_timeout(self._soon)
        self._soon = loop.call_later(SOON_S, self.spare)


COLLECTOR = Collector()
