"""Requests and estimates: runs `core`, holds read-only results, imports no widgets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, lru_cache, partial
from hashlib import sha256
from importlib import resources
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from app.model.budget import fits, fitting, ranging, require_fitting, spending
from app.model.large import Cutout, Grid, LargeFile, open_large, require_small
from app.model.methods import default_settings
from app.model.state import (
    ALL_RETURNS,
    AUTOMATIC,
    MOST_PROBABLE,
    Illumination,
    ReductionSettings,
    Viewing,
)
from app.units import ShownGate
from core import (
    CORRECTIONS,
    ESTIMATORS,
    PARTS,
    Capture,
    PhotonBudget,
    Run,
    Scene,
    Signals,
    TrackingParameters,
    Window,
    first_difference,
    judged_by_image,
    rate_per_bin,
    read_capture,
    run,
    scenes,
    simulate,
    tracking_signals,
    trigger_probability,
    with_returns,
    without,
    without_correction,
)
from core.cost import Cost, cost_of, n_groups_of, predicted, predicted_returns_time
from core.estimators import JUDGES, Judge, suitable_method
from core.geometry import guessed_field_of_view_deg
from core.inference import has_posterior, pixel_range_intervals, posterior_of
from core.inspection import PixelReport
from core.io import ReadOptions, files_of
from core.metrics import Interval

NO_OPTIONS = ReadOptions()
_END_BYTES, _FILES_READ = 2**16, 16
_SCENES_KEPT = 2  # whose estimates are kept for the next sessions
ASSETS = Path(str(resources.files("assets")))


@dataclass(frozen=True)
class Source:
    """A built-in scene to simulate, or a file to read."""

    title: str
    load: Callable[[Request], Capture]
    """Simulates the scene, or reads the file, as a request says."""
    scene: Callable[[], Scene] | None = None
    """None for a file."""
    large: Callable[[ReadOptions], LargeFile | None] = lambda _reading: None
    """Opens a file that is read in windows; None for one that is read as a whole."""
    name: str = ""
    """Name of the scene in `core.scenes`, or of the file."""
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Arguments of the scene."""
    given: ReadOptions = NO_OPTIONS
    """Options for reading that hold unless a request has others."""
    truth: AddedTruth | None = None
    path: Path | None = None
    """Where the file is; None for a scene."""

    @property
    def is_scene(self) -> bool:
        """Whether captures are simulated."""
        return self.scene is not None

    def read(self) -> Capture:
        """Return the capture of a file, read with the options that are given.

        Raises
        ------
        ValueError
            If it cannot be read or is too large.
        """
        return self.load(Request(self))

    @property
    def without_truth(self) -> Source:
        """The capture without a truth that was added to it."""
        return self if self.truth is None else self.truth.to


@dataclass(frozen=True)
class AddedTruth:
    """True ranges that a file holds: another one than the capture's, or the same."""

    to: Source
    """The capture."""
    name: str
    """Name of the file."""
    options: Mapping[str, str] = field(hash=False)
    """Options of `core.read_truth`."""


def scene_source(title: str, name: str, **arguments: Any) -> Source:
    """Return a source of captures of a scene of `core.scenes`."""
    build = cache(partial(scenes[name], **arguments))
    return Source(title, simulated, build, name=name, arguments=arguments)


def simulated(request: Request) -> Capture:
    """Return a capture of the scene of a request, which its source names."""
    scene, light = request.scene, request.illumination
    acquisition, name = light.acquisition(scene.acquisition), request.source.name
    n_groups = scene.groups_of(acquisition.n_pulses)
    return simulate(scene, acquisition, light.flux, seed=light.seed, name=name, n_groups=n_groups)


def file_source(
    path: Path,
    title: str | None = None,
    *,
    given: ReadOptions = NO_OPTIONS,
    shared: bool = False,
) -> Source:
    """Return a capture file as a source; with `shared`, its capture is kept for all sessions."""

    def read(reading: ReadOptions) -> Capture:
        capture = read_capture(path, **vars(reading.completed_by(given)))
        require_small(path, capture.cube.nbytes)
        return capture

    def load(request: Request) -> Capture:
        large = opened(request.reading)
        return get(request.reading) if large is None else large.preview.capture

    @lru_cache(maxsize=1)
    def opened(reading: ReadOptions) -> LargeFile | None:
        return open_large(path, vars(reading.completed_by(given)))

    get = lru_cache(maxsize=1)(read) if shared else read
    return Source(title or path.name, load, large=opened, name=path.name, given=given, path=path)


def content_key(path: Path) -> str:
    """Return a key for links that names a file and tells it from others of the same name.

    It depends on the sizes of all files of a capture, and on both ends of the first ones.
    """
    digest = sha256()
    inside = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else []
    files = inside or files_of(path) or [path]
    for number, each in enumerate(files):
        size = each.stat().st_size
        digest.update(f"{each.relative_to(path.parent)} {size}\n".encode())
        if number >= _FILES_READ:
            continue
        with each.open("rb") as file:
            digest.update(file.read(_END_BYTES))
            file.seek(max(size - _END_BYTES, 0))
            digest.update(file.read(_END_BYTES))
    return f"{path.name}~{digest.hexdigest()[:8]}"


def built_in_sources() -> dict[str, Source]:
    """Return the scenes and the sample that every session offers."""
    return {
        "car": scene_source("Car at 50 m", "car"),
        "car_256": scene_source("Car at 50 m, 256 × 256", "car", size=256),
        "building": scene_source("Building at 830–860 m", "building"),
        "staircase": scene_source("Staircase through the gate", "staircase"),
        "uniform": scene_source("Random depths", "uniform"),
        "wall": scene_source("Oblique wall", "wall"),
        "piecewise": scene_source("Planes before a wall", "piecewise"),
        "net": scene_source("Net before a wall", "net"),
        "edges": scene_source("Building, edges seen whole", "edges"),
        "fog": scene_source("Car in fog", "fog"),
        "approach": scene_source("Car approached at 20 m/s", "approach"),
        "worn": scene_source("Car, worn instrument", "worn"),
        "field": scene_source("Generated field capture", "field"),
        "sample": file_source(ASSETS / "sample_capture.npz", "Sample capture (file)"),
    }


@dataclass(frozen=True)
class Request:
    """Everything that an estimate is computed from."""

    source: Source
    light: Illumination = field(default_factory=Illumination)
    reading: ReadOptions = field(default_factory=ReadOptions)
    tracking: TrackingParameters = field(default_factory=TrackingParameters)
    reduction: ReductionSettings = field(default_factory=ReductionSettings)
    method: str = AUTOMATIC
    """Key of `core.ESTIMATORS`, or `AUTOMATIC`."""
    settings: Mapping[str, Any] = field(default_factory=default_settings, hash=False)
    """Settings of the other estimators by their keys."""
    judged_by: Judge = JUDGES[0]
    returns: str = MOST_PROBABLE
    """One of `app.model.state.RETURNS`."""
    absent: frozenset[str] = frozenset()
    """Parts of the scene and corrections of the estimators that are switched off."""
    window: Window | None = None
    """Part of a capture larger than memory; None for its preview."""
    budget: PhotonBudget | None = None
    """Laser, optics and sunlight that give the flux of a scene; None for that of `light`."""

    @property
    def whole_scene(self) -> Scene:
        """The scene with all parts; with a photon budget, its signal falls with range."""
        return self._lit[0]

    @property
    def scene(self) -> Scene:
        """The scene without the parts that are switched off."""
        return without(self.whole_scene, *self.absent_parts)

    @property
    def absent_parts(self) -> tuple[str, ...]:
        """Parts of the scene that are switched off."""
        return tuple(part for part in PARTS if part in self.absent)

    @property
    def illumination(self) -> Illumination:
        """The illumination of a scene, with the flux of the photon budget if there is one."""
        return self._lit[1] if self.source.is_scene else self.light

    @cached_property
    def _lit(self) -> tuple[Scene, Illumination]:
        assert self.source.scene is not None
        scene = self.source.scene()
        if self.budget is None:
            return scene, self.light
        scene, flux = self.budget.apply(scene)
        return scene, replace(self.light, ppp=flux.signal, sbr=flux.sbr)

    def method_for(self, capture: Capture) -> str:
        """Return the key of the estimator for a capture."""
        return suitable_method(capture) if self.method == AUTOMATIC else self.method

    def settings_of(self, method: str) -> Any:
        """Return the settings of an estimator."""
        return self.tracking if method == "tracking" else self.settings[method]

    def with_settings(self, settings: Any) -> Request:
        """Return the request with other settings of its estimator, which must be named."""
        if self.method == "tracking":
            return replace(self, tracking=settings)
        return replace(self, settings={**self.settings, self.method: settings})


COMPUTED_FROM = tuple(each.name for each in fields(Request))
"""Parameters of the state that a request is made of."""


@dataclass(frozen=True)
class Refused:
    """A file that could not be read."""

    request: Request
    why: str
    """Reason, as shown on the page."""
    question: str
    """What the user must choose; empty for other errors."""
    choices: Mapping[str, Mapping[str, str]]
    """Options as text that answer the question, by title."""

    @classmethod
    def of(cls, request: Request, error: Exception, why: str) -> Refused:
        """Return what an error says about the file of a request."""
        question = getattr(error, "question", "").format(file=request.source.title)
        return cls(request, why, question, getattr(error, "choices", {}))


def is_ambiguous(error: Exception) -> bool:
    """Return whether a file was refused because the user must choose how to read it."""
    return bool(getattr(error, "question", ""))


@dataclass(frozen=True)
class Answer:
    """The estimate that was computed for a request."""

    request: Request
    run: Run
    capture_s: float
    """Seconds spent simulating or reading."""
    whole: Capture
    """The capture before its reduction."""
    own_field_of_view_deg: float
    """Horizontal field of view that the capture states, else a guess; see `field_of_view_deg`."""
    cutout: Cutout | None = None
    """The part in memory of a file larger than memory."""
    requested: ReductionSettings = field(default_factory=ReductionSettings)
    """The reduction that was requested; `request` has a stronger one where the server requires
    it."""

    @property
    def capture(self) -> Capture:
        """The capture after its reduction."""
        return self.run.capture

    @property
    def method(self) -> str:
        """Key of the estimator."""
        return self.request.method_for(self.capture)

    @property
    def settings(self) -> Any:
        """Settings of the estimator."""
        return self.request.settings_of(self.method)

    @property
    def follows_motion(self) -> bool:
        """Whether surfaces may have moved while the pulses were sent."""
        return ESTIMATORS[self.method].follows_motion and self.capture.groups is not None

    def field_of_view_deg(self, viewing: Viewing) -> float:
        """Return the field of view that the user has set, else the capture's own."""
        chosen = viewing.field_of_view_deg
        return self.own_field_of_view_deg if chosen is None else chosen

    def is_width_guessed(self, viewing: Viewing) -> bool:
        """Return whether the field of view is neither stated by the capture nor set by the user."""
        is_stated = self.capture.acquisition.pixel_angle_rad is not None
        return viewing.field_of_view_deg is None and not is_stated

    @property
    def gate(self) -> ShownGate:
        """The gate of the capture as a part of the whole one."""
        reduction = self.request.reduction
        first, _ = reduction.gate(self.whole.acquisition.n_bins)
        return ShownGate(self.capture.acquisition, first, reduction.merge)

    @property
    def grid(self) -> Grid:
        """Rows and columns in the file of the capture's pixels."""
        if self.cutout is None:
            return Grid()
        rows, cols = self.cutout.window.picked
        reduction = self.request.reduction
        return Grid((rows[0], cols[0]), rows.step).thinned(reduction.skip, reduction.pool)


def compute(request: Request, previous: Answer | None) -> Answer:
    """Compute an estimate, as far as possible from what the previous one holds.

    A capture that has just been opened is reduced until it fits the limits of a request
    (`app.model.budget`).

    Raises
    ------
    ValueError
        If the request exceeds these limits otherwise; as `Source.load`.
    """
    started = perf_counter()
    is_new = previous is None or not same_capture(request, previous.request)
    cutout = _cutout(request, None if is_new else previous)
    if cutout is not None:
        whole = cutout.capture
    elif previous is None or is_new:
        whole = request.source.load(request)
    else:
        whole = previous.whole
    requested = request.reduction
    if is_new:
        request = replace(request, reduction=_fitting(whole, request))
    if (
        previous is not None
        and whole is previous.whole
        and _agree(request, previous.request, "reduction", "absent")
    ):
        capture, capture_s = previous.capture, previous.capture_s
    else:
        shape = _reduced_shape(whole, request)
        require_fitting(shape, *_costliest(whole, request, shape))
        capture = reduced(whole, request)
        if request.reduction != requested:
            source = f"{capture.source}; reduced to fit the limits of this server"
            capture = replace(capture, source=source)
        capture_s = perf_counter() - started
    estimated, flux_s = _estimate(capture, request, previous)
    if previous is not None and same_view(request, previous.request):
        width_deg = previous.own_field_of_view_deg  # the cloud keeps its width
    else:
        width_deg = _own_field_of_view_deg(estimated)
    return Answer(request, estimated, capture_s + flux_s, whole, width_deg, cutout, requested)


def first_answer(request: Request) -> Answer:
    """Compute an estimate without a previous one; sessions share that of a scene."""
    return (_kept if request.source.is_scene else compute)(request, None)


_kept = lru_cache(maxsize=_SCENES_KEPT)(compute)


def _own_field_of_view_deg(run: Run) -> float:
    """Return the image's width as the capture states it; else about as wide as the scene is deep.

    Rounded to three digits, as a form shows it.
    """
    acquisition, image = run.capture.acquisition, run.image
    if acquisition.pixel_angle_rad is None:
        return guessed_field_of_view_deg(image.range_m, image.confidence, acquisition)
    half_width = run.capture.shape[1] / 2 * np.tan(acquisition.pixel_angle_rad)
    return float(f"{np.degrees(2 * np.arctan(half_width)):.3g}")


def _estimate(capture: Capture, request: Request, previous: Answer | None) -> tuple[Run, float]:
    """Return an estimate, that of `previous` if it is the same, and the seconds for the fluxes."""
    method = request.method_for(capture)
    settings = request.settings_of(method)
    if (
        previous is not None
        and capture is previous.capture
        and (method, settings) == (previous.method, previous.settings)
        and _agree(request, previous.request, "judged_by", "returns")
    ):
        return previous.run, 0.0
    with ranging(capture, method, settings):
        flux_s = 0.0
        if not has_posterior(capture):
            started = perf_counter()
            posterior_of(capture)  # every confidence is computed from it, whatever the method
            flux_s = perf_counter() - started
        found = run(capture, method, settings)
    found = judged(found, request.judged_by)
    if request.returns == ALL_RETURNS:
        with spending(capture.cube.shape, ALL_RETURNS, _returns_cost(capture)):
            found = replace(found, image=with_returns(capture, found.image))
    return found, flux_s


def judged(found: Run, judged_by: Judge) -> Run:
    """Return an estimate with the confidence by one of `core.estimators.JUDGES`, within limits."""
    if judged_by == "pixel":
        return found
    with ranging(found.capture, "image_posterior"):
        return replace(found, image=judged_by_image(found.capture, found.image))


def predicted_seconds(request: Request, previous: Answer) -> float:
    """Predict the time of an estimate of the capture of a previous one."""
    capture, method = previous.capture, request.method_for(previous.capture)
    seconds = cost_of(capture, method, request.settings_of(method)).seconds
    if request.returns == ALL_RETURNS:
        seconds += _returns_cost(capture).seconds
    kept = {each: getattr(request, each) for each in ("method", "tracking", "settings", "returns")}
    if request.judged_by == "image" and request != replace(previous.request, **kept):
        seconds += cost_of(capture, "image_posterior").seconds  # kept with its capture
    return seconds


def _returns_cost(capture: Capture) -> Cost:
    rows, cols, n_bins = capture.cube.shape
    return predicted_returns_time(rows * cols, n_bins)


def _reduced_shape(whole: Capture, request: Request) -> tuple[int, int, int]:
    rows, cols, n_bins = whole.cube.shape
    reduction = request.reduction.in_bins(n_bins)
    shape = rows, cols, n_bins
    return reduction.shape(shape) if reduction.fits(shape) else shape


def _costliest(whole: Capture, request: Request, shape: tuple[int, int, int]) -> tuple[str, Cost]:
    """Return the slowest method of a request, and its cost for a capture reduced to a shape."""
    methods = {request.method_for(whole)}
    if request.judged_by == "image":
        methods.add("image_posterior")
    groups = n_groups_of(whole)
    costs = {
        each: predicted(shape, each, request.settings_of(each), n_groups=groups) for each in methods
    }
    return max(costs.items(), key=lambda each: each[1].seconds)


def _fitting(whole: Capture, request: Request) -> ReductionSettings:
    """Return the requested reduction, or the weakest stronger one that fits."""

    def cost(shape: tuple[int, int, int]) -> Cost:
        return _costliest(whole, request, shape)[1]

    if fits(cost(_reduced_shape(whole, request))):
        return request.reduction
    rows, cols, n_bins = whole.cube.shape
    found = fitting((rows, cols, n_bins), cost, request.reduction.in_bins(n_bins))
    return (
        request.reduction
        if found is None
        else replace(request.reduction, merge=found[0], skip=found[1])
    )


def _cutout(request: Request, previous: Answer | None) -> Cutout | None:
    """Return the part in memory of a large file; its preview grows as more is read."""
    if previous is None:
        large = request.source.large(request.reading)
        return None if large is None else large.cutout(request.window)
    if previous.cutout is None or request.window is not None:
        return previous.cutout
    return previous.cutout.file.preview


def reduced(whole: Capture, request: Request) -> Capture:
    """Return a capture with the reduction and without the corrections that are switched off."""
    capture = request.reduction.in_bins(whole.acquisition.n_bins).of(whole)
    for name in CORRECTIONS:
        if name in request.absent:
            capture = without_correction(capture, name)
    return capture


def same_subject(one: Request, other: Request) -> bool:
    """Whether two requests are for the same scene and illumination, or the same file."""
    return _agree(one, other, "source", "light", "budget", "reading", "window")


def same_capture(one: Request, other: Request) -> bool:
    """Whether two requests are for the same capture, reductions aside."""
    return same_subject(one, other) and one.absent & {*PARTS} == other.absent & {*PARTS}


def same_view(one: Request, other: Request) -> bool:
    """Whether the estimates of two requests have the same pixels and bins."""
    kept = {replace(each.reduction, pulses=1.0) for each in (one, other)}
    return _agree(one, other, "source", "reading", "window") and len(kept) == 1


def same_pixels(one: Answer, other: Answer) -> bool:
    """Whether a row and a column mean the same in two estimates."""
    same = one.capture.shape == other.capture.shape and one.grid == other.grid
    return same and one.request.source.without_truth is other.request.source.without_truth


def _agree(one: Request, other: Request, *names: str) -> bool:
    return all(getattr(one, name) == getattr(other, name) for name in names)


@dataclass(frozen=True)
class Pixel:
    """One pixel of an estimate; bins are fractional, NaN where there is no range."""

    row: int
    col: int
    histogram: np.ndarray[Any, Any]
    """Detections in each bin, shape (bin,)."""
    signals: Signals | None
    """Stages of the tracking differentiator; None for another estimator."""
    score: np.ndarray[Any, Any]
    """Score of each bin, shape (bin,); of the tracking differentiator, the enhanced signal."""
    expected: np.ndarray[Any, Any] | None
    """Expected counts of the model; None where the truth is unknown."""
    difference: np.ndarray[Any, Any]
    truth_bin: float
    answer_bin: float
    range_m: float
    interval_95_m: Interval
    """The estimate with the 95 % interval of the range of the surface (`core.range_interval`)."""
    truth_m: float
    has_target: bool | None
    """None where the truth is unknown."""
    confidence: float
    counts: int
    at_rest: bool
    """Whether the score is that of a surface at rest, while the estimate follows its motion."""

    @property
    def peak_lag_bins(self) -> float:
        """Distance from the estimate to the middle of the bin of the largest score."""
        return float(np.argmax(self.score)) + 0.5 - self.answer_bin

    @property
    def lines(self) -> dict[str, np.ndarray[Any, Any] | None]:
        """Curves (bin,) over the histogram by their layers; None where they are not known."""
        signals = self.signals
        scales = (None, None) if signals is None else (signals.small, signals.large)
        return dict(zip(("expected", "small", "large"), (self.expected, *scales), strict=True))


def inspect(answer: Answer, row: int, col: int, report: PixelReport | None = None) -> Pixel:
    """Return the counts of one pixel and what the estimator makes of them.

    A report on the pixel, if there is one, has the score and the intervals already.
    """
    capture, image = answer.capture, answer.run.image
    acquisition, histogram = capture.acquisition, capture.cube[row, col]
    truth_m = np.nan if capture.truth_range_m is None else float(capture.truth_range_m[row, col])
    signals = None
    if answer.method == "tracking":
        signals = tracking_signals(histogram, answer.settings, capture.gated_pulses)
    if report is not None:
        score, interval_m = report.curve, report.interval_95_m
    else:
        score = ESTIMATORS[answer.method].curves(capture, row, col, answer.settings)
        (interval_m,) = pixel_range_intervals(capture, image, row, col, (0.95,))
    return Pixel(
        row,
        col,
        histogram.astype(float),
        signals,
        score,
        _expected_counts(capture, row, col),
        first_difference(histogram),
        float(acquisition.range_m_to_bin(truth_m)),
        float(image.bin[row, col]),
        float(image.range_m[row, col]),
        interval_m,
        truth_m,
        None if capture.truth_range_m is None else bool(np.isfinite(truth_m)),
        float(image.confidence[row, col]),
        int(capture.counts[row, col]),
        answer.follows_motion,
    )


def _expected_counts(capture: Capture, row: int, col: int) -> np.ndarray[Any, Any] | None:
    acquisition, truth_m = capture.acquisition, capture.truth_range_m
    signal, background = capture.signal, capture.background
    if truth_m is None or signal is None or background is None or acquisition.n_pulses is None:
        return None
    onset_bin = acquisition.range_m_to_bin(truth_m[row, col])
    rate = rate_per_bin(onset_bin, signal[row, col], background, capture.pulse, acquisition)
    return trigger_probability(rate) * acquisition.n_pulses


def is_wrong(answer: Answer, tolerance_bins: float = 3.0) -> np.ndarray[Any, Any] | None:
    """Return the pixels whose estimate is outside the tolerance; None without a truth."""
    truth_m, image = answer.capture.truth_range_m, answer.run.image
    if truth_m is None:
        return None
    tolerance_m = tolerance_bins * answer.capture.acquisition.bin_length_m
    return np.asarray(image.valid & ~(np.abs(image.range_m - truth_m) <= tolerance_m))
