"""Pulse, estimated from the counts of a capture alone.

Two photons of the same echo lie within a pulse's width of each other, wherever the surface is. So
the gaps between two photons of the same pixel have a peak at zero: the autocorrelation of the
pulse, √2 as wide as a Gaussian one.

Null. The gaps also crowd where the histograms of all pixels do: in the decay of first photons under
a strong background, and at the depths of the scene. Photons exchanged between pixels keep these
pairs and lose those of an echo. Their expected number is the autocorrelation of the pooled
histogram, Σ n (n - 1) (m ⋆ m) with n photons in a pixel and shares m of the bins, and is
subtracted. It is pooled in strata of pixels with similar numbers of photons, since brighter pixels
may have another shape: a greater share of signal, or a faster decay.

Scene at one depth. There the null contains all pairs of the echo, and the pooled histogram shows
the pulse itself. The peaks q of the pooled histogram above its level, a running median, are
therefore put back: Σ n (n - 1) (q ⋆ q). For depths that are spread out, this adds only a broad
floor. In between, the sum is still the pairs of an echo.

Pile-up. Where only first photons are counted and the number of pulses is known, each bin counts for
the photons that all pulses would have shown there, by the pulses that are left: first photons alone
come from the leading edge of a bright echo, and are fewer behind it. At 1 (3) signal photons a
pulse, a Gaussian would be 2 % (11 %) too narrow, a gamma pulse 16 % (43 %). Nothing is estimated
where the gate ends with fewer than 3 pulses left, since what no pulse reaches is unknown.

Evidence. Gaussian and gamma pulses compete, with standard deviations from a fifth of a bin to a
tenth of the gate. Each predicts a peak, blurred by the bins, on a parabola for what remains of the
floor; it holds at least the pairs of the pooled peaks. Each of 32 groups of pixels is held out in
turn: the peak fitted to the pairs of the others predicts its pairs. The highest likelihood of the
pairs held out wins; that of no echo is 0 (composite likelihood, with the variance of counts: pairs
share photons). The error of a difference between two candidates comes from the scatter between the
groups, from the level below the pooled peaks, taken to be known to 2 %, and from the model, taken
to be right to 1 % of the peak. Candidates of either shape within three errors of the best form the
interval. A gamma pulse is chosen only if every Gaussian is rejected.

Pairs of a pulse below one bin depend on its position within the bin. Where all echoes lie in a few
bins, this is not averaged out: pulses at any one position compete, too.

There is an echo if its absence is rejected by five errors. The width is determined if the interval
lies within a factor of 1.3 of the estimate; otherwise, the estimate is still better than one bin.
Of 320 captures of 1600 pixels, with Gaussian and gamma pulses of 0.3 to 30 bins, 1 to 1000 photons
a pixel, SBRs of 0.02 to 100, and surfaces at one depth or spread out, 195 widths were determined,
all within a factor of 1.3. For 51 others an interval was found, which always included the truth; in
74 no echo was found. Nothing is estimated from fewer than 16 bins or 32 pixels, nor from more than
65,536 bins. The pairs of a pulse and of its mirror image are the same: that a tail is late is
assumed.

Pairs are counted by Fourier transforms, of as many evenly spread pixels as `_MOST_NUMBERS` allows.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse
from core.io.readers.quantities import time_text

_GROUPS = 32
_MOST_STRATA = 8
_FEWEST_PIXELS = 64  # in a stratum
_FEWEST_PHOTONS = 100  # in a bin of a stratum
_SMOOTH_PHOTONS = 1e4  # to which a histogram is smoothed for its level, which is noisy at the ends
_MOST_NUMBERS = 2**24  # in all transforms together: a tenth of a second
_FEWEST_BINS = 16
_FEWEST_LEFT = 3.0  # pulses that fire a pixel nowhere in the gate; fewer hide what is behind
_MOST_BINS = 2**16  # above, even one pixel of each group would take long
_NARROWEST_BINS = 0.2  # standard deviation; below, a bin holds nearly all of an echo
_WIDEST_SHARE = 0.1  # of the gate; above, no floor is left
_STEP = 0.02  # between candidates, of their width
_GAMMA_SIGMA = math.sqrt(2.0)  # standard deviation of a gamma pulse, in its tau
_REJECTED = 3.0  # standard errors
_ECHO_REJECTED = 5.0
_MODEL_ERROR = 0.01  # of the peak: no echo is exactly Gaussian, and pile-up may narrow it
_CLOSE = 1.3  # largest factor between the ends of the interval and the estimate
_SINGLE_LAGS = 16  # wider classes of lags follow
_PHASES = np.arange(0.0, 1.0, 0.05)  # of an echo within its bin
_FEW_BINS = 6  # that hold all echoes
_LEVEL_ERROR = 0.02  # of a pooled histogram, as a share
_LEVEL_ROUNDS = 3
_PEAK_ERRORS = 5.0  # standard errors

Cube = NDArray[np.unsignedinteger]
Floats32 = NDArray[np.float32]
Shape = Literal["gaussian", "gamma"]
_SHAPES: tuple[Shape, ...] = get_args(Shape)


class PulseGuess(NamedTuple):
    """Pulse estimated from counts."""

    shape: Shape
    tau_bins: float
    """``Pulse.tau_s`` in bins: the standard deviation of a Gaussian."""
    low_bins: float
    high_bins: float
    """Ends of its interval, of three standard errors: 0 if all narrower ones are alike, infinite if
    all wider ones are."""
    is_determined: bool
    """Whether the ends are close to the estimate."""
    may_have_tail: bool
    """Whether a gamma pulse fits; a Gaussian may, too."""

    @property
    def sigma_bins(self) -> float:
        """Standard deviation in bins."""
        return self.tau_bins * (_GAMMA_SIGMA if self.shape == "gamma" else 1.0)


def guessed_pulse(cube: Cube, bin_width_s: float, n_pulses: int | None = None) -> tuple[Pulse, str]:
    """Return the estimated pulse and how well it is known.

    Without an echo, or if arbitrarily wide pulses fit, it is a Gaussian of one bin.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
        Counts.
    bin_width_s : float
        Width of one bin in seconds.
    n_pulses : int, optional
        As for `pulse_guess`.

    Returns
    -------
    pulse : Pulse
        Its width has two digits.
    known : str
        The interval of its width, and what is not determined.
    """
    guess = pulse_guess(cube, n_pulses)
    if guess is None or math.isinf(guess.high_bins):
        return Pulse.gaussian(bin_width_s), "one bin: width not determined"
    tau_s, low_s, high_s = (float(f"{bins * bin_width_s:.1e}") for bins in guess[1:4])
    known = f"{time_text(low_s)} to {time_text(high_s)}"
    if not guess.is_determined:
        known = f"width not determined: {known}"
    elif guess.shape == "gaussian" and guess.may_have_tail:
        known = f"{known}, a tail not excluded"
    return Pulse(tau_s, shape=guess.shape), known


def pulse_guess(cube: Cube, n_pulses: int | None = None) -> PulseGuess | None:
    """Estimate the pulse and the interval of its width; None if there is no echo.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
        Counts.
    n_pulses : int, optional
        Pulses sent for each pixel if only first photons are counted; None for all photons.

    Returns
    -------
    PulseGuess or None
    """
    n_bins = cube.shape[2]
    if not _FEWEST_BINS <= n_bins <= _MOST_BINS or cube.shape[0] * cube.shape[1] < _GROUPS:
        return None
    if n_pulses is not None and _pulses_left(cube, n_pulses) < _FEWEST_LEFT:
        return None
    pairs = _echo_pairs(cube, n_pulses, _lag_edges(3 * n_bins // 4))
    if pairs.counted.sum() < 0.5:  # whole numbers, but for rounding
        return None
    candidates = [_candidates(shape, n_bins, pairs) for shape in _SHAPES]
    found = _competition(pairs, np.concatenate([peaks for _, peaks in candidates]))
    if found.against_none < _ECHO_REJECTED:
        return None
    sigma = np.concatenate([of_shape for of_shape, _ in candidates])
    is_gamma = np.arange(sigma.size) >= candidates[0][0].size
    left = found.against < _REJECTED
    shape: Shape = "gamma" if is_gamma[left].all() else "gaussian"
    is_shape = left & (is_gamma == (shape == "gamma"))
    best = sigma[np.where(is_shape, found.gain, -np.inf).argmax()]
    low, high = float(sigma[left].min()), float(sigma[left].max())
    is_bounded = high < sigma.max()
    is_close = best / low < _CLOSE and high / best < _CLOSE
    unit = _GAMMA_SIGMA if shape == "gamma" else 1.0
    return PulseGuess(
        shape,
        float(best) / unit,
        low / (1 + _STEP) / unit if low > sigma.min() else 0.0,
        high * (1 + _STEP) / unit if is_bounded else math.inf,
        is_determined=bool(is_close and is_bounded),
        may_have_tail=bool(is_gamma[left].any()),
    )


def _pulses_left(cube: Cube, n_pulses: int) -> float:
    """Return the pulses that fire a pixel nowhere in the gate, on average over all photons."""
    n_photons = cube.sum(axis=2, dtype=float).ravel()
    return float(n_pulses - n_photons @ n_photons / max(n_photons.sum(), 1.0))


class _EchoPairs(NamedTuple):
    """Pairs of photons of the same pixel by their gap, in classes of lags."""

    edges: NDArray[np.int64]
    """First lag of each class, and the end of the last, shape (class + 1,)."""
    counted: Floats
    """All pairs, shape (class,)."""
    excess: Floats
    """Pairs less those of the null, plus those of the pooled peaks, shape (group, class)."""
    doubt: Floats
    """Error of the pairs of the pooled peaks, that of their level, shape (class,)."""
    pooled: float
    """Number of pairs that the photons of the pooled peaks form at least."""
    occupied_bins: float
    """Bins that these peaks would fill if they were level; 0 without peaks."""


def _echo_pairs(cube: Cube, n_pulses: int | None, edges: NDArray[np.int64]) -> _EchoPairs:
    n_lags = int(edges[-1])
    sums = _sums(_sample(cube, n_lags), n_pulses, n_lags)
    pooled, noise, weight = sums.pooled, sums.noise, sums.weight
    spread = noise / np.where(pooled > 0, pooled, 1.0)  # 1 for counts: Poisson
    is_peak = np.zeros(pooled.shape[1], bool)
    for _ in range(_LEVEL_ROUNDS):  # a broad peak lifts the median around it
        level = np.array(
            [_level(*of_stratum, is_peak) for of_stratum in zip(pooled, noise, strict=True)]
        )
        above, below = (pooled - level).sum(axis=0), level.sum(axis=0)
        is_peak = is_peak | _is_peak(above, below, (level * spread).sum(axis=0))
    peak = np.where(is_peak, pooled - level, 0.0)

    total = np.maximum(pooled.sum(axis=1), 2.0)
    null = _autocorrelation(pooled, n_lags)
    null[:, 0] -= noise.sum(axis=1)  # each photon with itself
    null /= (total**2 - noise.sum(axis=1))[:, np.newaxis]
    echo = _autocorrelation(peak, n_lags)
    echo[:, 0] -= noise[:, is_peak].sum(axis=1)
    echo /= (total**2)[:, np.newaxis]

    counted = _in_classes(sums.pairs, edges)
    below, above = level[:, is_peak].sum(axis=1), peak.sum(axis=1)
    error = np.sqrt((level * spread)[:, is_peak].sum(axis=1))
    least = above - _LEVEL_ERROR * below - _REJECTED * error
    share = np.maximum(least, 0.0) / total
    doubt = 2 * np.minimum(_LEVEL_ERROR * below / np.maximum(above, 1.0), 1.0)
    echo_by_class = _in_classes(echo, edges)
    alike, at_zero = (weight.sum(axis=0) @ of_stratum for of_stratum in (share**2, echo[:, 0]))
    return _EchoPairs(
        edges=edges,
        counted=counted.sum(axis=0),
        excess=counted + weight @ (echo_by_class - _in_classes(null, edges)),
        doubt=(weight.sum(axis=0) * doubt) @ echo_by_class,
        pooled=float(alike),
        occupied_bins=float(alike / at_zero) if at_zero > 0 else 0.0,
    )


def _sample(cube: Cube, n_lags: int) -> Cube:
    """Return evenly spread histograms, shape (pixel, bin), as many as can be transformed."""
    histograms = cube.reshape(-1, cube.shape[2])
    numbers = histograms.shape[0] * _transform_size(cube.shape[2], n_lags)
    return histograms[:: -(-numbers // _MOST_NUMBERS)]


class _Sums(NamedTuple):
    """Sums over pixels, in strata of similar photon numbers and in groups of every 32nd of them."""

    pairs: Floats
    """Pairs of photons of a pixel, shape (group, lag)."""
    weight: Floats
    """All pairs of them, shape (group, stratum)."""
    pooled: Floats
    """Histograms, shape (stratum, bin)."""
    noise: Floats
    """Variances of these, shape (stratum, bin)."""


def _sums(histograms: Cube, n_pulses: int | None, n_lags: int) -> _Sums:
    n_pixels, n_bins = histograms.shape
    n_photons = histograms.sum(axis=1, dtype=np.int64)
    order = np.argsort(n_photons, kind="stable")
    per_bin = n_photons.sum() / n_bins
    n_strata = int(max(1, min(_MOST_STRATA, n_pixels / _FEWEST_PIXELS, per_bin / _FEWEST_PHOTONS)))
    stratum = np.repeat(
        np.arange(n_strata), [some.size for some in np.array_split(order, n_strata)]
    )
    size = _transform_size(n_bins, n_lags)
    power, with_itself = np.zeros((_GROUPS, size // 2 + 1)), np.zeros(_GROUPS)
    weight = np.zeros((_GROUPS, n_strata))
    pooled, noise = np.zeros((2, n_strata, n_bins))
    for group in range(_GROUPS):
        photons, variance = _without_pile_up(histograms[order[group::_GROUPS]], n_pulses)
        spectrum = scipy.fft.rfft(photons, size, axis=1)
        for part in (spectrum.real, spectrum.imag):
            power[group] += np.einsum("pf,pf->f", part, part)
        of_pixel = variance.sum(axis=1, dtype=float)
        with_itself[group] = of_pixel.sum()
        n_pairs = photons.sum(axis=1, dtype=float) ** 2 - of_pixel
        for k in range(n_strata):
            is_in = stratum[group::_GROUPS] == k
            weight[group, k] = n_pairs[is_in].sum()
            pooled[k] += photons[is_in].sum(axis=0, dtype=float)
            noise[k] += variance[is_in].sum(axis=0, dtype=float)
    pairs = scipy.fft.irfft(power, size, axis=1)[:, :n_lags]
    pairs[:, 0] -= with_itself
    return _Sums(np.asarray(pairs), weight, pooled, noise)


def _without_pile_up(counts: Cube, n_pulses: int | None) -> tuple[Floats32, Floats32]:
    """Estimate the photons of all pulses from first ones, and the variances of these estimates.

    If `A` pulses reach a bin and `n` fire in it, ``Σ 1 / (A - i)`` over ``i < n`` estimates photons
    per pulse without bias, and ``Σ 1 / (A - i)²`` its variance (Nelson and Aalen). The errors of
    two bins are uncorrelated, so pairs of photons are unbiased, too. Both sums are replaced by
    integrals. Without a number of pulses, photons and variances are the counts.
    """
    if n_pulses is None:
        photons = counts.astype(np.float32)
        return photons, photons
    after = np.maximum(n_pulses - np.cumsum(counts, axis=1, dtype=float), 0.0) + 0.5
    before = after + counts
    photons = n_pulses * np.log(before / after)
    return photons.astype(np.float32), (n_pulses**2 * (1 / after - 1 / before)).astype(np.float32)


def _autocorrelation(shapes: Floats, n_lags: int) -> Floats:
    """Correlate each row with itself, shape (row, lag)."""
    size = _transform_size(shapes.shape[1], n_lags)
    power = np.abs(scipy.fft.rfft(shapes, size, axis=1)) ** 2
    return np.asarray(scipy.fft.irfft(power, size, axis=1)[:, :n_lags])


def _transform_size(n_bins: int, n_lags: int) -> int:
    return int(scipy.fft.next_fast_len(n_bins + n_lags, real=True))


def _level(shape: Floats, noise: Floats, is_peak: NDArray[np.bool_]) -> Floats:
    """Return the level of a histogram outside its peaks, interpolated below them.

    It is the running median of what deviates from a decay, the one of first photons under a steady
    background, fitted with the variances `noise` of the bins.
    """
    if np.count_nonzero(~is_peak) < shape.size // 4:
        is_peak = np.zeros_like(is_peak)
    bins, outside, noise = np.arange(shape.size), shape[~is_peak], noise[~is_peak]
    weight = np.maximum(outside, 1e-3) / np.sqrt(np.maximum(noise, 1e-3))
    line = np.polyfit(bins[~is_peak], np.log(np.maximum(outside, 1.0)), 1, w=weight)
    decay = np.exp(np.polyval(line, bins))
    n_photons = outside.sum() ** 2 / max(noise.sum(), 1.0)  # as noisy, if they are counts
    at_once = np.ceil(_SMOOTH_PHOTONS * outside.size / max(n_photons, 1.0))
    at_once = int(max(1, min(at_once, outside.size // 8)))
    smooth = scipy.ndimage.uniform_filter1d(outside / decay[~is_peak], at_once, mode="nearest")
    median = scipy.ndimage.median_filter(smooth, size=shape.size // 2, mode="nearest")
    median = np.maximum(median, 0.0)  # running sums round below 0
    return np.asarray(decay * np.interp(bins, bins[~is_peak], median))


def _is_peak(excess: Floats, level: Floats, noise: Floats) -> NDArray[np.bool_]:
    """Find the bins where a histogram exceeds its level significantly, from fine to coarse.

    `noise` is the variance of a histogram of that level.
    """
    found = np.zeros(excess.size, bool)
    size = 1
    while size <= excess.size // 8:
        above, below, variance = (
            size * scipy.ndimage.uniform_filter1d(shape, size, mode="constant")
            for shape in (np.where(found, 0.0, excess), level, noise)
        )
        hit = above > np.maximum(_PEAK_ERRORS * np.sqrt(variance + 1), _LEVEL_ERROR * below)
        found |= scipy.ndimage.maximum_filter1d(hit, 2 * size + 5)  # with its flanks
        size *= 2
    return found


def _lag_edges(n_lags: int) -> NDArray[np.int64]:
    """Divide lags into single ones and classes that widen by a tenth; the last edge is `n_lags`."""
    n_wide = max(0, int(np.ceil(np.log(n_lags / _SINGLE_LAGS) / np.log(1.1))))
    wide = np.rint(_SINGLE_LAGS * 1.1 ** np.arange(n_wide)).astype(np.int64)
    edges = np.unique(np.concatenate([np.arange(_SINGLE_LAGS), wide]))
    return np.append(edges[edges < n_lags], n_lags)


def _in_classes(pairs: Floats, edges: NDArray[np.int64]) -> Floats:
    """Add the pairs of each class, shape (..., class)."""
    return np.asarray(np.add.reduceat(pairs, edges[:-1], axis=-1))


def _candidates(shape: Shape, n_bins: int, pairs: _EchoPairs) -> tuple[Floats, Floats]:
    """Return standard deviations of the candidates in bins, and their peaks as `_peaks` does."""
    steps = np.arange(0.0, np.log(_WIDEST_SHARE * n_bins / _NARROWEST_BINS), _STEP)
    sigma = _NARROWEST_BINS * np.exp(steps)
    tau = sigma / (_GAMMA_SIGMA if shape == "gamma" else 1.0)
    peaks = _peaks(shape, tau, pairs.edges)
    if not 0 < pairs.occupied_bins < _FEW_BINS:
        return sigma, peaks
    narrow = sigma < 1.0
    at_phases = [_peaks_at(phase, shape, tau[narrow], pairs.edges) for phase in _PHASES]
    every = np.append(sigma, np.tile(sigma[narrow], _PHASES.size))
    return every, np.concatenate([peaks, *at_phases])


def _peaks(shape: Shape, tau: Floats, edges: NDArray[np.int64]) -> Floats:
    """Return the share of an echo's pairs in each class of lags.

    The gap of two photons is √2 as wide as a Gaussian pulse. For a gamma pulse its density is
    ``(1 + |x|) exp(-|x|) / (4 tau)``, with ``x`` the gap divided by tau. Both photons are rounded
    to bins, which blurs the gap by a triangle two bins wide: the share of a lag is a second
    difference of the density's second integral, and that of a class one of two first differences.

    Parameters
    ----------
    shape : str
        ``"gaussian"`` or ``"gamma"``.
    tau : ndarray, shape (candidate,)
        Time constants in bins.
    edges : ndarray, shape (class + 1,)
        As those of `_EchoPairs`.

    Returns
    -------
    ndarray, shape (candidate, class)
        Probabilities of the gaps from 0 up: a little more than half in total.
    """
    width = tau[:, np.newaxis] * (np.sqrt(2.0) if shape == "gaussian" else 1.0)

    def integrated_twice(gap: Floats) -> Floats:
        x = gap / width
        if shape == "gamma":
            return width * (np.maximum(x, 0.0) + (3 + np.abs(x)) * np.exp(-np.abs(x)) / 4)
        density = np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi)
        return np.asarray(width * (x * scipy.special.ndtr(x) + density))

    at = edges.astype(float)
    first = integrated_twice(at) - integrated_twice(at - 1.0)
    return np.diff(first, axis=1)


def _peaks_at(phase: float, shape: Shape, tau: Floats, edges: NDArray[np.int64]) -> Floats:
    """Return what `_peaks` does for echoes whose time zero is `phase` bins after a bin's edge."""
    bins = np.arange(-_SINGLE_LAGS, _SINGLE_LAGS + 1) - phase
    share = np.diff(Pulse(1.0, shape=shape).cdf(bins / tau[:, np.newaxis]), axis=1)
    peaks = np.zeros((tau.size, edges.size - 1))
    for lag in range(min(_SINGLE_LAGS, edges.size - 1)):
        peaks[:, lag] = (share[:, lag:] * share[:, : share.shape[1] - lag]).sum(axis=1)
    return peaks


class _Competition(NamedTuple):
    """Comparison of candidates."""

    gain: Floats
    """Twice the log likelihood ratio of each candidate to no echo, shape (candidate,)."""
    against: Floats
    """Standard errors by which each candidate is worse than the best, shape (candidate,)."""
    against_none: float
    """Standard errors by which the hypothesis of no echo is worse."""


def _competition(pairs: _EchoPairs, peaks: Floats) -> _Competition:
    """Fit each candidate and compare them.

    Parameters
    ----------
    pairs : _EchoPairs
    peaks : ndarray, shape (candidate, class)
        Shares of an echo's pairs.
    """
    width, n_lags = np.diff(pairs.edges), pairs.edges[-1]
    # Poisson weights, of at least the mean: chance lows would pull the fit down.
    scale = 1 / np.sqrt(np.maximum(pairs.counted, width * (pairs.counted.sum() / n_lags)))
    middle = (pairs.edges[:-1] + pairs.edges[1:]) / (2 * n_lags)
    floor, _ = np.linalg.qr((scale * width * middle ** np.arange(3)[:, np.newaxis]).T)
    scaled = scale * peaks
    scaled -= scaled @ floor @ floor.T
    length = np.linalg.norm(scaled, axis=1)
    scaled /= length[:, np.newaxis]
    amplitudes = (scale * pairs.excess) @ scaled.T  # (group, candidate)
    amplitude = amplitudes.sum(axis=0)
    least = pairs.pooled * length
    # What the other groups predict of each, and twice the log likelihood ratio of its pairs.
    predicted = np.maximum((amplitude - amplitudes) / (_GROUPS - 1), least / _GROUPS)
    by_group = _GROUPS * predicted * (2 * amplitudes - predicted)
    gain = by_group.sum(axis=0)
    best = int(np.argmax(gain))
    doubt = 2 * np.maximum(amplitude, least) * (scaled @ (scale * pairs.doubt))  # to first order

    def errors(difference: Floats, of_groups: Floats, of_doubt: Floats) -> Floats:
        variance = _GROUPS * of_groups.var(axis=0, ddof=1) + of_doubt**2
        variance += (2 * _MODEL_ERROR) ** 2 * gain[best] * difference
        # The gain is a square: z standard errors of the amplitude are z / 2 of the gain.
        return np.asarray(2 * difference / np.sqrt(np.maximum(variance, 1.0)))

    against = errors(gain[best] - gain, by_group[:, [best]] - by_group, doubt[best] - doubt)
    against_none = errors(gain[best], by_group[:, best], doubt[best])
    return _Competition(gain, against, float(against_none))
