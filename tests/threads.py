"""A page's thread in the hands of a test, for `app.tasks.jobs`."""

from __future__ import annotations

from collections.abc import Callable

Act = Callable[[], None]


def at_once(act: Act, due: Act | None = None) -> None:
    """The page's turn comes at once."""
    if due:
        due()
    act()


def queued(put: Callable[[Act], None]) -> Callable[..., None]:
    """What is to be done on the page is put somewhere, as if its turn had come."""

    def on_page(act: Act, due: Act | None = None) -> None:
        if due:
            due()
        put(act)

    return on_page
