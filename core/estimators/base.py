"""Common parts of estimators: interface, lag calibration, confidence, detection threshold."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.checks import require
from core.deprecation import renamed
from core.geometry import Box
from core.inference.fit import fit_of
from core.inference.flux import flux_model_of
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions
from core.inference.motion import RadialVelocity
from core.inference.neighbours import Patch, patches, pooled_at, pooled_in
from core.inference.posterior import tolerance_probability
from core.inference.returns import Returns
from core.kernels.parallel import each_on_threads
from core.labels import Plane, images_dataset, software
from core.notebook import html_table
from core.parameters import Choice, Number
from core.trigger import draw_counts, rate_per_bin, trigger_probability

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class NoParameters:
    """Settings of a method that has none."""


class _Deferred:
    """Field for a text, or for a function that returns it and is called at the first access."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, holder: object, owner: type | None = None) -> str:
        if holder is None:
            return ""  # default of the field
        text = vars(holder)[self._name]
        if callable(text):
            text = vars(holder)[self._name] = text()
        return str(text)

    def __set__(self, holder: object, text: str | Callable[[], str]) -> None:
        vars(holder)[self._name] = text


@dataclass(frozen=True)
class Provenance:
    """How the estimates of a range image were made.

    Parameters
    ----------
    method : str
        Key of `core.ESTIMATORS`.
    settings : dataclass
        Settings of the method.
    false_alarm : float, optional
        As for `core.estimate`.
    remark : str
        Limits of the model, see `Estimator.remark`. May be given as a function that returns it: the
        goodness of fit takes longer than an estimate.
    least_confidence : float, optional
        Estimates of less confidence have been removed, see `RangeImage.confident`.
    box : Box, optional
        Estimates outside it have been removed, see `RangeImage.cropped`.
    judged_by : str, optional
        ``"image"`` if the confidence is from `core.judged_by_image`.
    most_returns, false_return : int and float, optional
        `most` and `false_return` of `core.with_returns`.
    """

    method: str
    settings: Any
    false_alarm: float | None = None
    remark: _Deferred = _Deferred()
    least_confidence: float | None = None
    box: Box | None = None
    judged_by: str | None = None
    most_returns: int | None = None
    false_return: float | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields, with `remark` as text, for another process."""
        return vars(self) | {"remark": self.remark}

    def after(self, **step: Any) -> Provenance:
        """Return a copy with a further step, such as a removal; a deferred remark stays so."""
        return replace(self, remark=vars(self)["remark"], **step)

    @property
    def facts(self) -> dict[str, str | float]:
        """Facts for a file: all settings as JSON; what was not given is left out."""
        settings = json.dumps(asdict(self.settings), ensure_ascii=False)
        box = self.box and str(self.box)
        known = vars(self) | {"settings": settings, "remark": self.remark or None, "box": box}
        return {name: value for name, value in known.items() if value is not None}


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Estimate of a capture; every array has shape (row, col).

    Parameters
    ----------
    range_m : ndarray of float
        Range of the surface in metres; NaN where `valid` is False.
    bin : ndarray of float
        Delay of the echo in fractional bins, corrected for the estimator's lag; NaN where `valid`
        is False.
    score : ndarray of float
        Score of the estimator at its estimate, in a unit of its own.
    confidence : ndarray of float
        Posterior probability of a surface within 3 bins of the estimate, from the exact
        first-photon likelihood and the fluxes estimated from the capture
        (`core.inference.posterior`); of the method "image_posterior", and of others that are judged
        by it (`core.judged_by_image`), from the posterior of the image, which includes the
        neighbours. It is calibrated for every estimator: of pixels with
        confidence 0.9, nine in ten are right, unless the remark of `made_by` says that the model
        does not fit (`core.inference.fit`). 0 where `valid` is False.
    valid : ndarray of bool
        Whether the pixel has an estimate.
    made_by : Provenance, optional
        Method and settings; None where they are not known.
    velocity : RadialVelocity, optional
        Of methods that estimate it: velocity of the surfaces, whose ranges are those in the middle
        of the recording.
    returns : Returns, optional
        All surfaces of each pixel, the estimate among them; None unless asked for
        (`core.with_returns`).
    """

    range_m: Floats
    bin: Floats
    score: Floats
    confidence: Floats
    valid: NDArray[np.bool_]
    made_by: Provenance | None = field(default=None, repr=False)
    velocity: RadialVelocity | None = field(default=None, repr=False)
    returns: Returns | None = field(default=None, repr=False)

    @property
    def planes(self) -> dict[str, Plane]:
        """Images with unit and meaning, by name."""
        moving = {} if self.velocity is None else self.velocity.planes(self.valid)
        return {
            "range_m": Plane(self.range_m, "m", "range of the surface, NaN without an estimate"),
            "confidence": Plane(
                self.confidence, "1", "probability that the estimate is right within 3 bins"
            ),
            "bin": Plane(self.bin, "1", "delay of the echo in bins, from the opening of the gate"),
            "score": Plane(self.score, "1", "score of the estimate, of the estimator's own scale"),
            "valid": Plane(self.valid, "1", "whether there is an estimate"),
            **moving,
            **self.return_planes,
        }

    @property
    def return_planes(self) -> dict[str, Plane]:
        """Images of the returns, by name; empty unless they were asked for."""
        return {} if self.returns is None else self.returns.planes(self.valid.shape)

    def to_xarray(self) -> xr.Dataset:
        """Return the image as labelled arrays, as `core.save_image` writes them.

        Returns
        -------
        xarray.Dataset
            Variables ``range_m``, ``confidence``, ``bin``, ``score`` and ``valid`` (1 or 0) over
            the coordinates ``row`` and ``col``, with units; method, settings (JSON) and version
            are attributes. If they were asked for, ``returns``, the number of returns, and
            ``return_1_range_m`` and so on, with strength and confidence.
        """
        about = {} if self.made_by is None else self.made_by.facts
        return images_dataset(self.planes, {**about, "software": software()})

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        (rows, cols), n_valid = self.valid.shape, int(self.valid.sum())
        facts = {
            "shape": f"{rows} × {cols} pixels",
            "estimates": f"{n_valid:,} of {self.valid.size:,} pixels",
        }
        if n_valid:
            low, middle, high = np.percentile(self.range_m[self.valid], [0, 50, 100])
            facts["ranges"] = f"{low:.6g} to {high:.6g} m, median {middle:.6g} m"
            facts["confidence"] = f"{self.confidence[self.valid].mean():.3g} on average"
        if self.made_by is not None:
            facts |= {name: str(fact) for name, fact in self.made_by.facts.items()}
        return html_table("Range image", facts)

    def confident(self, least: float) -> RangeImage:
        """Return the image without estimates of a confidence below `least`, 0 to 1.

        Their scores and confidences are kept.

        Raises
        ------
        ValueError
            If `least` is not a probability.
        """
        require("least_confidence", least, 0 <= least <= 1, "a probability, 0 to 1")
        found = self.returns and self.returns.where(self.returns.confidence >= least)
        return self._kept(self.confidence >= least, found, least_confidence=least)

    def cropped(self, box: Box) -> RangeImage:
        """Return the image without estimates outside a box, which `made_by` then states.

        Their scores and confidences are kept.
        """
        found = self.returns
        if found:
            shape, numbers = self.valid.shape, range(1, found.most + 1)
            inside = [box.contains(found.image("range_m", number, shape)) for number in numbers]
            found = found.where(np.array(inside)[found.number - 1, found.row, found.col])
        return self._kept(box.contains(self.range_m), found, box=box)

    def _kept(self, pixels: NDArray[np.bool_], returns: Returns | None, **why: Any) -> RangeImage:
        """Return the image with some estimates and returns, and the reason in `made_by`."""
        kept = self.valid & pixels
        range_m, bins = (np.where(kept, each, np.nan) for each in (self.range_m, self.bin))
        made_by = self.made_by and self.made_by.after(**why)
        return replace(
            self, range_m=range_m, bin=bins, valid=kept, made_by=made_by, returns=returns
        )


Pixels = Literal["estimate every pixel", "allow empty pixels"]
"""Whether a method of whole images answers pixels in which it finds no surface of their own."""

PIXELS = Choice("Pixels", get_args(Pixels))

FALSE_ALARM = Number("False alarms", 1e-3, 1.0, log=True, least=1e-3, most=1.0)
"""Share of echo-free pixels that may get an estimate; with 1 all of them do."""

NULL_SIDE = 256
"""Rows and columns of the echo-free image from which a detection threshold is found."""


class Evidence(NamedTuple):
    """Probability of a surface in each bin of a pixel, from its own counts and its neighbours.

    Each has the shape (bin,); its sum is the probability of a surface at all. The posterior is
    proportional to the product of the others over the prior.
    """

    alone: Floats
    """From the pixel alone."""
    neighbours: Floats
    """From its neighbours alone."""
    posterior: Floats
    """From both."""


NEXT_TO_SURFACES = (
    "next to surfaces, a larger share of empty pixels get a range than is asked for: counts of "
    "neighbouring pixels are added"
)
"""Remark of methods that add neighbours, whose threshold is that of pixels far from surfaces."""

NOT_JUDGED = "the goodness of fit, which is that of surfaces at rest, is not judged"
"""Remark of methods that follow motion."""


class Calibration(NamedTuple):
    """Quantities of an estimator that all pixels of an image share."""

    lag_bins: float
    """`Estimator.lag_bins`."""
    least_score: float | None
    """Threshold that a score must exceed; None for no threshold."""
    kept_ties: float = 0.0
    """Share of the estimates with just this score that are kept."""


@dataclass(frozen=True)
class Estimator:
    """One entry of the registry.

    Parameters
    ----------
    title : str
        Name on screen.
    parameters : type
        Frozen dataclass of its settings.
    curve : callable
        ``(histogram, conditions, parameters) -> score``, both of shape (..., bin): the score of
        each bin, larger where an echo is more plausible.
    locate : callable, optional
        ``(capture, flux_model, parameters) -> (position_bin, score)``, each of shape (row, col),
        NaN where there is none: a faster or finer search for the maximum of the curve.
    window_size : callable, optional
        ``parameters -> pixels``, odd: rows and columns of the neighbourhood whose counts are added
        before `curve` is applied.
    first_bin : callable, optional
        ``parameters -> bin`` of the first possible estimate.
    finds_delay : bool
        Whether positions are delays of the surface, without a lag to calibrate.
    flux_model : callable
        ``capture -> FluxModel`` for the estimator; raises ``ValueError`` if it is unknown.
    knows_flux : bool
        Whether `flux_model` is the true one, which no instrument knows.
    reconstructed : str
        If the original was not available: the source of the reconstruction.
    own_threshold : str
        If the share of false alarms cannot be chosen: a clause on what is reported instead.
    undoes_pile_up : bool
        Whether the estimator corrects pile-up of first photons if the number of pulses is known.
    omits : callable
        ``capture -> clause`` that describes which part of its model the estimator leaves out
        because the pulses of the capture do not resolve it; empty if none.
    whole_image : bool
        Whether the estimate of a pixel depends on pixels outside its window, so that no part of an
        image can be estimated alone.
    fills : bool
        Whether a pixel without a detection may get an estimate from its neighbours.
    refine : callable, optional
        ``(capture, flux_model, delay_bin, parameters) -> delay_bin``, each of shape (row, col): a
        finer search in the neighbourhood of a delay that is corrected for the lag.
    confidence : callable, optional
        ``(capture, flux_model, delay_bin, parameters) -> probability``, likewise: the confidence by
        a posterior of the estimator's own instead of `core.inference.posterior`.
    follows_motion : bool
        Whether groups of pulses are used, so that motion does not contradict the model.
    velocity : callable, optional
        ``(capture, parameters) -> RadialVelocity``, or None where it is not known.
    evidence : callable, optional
        ``(capture, flux_model, row, col) -> Evidence``, or None where neighbours have no
        influence: the parts of a pixel's posterior.
    """

    title: str
    parameters: type[Any]
    curve: Callable[[Floats, Conditions, Any], Floats]
    locate: Callable[[Capture, FluxModel, Any], tuple[Floats, Floats]] | None = None
    window_size: Callable[[Any], int] = lambda _: 1
    first_bin: Callable[[Any], int] = lambda _: 0
    finds_delay: bool = False
    flux_model: Callable[[Capture], FluxModel] = flux_model_of
    knows_flux: bool = False
    reconstructed: str = ""
    own_threshold: str = ""
    undoes_pile_up: bool = False
    omits: Callable[[Capture], str] = lambda _: ""
    whole_image: bool = False
    fills: bool = False
    refine: Callable[[Capture, FluxModel, Floats, Any], Floats] | None = None
    confidence: Callable[[Capture, FluxModel, Floats, Any], Floats] | None = None
    follows_motion: bool = False
    velocity: Callable[[Capture, Any], RadialVelocity | None] = lambda *_: None
    evidence: Callable[[Capture, FluxModel, int, int], Evidence | None] | None = None

    light = renamed("flux_model")
    reach = renamed("window_size")
    spares = renamed("omits")

    def __call__(
        self, capture: Capture, parameters: Any, false_alarm: float | None = None
    ) -> RangeImage:
        """Estimate the range of every pixel of a capture; see `core.estimate`.

        Parameters
        ----------
        capture : Capture
        parameters : object
            Instance of `Estimator.parameters`.
        false_alarm : float, optional
            As for `core.estimate`; 1 is the same as None.

        Raises
        ------
        ValueError
            If `false_alarm` is not within the bounds of `FALSE_ALARM`.
        """
        return self.ranged(capture, parameters, self.calibration(capture, parameters, false_alarm))

    def remark(
        self, capture: Capture, false_alarm: float | None = None, parameters: Any = None
    ) -> str:
        """Return why confidences mislead and what is left out of the model; empty if nothing.

        Also whether `false_alarm` of the call has no effect, or is exceeded next to surfaces with
        `parameters` (by default the default settings). Clauses are separated by semicolons.
        """
        follows_motion = self.follows_motion and capture.groups is not None
        fit = NOT_JUDGED if follows_motion else fit_of(capture).remark
        clauses = [fit, self.omits(capture)]
        if self.undoes_pile_up and capture.gated_pulses is None:
            known = capture.detection == "all"
            why = "the capture holds all photons" if known else "the number of pulses is not known"
            clauses.append(f"no pile-up is undone: {why}")
        if false_alarm not in (None, 1):
            if self.own_threshold:
                clauses.append(f"the share of false alarms is not controlled: {self.own_threshold}")
            elif self.window_size(parameters or self.parameters()) > 1:
                clauses.append(NEXT_TO_SURFACES)
        return "; ".join(filter(None, clauses))

    def calibration(
        self, capture: Capture, parameters: Any, false_alarm: float | None = None
    ) -> Calibration:
        """Compute lag and threshold from a capture or a sample of it; arguments as for a call."""
        least, kept_ties = None, 0.0
        if false_alarm is not None:
            FALSE_ALARM.check("false_alarm", false_alarm)
            if false_alarm < 1 and not self.own_threshold:
                least, kept_ties = self._threshold(capture, parameters, false_alarm)
        lag = 0.0 if self.finds_delay else self.lag_bins(capture, parameters)
        return Calibration(lag, least, kept_ties)

    def ranged(self, capture: Capture, parameters: Any, calibration: Calibration) -> RangeImage:
        """Estimate the range of every pixel of a capture, or of a part of the calibrated one."""
        bins, score = self._delays(capture, parameters, calibration)
        if self.confidence is None:
            confidence = tolerance_probability(capture, bins)
        else:
            confidence = self.confidence(capture, self.flux_model(capture), bins, parameters)
        return RangeImage(
            range_m=capture.acquisition.bin_to_range_m(bins),
            bin=bins,
            score=score,
            confidence=confidence,
            valid=np.isfinite(bins),
            velocity=self.velocity(capture, parameters),
        )

    def delays(
        self, capture: Capture, parameters: Any, false_alarm: float | None = None
    ) -> tuple[Floats, Floats]:
        """Return only `RangeImage.bin` and `RangeImage.score`, without computing confidence."""
        return self._delays(capture, parameters, self.calibration(capture, parameters, false_alarm))

    def _delays(
        self, capture: Capture, parameters: Any, calibration: Calibration
    ) -> tuple[Floats, Floats]:
        flux = self.flux_model(capture)
        position, score = self.positions(capture, flux, parameters)
        if calibration.least_score is not None:
            kept, tied = score > calibration.least_score, score == calibration.least_score
            kept[tied] = histogram_numbers(capture.cube[tied]) < calibration.kept_ties
            position = np.where(kept, position, np.nan)
        delay = np.clip(position - calibration.lag_bins, 0.0, capture.acquisition.n_bins)
        if self.refine is not None:
            delay = self.refine(capture, flux, delay, parameters)
        return delay, score

    def curves(self, capture: Capture, row: int, col: int, parameters: Any) -> Floats:
        """Score of each bin for one pixel, shape (bin,)."""
        flux, size = self.flux_model(capture), self.window_size(parameters)
        around = pooled_at(capture.cube, row, col, size)
        given = conditions_of(capture, flux, size)
        here = np.s_[row : row + 1, col : col + 1]
        conditions = given._replace(signal=given.signal[here], background=given.background[here])
        one = around[np.newaxis, np.newaxis].astype(float)
        return np.asarray(self.curve(one, conditions, parameters)[0, 0])

    def evidence_at(self, capture: Capture, row: int, col: int) -> Evidence | None:
        """Return the evidence of a pixel and its neighbours; None for methods of single pixels."""
        if self.evidence is None:
            return None
        return self.evidence(capture, self.flux_model(capture), row, col)

    def _threshold(
        self, capture: Capture, parameters: Any, false_alarm: float
    ) -> tuple[float, float]:
        """Return `Calibration.least_score` and `Calibration.kept_ties`.

        A share `false_alarm` of the pixels of an image drawn from the background of the capture
        alone have a larger score. Scores that are counts are often equal: of those equal to the
        threshold, as many are kept as are missing to the share (the randomized test of Neyman &
        Pearson 1933), by a number that depends on the histogram alone (`histogram_numbers`).
        """
        cube = _null_cube(capture)
        null = Capture(cube, capture.acquisition, capture.pulse, detection=capture.detection)
        flux = self.flux_model(capture).of_pixels(null_pixels(capture))
        position, score = self.positions(null, flux, parameters)
        least, found = float(np.quantile(score, 1 - false_alarm)), np.isfinite(position)
        missing = false_alarm * score.size - np.count_nonzero(found & (score > least))
        tied = np.count_nonzero(found & (score == least))
        return least, float(np.clip(missing / tied, 0.0, 1.0)) if tied else 0.0

    def lag_bins(self, capture: Capture, parameters: Any) -> float:
        """Distance in bins from the surface's delay to the maximum of a noise-free echo's score.

        Expected echoes with the capture's mean signal and background are placed at all fractions of
        a bin at several delays of the gate; the calibration is their median lag. It depends a
        little on the fluxes and is therefore not a constant.

        Returns
        -------
        float
            0 if no echo is found at all (if every bin is excluded, for example).
        """
        n_bins = capture.acquisition.n_bins
        given = conditions_of(capture, self.flux_model(capture), self.window_size(parameters))
        given = given._replace(
            signal=np.asarray(given.signal.mean()), background=np.asarray(given.background.mean())
        )
        first = max(self.first_bin(parameters), 0.1 * n_bins)
        places = np.round(np.linspace(first, 0.9 * n_bins, 8))
        # The first one is no echo. The maximum of the score that an echo adds: the score of the
        # falling background itself may be larger than that of a weak echo.
        onset = np.append(math.nan, places[:, np.newaxis] + np.arange(8) / 8)
        most, at = np.empty(onset.size), np.empty(onset.size, np.intp)
        at_once = max(1, NUMBERS_AT_ONCE // n_bins)
        for first in range(0, onset.size, at_once):
            some = slice(first, first + at_once)
            score = self.curve(_expected(onset[some], given), given, parameters)
            if first == 0:
                without = score[0].copy()
            added = score - without
            most[some], at[some] = added.max(axis=1), added.argmax(axis=1)
        found = most > 0
        if not found.any():
            return 0.0
        return float(np.median(at[found] - onset[found]))

    def positions(
        self, capture: Capture, flux: FluxModel, parameters: Any
    ) -> tuple[Floats, Floats]:
        """Bin and value of the largest score, each of shape (row, col), the lag not corrected.

        NaN and 0 where a pixel has no detection, unless the method fills such pixels.
        """
        locate = self.locate or self._largest
        position, score = locate(capture, flux, parameters)
        if self.fills:
            return position, score
        seen = capture.counts > 0
        return np.where(seen, position, np.nan), np.where(seen, score, 0.0)

    def _largest(self, capture: Capture, flux: FluxModel, parameters: Any) -> tuple[Floats, Floats]:
        size = self.window_size(parameters)
        given = conditions_of(capture, flux, size)
        position, score = np.empty((2, *capture.shape))

        def fill(patch: Patch, cube: NDArray[Any], rows: slice) -> None:
            signal, background = given.signal[patch][rows], given.background[patch][rows]
            some = given._replace(signal=signal, background=background)
            curve = self.curve(cube[rows].astype(float), some, parameters)
            position[patch][rows] = curve.argmax(axis=2)
            score[patch][rows] = curve.max(axis=2)

        for patch in patches(capture.cube.shape, NUMBERS_AT_ONCE):
            cube = pooled_in(capture.cube, patch, size)
            # A few rows at a time, so that temporaries stay in the cache.
            rows_at_once = max(1, _IN_CACHE // cube[0].size)
            starts = range(0, len(cube), rows_at_once)
            rows = [slice(first, first + rows_at_once) for first in starts]
            each_on_threads(partial(fill, patch, cube), rows)
        return position, score


def histogram_numbers(histograms: NDArray[np.unsignedinteger]) -> Floats:
    """Numbers from 0 to 1 that appear random, the same for equal histograms (..., bin).

    The fractional part of the golden ratio times the first moment, which is evenly distributed over
    the bins even for a single photon.
    """
    bins = np.arange(1, histograms.shape[-1] + 1)
    moment = np.einsum("...k,k->...", histograms, bins)
    return np.asarray(moment * _GOLDEN % 1.0)


def conditions_of(capture: Capture, flux: FluxModel, window_size: int = 1) -> Conditions:
    """Conditions of a capture's histograms, summed over windows of `window_size` squared pixels."""
    n_pulses, n_pixels = capture.gated_pulses, window_size * window_size
    more = 1 if n_pulses else n_pixels  # without pulses, fluxes are per histogram
    signal, background = flux.typical_signal, flux.typical_background
    return Conditions(
        capture.acquisition,
        capture.pulse,
        n_pulses * n_pixels if n_pulses else None,
        signal * more,
        background * more,
        flux.contrast,
        flux.pile_up,
        flux.background_shape,
    )


def _expected(onset_bin: Floats, given: Conditions) -> Floats:
    """Expected counts of echoes at given delays, NaN for no echo, shape (delay, bin)."""
    signal = np.full(onset_bin.size, given.signal)
    rate = rate_per_bin(onset_bin, signal, float(given.background), given.pulse, given.acquisition)
    if given.background_shape is not None:
        rate += given.background / given.acquisition.n_bins * (given.background_shape - 1)
    return rate if given.n_pulses is None else trigger_probability(rate) * given.n_pulses


NUMBERS_AT_ONCE = 2**20  # float64 numbers of a temporary: 8 MiB
_IN_CACHE = 2**16
_GOLDEN = (math.sqrt(5) - 1) / 2
_PATCH = 64  # rows and columns that stay together, for methods that use neighbours


def whole_patches(side: int, size: int) -> int:
    """Round `side` rows or columns to whole patches of an image of `size`."""
    patch = min(_PATCH, size)
    return max(1, round(side / patch)) * patch


@cached_per_capture
def null_pixels(capture: Capture) -> NDArray[np.intp]:
    """Flat indices (row, col) of random patches whose background the echo-free image has."""
    rows, cols = capture.shape
    # Fewer pixels, and a less precise threshold, for a long gate.
    side = min(NULL_SIDE, math.isqrt(2**23 // capture.acquisition.n_bins))
    high, wide = min(_PATCH, rows), min(_PATCH, cols)
    down, across = whole_patches(side, rows) // high, whole_patches(side, cols) // wide
    rng = np.random.default_rng(0)
    top = rng.integers(rows - high + 1, size=(down, 1, across, 1))
    left = rng.integers(cols - wide + 1, size=(down, 1, across, 1))
    row = top + np.arange(high)[:, np.newaxis, np.newaxis]
    col = left + np.arange(wide)
    return np.asarray((row * cols + col).reshape(down * high, across * wide))


@cached_per_capture
def _null_cube(capture: Capture) -> NDArray[np.unsignedinteger]:
    """Draw counts of pixels that see only the background of the capture, (row, col, bin)."""
    rng = np.random.default_rng(1)
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    pixels = null_pixels(capture)
    flux = flux_model_of(capture).of_pixels(pixels)
    cubes = []
    rows_at_once = max(1, NUMBERS_AT_ONCE // (pixels.shape[1] * n_bins))
    for first in range(0, len(pixels), rows_at_once):
        mean = flux.typical_background[first : first + rows_at_once, :, np.newaxis] / n_bins
        cubes.append(draw_counts(mean * flux.relative_background, n_pulses, rng))
    return np.concatenate(cubes)
