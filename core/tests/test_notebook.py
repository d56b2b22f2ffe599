"""Tests of what notebooks use: labelled arrays, tables, examples, and messages."""

from __future__ import annotations

import doctest
from dataclasses import replace
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import core
from core.acquisition import Acquisition, Flux
from core.capture import Capture

pytestmark = pytest.mark.files


def small() -> Capture:
    scene = core.scenes["staircase"](8)
    return core.simulate(scene, Acquisition(n_pulses=300), Flux(0.3, sbr=1.0), seed=2)


CAPTURE = small()

ENGINES: dict[str, dict[str, Any]] = {
    ".nc": {"engine": "h5netcdf"},
    ".zarr": {"engine": "zarr", "consolidated": False},
}


EXAMPLES = ("core", "core.io.names", "core.io.readers.sequence", "core.typesetting")


@pytest.mark.compiled
@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_give_the_results_they_show(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(import_module(name))
    assert result.attempted > 0 and result.failed == 0


@pytest.mark.parametrize("suffix", ENGINES)
def test_a_capture_is_the_same_in_memory_and_in_a_file(suffix: str, tmp_path: Path) -> None:
    found = CAPTURE.to_xarray()
    core.save_capture(CAPTURE, tmp_path / f"a{suffix}")
    with xr.open_dataset(tmp_path / f"a{suffix}", **ENGINES[suffix]) as stored:
        xr.testing.assert_equal(stored, found)
        assert stored.counts.attrs.keys() == found.counts.attrs.keys()
    assert found.counts.dims == ("row", "col", "bin")
    assert found.time_s.attrs["units"] == "s" and found.range_m.attrs["units"] == "m"
    np.testing.assert_array_equal(found.truth_range_m, CAPTURE.truth_range_m)
    assert core.open_capture(tmp_path / f"a{suffix}").attrs["source"] == CAPTURE.source


@pytest.mark.parametrize("suffix", ENGINES)
def test_a_range_image_is_the_same_in_memory_and_in_a_file(suffix: str, tmp_path: Path) -> None:
    image = core.estimate(CAPTURE, "tracking", false_alarm=0.1)
    found = image.to_xarray()
    core.save_image(CAPTURE, image, tmp_path / f"a{suffix}")
    with xr.open_dataset(tmp_path / f"a{suffix}", **ENGINES[suffix]) as stored:
        xr.testing.assert_equal(stored.drop_vars("counts"), found)
        assert {name: stored[name].attrs["units"] for name in found} == {
            name: each.attrs["units"] for name, each in found.items()
        }
        assert found.attrs.items() <= stored.attrs.items()
    assert found.attrs["method"] == "tracking"
    assert found.range_m.sel(row=3, col=5) == image.range_m[3, 5]
    assert found.row.attrs["long_name"] == "row of the pixel, 0 on top"


class Cells(HTMLParser):
    """Texts of a table, and its tags."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: set[str] = set()
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    @property
    def facts(self) -> dict[str, str]:
        return dict(zip(self.texts[1::2], self.texts[2::2], strict=True))


def test_a_notebook_shows_a_capture_as_a_table() -> None:
    source = "<script>alert(1)</script> & more"
    table = Cells(replace(CAPTURE, source=source, truth_range_m=None)._repr_html_())
    assert table.texts[0] == "Capture"
    assert table.tags == {"table", "caption", "tbody", "tr", "th", "td"}
    facts = table.facts
    assert facts["source"] == source
    assert facts["shape"] == "8 × 8 pixels"
    assert facts["bins"].startswith("100 of 1 ns, ")
    assert facts["pulses"] == "300"
    assert facts["photons"].startswith(f"{CAPTURE.counts.sum():,}, ")
    assert facts["truth"] == "not known"
    bright = Capture(np.full((1, 1, 4), 60_000, np.uint16), Acquisition(n_bins=4, n_pulses=None))
    assert bright.facts["photons"] == "240,000, 240,000 per pixel"


def test_a_notebook_shows_a_range_image_as_a_table() -> None:
    image = core.estimate(CAPTURE, "peak")
    table = Cells(image._repr_html_())
    assert table.texts[0] == "Range image"
    assert table.facts["estimates"] == f"{image.valid.sum()} of 64 pixels"
    assert table.facts["method"] == "peak"
    nothing = replace(image, valid=np.zeros((8, 8), bool), made_by=None)
    assert "ranges" not in Cells(nothing._repr_html_()).facts


@pytest.mark.parametrize("function", [core.estimate, core.run])
@pytest.mark.parametrize(
    ("given", "named"),
    [
        (CAPTURE.cube, r"'numpy.ndarray of shape \(8, 8, 100\)'"),
        ("file.npz", "'str'"),
        (CAPTURE.to_xarray().counts, r".*DataArray of shape \(8, 8, 100\)'"),
        (None, "'NoneType'"),
    ],
)
def test_what_is_no_capture_is_refused_with_how_to_make_one(
    function: Any, given: Any, named: str
) -> None:
    with pytest.raises(ValueError, match=f"^capture = {named} .*") as error:
        function(given, "peak")
    assert "core.read_capture(path)" in str(error.value)
    n_bins = "100" if getattr(given, "ndim", 0) == 3 else "..."
    assert f"core.Capture(counts, core.Acquisition(n_bins={n_bins}" in str(error.value)
