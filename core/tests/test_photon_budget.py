"""The photon budget against its own equations, published budgets, and the simulation."""

from __future__ import annotations

import json
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest
from scipy import constants
from scipy.optimize import brentq

from core import Acquisition, Flux, PhotonBudget, Pulse, Scene, scenes, simulate
from core.acquisition import SPEED_OF_LIGHT_M_S
from core.cli import main
from core.effects import Backscatter, Falloff
from core.estimators import estimate
from core.metrics import restoration_degree
from core.photon_budget import (
    GIVEN,
    OF_SCENE,
    OF_STANDARD,
    PLANCK_J_S,
    STANDARD_SUN_LUX,
    flux_extents,
    predicted_rd,
    reaching,
    steps,
    with_falloff,
)
from core.simulation import echoes
from core.studies.budget import background_note, needed_table, steps_table
from core.studies.outputs import as_markdown

RESULTS = Path(__file__).resolve().parents[2] / "assets" / "results" / "budget.md"

SPELLED = str.maketrans({"·": "*", "²": "**2"})
NAMES = {"h": PLANCK_J_S, "c": SPEED_OF_LIGHT_M_S, "π": pi, "min": min}


def values(budget: PhotonBudget, scene: Scene) -> dict[str, float]:
    return {step.symbol: step.value for step in steps(budget, scene)}


def one_pixel(range_m: float, pixel_angle_rad: float = 1e-3) -> Scene:
    """A scene of one pixel, on which the whole beam falls."""
    return Scene(np.full((1, 1), range_m), acquisition=Acquisition(pixel_angle_rad=pixel_angle_rad))


WALLS = Scene(
    np.tile(np.repeat([48.8, 50.0, 51.8], 21), (64, 1)), acquisition=scenes["car"]().acquisition
)
"""As many pixels as the car's scene, at three ranges: predictions take a tenth of the time."""


@pytest.mark.parametrize(
    "budget", [PhotonBudget(), PhotonBudget(beam_mrad=0.5, irradiance_w_m2_nm=0.3)]
)
def test_each_value_is_that_of_the_equation_shown_with_it(budget: PhotonBudget) -> None:
    known: dict[str, object] = dict(NAMES)
    computed = 0
    for step in steps(budget, scenes["car"]()):
        assert step.symbol not in known
        if step.equation not in (GIVEN, OF_SCENE, OF_STANDARD):
            found = eval(step.equation.translate(SPELLED), {}, known)
            assert step.value == pytest.approx(found, rel=1e-12), step.name
            computed += 1
        known[step.symbol] = step.value
    assert computed >= 15


def test_constants_are_those_of_the_si() -> None:
    assert constants.h == PLANCK_J_S
    assert constants.c == SPEED_OF_LIGHT_M_S


def test_a_published_signal_of_a_satellite() -> None:
    """NASA on ICESat-2 (icesat-2.gsfc.nasa.gov/space-lasers): of about 20 trillion photons of a
    pulse "only about a dozen return to the satellite's telescope", of 2.6 feet, from 500 km below.

    Assumed: fresh snow of reflectivity 0.9, clear air. This checks the share that returns, the
    ratio of NASA's two numbers; the next test has the number of photons that NASA states elsewhere.
    """
    photons, feet_m = 20e12, 0.3048
    energy_j = photons * constants.h * constants.c / 532e-9
    budget = PhotonBudget(
        pulse_energy_uj=energy_j * 1e6,
        wavelength_nm=532.0,
        aperture_mm=2.6 * feet_m * 1e3,
        reflectivity=0.9,
        transmission=1.0,
    )
    found = values(budget, one_pixel(500e3))
    assert found["N"] == pytest.approx(photons)
    assert 10 < found["M"] < 14


def test_a_published_number_of_detections_of_a_satellite() -> None:
    """Sea ice ATBD of ICESat-2 (Kwok et al., doi:10.5067/KPMXUOH7TNIY; read in a summary only):
    about 6 signal photons per pulse are detected in a strong beam over snow-covered ice, and 1.5 in
    a weak one; three beams of each kind share the energy 4 to 1. NASA (climate.nasa.gov/news/2814):
    a pulse is 300 trillion photons; telescope and altitude as above.

    The losses in air, optics and detector are not stated there, so that only their product can be
    compared: it must be that of an instrument, 0.05 to 0.3 (an optical throughput of a half, twice
    through air of 0.8, a detector of 0.15 to 0.5). No published budget of a background was found
    that states all of its numbers.
    """
    strong = 300e12 * 4 / 15
    budget = PhotonBudget(
        pulse_energy_uj=strong * constants.h * constants.c / 532e-9 * 1e6,
        wavelength_nm=532.0,
        aperture_mm=2.6 * 304.8,
        reflectivity=0.9,
        transmission=1.0,
    )
    found = values(budget, one_pixel(500e3))
    assert 0.05 < 6 / found["M"] < 0.3


def test_a_published_reach_of_a_range_finder() -> None:
    """Jioptics (jioptics.com/35km-laser-range-finder-module): 1 MW in a beam of 0.8 mrad, optics of
    0.9 and 0.8, an aperture of 67 mm, a target of 2.3 m by 2.3 m and reflectivity 0.3, air that
    takes 0.03 per km. The least that the detector sees, 5 nW, is to come from 21 to 22 km, "might
    be close or less than 22 km"; at 22 km it is less. The formula is not stated; a tenth of the
    range changes the power by a factor of 1.7.
    """
    angle_rad = 0.8e-3 * np.sqrt(pi) / 2  # of a square beam of the same solid angle

    def power_w(range_m: float) -> float:
        budget = PhotonBudget(
            aperture_mm=67.0,
            reflectivity=0.3,
            transmission=0.9 * 0.8 * np.exp(-2 * 0.03e-3 * range_m),
            beam_mrad=angle_rad * 1e3,
            wavelength_nm=1570.0,
        )
        found = values(budget, one_pixel(range_m, 2.3 / range_m))
        return 1e6 * found["M"] / found["N"]

    assert power_w(22e3) < 5e-9
    reach_m = brentq(lambda range_m: power_w(range_m) - 5e-9, 10e3, 30e3)
    assert reach_m == pytest.approx(21.5e3, rel=0.1)


def test_a_background_worked_out_by_hand() -> None:
    """0.5 · 2 W/m²/nm · 1 nm / π, times π · (2 cm)² / 4, 1e-6 sr and 0.5: 50 pW.

    At 1000 nm, with 1.98645e-19 J a photon, these are 2.5171e8 photons a second: of them a tenth is
    detected, and of 100 ns are counted 2.5171, with 10 million dark counts a second 3.5171.
    """
    budget = PhotonBudget(
        wavelength_nm=1000.0,
        aperture_mm=20.0,
        filter_nm=1.0,
        reflectivity=0.5,
        transmission=0.5,
        efficiency=0.1,
        irradiance_w_m2_nm=2.0,
        dark_count_hz=1e7,
    )
    found = values(budget, one_pixel(70.0))
    assert found["P"] == pytest.approx(50e-12)
    assert found["r"] == pytest.approx(2.5171e8, rel=1e-4)
    assert found["B"] == pytest.approx(3.5171, rel=1e-4)


def test_the_standard_sun_is_as_bright_as_its_spectrum() -> None:
    """683 lm/W, with the luminosity V(λ) as Stockman's group fits it (Wyman et al. 2013)."""
    step_nm = 1.0
    wavelength_nm = np.arange(401.0, 760.0, step_nm)
    irradiance = [
        values(PhotonBudget(wavelength_nm=each, filter_nm=step_nm), one_pixel(50.0))["E_s"]
        for each in wavelength_nm
    ]
    luminosity = 1.019 * np.exp(-285.4 * (wavelength_nm * 1e-3 - 0.559) ** 2)
    lux = 683 * step_nm * float(np.dot(irradiance, luminosity))
    assert lux == pytest.approx(STANDARD_SUN_LUX, rel=0.02)


def test_signal_falls_with_range_and_reflectivity_over_the_scene() -> None:
    range_m = np.array([[50.0, 100.0, np.nan, 25.0]])
    scene = Scene(range_m, np.array([[1.0, 0.5, 1.0, 1.0]]), Acquisition(1000))
    lit, flux = PhotonBudget().apply(scene)
    signal = flux.signal * np.array([[1.0, 0.125, 0.0, 4.0]])
    assert next(echoes(lit, flux))[1] == pytest.approx(signal)
    found = values(PhotonBudget(), scene)
    half = (0.5 * found["η"] * found["r"] + found["d"]) * found["t"]
    extents = flux_extents(PhotonBudget(), scene)
    assert extents[0] == pytest.approx((flux.signal / 8, 4 * flux.signal))
    assert extents[1] == pytest.approx((half, found["B"]), rel=1e-4)
    assert (flux.signal, flux.sbr) == pytest.approx((found["S"], found["SBR"]), rel=1e-4)


def test_bright_surfaces_reflect_more_sunlight_and_dark_counts_are_even() -> None:
    range_m = np.array([[50.0, 50.0, np.nan]])
    scene = Scene(range_m, np.array([[1.0, 0.25, 0.0]]), Acquisition(1000))
    budget = PhotonBudget(pulse_energy_uj=3e-4, dark_count_hz=1e6)
    lit, flux = budget.apply(scene)
    found = values(budget, scene)
    dim = (0.25 * found["η"] * found["r"] + 1e6) * found["t"]
    expected = np.array([[found["B"], dim, found["B"]]])
    assert lit.ambient * flux.background == pytest.approx(expected, rel=1e-4)
    assert flux_extents(budget, scene)[1] == pytest.approx((dim, found["B"]), rel=1e-4)
    # Less background than that of an even scene makes the dim pixel easier to range.
    assert predicted_rd(lit, flux) > predicted_rd(replace(lit, ambient=None), flux)


def test_light_from_fog_does_not_depend_on_the_target() -> None:
    """The photons of the fog depend neither on the target's reflectivity nor on its range."""
    car = scenes["car"]()

    def of_fog(scene: Scene, reflectivity: float) -> np.ndarray:
        fog = replace(scene, backscatter=Backscatter(0.01))
        lit, flux = PhotonBudget(reflectivity=reflectivity).apply(fog)
        assert lit.backscatter is not None
        return lit.backscatter.photons_before(flux.signal, Pulse(), lit.acquisition)

    farther = replace(car, range_m=1.1 * car.range_m)
    assert of_fog(car, 0.1).max() > 0
    assert of_fog(car, 0.1) == pytest.approx(of_fog(farther, 0.5), rel=1e-4)


def test_the_signal_is_that_at_the_median_range() -> None:
    scene = scenes["car"]()
    assert values(PhotonBudget(), scene)["R"] == pytest.approx(np.nanmedian(scene.range_m))
    assert with_falloff(scene).falloff == Falloff(float(np.nanmedian(scene.range_m)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PhotonBudget(pulse_energy_uj=0.0), "pulse_energy_uj = 0.0"),
        (lambda: PhotonBudget(reflectivity=1.2), "reflectivity = 1.2"),
        (lambda: PhotonBudget(wavelength_nm=10_600.0), "wavelength_nm = 10600.0"),
        (lambda: Falloff(0.0), "reference_m = 0.0"),
        (lambda: steps(PhotonBudget(), one_pixel(np.nan)), "no pixel with a target"),
        (lambda: reaching(PhotonBudget(), one_pixel(50.0), 1.5), "target_rd = 1.5"),
    ],
)
def test_bad_input_is_refused(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_an_unknown_pixel_angle_is_refused() -> None:
    with pytest.raises(ValueError, match="pixel_angle_rad = None"):
        steps(
            PhotonBudget(),
            Scene(np.full((1, 1), 50.0), acquisition=Acquisition(pixel_angle_rad=None)),
        )


@pytest.mark.parametrize("pulse_energy_uj", [0.2, 0.3])
def test_the_predicted_restoration_degree_is_that_of_simulations(pulse_energy_uj: float) -> None:
    scene, flux = PhotonBudget(pulse_energy_uj).apply(scenes["car"]())
    capture = simulate(scene, scene.acquisition, flux)
    tolerance_m = 3 * scene.acquisition.bin_length_m
    found = restoration_degree(estimate(capture, "likelihood").range_m, scene.range_m, tolerance_m)
    n, rd = np.isfinite(scene.range_m).sum(), predicted_rd(scene, flux)
    # The stated error, and four standard deviations.
    assert found == pytest.approx(rd, abs=0.015 + 4 * np.sqrt(rd * (1 - rd) / n))


def test_a_restoration_degree_is_reached_with_what_is_needed() -> None:
    budget, scene = PhotonBudget(), WALLS
    energy, aperture, filter_ = reaching(budget, scene, 0.95)

    def rd(name: str, value: float) -> float:
        return predicted_rd(*replace(budget, **{name: value}).apply(scene))

    for found in (energy, aperture, filter_):
        assert rd(found.name, found.best) == pytest.approx(found.best_rd)
        assert found.low <= found.best <= found.high
        for end in (found.low, found.high):
            if not np.isclose(end, (found.spec.low, found.spec.high)).any():
                assert rd(found.name, end) == pytest.approx(0.95, abs=0.002)
    # More light alone piles up; more energy, or less sunlight, never harms.
    assert aperture.low < budget.aperture_mm < aperture.high < aperture.spec.high
    assert energy.high == pytest.approx(energy.spec.high)
    assert filter_.low == pytest.approx(filter_.spec.low)
    # A lower target takes less energy, or allows a wider filter.
    lower = reaching(budget, scene, 0.8)
    assert lower[0].low < energy.low
    assert lower[2].high > filter_.high


def test_a_restoration_degree_out_of_reach_is_stated() -> None:
    dim, scene = PhotonBudget(pulse_energy_uj=1e-3), WALLS
    _, *out_of_reach = reaching(dim, scene)
    for found in out_of_reach:
        assert np.isnan((found.low, found.high)).all()
        tried = np.geomspace(found.spec.low, found.spec.high, 40)
        rd = [predicted_rd(*replace(dim, **{found.name: x}).apply(scene)) for x in tried]
        # None is better but for rounding: the ends of a slider are searched as logarithms.
        assert max(rd) <= found.best_rd + 1e-12 < 0.99


def test_the_command_prints_steps_and_the_way_back(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(scenes, "car", lambda: WALLS)
    chosen = ["budget", "--pulse-energy-uj", "2", "--pulses", "500", "--rd", "0.95"]
    assert main([*chosen, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    budget, car = PhotonBudget(pulse_energy_uj=2.0), WALLS
    assert found["S"] == values(budget, car)["S"]
    car = replace(car, acquisition=replace(car.acquisition, n_pulses=500))
    needed = reaching(budget, car, 0.95)
    assert found["needed"] == {each.name: [each.low, each.high] for each in needed}
    assert main(chosen) == 0
    table = needed_table(needed, 0.95)
    assert as_markdown(table.columns, table.rows, table.formats) in capsys.readouterr().out


def test_an_even_background_is_one_number() -> None:
    assert background_note(1.0, 1.0004) == "The background is 1 in all pixels."
    assert background_note(1.0, 2.0).startswith("The background is 1 to 2: ")


def test_the_documented_budget_is_that_of_the_code() -> None:
    table = steps_table(PhotonBudget(), scenes["car"](), "car")
    assert as_markdown(table.columns, table.rows, table.formats) in RESULTS.read_text("utf-8")
    assert table.note in RESULTS.read_text("utf-8")


def test_falloff_changes_nothing_at_its_reference_range() -> None:
    scene = scenes["car"]()
    flat = replace(scene, range_m=np.where(np.isfinite(scene.range_m), 50.0, np.nan))
    plain = simulate(flat, flat.acquisition, Flux())
    falling = simulate(with_falloff(flat), flat.acquisition, Flux())
    assert np.array_equal(plain.cube, falling.cube)
