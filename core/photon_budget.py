"""Photon budget: from laser, optics and sunlight to signal and background photons per pulse.

The radar equation of an extended Lambertian target at normal incidence, for a laser that floods
many pixels or only one. `steps` is the one definition: the app, ``python -m core budget`` and
``assets/results/budget.md`` show its equations, and a test evaluates each of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import SPEED_OF_LIGHT_M_S, Floats, Flux, Pulse
from core.checks import require
from core.effects import Falloff
from core.inference.limits import right_bin_probability
from core.parameters import Number, Settings, parameter, spec_of
from core.scene import Scene
from core.simulation import echoes

__all__ = [
    "GIVEN",
    "OF_SCENE",
    "OF_STANDARD",
    "SOUGHT",
    "TARGET_RD",
    "PhotonBudget",
    "Reach",
    "Step",
    "flux_extents",
    "predicted_rd",
    "reaching",
    "steps",
    "with_falloff",
]

PLANCK_J_S = 6.626_070_15e-34  # exact by definition

STANDARD_SUN_LUX = 109_500.0
"""Illuminance of the spectrum of ASTM G173-03 (global): 683 lm/W times its integral with V(λ)."""

TARGET_RD = 0.99
"""Default restoration degree of `reaching`."""

GIVEN = "given"
"""In place of the equation of a `Step` that is a setting."""

OF_SCENE, OF_STANDARD = "of the scene", "ASTM G173-03"
"""In place of the equation of a `Step` that is a property of the scene, or of the standard sun."""

SOUGHT = ("pulse_energy_uj", "aperture_mm", "filter_nm")
"""Settings that `reaching` varies."""

_MOST_PIXELS = 24  # of different ranges, whose mean predicts a restoration degree within 0.001
_VALUES = 17  # of a setting between the ends of its slider
_TOLERANCE = 2e-3  # relative, of a setting that is sought


def _positive(symbol: str, low: float, high: float, unit: str = "", most: float = 1e9) -> Number:
    return Number(symbol, low, high, log=True, unit=unit, least=0.0, most=most, open_below=True)


def _share(symbol: str) -> Number:
    return Number(symbol, 0.01, 1.0, least=0.0, most=1.0, open_below=True)


def _optional(spec: Number, none_means: str) -> Number:
    return replace(spec, optional=True, none_means=none_means)


@dataclass(frozen=True)
class PhotonBudget(Settings):
    """Laser, receiver, target and sunlight, in the units of data sheets.

    The defaults give about the default flux on the car: a weak flood laser at noon.

    Raises
    ------
    ValueError
        If a setting is out of its bounds.
    """

    pulse_energy_uj: float = parameter(
        0.4,
        _positive("Pulse energy", 1e-3, 1e4, "µJ"),
        "Energy that leaves the laser's optics with each pulse, spread over the whole beam.",
    )
    aperture_mm: float = parameter(
        10.0,
        _positive("Aperture", 1.0, 500.0, "mm", 1e5),
        "Diameter of the receiver's aperture. More collects more signal and more background.",
    )
    filter_nm: float = parameter(
        5.0,
        _positive("Filter width", 0.05, 100.0, "nm", 200.0),
        "Width of the receiver's optical filter, centred on the laser. A narrower one keeps "
        "sunlight out, and costs no signal as long as the laser fits in.",
    )
    illuminance_lux: float = parameter(
        100_000.0,
        Number("Sunlight", 1.0, 150_000.0, log=True, unit="lux", least=0.0, most=1e7),
        "Illuminance of the target: 100,000 lux in full sun, 10,000 under clouds, 1 by night. Its "
        "spectrum is that of the standard sun.",
    )
    reflectivity: float = parameter(
        0.2,
        _share("Reflectivity"),
        "Share of the light that the target reflects, alike in all directions (Lambert). The "
        "scene's own reflectivity multiplies it.",
    )
    efficiency: float = parameter(
        0.2,
        _share("Detection efficiency"),
        "Probability that a photon at the detector is detected, fill factor included.",
    )
    transmission: float = parameter(
        0.6,
        _share("Transmission"),
        "Share of the light that the receiver's optics and filter let pass; air, too, unless the "
        "scene has fog.",
    )
    wavelength_nm: float = parameter(
        905.0,
        Number("Wavelength", 400.0, 1700.0, unit="nm", least=400.0, most=1700.0),
        "Wavelength of the laser: 905, 940, 1064 and 1550 nm are usual.",
    )
    dark_count_hz: float = parameter(
        1000.0,
        _positive("Dark counts", 1.0, 1e6, "1/s"),
        "Detections per second of an armed pixel in the dark.",
    )
    beam_mrad: float | None = parameter(
        None,
        _optional(_positive("Beam angle", 0.01, 3000.0, "mrad", 3000.0), "image"),
        "Side of a square beam. Empty: the beam floods the whole image. One no wider than a pixel "
        "is that of a scanner.",
    )
    irradiance_w_m2_nm: float | None = parameter(
        None,
        _optional(_positive("Irradiance", 1e-4, 10.0, "W/m²/nm", 1e6), "from lux"),
        "Sunlight on the target at the laser's wavelength, if it is known better than by its "
        "illuminance. Empty: from the illuminance.",
    )

    def apply(self, scene: Scene) -> tuple[Scene, Flux]:
        """Return a scene lit by laser and sun, and the flux at its median range.

        Its signal falls with range, and its bright surfaces also reflect more sunlight. The flux
        has five digits, so that it can be read and typed.
        """
        found = {step.symbol: step.value for step in steps(self, scene)}
        signal, sbr = (float(f"{found[symbol]:.5g}") for symbol in ("S", "SBR"))
        sunlit = _sunlit(scene, found["η"] * found["r"] / found["b"])
        return with_falloff(sunlit, self.reflectivity), Flux(signal, sbr)


class Step(NamedTuple):
    """One quantity of a budget, in the order in which they are computed."""

    name: str
    symbol: str
    equation: str
    """In the symbols of steps before, or where the value comes from."""
    value: float
    unit: str


def steps(budget: PhotonBudget, scene: Scene) -> tuple[Step, ...]:
    """Return every step from the settings to signal, background and their ratio.

    Parameters
    ----------
    budget : PhotonBudget
    scene : Scene
        Its ranges, number of pixels, pixel angle and gate are used.

    Raises
    ------
    ValueError
        If the pixel angle is unknown, or no pixel has a target.
    """
    found = _Sheet()
    _add_inputs(found, budget, scene)
    _add_signal(found)
    _add_background(found, budget)
    return tuple(found.steps.values())


class _Sheet:
    """Steps by symbol, in the order in which they are added."""

    def __init__(self) -> None:
        self.steps: dict[str, Step] = {}

    def __getitem__(self, symbol: str) -> float:
        return self.steps[symbol].value

    def add(self, name: str, symbol: str, equation: str, value: float, unit: str = "") -> None:
        self.steps[symbol] = Step(name, symbol, equation, value, unit)


def _add_inputs(at: _Sheet, budget: PhotonBudget, scene: Scene) -> None:
    gate, angle_rad = scene.acquisition, scene.acquisition.pixel_angle_rad
    if angle_rad is None:
        raise ValueError("pixel_angle_rad = None is not accepted: give the angle of a pixel.")
    at.add("Pulse energy", "E", GIVEN, budget.pulse_energy_uj * 1e-6, "J")
    at.add("Wavelength", "λ", GIVEN, budget.wavelength_nm * 1e-9, "m")
    at.add("Reflectivity", "ρ", GIVEN, budget.reflectivity)
    at.add("Diameter of the aperture", "D", GIVEN, budget.aperture_mm * 1e-3, "m")
    at.add("Transmission", "T", GIVEN, budget.transmission)
    at.add("Detection efficiency", "η", GIVEN, budget.efficiency)
    at.add("Filter width", "Δλ", GIVEN, budget.filter_nm, "nm")
    at.add("Dark counts", "d", GIVEN, budget.dark_count_hz, "1/s")
    at.add("Median range", "R", OF_SCENE, _median_range_m(scene), "m")
    at.add("Angle of a pixel", "φ", OF_SCENE, angle_rad, "rad")
    at.add("Solid angle of a pixel", "Ω", "φ²", at["φ"] ** 2, "sr")
    if budget.beam_mrad is None:
        at.add("Pixels", "n", OF_SCENE, float(np.size(scene.range_m)))
        at.add("Solid angle of the beam", "Ω_b", "n · Ω", at["n"] * at["Ω"], "sr")
    else:
        at.add("Beam angle", "θ", GIVEN, budget.beam_mrad * 1e-3, "rad")
        at.add("Solid angle of the beam", "Ω_b", "θ²", at["θ"] ** 2, "sr")
    at.add("Gate", "t", OF_SCENE, gate.n_bins * gate.bin_width_s, "s")


def _add_signal(at: _Sheet) -> None:
    photon_j = PLANCK_J_S * SPEED_OF_LIGHT_M_S / at["λ"]
    at.add("Energy of a photon", "Q", "h · c / λ", photon_j, "J")
    at.add("Photons of a pulse", "N", "E / Q", at["E"] / at["Q"])
    share = min(1.0, at["Ω"] / at["Ω_b"])
    at.add("Share of the beam on a pixel", "q", "min(1, Ω / Ω_b)", share)
    at.add("Area of the aperture", "A", "π · D² / 4", math.pi * at["D"] ** 2 / 4, "m²")
    collected = at["ρ"] * at["A"] / (math.pi * at["R"] ** 2)
    at.add("Share that returns (Lambert)", "g", "ρ · A / (π · R²)", collected)
    arriving = at["N"] * at["q"] * at["g"] * at["T"]
    at.add("Signal photons at the detector", "M", "N · q · g · T", arriving)
    at.add("Signal", "S", "η · M", at["η"] * at["M"], "per pulse")


def _add_background(at: _Sheet, budget: PhotonBudget) -> None:
    sun, unit = "Spectral irradiance of the sun", "W/m²/nm"
    if budget.irradiance_w_m2_nm is None:
        at.add("Illuminance", "E_v", GIVEN, budget.illuminance_lux, "lux")
        at.add("Illuminance of the standard sun", "E_0", OF_STANDARD, STANDARD_SUN_LUX, "lux")
        at.add("Its irradiance in the filter", "E_s", OF_STANDARD, _standard_sun(budget), unit)
        at.add(sun, "E_λ", "E_s · E_v / E_0", at["E_s"] * at["E_v"] / at["E_0"], unit)
    else:
        at.add(sun, "E_λ", GIVEN, budget.irradiance_w_m2_nm, unit)
    radiance = at["ρ"] * at["E_λ"] * at["Δλ"] / math.pi
    at.add("Radiance of the target", "L", "ρ · E_λ · Δλ / π", radiance, "W/m²/sr")
    power_w = at["L"] * at["A"] * at["Ω"] * at["T"]
    at.add("Background on a pixel", "P", "L · A · Ω · T", power_w, "W")
    at.add("Background photons", "r", "P / Q", at["P"] / at["Q"], "1/s")
    at.add("Background and dark counts", "b", "η · r + d", at["η"] * at["r"] + at["d"], "1/s")
    at.add("Background in the gate", "B", "b · t", at["b"] * at["t"], "per pulse")
    at.add("Signal over background", "SBR", "S / B", at["S"] / at["B"])


def _sunlit(scene: Scene, share: float) -> Scene:
    """Return a scene whose surfaces reflect sunlight as they reflect the laser.

    `share` is that of sunlight in the background of a surface of reflectivity 1; the rest are dark
    counts. Where there is no target, the background stays what it is.
    """
    if scene.reflectivity is None:
        return scene
    reflected = np.where(np.isfinite(scene.range_m), scene.reflectivity, 1.0)
    ambient = 1.0 if scene.ambient is None else scene.ambient
    return replace(scene, ambient=ambient * (1.0 - share + share * reflected))


def with_falloff(scene: Scene, reflectivity: float = 1.0) -> Scene:
    """Return a scene whose signal falls with ``1 / R²`` from that at its median range.

    Parameters
    ----------
    scene : Scene
    reflectivity : float
        Reflectivity to which the signal refers. A surface of reflectivity 1 returns as much from a
        range that is larger by the root, to which the signal of fog refers.

    Raises
    ------
    ValueError
        If no pixel has a target.
    """
    reference_m = _median_range_m(scene)
    fog = scene.backscatter
    if fog is not None:
        fog = replace(fog, reference_m=reference_m / math.sqrt(reflectivity))
    return replace(scene, falloff=Falloff(reference_m), backscatter=fog)


def flux_extents(
    budget: PhotonBudget, scene: Scene
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the smallest and largest signal, and background, of pixels with a target, per pulse.

    Raises
    ------
    ValueError
        As `steps`.
    """
    lit, flux = budget.apply(scene)
    is_target = np.isfinite(lit.range_m)
    signal, background = next(echoes(lit, flux))[1][is_target], _background(lit, flux)[is_target]
    return (
        (float(signal.min()), float(signal.max())),
        (float(background.min()), float(background.max())),
    )


def _background(scene: Scene, flux: Flux) -> Floats:
    """Background of each pixel per pulse, shape (row, col)."""
    ambient = 1.0 if scene.ambient is None else scene.ambient
    return np.broadcast_to(flux.background * np.asarray(ambient), np.shape(scene.range_m))


def predicted_rd(scene: Scene, flux: Flux, pulse: Pulse = Pulse()) -> float:
    """Predict the restoration degree of the likelihood with known fluxes.

    The mean of `core.limits.right_bin_probability` over pixels with a target, for their own signal:
    within 0.015 of simulations with 300 pulses or more. Only reflectivity, fog and the fall of the
    signal with range are taken into account, and the background of each pixel.
    """
    range_m, signal = (each.ravel() for each in next(echoes(scene, flux)))
    target = np.flatnonzero(np.isfinite(range_m))
    target = target[np.argsort(range_m[target], kind="stable")]
    count = min(target.size, _MOST_PIXELS)
    some = target[((np.arange(count) + 0.5) * target.size / count).astype(int)]
    onset_bin = scene.acquisition.range_m_to_bin(range_m[some])
    background, found = _background(scene, flux).ravel()[some], np.empty(count)
    for level in np.unique(background):
        at = background == level
        found[at] = right_bin_probability(
            onset_bin[at], signal[some][at], level, pulse, scene.acquisition
        )
    return float(found.mean())


class Reach(NamedTuple):
    """The values of a setting that reach a restoration degree, others unchanged."""

    name: str
    """Field of `PhotonBudget`."""
    now: float
    low: float
    """Smallest such value on its slider; NaN if there is none."""
    high: float
    """Largest such value on its slider; NaN if there is none."""
    best_rd: float
    """Largest restoration degree that it reaches."""
    best: float
    """Value with which it does."""

    @property
    def spec(self) -> Number:
        """Symbol and unit of the setting."""
        return _spec_of(self.name)


def _spec_of(name: str) -> Number:
    (spec,) = (spec_of(each) for each in fields(PhotonBudget) if each.name == name)
    assert isinstance(spec, Number)
    return spec


def reaching(
    budget: PhotonBudget, scene: Scene, target_rd: float = TARGET_RD, pulse: Pulse = Pulse()
) -> tuple[Reach, ...]:
    """Find the values of each of `SOUGHT`, one at a time, that reach a restoration degree.

    The restoration degree is that of `predicted_rd`, with the pulses of the scene's acquisition.

    Raises
    ------
    ValueError
        If the restoration degree is not between 0 and 1; as `steps`.
    """
    require("target_rd", target_rd, 0 < target_rd < 1, "a share between 0 and 1")
    return tuple(_reach(budget, scene, name, target_rd, pulse) for name in SOUGHT)


def _reach(budget: PhotonBudget, scene: Scene, name: str, target_rd: float, pulse: Pulse) -> Reach:
    def margin(log_value: float) -> float:
        changed = replace(budget, **{name: math.exp(log_value)})
        return predicted_rd(*changed.apply(scene), pulse) - target_rd

    now = float(getattr(budget, name))
    spec = _spec_of(name)
    logs = np.linspace(math.log(spec.low), math.log(spec.high), _VALUES)
    margins = np.array([margin(each) for each in logs])
    best = int(margins.argmax())  # the maximum may lie between two values
    ends = logs[max(best - 1, 0)], logs[min(best + 1, _VALUES - 1)]
    top = scipy.optimize.minimize_scalar(
        lambda at: -margin(at), bounds=ends, options={"xatol": 0.02}
    )
    if -top.fun > margins[best]:
        best = int(np.searchsorted(logs, top.x))
        logs, margins = np.insert(logs, best, top.x), np.insert(margins, best, -top.fun)

    def end(step: int) -> float:
        """Follow the values that suffice from the best one, down (-1) or up (1)."""
        i = best
        while 0 <= i + step < logs.size and margins[i + step] >= 0:
            i += step
        if not 0 <= i + step < logs.size:
            return math.exp(logs[i])
        root = scipy.optimize.brentq(margin, *sorted(logs[[i, i + step]]), xtol=_TOLERANCE)
        return math.exp(root)

    low, high = (end(-1), end(1)) if margins[best] >= 0 else (math.nan, math.nan)
    return Reach(name, now, low, high, float(margins[best] + target_rd), math.exp(logs[best]))


# -- Inputs ----------------------------------------------------------------------------------------


def _median_range_m(scene: Scene) -> float:
    known = scene.range_m[np.isfinite(scene.range_m)]
    require("range_m", "no pixel with a target", known.size > 0, "a scene with a target")
    return float(np.median(known))


def _standard_sun(budget: PhotonBudget) -> float:
    """Mean spectral irradiance of the standard sun within the filter, in W/m²/nm.

    Beyond 400 and 1700 nm, the value at that end is used.
    """
    wavelength_nm, irradiance = _sunlight()
    half = budget.filter_nm / 2
    low, high = budget.wavelength_nm - half, budget.wavelength_nm + half
    inside = wavelength_nm[(wavelength_nm > low) & (wavelength_nm < high)]
    at = np.concatenate([[low], inside, [high]])
    return float(np.trapezoid(np.interp(at, wavelength_nm, irradiance), at) / (high - low))


@cache
def _sunlight() -> tuple[Floats, Floats]:
    """Wavelengths in nm and spectral irradiance in W/m²/nm of ASTM G173-03, global tilt."""
    with resources.files("assets").joinpath("sunlight.npz").open("rb") as file:
        stored = np.load(file)
        return stored["wavelength_nm"].astype(float), stored["irradiance_w_m2_nm"].astype(float)
