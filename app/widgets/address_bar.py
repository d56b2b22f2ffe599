"""The address of the page, kept up to date with its state."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import param

from app.model.address import defaults
from app.model.state import State
from app.widgets.component import Component

REST_MS = 250
"""Time without a change after which the address is updated: slider moves are not delayed."""


class AddressBar(Component):
    """Replace the query of the page's address without loading the page.

    `panel.state.location` adds an entry to the browser's history with each change (its script calls
    ``pushState``), so that the Back button would undo slider moves one by one.
    """

    query = param.String(default="", doc="Part of the address after the question mark.")

    _esm = """
    export function render({ model }) {
      const show = () => {
        const query = model.query ? `?${model.query}` : "";
        history.replaceState(history.state, "", location.pathname + query + location.hash);
      };
      model.on("query", show);
      show();
      return document.createElement("span");
    }
    """

    def follow(
        self,
        state: State,
        query: Callable[[], str],
        wait: Callable[[int, Callable[[], None]], None],
        run_on_page: Callable[[Callable[[], None]], None],
    ) -> None:
        """Update the address whenever the state has not changed for `REST_MS`.

        Parameters
        ----------
        state : State
        query : callable
            Returns the query of the present state.
        wait, run_on_page : callable
            ``call_later`` and ``run_next`` of `app.tasks.page.PageTasks`.
        """
        changes = 0

        def write() -> None:
            self.query = query()

        def changed(*_events: Any) -> None:
            nonlocal changes
            changes += 1
            wait(REST_MS, partial(check, changes))

        def check(seen: int) -> None:
            if seen == changes:
                run_on_page(write)

        write()
        state.param.watch(changed, list(defaults()))
