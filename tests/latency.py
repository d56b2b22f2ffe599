"""Time from a key press to changed pixels in a real browser: ``python -m tests.latency``.

Each move presses an arrow key on a slider of the served app, at 64 × 64 pixels and 100 bins. The
page records the times of the key, of messages to and from the server, and of every stroke on a
canvas. "Plots" are the pixel's three plots; "everything" includes the image and the 3D cloud, which
are drawn after them on purpose.

On the 21 km capture, 256 × 256 pixels and 200 bins, arrow keys move the pixel of the Inspect page.
Opening times run from the address to the last stroke, for new browsers and for a second visit; the
server has shown the page before.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, fields

import numpy as np
from playwright.sync_api import Browser, Locator, Page

from core.tests.captures import CAPTURES
from tests.browser import chromium, open_page, serving

OPENINGS = 7

# Runs before the page's own scripts. Times are in milliseconds, `paints` one per canvas and stroke.
STOPWATCH = """
window.watch = { key: 0, sent: 0, received: 0, paints: [] };
addEventListener("keydown", () => {
  watch = { key: performance.now(), sent: 0, received: 0, paints: [] };
}, true);
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (data) {
  if (!watch.sent) watch.sent = performance.now();
  return send.call(this, data);
};
const listen = Object.getOwnPropertyDescriptor(WebSocket.prototype, "onmessage");
Object.defineProperty(WebSocket.prototype, "onmessage", {
  set(handler) {
    listen.set.call(this, (event) => {
      const isPatch = String(event.data).includes('"PATCH-DOC"');
      if (isPatch && !watch.received) watch.received = performance.now();
      return handler(event);
    });
  },
});
const part = (canvas) => {
  for (let node = canvas; node; node = node.parentNode ?? node.host) {
    if (node.dataset?.part) return node.dataset.part;
    if (node === document) return "plots";
  }
  return "none"; // an off-screen canvas
};
const observe = (prototype, names) => {
  for (const name of names) {
    const draw = prototype[name];
    prototype[name] = function (...values) {
      const result = draw.apply(this, values);
      const place = this.drawArrays ? "cloud" : part(this.canvas);
      if (place !== "none") watch.paints.push([performance.now(), place]);
      return result;
    };
  }
};
const strokes = ["stroke", "fill", "fillRect", "drawImage", "fillText"];
observe(CanvasRenderingContext2D.prototype, strokes);
observe(WebGL2RenderingContext.prototype, ["drawArrays", "drawElements"]);
"""

ANSWERED = "watch.paints.some(([, part]) => part === 'plots')"
PAINTED = "watch.paints.length ? watch.paints.at(-1)[0] : null"


@dataclass(frozen=True)
class Move:
    """Milliseconds from the key press to ..."""

    server: float
    """... the answer's arrival in the browser."""
    plots: float
    """... the last stroke of the pixel's plots."""
    everything: float
    """... the last stroke of image and cloud."""


def moves(page: Page, label: str, count: int) -> list[Move]:
    """Press the arrow keys on a slider, back and forth, and wait each time until all is drawn."""
    return _moves(page, page.get_by_role("slider", name=label, exact=True), count)


def pixel_moves(page: Page, count: int) -> list[Move]:
    """Press the arrow keys on the range image."""
    return _moves(page, page.locator("[data-part=image]"), count)


def openings_ms(browser: Browser, address: str) -> tuple[float, float]:
    """Milliseconds from the address of a page to its last stroke, at the first and second visit."""
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    page = context.new_page()
    page.add_init_script(STOPWATCH)
    first, again = (_opening_ms(page, address) for _ in range(2))
    context.close()
    return first, again


def _opening_ms(page: Page, address: str) -> float:
    page.goto(address)
    last = None
    while last is None or page.evaluate(PAINTED) != last:
        last = page.evaluate(PAINTED)
        page.wait_for_timeout(2000)
    return float(last)


def _moves(page: Page, control: Locator, count: int) -> list[Move]:
    control.focus()
    taken = []
    for n in range(count):
        control.press("ArrowRight" if n // 10 % 2 else "ArrowLeft")
        page.wait_for_function(ANSWERED)
        page.wait_for_timeout(500)  # for what is drawn after them
        watch = page.evaluate("watch")
        plots = max(at for at, part in watch["paints"] if part == "plots")
        everything = max(at for at, _ in watch["paints"])
        taken.append(
            Move(
                watch["received"] - watch["key"],
                plots - watch["key"],
                everything - watch["key"],
            )
        )
    return taken


def as_markdown(measured: dict[str, list[Move]]) -> str:
    """Median and 95th percentile of each part, a row a slider."""
    lines = [
        "| move | answer in the browser, ms (95 %) | plots painted | image and cloud painted |",
        "|---|---|---|---|",
    ]
    for label, each in measured.items():
        cells = []
        for part in fields(Move):
            times = [getattr(move, part.name) for move in each]
            cells.append(f"{np.median(times):.0f} ({np.percentile(times, 95):.0f})")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.latency", description=__doc__)
    parser.add_argument("--moves", type=int, default=60, help="moves of each slider")
    chosen = parser.parse_args(arguments)
    with serving() as address, chromium() as browser:
        page = open_page(browser, address, prepare=STOPWATCH)
        page.wait_for_timeout(3000)
        sliders = ("l", "T_n (bins)", "SBR")
        taken = {label: moves(page, label, chosen.moves) for label in sliders}
        page.close()
    capture = CAPTURES / "21km_K11_night.mat"
    opened = ""
    if capture.exists():
        with serving(capture) as address, chromium() as browser:
            openings_ms(browser, address)
            firsts, agains = zip(
                *(openings_ms(browser, address) for _ in range(OPENINGS)), strict=True
            )
            page = open_page(browser, address, prepare=STOPWATCH)
            page.wait_for_timeout(3000)
            taken["pixel on the 21 km capture"] = pixel_moves(page, chosen.moves)
        opened = (
            f"Open the 21 km capture, ranged and drawn: {np.median(agains):.0f} ms "
            f"(longest of {OPENINGS}: {max(agains):.0f}); "
            f"by a new browser: {np.median(firsts):.0f} ms ({max(firsts):.0f})"
        )
    print(as_markdown(taken))
    print(f"\n{opened or f'{capture} is missing: it was not measured.'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
