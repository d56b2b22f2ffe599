"""A session's capture and answer: runs `core`, holds read-only results, knows no widget."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache, lru_cache, partial
from importlib import resources
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from app.model.budget import fits, fitting, ranging, require_fitting
from app.model.large import Cutout, Grid, LargeFile, open_large, require_small
from app.model.state import Illumination, Less
from core import (
    CORRECTIONS,
    PARTS,
    Capture,
    Run,
    Scene,
    Signals,
    TrackingParameters,
    Window,
    first_difference,
    rate_per_bin,
    read_capture,
    run,
    scenes,
    simulate,
    tracking_signals,
    trigger_probability,
    without,
    without_correction,
)
from core.cost import Cost, predicted
from core.inference import has_posterior, posterior_of
from core.io import ReadOptions

ASSETS = Path(str(resources.files("assets")))


@dataclass(frozen=True)
class Source:
    """Something to look at: a built-in scene to simulate, or a file to read."""

    title: str
    load: Callable[[Illumination, ReadOptions, Collection[str]], Capture]
    """Makes the capture, parts of some names left out of a scene."""
    scene: Callable[[], Scene] | None = None
    """None for a file."""
    large: Callable[[ReadOptions], LargeFile | None] = lambda _reading: None
    """Opens a file of which only windows are read; None where all of it is."""
    name: str = ""
    """Of the scene in `core.scenes`, or of the file."""
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """With which the scene is built."""

    @property
    def is_scene(self) -> bool:
        """Whether it is simulated."""
        return self.scene is not None


def bare(scene: Scene, absent: Collection[str]) -> Scene:
    """A scene without those of its parts that are switched off."""
    for part in PARTS:
        if part in absent:
            scene = without(scene, part)
    return scene


def scene_source(title: str, name: str, **arguments: Any) -> Source:
    """A built-in scene of `core.scenes`."""

    build = cache(partial(scenes[name], **arguments))

    def load(light: Illumination, _reading: ReadOptions, absent: Collection[str]) -> Capture:
        scene = bare(build(), absent)
        return simulate(scene, light.acquisition(scene.acquisition), light.flux, seed=light.seed)

    return Source(title, load, build, name=name, arguments=arguments)


def file_source(path: Path, title: str | None = None, *, shared: bool = False) -> Source:
    """A capture file; one that all sessions share is kept once it is read."""

    def read(reading: ReadOptions) -> Capture:
        capture = read_capture(path, **vars(reading))
        require_small(path, capture.cube.nbytes)
        return capture

    def load(_light: Illumination, reading: ReadOptions, _absent: Collection[str]) -> Capture:
        large = opened(reading)
        return get(reading) if large is None else large.preview.capture

    @lru_cache(maxsize=1)
    def opened(reading: ReadOptions) -> LargeFile | None:
        return open_large(path, vars(reading))

    get = lru_cache(maxsize=1)(read) if shared else read
    return Source(title or path.name, load, large=opened, name=path.name)


def built_in_sources() -> dict[str, Source]:
    """What every session starts with."""
    return {
        "car": scene_source("Car at 50 m", "car"),
        "car_256": scene_source("Car at 50 m, 256 × 256", "car", size=256),
        "building": scene_source("Building at 830–860 m", "building"),
        "staircase": scene_source("Staircase through the gate", "staircase"),
        "uniform": scene_source("Random depths", "uniform"),
        "edges": scene_source("Building, edges seen whole", "edges"),
        "fog": scene_source("Car in fog", "fog"),
        "approach": scene_source("Car approached at 20 m/s", "approach"),
        "worn": scene_source("Car, worn instrument", "worn"),
        "sample": file_source(ASSETS / "sample_capture.npz", "Sample capture (file)"),
    }


@dataclass(frozen=True)
class Request:
    """What is to be computed."""

    source: Source
    light: Illumination
    reading: ReadOptions
    tracking: TrackingParameters
    less: Less
    absent: frozenset[str] = frozenset()
    """Parts of the scene and corrections of the estimators that are switched off."""
    window: Window | None = None
    """Of a capture larger than memory; None for all of it."""


COMPUTED_FROM = tuple(each.name for each in fields(Request))
"""Parameters of the state that an answer is computed from."""


@dataclass(frozen=True)
class Answer:
    """What was computed, and from what."""

    request: Request
    run: Run
    capture_s: float
    """Seconds spent simulating or reading."""
    whole: Capture
    """What the capture that was ranged is a part of, or that capture itself."""
    cutout: Cutout | None = None
    """Of a file larger than memory, what is in memory."""
    asked: Less = field(default_factory=Less)
    """The reduction that was asked for; that of `request` leaves out more where this would take
    more than the server gives to a request."""

    @property
    def capture(self) -> Capture:
        """The capture that was ranged."""
        return self.run.capture

    @property
    def grid(self) -> Grid:
        """Which rows and columns of its file the pixels of the capture are."""
        if self.cutout is None:
            return Grid()
        rows, cols = self.cutout.window.picked
        less = self.request.less
        return Grid((rows[0], cols[0]), rows.step).thinned(less.skip, less.pool)


def compute(request: Request, previous: Answer | None) -> Answer:
    """Answer a request; what the previous answer already holds is not computed again.

    A capture that is opened, and takes more memory or time than one request may, is reduced until
    it fits (`app.model.budget`).

    Raises
    ------
    ValueError
        If it takes more than one request may, and is not opened just now; as `Source.load`.
    """
    started = perf_counter()
    cutout = _cutout(request, previous)
    if cutout is not None:
        whole = cutout.capture
    elif previous is None or not same_capture(request, previous.request):
        whole = request.source.load(request.light, request.reading, request.absent)
    else:
        whole = previous.whole
    asked = request.less
    if previous is None or not same_capture(request, previous.request):
        request = replace(request, less=_fitting(whole, request))
    if (
        previous is not None
        and whole is previous.whole
        and _same(request, previous.request, "less", "absent")
    ):
        capture, capture_s = previous.capture, previous.capture_s
    else:
        require_fitting(_reduced_shape(whole, request), "tracking", _cost(whole, request))
        capture = reduced(whole, request)
        if request.less != asked:
            fewer = f"{capture.source}; so reduced that it takes no more than this server allows"
            capture = replace(capture, source=fewer)
        capture_s = perf_counter() - started
    with ranging(capture, "tracking", request.tracking):
        started = perf_counter()
        if not has_posterior(capture):
            posterior_of(capture)  # what every answer's confidence rests on, whatever the method
            capture_s += perf_counter() - started
        ranged = run(capture, "tracking", request.tracking)
    return Answer(request, ranged, capture_s, whole, cutout, asked)


def _reduced_shape(whole: Capture, request: Request) -> tuple[int, int, int]:
    rows, cols, n_bins = whole.cube.shape
    reduction = request.less.reduction(n_bins)
    fits = reduction.fits((rows, cols, n_bins))
    return reduction.shape((rows, cols, n_bins)) if fits else (rows, cols, n_bins)


def _cost(whole: Capture, request: Request) -> Cost:
    return predicted(_reduced_shape(whole, request), "tracking", request.tracking)


def _fitting(whole: Capture, request: Request) -> Less:
    """The reduction asked for, or the least that is more of it and that one request may take."""
    if fits(_cost(whole, request)):
        return request.less
    rows, cols, n_bins = whole.cube.shape
    found = fitting((rows, cols, n_bins), "tracking", request.less.reduction(n_bins))
    return request.less if found is None else replace(request.less, merge=found[0], skip=found[1])


def _cutout(request: Request, previous: Answer | None) -> Cutout | None:
    """What is looked at of a file larger than memory; of its preview, as much as has been read."""
    if previous is None or not same_capture(request, previous.request):
        large = request.source.large(request.reading)
        return None if large is None else large.cutout(request.window)
    if previous.cutout is None or request.window is not None:
        return previous.cutout
    return previous.cutout.file.preview


def reduced(whole: Capture, request: Request) -> Capture:
    """As much of a capture as is asked for, some corrections switched off."""
    capture = request.less.reduction(whole.acquisition.n_bins).of(whole)
    for name in CORRECTIONS:
        if name in request.absent:
            capture = without_correction(capture, name)
    return capture


def same_subject(one: Request, other: Request) -> bool:
    """Whether both look at the same scene in the same light, or the same file, part or no part."""
    return _same(one, other, "source", "light", "reading", "window")


def same_capture(one: Request, other: Request) -> bool:
    """Whether both look at the same capture, however much of it."""
    return same_subject(one, other) and one.absent & {*PARTS} == other.absent & {*PARTS}


def same_view(one: Request, other: Request) -> bool:
    """Whether the answers to both show the same pixels and bins, in whatever light."""
    seen = (replace(each.less, pulses=1.0) for each in (one, other))
    return _same(one, other, "source", "reading", "window") and len({*seen}) == 1


def same_pixels(one: Answer, other: Answer) -> bool:
    """Whether a row and a column mean the same in both."""
    same = one.capture.shape == other.capture.shape and one.grid == other.grid
    return same and one.request.source is other.request.source


def _same(one: Request, other: Request, *names: str) -> bool:
    return all(getattr(one, name) == getattr(other, name) for name in names)


@dataclass(frozen=True)
class Pixel:
    """Everything about one pixel; bins are fractional, NaN where there is nothing."""

    row: int
    col: int
    signals: Signals
    expected: np.ndarray[Any, Any] | None
    """The model's expected counts, where the truth is known."""
    difference: np.ndarray[Any, Any]
    truth_bin: float
    answer_bin: float
    range_m: float
    truth_m: float
    confidence: float
    counts: int


def inspect(answer: Answer, row: int, col: int) -> Pixel:
    """Every stage of the estimator for one pixel of an answer."""
    capture, image = answer.capture, answer.run.image
    acquisition, histogram = capture.acquisition, capture.cube[row, col]
    truth_m = np.nan if capture.truth_range_m is None else float(capture.truth_range_m[row, col])
    expected = _expected_counts(capture, row, col)
    return Pixel(
        row,
        col,
        tracking_signals(histogram, answer.request.tracking, capture.gated_pulses),
        expected,
        first_difference(histogram),
        float(acquisition.range_m_to_bin(truth_m)),
        float(image.bin[row, col]),
        float(image.range_m[row, col]),
        truth_m,
        float(image.confidence[row, col]),
        int(capture.counts[row, col]),
    )


def _expected_counts(capture: Capture, row: int, col: int) -> np.ndarray[Any, Any] | None:
    acquisition = capture.acquisition
    if (
        capture.truth_range_m is None
        or capture.signal is None
        or capture.background is None
        or acquisition.n_pulses is None
    ):
        return None
    onset_bin = acquisition.range_m_to_bin(capture.truth_range_m[row, col])
    rate = rate_per_bin(
        onset_bin, capture.signal[row, col], capture.background, capture.pulse, acquisition
    )
    return trigger_probability(rate) * acquisition.n_pulses


def is_wrong(answer: Answer, tolerance_bins: float = 3.0) -> np.ndarray[Any, Any] | None:
    """Answers off by more than `tolerance_bins`, or without a target; None without truth."""
    truth_m, image = answer.capture.truth_range_m, answer.run.image
    if truth_m is None:
        return None
    tolerance_m = tolerance_bins * answer.capture.acquisition.bin_length_m
    return np.asarray(image.valid & ~(np.abs(image.range_m - truth_m) <= tolerance_m))
