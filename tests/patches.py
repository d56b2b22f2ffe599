"""Gain of each patch of Panel and Bokeh: ``python -m tests.patches [NAME ...]``.

Two servers run side by side, one with all patches and one with a single patch switched off. Each
round opens a page on both, one after the other, and moves its sliders: through a client of Bokeh's
protocol for patches of the server, through Chromium for patches of the browser, which also goes to
other pages and back. CPU time depends little on what else the machine does; messages, bytes,
layouts and style computations are counted. The table has medians, and the ratio off/on with its
range over the rounds. The rows "server" and "browser" compare two equal servers: a gain that does
not exceed their range is noise.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page

from app.server import patches
from app.server.patches import OFF_VARIABLE, PATCHES
from tests.browser import VIEWS, chromium, open_page, server_process, serving
from tests.load import opened
from tests.wire import Wire

FOLDER = Path(patches.__file__).parent
CONTROLS = ("server", "browser")

OPENINGS = 4
WIRE_STEPS = 80
BROWSER_STEPS = 12
DRAG_MOVES = 60
PAGES = ("Inspect", "Explore", "Compare", "Explore")
QUIET_S = 0.4
"""Time without a message after which everything has been drawn."""

SESSIONS = 8
FORGOTTEN_S = 40.0
"""Time after which the server has dropped sessions that were closed."""

Costs = dict[str, float]


def cpu_ms(address: str) -> float:
    """CPU time of a server so far."""
    return 1e3 * float(sum(server_process(address).cpu_times()[:2]))


def server_costs(address: str) -> Costs:
    """Costs of opening a session, and of each step of its controls."""

    async def use() -> Costs:
        start_ms = cpu_ms(address)
        for wire, _ in [await opened(address, seed=0) for _ in range(OPENINGS - 1)]:
            wire.close()
        wire, hand = await opened(address, seed=0)
        opened_ms = cpu_ms(address)
        n_messages, n_bytes, waits_ms = wire.n_messages, wire.n_bytes, []
        for _ in range(WIRE_STEPS):
            begun_s = time.perf_counter()
            await hand.step()
            waits_ms.append(1e3 * (time.perf_counter() - begun_s))
        costs = {
            "opening: server, ms": (opened_ms - start_ms) / OPENINGS,
            "opening: kB": 1e-3 * n_bytes,
            "step: server, ms": (cpu_ms(address) - opened_ms) / WIRE_STEPS,
            "step: messages": (wire.n_messages - n_messages) / WIRE_STEPS,
            "step: kB": 1e-3 * (wire.n_bytes - n_bytes) / WIRE_STEPS,
            "step: response, ms": float(np.median(waits_ms)),
        }
        wire.close()
        return costs

    return asyncio.run(use())


class Meter:
    """Cost of a page from its creation on."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._start_ms = cpu_ms(address)
        self._n_messages = self._n_bytes = 0
        self._latest_s = time.monotonic()

    def watch(self, page: Page) -> None:
        """Follow a page that has not loaded anything yet."""
        self._page = page
        self._session = page.context.new_cdp_session(page)
        self._session.send("Performance.enable", {"timeDomain": "threadTicks"})
        page.on("websocket", self._follow)

    def settle(self) -> None:
        """Wait until no message has come for a while."""
        while time.monotonic() - self._latest_s < QUIET_S:
            self._page.wait_for_timeout(50)

    def press(self, slider: Any, n: int) -> None:
        """Move a slider by one key, to and fro."""
        self._latest_s = time.monotonic()
        slider.press("ArrowRight" if n // 10 % 2 else "ArrowLeft")

    def tour(self) -> None:
        """Go to other pages of the app and back."""
        for name in PAGES:
            before = self._page.url
            self._page.get_by_role("button", name=name, exact=True).click()
            self._page.wait_for_url(lambda url, before=before: url != before)
            self.settle()

    def totals(self) -> Costs:
        """Costs so far."""
        found = self._session.send("Performance.getMetrics")["metrics"]
        browser = {each["name"]: each["value"] for each in found}
        return {
            "server, ms": cpu_ms(self._address) - self._start_ms,
            "browser, ms": 1e3 * browser["TaskDuration"],
            "of it scripts, ms": 1e3 * browser["ScriptDuration"],
            "layouts": browser["LayoutCount"],
            "styles": browser["RecalcStyleCount"],
            "messages": self._n_messages,
            "kB": 1e-3 * self._n_bytes,
        }

    def _follow(self, socket: Any) -> None:
        socket.on("framesent", self._note)
        socket.on("framereceived", self._note)

    def _note(self, payload: str | bytes) -> None:
        self._latest_s = time.monotonic()
        self._n_messages += 1
        self._n_bytes += len(payload)


def browser_costs(browser: Browser, address: str) -> Costs:
    """Costs of opening the app, of a step of a slider, of a value of a drag, of going to a page."""
    meter = Meter(address)
    page = open_page(browser, address, watch=meter.watch)
    meter.settle()
    start = meter.totals()
    views = page.evaluate(f"(() => {{ {VIEWS} return views.length }})()")
    slider = page.get_by_role("slider", name="l", exact=True)
    response = page.locator("dl.timed dd").last
    responses_ms = []
    for n in range(BROWSER_STEPS):
        meter.press(slider, n)
        meter.settle()
        responses_ms.append(float(response.inner_text().removesuffix(" ms")))
    stepped = meter.totals()
    for n in range(DRAG_MOVES):
        meter.press(slider, n)
    meter.settle()
    dragged = meter.totals()
    meter.tour()  # which builds the other pages
    built = meter.totals()
    meter.tour()
    went = meter.totals()
    page.close()
    return {
        **{f"opening: {name}": value for name, value in start.items()},
        **{f"step: {name}": (stepped[name] - start[name]) / BROWSER_STEPS for name in start},
        "step: response, ms": float(np.median(responses_ms)),
        "views": float(views),
        **{f"drag: {name}": (dragged[name] - stepped[name]) / DRAG_MOVES for name in start},
        **{f"going: {name}": (went[name] - built[name]) / len(PAGES) for name in start},
    }


def memory_of(address: str) -> Costs:
    """Resident memory of a server after sessions of 256 × 256 pixels have come and gone."""

    async def come_and_go() -> None:
        wires = [Wire() for _ in range(SESSIONS)]
        for wire in wires:
            await wire.open(f"{address}?source=car_256")
        for wire in wires:
            wire.close()
        await asyncio.sleep(FORGOTTEN_S)

    asyncio.run(come_and_go())
    return {"memory after closed sessions, MB": server_process(address).memory_info().rss / 1e6}


def compare(name: str, rounds: int, measure: Callable[[str], Costs]) -> Iterator[str]:
    """Rows of the table for a patch; "server" and "browser" switch nothing off."""
    off = {} if name in CONTROLS else {OFF_VARIABLE: name}
    found: dict[bool, list[Costs]] = {True: [], False: []}
    with serving() as with_it, serving(**off) as without_it:
        measure(with_it), measure(without_it)  # the first page is slower
        for n in range(rounds):
            for is_on in (True, False) if n % 2 else (False, True):
                found[is_on].append(measure(with_it if is_on else without_it))
    for cost in found[True][0]:
        on, without = (np.array([each[cost] for each in found[key]]) for key in (True, False))
        ratios = without / np.maximum(on, 1e-9)
        yield (
            f"| {name} | {cost} | {np.median(on):.4g} | {np.median(without):.4g} "
            f"| {np.median(ratios):.3f} [{ratios.min():.3f}, {ratios.max():.3f}] |"
        )


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    names = [*CONTROLS, *(patch.name for patch in PATCHES)]
    parser = argparse.ArgumentParser(prog="python -m tests.patches", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="patches; default: all")
    parser.add_argument("--rounds", type=int, default=5, help="of each patch; default: 5")
    chosen = parser.parse_args(arguments)
    if unknown := {*chosen.names} - {*names}:
        parser.error(f"no patch is called {min(unknown)!r}; accepted: {', '.join(names)}")
    print("| patch | cost | with | without | without / with |\n|---|---|---|---|---|", flush=True)
    for name in chosen.names or names:
        if name == "freed_memory":
            rows = [*compare(name, 1, memory_of)]
        elif name == "browser" or (FOLDER / f"{name}.js").exists():
            with chromium() as browser:
                rows = [*compare(name, chosen.rounds, partial(browser_costs, browser))]
        else:
            rows = [*compare(name, chosen.rounds, server_costs)]
        print(*rows, sep="\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
