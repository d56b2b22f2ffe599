"""Many sessions at once, and many interactions in one: ``python -m tests.load``.

Sessions are clients of Bokeh's protocol (`tests.wire`), on the same cores as the server; as many
real browsers would measure browsers. Each drags one control after the other, 20 values a second,
whether or not the last one was answered. As in a browser, a value that is replaced before it is
sent (``latest_value.js``) has no response of its own: each value counts as answered when the first
data arrive that show it or a later one of the same drag. The value follows from the data: T_n is
where the weight begins, SBR follows from the first of the expected counts.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from random import Random
from typing import Any

import numpy as np

from app.model.state import Illumination
from app.plots.elements import ENHANCED_LAYERS, HISTOGRAM_LAYERS
from tests.browser import server_process, serving
from tests.wire import Wire

MOVES_A_SECOND = 20
MOVES_A_DRAG = 40
PAUSE_S = 0.3
"""Pause of a user between two controls."""

LATEST_S = 30.0
"""A response that takes longer is missing."""

TITLES = {"Estimate": "Estimated", "Truth": "True", "Error": "Error:", "Counts": "Detections"}
"""First word of the title of each kind of image."""

SCENES = ("Car at 50 m", "Staircase through the gate", "Car at 50 m", "Random depths")
"""Scenes of the sessions; half of them stay on the first scene."""

FORGOTTEN_S = 40.0
"""Time after which the server has dropped closed sessions."""

WARM = 200
"""Interactions before growth is measured."""

MEGA = 1e6


@dataclass(frozen=True)
class Bounds:
    """Requirements on the server."""

    latency_s: float = 1.0
    session_mb: float = 60.0
    growth_mb: float = 30.0


@dataclass(frozen=True)
class Control:
    """A control to drag, and the value of it that the data on the page show."""

    model: str
    attribute: str
    values: Sequence[Any]
    shown: Callable[[], Any]


class Hand:
    """Moves the controls of one session, and waits for the responses."""

    def __init__(self, wire: Wire, random: Random) -> None:
        self._wire = wire
        self._random = random
        figures = {
            each["attributes"]["title"]["attributes"]["text"].split()[0]: each["attributes"]
            for each in wire.models.values()
            if each["name"] == "Figure"
        }
        image = figures[TITLES["Estimate"]]
        self._title = image["title"]["id"]
        self._expected = _source(figures["Histogram"], HISTOGRAM_LAYERS.index("expected"))
        self._weight = _source(figures["Enhanced:"], ENHANCED_LAYERS.index("weight"))
        self._numbers = next(
            key
            for key, each in wire.models.items()
            if each["name"].startswith("Facts") and "Pixel" in _named(each["attributes"]["facts"])
        )
        knob = partial(wire.find, "Knob")
        pixels = [[row, col] for row in (20, 40) for col in range(12, 52)]
        self._controls = (
            Control(knob(label="l"), "value", _spaced(2e-3, 2e-2), self._shown_l),
            Control(knob(label="SBR"), "value", _spaced(0.03, 0.5), self._shown_sbr),
            Control(knob(label="T_n"), "value", [*range(5, 45)], self._shown_t_n),
            Control(wire.find("PixelKeys"), "pixel", pixels, self._shown_pixel),
        )
        kinds = wire.find("RadioButtonGroup", value="Estimate")
        self._image = Control(kinds, "value", list(TITLES), self._shown_image)
        self._alert = wire.find("Sentence", warning=True)
        self.latencies_s: list[float] = []
        self.troubles: list[str] = []

    async def go_to(self, scene: str) -> None:
        """Choose another scene."""
        if scene != SCENES[0]:
            chosen = self._wire.find("Select", label="Scene or capture")
            cloud = self._wire.find("PointCloud")
            before = self._wire.values[cloud, "scene_id"]
            await self._wire.set(chosen, "value", scene)
            await self._until(lambda: self._wire.values[cloud, "scene_id"] != before)

    async def drag(self) -> None:
        """Drag a random control through some of its values."""
        control = self._random.choice((*self._controls, self._image))
        values = self._some(control)
        sent_s: list[float] = []
        following = asyncio.ensure_future(self._follow(control, values, sent_s))
        pace = 1 / MOVES_A_SECOND
        for value in values:
            sent_s.append(time.perf_counter())
            await self._wire.set(control.model, control.attribute, value)
            await asyncio.sleep(max(0.0, sent_s[0] + len(sent_s) * pace - time.perf_counter()))
        await following
        await asyncio.sleep(PAUSE_S)

    async def step(self) -> None:
        """Set a random control to another value, and wait for the response."""
        control = self._random.choice(self._controls)
        value = self._random.choice([v for v in control.values if v != control.shown()])
        sent_s = [time.perf_counter()]
        await self._wire.set(control.model, control.attribute, value)
        await self._follow(control, [value], sent_s)

    def _some(self, control: Control) -> list[Any]:
        """Return consecutive values without the one on show."""
        values = list(control.values)
        if control is self._image:
            return [kind for kind in values if kind != control.shown()]
        if self._random.random() < 0.5:
            values.reverse()
        start = self._random.randrange(len(values) - MOVES_A_DRAG + 1)
        return [v for v in values[start : start + MOVES_A_DRAG] if v != control.shown()]

    async def _follow(
        self, control: Control, values: Sequence[Any], sent_s: Sequence[float]
    ) -> None:
        """Record the response time of each value until the last one has come."""
        answered = 0

        def is_over() -> bool:
            nonlocal answered
            shown, now_s = control.shown(), time.perf_counter()
            if shown in values:
                newest = values.index(shown)
                self.latencies_s += [now_s - at for at in sent_s[answered : newest + 1]]
                answered = max(answered, newest + 1)
            return answered == len(values)

        await self._until(is_over)

    async def _until(self, holds: Callable[[], bool]) -> None:
        wire = self._wire
        try:
            async with asyncio.timeout(LATEST_S), wire.news:
                await wire.news.wait_for(lambda: holds() or wire.is_closed)
        except TimeoutError:
            self.troubles.append(f"no answer within {LATEST_S:.0f} s")
        if complaint := wire.values.get((self._alert, "text"), ""):
            self.troubles.append(complaint)

    # What the data on the page show

    def _number(self, name: str) -> float:
        facts = self._wire.values[self._numbers, "facts"]
        return next(float(value.split()[0]) for each, value, _ in facts if each == name)

    def _shown_l(self) -> float:
        return _nearest(self._number("r small") / self._number("σ"), _spaced(2e-3, 2e-2))

    def _shown_sbr(self) -> float:
        expected, light = self._wire.values[self._expected, "counts"], Illumination()
        background = -math.log1p(-expected[0] / light.n_pulses) * expected.size
        return _nearest(light.ppp / background, _spaced(0.03, 0.5))

    def _shown_t_n(self) -> int:
        return int(np.flatnonzero(self._wire.values[self._weight, "enhanced"])[0])

    def _shown_pixel(self) -> list[int]:
        facts = self._wire.values[self._numbers, "facts"]
        return [int(number) for number in re.findall(r"\d+", _named(facts)["Pixel"])]

    def _shown_image(self) -> str:
        title = self._wire.values[self._title, "text"].split()[0]
        return next(kind for kind, begins in TITLES.items() if begins == title)


def _named(facts: list[Any]) -> dict[str, str]:
    """Return the values of named facts."""
    return {name: value for name, value, _ in facts}


def _source(figure: Any, layer: int) -> str:
    """Id of the source of a figure's layer."""
    return figure["renderers"][layer]["attributes"]["data_source"]["id"]


def _spaced(low: float, high: float) -> list[float]:
    """Values that a slider on a logarithmic track takes."""
    return [float(f"{value:.3g}") for value in np.geomspace(low, high, 60)]


def _nearest(value: float, among: Sequence[float]) -> float:
    return min(among, key=lambda each: abs(math.log(each / value)))


# Measurements


@dataclass(frozen=True)
class Load:
    """Result of several sessions at once."""

    sessions: int
    latencies_s: np.ndarray[Any, Any]
    troubles: list[str]
    before_mb: float
    """Resident memory of the server after one session."""
    with_mb: float
    """Highest resident memory with all sessions."""
    after_mb: float
    """Resident memory after all sessions have ended."""

    @property
    def session_mb(self) -> float:
        """Memory that each session takes."""
        return (self.with_mb - self.before_mb) / self.sessions


@dataclass(frozen=True)
class Growth:
    """Result of one session with many interactions."""

    interactions: int
    troubles: list[str]
    before_mb: float
    after_mb: float


async def load(
    address: str,
    resident_mb: Callable[[], float],
    sessions: int,
    seconds: float,
    forgotten_s: float = FORGOTTEN_S,
) -> Load:
    """Open sessions, drag the controls of each for some seconds, and close them."""
    warm, _ = await opened(address, seed=0)
    warm.close()
    await asyncio.sleep(forgotten_s)
    before_mb = highest_mb = resident_mb()
    tabs = [await opened(address, seed) for seed in range(sessions)]

    async def use(hand: Hand, scene: str) -> None:
        await hand.go_to(scene)
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s and not hand.troubles:
            await hand.drag()

    async def watch() -> None:
        nonlocal highest_mb
        while True:
            highest_mb = max(highest_mb, resident_mb())
            await asyncio.sleep(0.2)

    watching = asyncio.ensure_future(watch())
    await asyncio.gather(
        *(use(hand, scene) for (_, hand), scene in zip(tabs, cycle(SCENES), strict=False))
    )
    watching.cancel()
    for wire, _ in tabs:
        wire.close()
    await asyncio.sleep(forgotten_s)
    return Load(
        sessions,
        np.concatenate([hand.latencies_s for _, hand in tabs]),
        [trouble for wire, hand in tabs for trouble in (*wire.troubles, *hand.troubles)],
        before_mb,
        highest_mb,
        resident_mb(),
    )


async def growth(
    address: str, resident_mb: Callable[[], float], interactions: int, warm: int = WARM
) -> Growth:
    """Set controls of one session one after the other."""
    wire, hand = await opened(address, seed=0)
    for _ in range(warm):
        await hand.step()
    before_mb = resident_mb()
    for _ in range(interactions):
        await hand.step()
    after_mb = resident_mb()
    wire.close()
    return Growth(interactions, [*wire.troubles, *hand.troubles], before_mb, after_mb)


async def opened(address: str, seed: int) -> tuple[Wire, Hand]:
    """Open a session; return it with a hand on its controls."""
    wire = Wire()
    await wire.open(address)
    return wire, Hand(wire, Random(seed))


def verdicts(used: Load, grown: Growth, bounds: Bounds) -> list[tuple[str, str, str, bool]]:
    """Return quantity, requirement, measurement, and whether it is met."""
    troubles = [*used.troubles, *grown.troubles]
    median, p95, p99 = np.percentile(used.latencies_s, [50, 95, 99])
    resident = ", ".join(f"{mb:.0f}" for mb in (used.before_mb, used.with_mb, used.after_mb))
    grown_mb = grown.after_mb - grown.before_mb
    return [
        ("sessions at once", "", f"{used.sessions}", True),
        ("interactions", "", f"{used.latencies_s.size:,}", True),
        ("errors", "none", f"{len(troubles)}", not troubles),
        ("response, median", "", f"{1e3 * median:.0f} ms", True),
        (
            "response, 95 %",
            f"< {1e3 * bounds.latency_s:.0f} ms",
            f"{1e3 * p95:.0f} ms",
            bool(p95 < bounds.latency_s),
        ),
        ("response, 99 %", "", f"{1e3 * p99:.0f} ms", True),
        ("resident memory before, with, after", "", f"{resident} MB", True),
        (
            "memory of a session",
            f"≤ {bounds.session_mb:.0f} MB",
            f"{used.session_mb:.1f} MB",
            used.session_mb <= bounds.session_mb,
        ),
        (
            f"growth by {grown.interactions:,} interactions of one session",
            f"< {bounds.growth_mb:.0f} MB",
            f"{grown_mb:.1f} MB",
            grown_mb < bounds.growth_mb,
        ),
    ]


def as_markdown(found: Sequence[tuple[str, str, str, bool]]) -> str:
    """Return a table with a row for each verdict."""
    lines = ["| quantity | required | measured |  |", "|---|---|---|---|"]
    for what, asked, measured, is_reached in found:
        verdict = ("reached" if is_reached else "missed") if asked else ""
        lines.append(f"| {what} | {asked} | {measured} | {verdict} |")
    return "\n".join(lines)


def server_mb(address: str) -> Callable[[], float]:
    """Return a function that measures the resident memory of a server."""
    server = server_process(address)
    return lambda: server.memory_info().rss / MEGA


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; return 1 if a requirement is missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.load", description=__doc__)
    parser.add_argument("--sessions", type=int, default=20, help="at once; default: 20")
    parser.add_argument("--seconds", type=float, default=60.0, help="of dragging; default: 60")
    parser.add_argument(
        "--interactions", type=int, default=10_000, help="of one session; default: 10,000"
    )
    chosen = parser.parse_args(arguments)

    with serving() as address:
        used = asyncio.run(load(address, server_mb(address), chosen.sessions, chosen.seconds))
    with serving() as address:  # another process, without the memory of many sessions
        grown = asyncio.run(growth(address, server_mb(address), chosen.interactions))
    found = verdicts(used, grown, Bounds())
    print(as_markdown(found))
    for trouble in sorted({*used.troubles, *grown.troubles}):
        print(f"error: {trouble}")
    return 0 if all(is_reached for *_, is_reached in found) else 1


if __name__ == "__main__":
    sys.exit(main())
