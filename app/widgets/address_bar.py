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
    """Write the state into the page's address, and follow the browser's history.

    Each address is an entry of the history: Back and Forward, or Ctrl+Z and Ctrl+Y outside of text
    fields, return to it without loading the page. `panel.state.location` cannot do this: its script
    adds an entry with each change, so that the Back button would undo slider moves one by one, and
    ignores Back.
    """

    entry = param.List(
        default=["", 0], doc="Part of the address after the question mark, and the latest visit."
    )
    dark = param.Boolean(default=False, doc="Whether the address asks for dark mode.")
    visited = param.List(
        default=["", 0], doc="Query of the entry that was returned to, and the number of the visit."
    )

    _esm = """
    export function render({ model }) {
      const step = () => history.state?.step ?? 0;
      let isNew = false;  // whether the next address is an entry of its own
      const addressOf = (query) => {
        const entries = [query, model.dark ? "theme=dark" : ""].filter(Boolean).join("&");
        const search = entries ? `?${entries}` : "";
        return new URL(location.pathname + search + location.hash, location.href);
      };
      const show = () => {
        const [query, visit] = model.entry;
        if (visit !== model.visited[1]) return;  // written before the latest visit was known
        const address = addressOf(query);
        if (address.href !== location.href) {
          if (isNew) history.pushState({ step: step() + 1 }, "", address);
          else history.replaceState(history.state, "", address);
        }
        isNew = true;
      };
      model.on("entry", show);
      // Not an entry of its own: Back does not change the mode.
      model.on("dark", () => history.replaceState(history.state, "", addressOf(model.entry[0])));
      show();

      const visit = () => {
        isNew = false;  // the state is written once more when it is restored
        model.visited = [location.search.slice(1), model.visited[1] + 1];
      };
      const TEXT = "input[type=text], input:not([type]), textarea";
      const press = (event) => {
        const isText = event.composedPath()[0].matches?.(TEXT);
        if (isText || event.altKey || !(event.ctrlKey || event.metaKey)) return;
        const key = event.key.toLowerCase();
        const isRedo = key === "y" || (key === "z" && event.shiftKey);
        if (!isRedo && key !== "z") return;
        event.preventDefault();
        if (isRedo) history.forward();
        else if (step() > 0) history.back();  // never leaves the page
      };
      addEventListener("popstate", visit);
      addEventListener("keydown", press);
      model.on("remove", () => {
        removeEventListener("popstate", visit);
        removeEventListener("keydown", press);
      });
      return document.createElement("span");
    }
    """

    def follow(
        self,
        state: State,
        query: Callable[[], str],
        is_settled: Callable[[], bool],
        wait: Callable[[int, Callable[[], None]], None],
        run_on_page: Callable[[Callable[[], None]], None],
    ) -> None:
        """Update the address whenever the state has not changed for `REST_MS`.

        Parameters
        ----------
        state : State
        query : callable
            Returns the query of the present state.
        is_settled : callable
            Returns whether the estimate is that of the state: until then, the address waits.
        wait, run_on_page : callable
            ``call_later`` and ``run_next`` of `app.tasks.page.PageTasks`.
        """
        changes = 0

        def write(seen: int) -> None:
            if seen == changes:
                self.entry = [query(), self.visited[1]]

        def changed(*_events: Any) -> None:
            nonlocal changes
            changes += 1
            wait(REST_MS, partial(check, changes))

        def check(seen: int) -> None:
            if seen == changes:
                if is_settled():
                    run_on_page(partial(write, seen))
                else:
                    wait(REST_MS, partial(check, seen))

        write(changes)
        state.param.watch(changed, list(defaults()))
        self.param.watch(changed, "visited")  # its entry is written, whatever could be restored
