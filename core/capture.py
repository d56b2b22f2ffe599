"""Captures: histograms of trigger times with their acquisition, simulated or read from a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, update_wrapper
from numbers import Real
from typing import (
    TYPE_CHECKING,
    Any,
    Concatenate,
    Generic,
    Literal,
    ParamSpec,
    Protocol,
    TypeVar,
    get_args,
    runtime_checkable,
)
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.checks import require, require_type
from core.deprecation import renamed
from core.kernels.blocks import Blocks, pixel_sums, to_blocks
from core.labels import dataset
from core.notebook import html_table
from core.pulse_groups import PulseGroups
from core.typesetting import typeset

if TYPE_CHECKING:
    import xarray as xr

    from core.inference.flux_model import FluxPrior

COUNT_TYPES = (np.uint8, np.uint16, np.uint32)

IMAGES = ("truth_range_m", "reported_range_m", "signal")
"""Fields of a `Capture` that hold an image (row, col), or None."""

Detection = Literal["first", "all"]
"""``"first"``: at most one detection per pulse (Geiger mode); ``"all"``: every photon (TCSPC)."""


class CaptureError(ValueError):
    """A file that cannot be read as a capture; names file, field, value and remedy."""

    @property
    def choices(self) -> Mapping[str, Mapping[str, str]]:
        """Reading options as text that would open the file, by title; empty for other errors."""
        return dict(getattr(self.__cause__, "choices", {}))

    @property
    def question(self) -> str:
        """Question that `choices` answer; empty for other errors."""
        return str(getattr(self.__cause__, "question", ""))


@dataclass(frozen=True)
class StatedFlux:
    """Mean fluxes of all pixels that a file states, to compare estimates with.

    Raises
    ------
    ValueError
        If one is negative or not finite.
    """

    signal: float | None = None
    """Signal photons of a pixel, of all pulses together."""
    background: float | None = None
    """Background photons of a pixel, likewise, over the whole gate."""
    sbr: float | None = None
    """Signal over background."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None:
                require(f"stated {name}", value, 0 <= value < np.inf, "finite and non-negative")


@dataclass(frozen=True, eq=False)
class Capture:
    """Histograms of trigger times, one for each pixel.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
        Counts as uint8, uint16 or uint32. Made read-only.
    acquisition : Acquisition
        Gate, bins and pulses; its ``n_bins`` is the cube's last axis.
    pulse : Pulse
        Shape of an echo.
    truth_range_m : ndarray, shape (row, col), optional
        True range in metres, NaN where there is no target; None for a capture without truth. This
        and the other images may be given as lists of rows, too.
    signal : ndarray, shape (row, col), optional
        True signal photons per pulse, if known.
    background : float, optional
        True background photons per pulse over the gate, if known.
    source : str
        Origin of the capture and, for a file, what was assumed about it.
    detection : str
        ``"first"`` if a pulse fires a pixel at most once, so that early photons hide later ones
        (pile-up); ``"all"`` if every photon is counted.
    flux_prior : FluxPrior, optional
        Flux parameters of the image that these pixels belong to; estimated from these pixels if
        None. ``dataclasses.replace`` keeps it: pass ``flux_prior=None`` together with counts of
        another image, gate or number of pulses.
    reported_range_m : ndarray, shape (row, col), optional
        Range in metres that the instrument itself reported, NaN where it found no target: a second
        estimate to compare with, not truth.
    n_records : int, optional
        Records in time of the file that the capture was read from, all of them or some added up;
        None for a file without a sequence.
    stated_flux : StatedFlux, optional
        Fluxes that the file states. No estimate uses them; reductions that change them drop them.
    guesses : mapping, optional
        Options that the reader of the file chose and no other field holds, such as the array's
        name as ``variable``, by their names in `core.io.ReadOptions`.
    groups : PulseGroups, optional
        Counts of successive groups of pulses, which add up to the cube; None if the order of the
        pulses is not known. Pass ``groups=None`` to ``dataclasses.replace`` with other counts.

    Raises
    ------
    ValueError
        If shapes or types do not match, a pixel has more first photons than pulses, or groups do
        not add up to the cube and the pulses.
    """

    cube: NDArray[np.unsignedinteger]
    acquisition: Acquisition
    pulse: Pulse = field(default_factory=Pulse)
    truth_range_m: Floats | None = None
    signal: Floats | None = None
    background: float | None = None
    source: str = ""
    detection: Detection = "first"
    flux_prior: FluxPrior | None = field(default=None, repr=False)
    reported_range_m: Floats | None = None
    n_records: int | None = None
    stated_flux: StatedFlux | None = None
    guesses: Mapping[str, Any] = field(default_factory=dict, repr=False)
    groups: PulseGroups | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        cube, counts = self.cube, "uint8, uint16 or uint32 counts of shape (row, col, bin)"
        require_type("cube", cube, np.ndarray, f"a NumPy array of {counts}")
        require(
            "cube",
            f"{cube.dtype} array of shape {cube.shape}",
            cube.ndim == 3 and cube.dtype in COUNT_TYPES and min(cube.shape) > 0,
            f"{counts}, none of them 0",
        )
        require_type("acquisition", self.acquisition, Acquisition, "a core.Acquisition")
        require_type("pulse", self.pulse, Pulse, "a core.Pulse, such as core.Pulse(1e-9)")
        require(
            "n_bins",
            self.acquisition.n_bins,
            self.acquisition.n_bins == cube.shape[2],
            f"{cube.shape[2]}, the cube's last axis",
        )
        for name in IMAGES:
            if getattr(self, name) is not None:
                image = _image(name, getattr(self, name))
                fits = image.shape == self.shape
                require(name, f"shape {image.shape}", fits, f"shape {self.shape}, that of the cube")
                object.__setattr__(self, name, image)  # a list has become an array
        if self.signal is not None:
            low, high = float(np.min(self.signal)), float(np.max(self.signal))
            require("signal", (low, high), 0 <= low <= high < np.inf, "finite and non-negative")
        if self.background is not None:
            accepted = "a finite and non-negative number"
            require_type("background", self.background, Real, accepted)
            require("background", self.background, 0 <= self.background < np.inf, accepted)
        kinds = get_args(Detection)
        require("detection", self.detection, self.detection in kinds, " or ".join(map(repr, kinds)))
        cube.setflags(write=False)
        if self.gated_pulses is not None:
            most, name = int(self.counts.max()), f"n_pulses = {self.gated_pulses}, counts"
            accepted = "no more first photons than pulses in a pixel, or 'all' for its detection"
            require(name, most, most <= self.gated_pulses, accepted)
        if self.groups is not None:
            sent, n_pulses = sum(self.groups.n_pulses), self.acquisition.n_pulses
            require("pulses of the groups", sent, sent == n_pulses, f"{n_pulses}, the capture's")
            same = np.array_equal(self.groups.total, cube)
            accepted = "groups that add up to the cube, or None with other counts"
            require("groups", f"shape {self.groups.counts.shape}", same, accepted)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.cube.shape[:2]

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Detections of each pixel, shape (row, col)."""
        return pixel_sums(self.cube)

    @cached_property
    def blocks(self) -> Blocks:
        """The cube in the layout of the kernels, cached."""
        return to_blocks(self.cube)

    @property
    def gated_pulses(self) -> int | None:
        """Pulses sent, for first photons; None for all photons and if the number is unknown."""
        return self.acquisition.n_pulses if self.detection == "first" else None

    armed_pulses = renamed("gated_pulses")

    @property
    def echo_bins(self) -> int:
        """Whole bins that hold the middle 80 % of an echo, at least 1."""
        begin_s, end_s = self.pulse.span_s
        return max(1, math.ceil((end_s - begin_s) / self.acquisition.bin_width_s))

    def images(self, change: Callable[[Floats], Any]) -> dict[str, Any]:
        """Return each of `IMAGES` after a change, by its field; what is None remains None."""
        images = {name: getattr(self, name) for name in IMAGES}
        return {name: image if image is None else change(image) for name, image in images.items()}

    def to_xarray(self) -> xr.Dataset:
        """Return the capture as labelled arrays, as `core.save_capture` writes them.

        Returns
        -------
        xarray.Dataset
            ``counts`` over ``row``, ``col`` and ``bin`` with the coordinates ``time_s`` (when a bin
            opens, after the pulse) and ``range_m``; its attributes describe acquisition, pulse,
            detection and source. Where known, ``truth_range_m``, ``reported_range_m`` and
            ``signal`` over ``row`` and ``col``.
        """
        return dataset(self)

    @property
    def facts(self) -> dict[str, str]:
        """Size, gate, pulses, photons, kind of detection, truth and source as text, by name."""
        (rows, cols), acquisition = self.shape, self.acquisition
        photons, n_pulses = int(self.counts.sum()), acquisition.n_pulses
        mean = photons / self.counts.size
        begin_m, end_m = acquisition.bin_to_range_m([0, acquisition.n_bins]).tolist()
        return {
            "shape": f"{rows} × {cols} pixels",
            "bins": f"{acquisition.n_bins} of {acquisition.bin_width_s * 1e9:.6g} ns, "
            f"{begin_m:.6g} to {end_m:.6g} m",
            "pulses": "not known" if n_pulses is None else f"{n_pulses:,}",
            "photons": f"{photons:,}, {typeset(f'{mean:.4g}')} per pixel",
            "detection": "first photons" if self.detection == "first" else "all photons",
            "truth": "not known" if self.truth_range_m is None else "known",
            "source": self.source,
        }

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        return html_table("Capture", self.facts)


def _image(name: str, values: Any) -> NDArray[Any]:
    """Return an image as an array; raise ``ValueError`` unless it holds real numbers."""
    try:
        image: NDArray[Any] = np.asanyarray(values)
    except ValueError:  # rows of different lengths
        image = np.asarray(values, object)
    is_real = np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)
    given = f"array of {image.dtype} of shape {image.shape}"
    require(name, given, is_real, "real numbers of shape (row, col), NaN where there is none")
    return image


@runtime_checkable
class CaptureInfo(Protocol):
    """The part of a `Capture` that is available even if its cube is not in memory."""

    @property
    def counts(self) -> NDArray[Any]:
        """Detections of each pixel, shape (row, col)."""

    @property
    def acquisition(self) -> Acquisition:
        """Settings of the recording."""

    @property
    def detection(self) -> Detection:
        """First photons or all."""

    @property
    def source(self) -> str:
        """Origin of the capture."""

    @property
    def gated_pulses(self) -> int | None:
        """`Capture.gated_pulses`."""


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


MOST_CACHED = 64
"""Results of a function that are kept for a capture."""


class cached_per_capture(Generic[_Arguments, _Result]):
    """Decorator that caches results of a function of a capture for the capture's lifetime.

    Those of the latest `MOST_CACHED` arguments are kept. The function must be deterministic and its
    other arguments hashable. Its result must not refer to the capture, which could then never be
    freed.
    """

    def __init__(self, compute: Callable[Concatenate[Capture, _Arguments], _Result]) -> None:
        update_wrapper(self, compute)
        self._compute = compute
        self._results: WeakKeyDictionary[Capture, dict[Any, _Result]] = WeakKeyDictionary()

    def __call__(
        self, capture: Capture, *args: _Arguments.args, **kwargs: _Arguments.kwargs
    ) -> _Result:
        """Return the cached result, or compute it."""
        results = self._results.setdefault(capture, {})
        key = (args, *kwargs.items())
        with suppress(KeyError):
            return results[key]
        result = results.setdefault(key, self._compute(capture, *args, **kwargs))
        for oldest in list(results)[:-MOST_CACHED]:
            results.pop(oldest, None)  # another thread may have done so
        return result

    def is_cached(self, capture: Capture) -> bool:
        """Return whether any result of a capture is cached."""
        return bool(self._results.get(capture))
