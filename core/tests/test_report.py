"""A report is one file that refers to no other, and holds the numbers of core's reports."""

from __future__ import annotations

import re
from base64 import b64decode, b64encode
from dataclasses import astuple, replace
from hashlib import sha256
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import core
from core.cli import main
from core.inference import fit_of, fit_p_values, share_below
from core.inspection import capture_report, pixel_report, reported_check
from core.report import representative_pixel, write_report
from core.typesetting import LEAST_PROBABILITY

pytestmark = pytest.mark.files

HOSTILE = "</title><script>alert(1)</script> \"'&\udcff\0.mat"
EMPTY = ("meta", "path", "use", "image")
PIXEL = (5, 6)


class Page(HTMLParser):
    """Elements of a page: attributes, text by element, and the cells of tables."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: dict[str, list[str]] = {}
        self.values: dict[str, list[float]] = {}
        """Numbers of each row of a table, by its first cell."""
        self._open: list[str] = []
        self._row = ""
        self.feed(source)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attributes]
        self.texts.setdefault(tag, []).append("")
        if tag == "data":
            value = float(dict(attributes)["value"] or "nan")
            self.values.setdefault(self._row, []).append(value)
        if tag not in EMPTY:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attributes]

    def handle_endtag(self, tag: str) -> None:
        if tag not in EMPTY:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        for tag in set(self._open):
            self.texts[tag][-1] += data
        if self._open and self._open[-1] == "th":
            self._row = data

    def of(self, tag: str, name: str) -> list[str]:
        """Return the values of an attribute."""
        return [value for each, known, value in self.attributes if (each, known) == (tag, name)]


def written(capture: core.Capture, image: core.RangeImage, **options: Any) -> str:
    file = BytesIO()
    write_report(capture, image, file, **options)
    return file.getvalue().decode()


def simulated(sbr: float = 1.0, n_pulses: int = 400) -> core.Capture:
    return core.simulate(
        core.scenes["staircase"](12),
        core.Acquisition(n_pulses=n_pulses, pixel_angle_rad=2e-3),
        core.Flux(0.5, sbr=sbr),
        seed=4,
    )


CAPTURE = simulated()
REPORTED_M = np.asarray(CAPTURE.truth_range_m) - 0.02
CAPTURE = replace(CAPTURE, reported_range_m=REPORTED_M)


@pytest.fixture(scope="module")
def image() -> core.RangeImage:
    return core.estimate(CAPTURE, "tracking")


@pytest.fixture(scope="module")
def source(image: core.RangeImage) -> str:
    return written(CAPTURE, image, pixel=PIXEL, title=HOSTILE, script=f"# {HOSTILE}\n1 < 2\n")


@pytest.fixture(scope="module")
def page(source: str) -> Page:
    return Page(source)


def test_the_page_refers_to_nothing_outside_itself(source: str, page: Page) -> None:
    for tag, name, value in page.attributes:
        if name in ("src", "href", "xlink:href", "srcset", "action", "poster"):
            assert value.startswith(("#", "data:image/png;")), (tag, name, value[:80])
    assert set(re.findall(r"url\((.)", source)) <= {"#"}
    assert "@import" not in source
    policy = page.of("meta", "content")[0]
    assert policy.startswith("default-src 'none'")
    code = page.texts["script"][0]
    assert f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'" in policy


def test_each_plot_has_a_heading_and_a_text_of_its_own(page: Page) -> None:
    headings = page.texts["h2"]
    assert len(page.texts["h1"]) == 1
    assert headings == [
        "What was read",
        "Signal, background and suggestions",
        "Maps",
        "Histogram of all pixels",
        "Pixel in row 5, column 6",
        "Point cloud",
        "Distances reported by the sensor",
        "Accuracy",
        "Settings and versions",
        "Python script",
    ]
    labels = page.of("svg", "aria-label")
    assert len(labels) == len(set(labels)) == len(page.texts["svg"])
    identifiers = [value for _, name, value in page.attributes if name == "id"]
    assert len(identifiers) == len(set(identifiers))


def test_texts_from_outside_stay_texts(page: Page) -> None:
    shown = HOSTILE.replace("\udcff", " ").replace("\0", " ")
    assert page.texts["h1"] == [shown]
    assert page.texts["title"] == [f"{shown} · {core.ESTIMATORS['tracking'].title}"]
    assert len(page.texts["script"]) == 1
    assert page.texts["code"][0].startswith("# </title><script>alert(1)</script> \"'&")
    assert page.texts["code"][0].endswith("\n1 < 2\n")


def test_numbers_are_those_of_the_reports(source: str, page: Page, image: core.RangeImage) -> None:
    whole, pixel = capture_report(CAPTURE), pixel_report(CAPTURE, image, *PIXEL)
    fluxes = whole.target_flux, whole.flux, pixel.flux
    for name, *found in zip(("Signal", "Background", "SBR"), *fluxes, strict=True):
        assert page.values[name] == [number for each in found for number in astuple(each)]
    assert page.values["Hot pixels"] == [whole.n_hot]
    assert page.values["Estimate"] == [pixel.answer_m]
    assert page.values["95 % interval"] == [pixel.interval_95_m.low, pixel.interval_95_m.high]
    assert page.values["Confidence"] == [pixel.confidence]
    assert f"Range: {pixel.interval_text}" in page.texts["p"]
    fit = f"{share_below(fit_p_values(CAPTURE))} {fit_of(CAPTURE).verdict}"
    assert fit in page.texts["figcaption"]
    assert f"{pixel.answer_m:.{pixel.interval_95_m.decimals}f}" in page.texts["data"]
    assert "T_n: " in source
    check = reported_check(CAPTURE, image)
    assert check is not None and check.n_pixels > 0
    assert page.values["Reported by the sensor"] == [REPORTED_M[PIXEL]]
    assert page.values["Estimate minus reported"] == [pixel.answer_m - REPORTED_M[PIXEL]]
    assert page.values["Median difference"] == [check.median_m]
    assert page.values["Half the central 68 % range"] == [check.spread_m]
    for rank, candidate in enumerate(pixel.candidates, 1):
        bin_, range_m, score, relative, probability = page.values[str(rank)]
        assert (bin_, range_m, score) == (candidate.bin, candidate.range_m, candidate.score)
        assert (relative, probability) == (candidate.relative, candidate.probability)
    truth_m, bin_m = CAPTURE.truth_range_m, CAPTURE.acquisition.bin_length_m
    assert truth_m is not None
    assert page.values["Root mean square error"] == [core.metrics.rmse_m(image.range_m, truth_m)]
    known = core.metrics.wilson(*core.metrics.restored(image.range_m, truth_m, 3 * bin_m))
    assert page.values["Restoration degree, 3 bins"] == list(astuple(known))


@pytest.mark.usefixtures("blank_figures")
def test_a_tiny_probability_is_shown_as_a_bound() -> None:
    capture = simulated(n_pulses=20_000)  # so many that noise is hardly ever the surface
    image = core.estimate(capture, "tracking")
    found = [each.probability for each in pixel_report(capture, image, *PIXEL).candidates]
    least = min(found)
    assert 0 < least < LEAST_PROBABILITY
    source = written(capture, image, pixel=PIXEL)
    assert f'<data value="{least}">&lt; 0.000001</data>' in source
    assert Page(source).texts["data"].count("< 0.000001") == sum(
        each < LEAST_PROBABILITY for each in found
    )


def test_the_cloud_has_the_confident_estimates(page: Page, image: core.RangeImage) -> None:
    def decoded(name: str, kind: str) -> np.ndarray:
        return np.frombuffer(b64decode(page.of("canvas", name)[0]), kind).reshape(-1, 3)

    xyz = decoded("data-xyz", "<i2") * float(page.of("canvas", "data-unit")[0])
    confident = image.confident(0.9)
    expected_m = core.geometry.points_m(confident.range_m, 2e-3).xyz_m
    expected_m = expected_m - np.median(expected_m, axis=0)
    assert len(decoded("data-rgb", "u1")) == len(xyz) == len(expected_m) > 100
    scale = np.linalg.norm(expected_m) / np.linalg.norm(xyz)
    np.testing.assert_allclose(xyz * scale, expected_m, atol=2e-4 * np.abs(expected_m).max())
    width_m, depth_m, height_m = np.ptp(expected_m, axis=0)
    size = f"{width_m:.3g} m wide, {height_m:.3g} m high and {depth_m:.3g} m deep."
    assert any(size in text for text in page.texts["figcaption"])
    hidden = int(image.valid.sum()) - len(xyz)
    caption = page.texts["figcaption"][0]
    assert f"{len(xyz):,} of" in caption
    assert (f"{hidden:,} are hidden" in caption) == (hidden > 0)


@pytest.mark.usefixtures("blank_figures")
def test_a_capture_without_photons_has_a_report() -> None:
    dark = core.Capture(np.zeros((3, 4, 30), np.uint8), core.Acquisition(30, 1e-9, 0.0, 100))
    page = Page(written(dark, core.estimate(dark, "likelihood")))
    assert "The capture has no detection." in page.texts["p"]
    assert "There are no points: no estimate is confident enough." in page.texts["p"]
    assert "canvas" not in page.texts
    assert "Estimate" not in page.values
    assert "Pixel in row 1, column 2" in page.texts["h2"]


@pytest.mark.usefixtures("blank_figures")
def test_a_ratio_without_an_upper_end_is_shown_by_its_lower_one() -> None:
    cube = np.zeros((2, 3, 40), np.uint8)
    cube[..., 20] = 9  # no background
    clear = core.Capture(cube, core.Acquisition(40, 1e-9, 0.0, 100))
    page = Page(written(clear, image := core.estimate(clear, "likelihood"), pixel=(0, 0)))
    assert page.values["SBR"][-1:] == [pixel_report(clear, image, 0, 0, "likelihood").flux.sbr.low]
    assert not any("∞" in text for text in page.texts["td"])


def test_a_large_image_is_thinned_and_its_file_stays_small() -> None:
    cube = np.zeros((400, 300, 8), np.uint8)
    rng = np.random.default_rng(0)
    row, col = np.indices(cube.shape[:2])
    cube[row, col, rng.integers(2, 5, row.shape)] = 9
    capture = core.Capture(cube, core.Acquisition(8, 1e-9), detection="all")
    source = written(capture, core.estimate(capture, "peak"), least_confidence=0.0)
    assert len(source) < 3e6
    page = Page(source)
    assert page.of("canvas", "aria-label") == ["Point cloud of 30,000 estimates"]
    assert "Maps show 1 of 2 rows and 1 of 2 columns." in page.texts["p"]


def test_the_default_pixel_has_a_target_or_a_confident_estimate(image: core.RangeImage) -> None:
    truth_m = np.full(CAPTURE.shape, np.nan)
    truth_m[2, 3] = truth_m[11, 0] = 50.0
    assert representative_pixel(replace(CAPTURE, truth_range_m=truth_m), image) == (2, 3)
    confidence = np.where(truth_m > 0, 0.95, 0.5)
    unknown = replace(CAPTURE, truth_range_m=None)
    assert representative_pixel(unknown, replace(image, confidence=confidence)) == (2, 3)
    assert representative_pixel(unknown, replace(image, confidence=0 * confidence)) == (6, 6)


def test_what_cannot_be_reported_is_refused(tmp_path: Path, image: core.RangeImage) -> None:
    path = tmp_path / "report.html"
    for wrong, options, named in (
        (replace(image, made_by=None), {}, "made_by"),
        (image, {"pixel": (12, 0)}, "row, col"),
        (image, {"least_confidence": 2.0}, "least_confidence"),
        (image, {"pixel_angle_rad": -1.0}, "pixel_angle_rad"),
        (core.estimate(core.reductions.Reduction(skip=2).of(CAPTURE), "peak"), {}, "shape"),
    ):
        with pytest.raises(ValueError, match=named):
            core.save_report(CAPTURE, wrong, path, **options)
    with pytest.raises(ValueError, match="suffix"):
        core.save_report(CAPTURE, image, tmp_path / "report.pdf")
    path.write_text("mine")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        core.save_report(CAPTURE, image, path)
    assert [path.read_text(), *tmp_path.iterdir()] == ["mine", path]


def test_the_command_and_its_script_write_the_same_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    core.save_capture(replace(CAPTURE, truth_range_m=None), "a 'b' <c>.npz")
    np.save("truth.npy", CAPTURE.truth_range_m)
    command = ["report", "cfar", "a 'b' <c>.npz", "report.html", "--pixel", "3", "4"]
    options = ["--truth", "truth.npy", "--truth-unit", "m", "--least-confidence", "0.5"]
    more = ["--guard-bins", "2", "--pulses", "400", "--judged-by", "image"]
    more += ["--color-from", "40", "--color-map", "viridis"]
    more += ["--crop", "-", "1e5", "--crop-pixels", "-1,-1 -1,20 20,20"]
    assert main([*command, *options, *more]) == 0
    first = Path("report.html").read_text(encoding="utf-8")
    assert main([*command, *options, *more]) == 2
    assert "--overwrite" in capsys.readouterr().err
    page = Page(first)
    assert "T_n: " not in first  # which only tracking has
    assert page.texts["h1"] == ["a 'b' <c>.npz"]
    assert "Pixel in row 3, column 4" in page.texts["h2"]
    assert "guard_bins=2" in page.texts["code"][0]
    assert "n_pulses=400" in page.texts["code"][0]
    assert 'RangeColors(color_from_m=40.0, color_map="viridis")' in page.texts["code"][0]
    (label,) = page.of("canvas", "aria-label")
    assert label.endswith(
        " in the box (pixels in the polygon of corners row,col -1,-1 -1,20 20,20; "
        "ranges to 100000 m)"
    )
    Path("report.html").unlink()
    exec(compile(page.texts["code"][0], "script", "exec"), {})
    again = Path("report.html").read_text(encoding="utf-8")
    assert again.split("</main>")[0].rstrip() == first.split("<h2>Python script")[0].rstrip()
