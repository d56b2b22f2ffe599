"""Tests of fluxes that a file states: read, kept, and compared with estimates, never used."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.io import savemat

from core import (
    Capture,
    CaptureError,
    StatedFlux,
    estimate,
    read_capture,
    save_capture,
    scenes,
    simulate,
)
from core.acquisition import Flux, Pulse
from core.cli import main
from core.inspection import capture_report
from core.io.writers import CAPTURE_SUFFIXES
from core.reductions import Reduction
from core.tests.labelled_files import Matlab73, hdf5_bytes

pytestmark = pytest.mark.files

STATED = StatedFlux(signal=2.0, background=16.0, sbr=0.125)
NAMED = {"SBR": 0.125, "mean_signal_photons": 2.0, "noise_ppp": 16.0, "mean_sbr": np.nan}


def mat73(path: Path, counts: Any, **numbers: float) -> None:
    file = Matlab73()
    file.number("counts", counts)
    for name, value in numbers.items():
        file.number(name, value)
    path.write_bytes(file.bytes())


def labelled(counts: Any, **numbers: float) -> xr.Dataset:
    """Counts, and numbers as arrays without axes."""
    return xr.Dataset({"counts": (("row", "col", "bin"), counts.astype(np.int32)), **numbers})


WRITE: dict[str, Callable[..., Any]] = {
    "v5.mat": lambda path, **known: savemat(path, known),
    "v73.mat": mat73,
    "a.npz": np.savez,
    "a.h5": lambda path, **known: path.write_bytes(hdf5_bytes(**known)),
    "a.zarr": lambda path, **known: labelled(**known).to_zarr(path, consolidated=False),
    "a.nc": lambda path, **known: labelled(**known).to_netcdf(path, engine="scipy"),
}


@pytest.fixture(scope="module")
def capture() -> Capture:
    scene = scenes["staircase"](24)
    return simulate(scene, replace(scene.acquisition, n_pulses=200), Flux(signal=0.05, sbr=0.5))


@pytest.mark.parametrize("name", WRITE)
def test_stated_fluxes_are_read_by_many_names_and_change_no_estimate(
    name: str, capture: Capture, tmp_path: Path
) -> None:
    path, plain = tmp_path / name, tmp_path / "plain.npz"
    WRITE[name](path, counts=capture.cube, **NAMED)
    np.savez(plain, counts=capture.cube)
    found, bare = read_capture(path), read_capture(plain)
    assert (found.stated_flux, bare.stated_flux) == (STATED, None)
    for method in ("likelihood", "tracking"):
        images = [estimate(each, method) for each in (found, bare)]
        np.testing.assert_array_equal(images[0].range_m, images[1].range_m)


@pytest.mark.parametrize("name", WRITE)
def test_pulses_and_times_are_read_by_other_names_only_where_these_are_plain(
    name: str, tmp_path: Path
) -> None:
    counts = np.ones((3, 4, 8), np.uint16)
    plain = {"Num_Shots": 200.0, "bin_width_ps": 512.0, "gate_delay_ns": 280.0}
    for number, (stated, expected, left_out) in enumerate(
        (
            (plain, (200, 512e-12, 280e-9), None),
            (plain | {"bin_size_ns": 0.512}, (200, 512e-12, 280e-9), None),  # the same
            ({"n_frames": 200.0, "cycles": 200.0}, (None, 1e-9, 0.0), None),  # ambiguous
            ({"bin_width": 0.5}, (None, 1e-9, 0.0), "bin_width = 0.5, without a unit, left out"),
            ({"gate_delay": 280.0}, (None, 1e-9, 0.0), "gate_delay = 280, without a unit, left"),
            ({"bin_width": 5e-10}, (None, 5e-10, 0.0), "guessed: axes (row, col, bin), bin width"),
        )
    ):
        path = tmp_path / f"{number}{name}"
        WRITE[name](path, counts=counts, **stated)
        found = read_capture(path, pulse=Pulse())
        timing = found.acquisition
        assert (timing.n_pulses, timing.bin_width_s, timing.gate_delay_s) == expected
        if left_out is None:
            assert "left out" not in found.source
        elif not ("axes" in left_out and name in ("a.nc", "a.zarr")):  # which name their axes
            assert left_out in found.source


@pytest.mark.parametrize("name", WRITE)
def test_a_file_that_contradicts_itself_is_refused_until_the_right_value_is_given(
    name: str, tmp_path: Path
) -> None:
    counts, path = np.ones((3, 4, 8), np.uint16), tmp_path / name
    WRITE[name](path, counts=counts, bin_width_s=1e-9, bin_size_ps=500.0, shots=200.0, pulses=300.0)
    options: dict[str, Any] = {"pulse": Pulse()}
    for field, right, stated in (
        ("n_pulses", 200, ("200 by shots", "300 by pulses")),
        ("bin_width_s", 5e-10, ("1e-09 by bin_width_s", "5e-10 by bin_size_ps")),
    ):
        others = {"n_pulses": 1, "bin_width_s": 1e-9} | options
        del others[field]
        with pytest.raises(CaptureError, match=f"{field} = .*several") as refused:
            read_capture(path, **others)
        assert all(each in str(refused.value) for each in stated)
        options[field] = right
    found = read_capture(path, **options).acquisition
    assert (found.n_pulses, found.bin_width_s) == (200, 5e-10)


@pytest.mark.parametrize("suffix", CAPTURE_SUFFIXES)
def test_stated_fluxes_are_saved(suffix: str, capture: Capture, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    save_capture(replace(capture, stated_flux=STATED), path)
    assert read_capture(path).stated_flux == STATED


def test_a_reduction_that_changes_the_fluxes_drops_what_was_stated(capture: Capture) -> None:
    stated = replace(capture, stated_flux=STATED)
    kept = {name: Reduction(**{name: 2}).of(stated).stated_flux for name in ("merge", "skip")}
    assert kept == {"merge": STATED, "skip": STATED}
    for change in ({"pool": 2}, {"gate": (0, 50)}, {"pulses": 0.5}):
        assert Reduction(**change).of(stated).stated_flux is None


def test_statement_and_estimate_are_compared_in_the_same_unit(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture.background is not None and capture.signal is not None
    true = StatedFlux(float(capture.signal.mean()) * 200, capture.background * 200)
    report = capture_report(replace(capture, stated_flux=true))
    signal, background = report.stated
    assert (signal.name, background.name) == ("signal", "background")
    assert (signal.stated, signal.unit) == (true.signal, "photons")
    assert signal.estimate == report.flux.signal.scaled(200)
    for each in report.stated:
        assert each.estimate.value == pytest.approx(each.stated, rel=0.1)
        assert each.difference == each.estimate.value - each.stated
    path = tmp_path / "a.npz"
    save_capture(replace(capture, stated_flux=true), path)
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["stated_signal"] == true.signal
    assert facts["stated_signal_difference"] == signal.difference
    assert "stated_sbr" not in facts


def test_stated_fluxes_are_checked() -> None:
    with pytest.raises(ValueError, match="stated sbr = -1"):
        StatedFlux(sbr=-1)
