"""One contract for every writer, each checked by another library's reader; whole files or none."""

from __future__ import annotations

import base64
import csv
import errno
import io
import json
import os
import resource
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree

import h5py
import laspy
import numpy as np
import pytest
import tifffile
import trimesh
from PIL import Image

import core
from core.acquisition import Acquisition
from core.capture import Capture
from core.estimators import Provenance, RangeImage
from core.estimators.base import NoParameters
from core.geometry import Box, sight_lines
from core.inference import fit_p_values
from core.io import ColorScale, Picture
from core.io.readers.labelled import dataset
from core.io.writers import (
    CAPTURE_SUFFIXES,
    FOLDER_WRITERS,
    OUTSIDE_COLOR,
    WRITERS,
    RangeColors,
    range_scale,
    save_capture,
    save_image,
    save_pixel,
)
from core.io.writers.product import Plane, Product
from core.tracking import TrackingParameters, tracking_signals

pytestmark = pytest.mark.files

Images = dict[str, np.ndarray]

ROWS, COLS = 7, 9
ANGLE = 1.5e-3
TITLE = "A <wall> & a µ-hole, 5 $ the piece"
SOURCE = "wall, Straße 5\n\0<&>"
PLAIN_SOURCE = "wall, Straße 5  <&>"


def capture_of(shape: tuple[int, int], angle_rad: float | None = ANGLE) -> Capture:
    cube = np.random.default_rng(3).poisson(0.3, (*shape, 100)).astype(np.uint16)
    return Capture(cube, Acquisition(100, 1e-9, 3e-7, 900, angle_rad), source=SOURCE)


def image_of(capture: Capture, valid: np.ndarray) -> RangeImage:
    """A slanted wall, ranged where `valid`."""
    rng = np.random.default_rng(5)
    bins = np.where(valid, 20 + np.arange(valid.size).reshape(valid.shape) / 3, np.nan)
    return RangeImage(
        range_m=capture.acquisition.bin_to_range_m(bins),
        bin=bins,
        score=rng.normal(size=valid.shape),
        confidence=np.where(valid, rng.uniform(0.5, 1, valid.shape), 0.0),
        valid=valid,
    )


CAPTURE = capture_of((ROWS, COLS))
VALID = np.ones((ROWS, COLS), bool)
VALID[0, 0] = VALID[3, 4] = VALID[6, 8] = False
IMAGE = image_of(CAPTURE, VALID)
NOTHING = image_of(CAPTURE, np.zeros((ROWS, COLS), bool))


def images_of(capture: Capture, image: RangeImage) -> Images:
    """All images that a writer may keep."""
    kept = ("range_m", "confidence", "bin", "score", "valid")
    return {"counts": capture.counts, **{name: getattr(image, name) for name in kept}}


def at_pixels(row: Any, col: Any, columns: dict[str, Any]) -> Images:
    """Images of the columns of a cloud; NaN where it has no point."""
    images = {}
    pixels = np.asarray(row, int), np.asarray(col, int)
    shape = [each.max() + 1 for each in pixels]
    for name, values in columns.items():
        images[name] = np.full(shape, np.nan)
        images[name][pixels] = np.asarray(values)
    return images


def read_npz(path: Path) -> Images:
    with np.load(path, allow_pickle=False) as archive:
        assert archive["format"] == "firstphoton-range-image-1"
        return {name: archive[name] for name in archive if archive[name].ndim == 2}


def without_comments(lines: Iterable[str]) -> Iterator[str]:
    return (line for line in lines if not line.startswith("# "))


def read_csv(path: Path) -> Images:
    content = path.read_bytes()
    assert content.count(b"\r\n") == content.count(b"\n")
    with path.open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(without_comments(file), strict=True))
    assert list(table[0]) == ["row", "col", "range_m", "confidence", "counts", "valid"]
    pixels = [(int(line["row"]), int(line["col"])) for line in table]
    shape = pixels[-1][0] + 1, pixels[-1][1] + 1
    assert pixels == list(np.ndindex(shape))
    return {
        name: np.array([float(line[name] or "nan") for line in table]).reshape(shape)
        for name in ("range_m", "confidence", "counts", "valid")
    }


def read_tiff(path: Path) -> Images:
    with tifffile.TiffFile(path) as file:
        pages = {page.tags["PageName"].value: page.asarray() for page in file.pages}
    with Image.open(path) as frames:  # another reader of the same
        for index, page in enumerate(pages.values()):
            frames.seek(index)
            assert frames.mode == "F"
            np.testing.assert_array_equal(np.asarray(frames), page)
    return pages


def read_hdf5(path: Path) -> Images:
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file if file[name].ndim == 2}


def read_ply(path: Path) -> Images:
    with path.open("rb") as file:
        raw = trimesh.exchange.ply.load_ply(file)["metadata"]["_ply_raw"]["vertex"]["data"]
    return at_pixels(raw["row"], raw["col"], {name: raw[name] for name in raw.dtype.names})


def read_las(path: Path) -> Images:
    las = laspy.read(path)
    names = ("x", "y", "z", "intensity", *las.point_format.extra_dimension_names)
    return at_pixels(las["row"], las["col"], {name: las[name] for name in names})


def read_pcd(path: Path) -> Images:
    """Parse the file by the description of the format."""
    header, _, data = path.read_bytes().partition(b"DATA binary\n")
    known = dict(line.split(" ", 1) for line in header.decode("ascii").splitlines())
    assert known["VERSION"] == "0.7"
    assert set(known["COUNT"].split()) == {"1"}
    kinds = [
        f"<{kind.lower()}{size}"
        for kind, size in zip(known["TYPE"].split(), known["SIZE"].split(), strict=True)
    ]
    table = np.frombuffer(data, list(zip(known["FIELDS"].split(), kinds, strict=True)))
    assert int(known["POINTS"]) == int(known["WIDTH"]) == len(table)
    return at_pixels(table["row"], table["col"], {name: table[name] for name in table.dtype.names})


def read_png(path: Path) -> Images:
    with Image.open(path) as picture:
        picture.verify()
        assert picture.format == "PNG"
        assert picture.width >= 1200
    return {}


def read_svg(path: Path) -> Images:
    root = ElementTree.parse(path).getroot()
    assert root.tag.endswith("svg")
    return {}


READERS: dict[str, Callable[[Path], Images]] = {
    ".npz": read_npz,
    ".csv": read_csv,
    ".tif": read_tiff,
    ".nc": read_hdf5,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
    ".pcd": read_pcd,
    ".png": read_png,
    ".svg": read_svg,
}
PICTURES = {".png", ".svg"}
CLOUDS = {".ply", ".las", ".laz", ".pcd"}

SINGLE = 6e-8
"""Relative quantisation of a 32-bit float."""
BIN_M = CAPTURE.acquisition.bin_length_m
STEP_M = BIN_M / 1000

ALIASES = {".tiff": ".tif", ".h5": ".nc"}
FORMATS = [suffix for suffix in WRITERS if suffix not in ALIASES]

every_format = pytest.mark.parametrize("suffix", FORMATS)
every_cloud = pytest.mark.parametrize("suffix", sorted(CLOUDS))


def saved(folder: Path, suffix: str, image: RangeImage = IMAGE, **options: Any) -> Path:
    path = folder / f"wall{suffix}"
    save_image(CAPTURE, image, path, **options)
    return path


def test_every_writer_is_checked_by_another_reader() -> None:
    assert set(FORMATS) == set(READERS)
    for alias, suffix in ALIASES.items():
        assert WRITERS[alias] is WRITERS[suffix]


def test_suffixes_may_be_in_upper_case(tmp_path: Path) -> None:
    save_image(CAPTURE, IMAGE, tmp_path / "WALL.NPZ")
    np.testing.assert_array_equal(read_npz(tmp_path / "WALL.NPZ")["range_m"], IMAGE.range_m)


POINT, LINE = capture_of((1, 1)), capture_of((1, 150))
IMAGES = {
    "wall": (CAPTURE, IMAGE),
    "nothing": (CAPTURE, NOTHING),
    "point": (POINT, image_of(POINT, np.ones(POINT.shape, bool))),
    "line": (LINE, image_of(LINE, np.ones(LINE.shape, bool))),
}


@every_format
@pytest.mark.parametrize(("capture", "image"), IMAGES.values(), ids=IMAGES)
def test_every_image_is_read_back(
    tmp_path: Path, suffix: str, capture: Capture, image: RangeImage
) -> None:
    path = tmp_path / f"wall{suffix}"
    if image is NOTHING and suffix in CLOUDS:
        with pytest.raises(ValueError, match=r"valid pixels = 0 .*a cloud needs points"):
            save_image(capture, image, path)
        assert os.listdir(tmp_path) == []
        return
    save_image(capture, image, path, title=TITLE)
    found = READERS[suffix](path)
    if suffix not in PICTURES:
        assert {"range_m", "confidence", "counts"} <= set(found)
    known = images_of(capture, image)
    for name in set(found) & set(known):
        expected = np.where(image.valid, known[name], np.nan) if suffix in CLOUDS else known[name]
        rounding = BIN_M / 100 if (suffix, name) == (".csv", "range_m") else 0.0
        np.testing.assert_allclose(found[name], expected, SINGLE, rounding, err_msg=name)
    if suffix not in {".tif", ".csv"} | PICTURES:
        np.testing.assert_array_equal(found["range_m"], image.range_m)
    assert os.listdir(tmp_path) == [f"wall{suffix}"]


@pytest.mark.parametrize("suffix", [".npz", ".nc", ".csv"])
def test_formats_that_list_pixels_hold_intervals_and_p_values(tmp_path: Path, suffix: str) -> None:
    (inner, outer), p_value = core.range_intervals(CAPTURE, IMAGE), fit_p_values(CAPTURE)
    path = saved(tmp_path, suffix, interval=outer, interval_68=inner, p_value=p_value)
    if suffix == ".csv":
        lines = list(without_comments(path.read_text(encoding="utf-8").splitlines()))
        table = np.genfromtxt(lines, delimiter=",", names=True)
        assert table.dtype.names[2:5] == ("range_m", "range_low_m", "range_high_m")
        found = {name: table[name].reshape(ROWS, COLS) for name in table.dtype.names}
        # A tenth of the standard deviation, at most a tenth of a bin, is resolved.
        step_m = np.minimum(inner.high_m - inner.low_m, 2 * BIN_M) / 20
        texts = [line.split(",")[2] for line in lines[1:]]
        decimals = [len(text.partition(".")[2]) for text in texts]
        expected = np.where(VALID, np.ceil(-np.log10(step_m)), 0)
        np.testing.assert_array_equal(decimals, expected.ravel())
        rounding_m = step_m / 2
    else:
        found, rounding_m = READERS[suffix](path), 0.0
    for name in ("low_m", "high_m"):
        name_68 = name.replace("_m", "_68_m")
        for limit, exact_m in ((name, getattr(outer, name)), (name_68, getattr(inner, name))):
            off_m = np.abs(found[f"range_{limit}"] - exact_m)
            np.testing.assert_array_equal(np.isfinite(off_m), VALID)
            assert (off_m <= rounding_m + 1e-12)[VALID].all()
    np.testing.assert_array_equal(found["fit_p_value"], p_value)
    with pytest.raises(ValueError, match=r"range_low_m = 'shape \(9, 7\)'"):
        saved(tmp_path, suffix, interval=core.RangeInterval(outer.low_m.T, outer.high_m))


@pytest.mark.parametrize("suffix", [".tif", *sorted(CLOUDS)])
def test_pages_and_clouds_hold_the_intervals(tmp_path: Path, suffix: str) -> None:
    inner, outer = core.range_intervals(CAPTURE, IMAGE)
    found = READERS[suffix](saved(tmp_path, suffix, interval=outer, interval_68=inner))
    expected = {"range_sd_m": (inner.high_m - inner.low_m) / 2}
    if suffix == ".tif":
        expected = {"range_low_m": outer.low_m, "range_high_68_m": inner.high_m}
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=SINGLE)


@every_cloud
@pytest.mark.parametrize("angle", [None, 0.02])
def test_points_lie_on_their_lines_of_sight(
    tmp_path: Path, suffix: str, angle: float | None
) -> None:
    found = READERS[suffix](saved(tmp_path, suffix, pixel_angle_rad=angle))
    lines = sight_lines((ROWS, COLS), angle or ANGLE)
    quantisation_m = STEP_M / 2 if suffix in {".las", ".laz"} else 0.0
    for axis, name in enumerate("xyz"):
        expected = lines[..., axis] * IMAGE.range_m
        np.testing.assert_allclose(found[name], expected, rtol=SINGLE, atol=quantisation_m)


@pytest.mark.parametrize("suffix", [*sorted(CLOUDS), ".npz"])
def test_only_a_cloud_needs_the_angle_between_pixels(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"wall{suffix}"
    without_angle = capture_of((ROWS, COLS), angle_rad=None)
    if suffix in CLOUDS:
        with pytest.raises(ValueError, match="pixel_angle_rad = None is not accepted: give the"):
            save_image(without_angle, IMAGE, path)
        assert os.listdir(tmp_path) == []
    save_image(without_angle, IMAGE, path, pixel_angle_rad=ANGLE if suffix in CLOUDS else None)
    READERS[suffix](path)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("wall.stl", {}, r"suffix = '\.stl' .*" + ", ".join(WRITERS)),
        *(("a.npz", {"pixel_angle_rad": a}, "between 0 and π/2") for a in (0.0, -1e-3, 2, np.nan)),
        ("a.npz", {"capture": capture_of((2, 2))}, r"image = 'shape \(7, 9\)'.*shape \(2, 2\)"),
        ("a.ply", {"rgb": np.zeros((ROWS, COLS, 3))}, "rgb = .*float64.* uint8 of shape"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(
    name: str, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        save_image(**{"capture": CAPTURE, "image": IMAGE, "path": tmp_path / name} | options)
    assert os.listdir(tmp_path) == []


# -- whole or not at all ---------------------------------------------------------------------------


def fails_half_way(product: Product, file: BinaryIO) -> None:
    file.write(b"half")
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("suffix", [".npz", ".nc", ".las"])
def test_an_existing_file_is_replaced_on_request_only(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"wall{suffix}"
    path.write_bytes(b"older")
    with pytest.raises(FileExistsError, match=f"wall{suffix} exists: give another name, or over"):
        save_image(CAPTURE, IMAGE, path)
    assert path.read_bytes() == b"older"
    save_image(CAPTURE, IMAGE, path, overwrite=True)
    READERS[suffix](path)
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("exists", [True, False])
def test_a_failed_write_changes_nothing(
    tmp_path: Path, exists: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "wall.npz"
    if exists:
        path.write_bytes(b"older")
    monkeypatch.setitem(WRITERS, ".npz", fails_half_way)
    with pytest.raises(OSError, match="No space"):
        save_image(CAPTURE, IMAGE, path, overwrite=True)
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == (
        {"wall.npz": b"older"} if exists else {}
    )


def fails_with_an_error_of_its_own(product: Product, file: BinaryIO) -> None:
    """As the library of LAZ does."""
    try:
        file.write(bytes(200))
        file.flush()
    except OSError:
        raise RuntimeError("Failed to call write") from None


@contextmanager
def files_of_at_most(n_bytes: int) -> Iterator[None]:
    """Let the system refuse to write more into a file; Python ignores the signal that it sends."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_is_full_is_reported_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit on the size of files stands for the disk."""
    monkeypatch.setitem(WRITERS, ".own", fails_with_an_error_of_its_own)
    kept = replace(CAPTURE, source="a wall")
    saves: list[tuple[Callable[..., object], tuple[Any, ...], Path]] = [
        *((save_image, (CAPTURE, IMAGE), tmp_path / f"image{s}") for s in WRITERS),
        *((save_image, (CAPTURE, IMAGE), tmp_path / f"image{s}") for s in FOLDER_WRITERS),
        *((save_capture, (kept,), tmp_path / f"capture{s}") for s in CAPTURE_SUFFIXES),
    ]
    for save, of, path in saves:
        save(*of, path)  # loads its library
    refused = []
    with files_of_at_most(100):
        for save, of, path in saves:
            with pytest.raises(OSError) as caught:
                save(*of, path, overwrite=True)
            refused.append((path, str(caught.value)))
    for path, message in refused:
        assert message.startswith(f"{path} cannot be written (")
        assert "): free some space, or give " in message
    assert sorted(tmp_path.iterdir()) == sorted(path for *_, path in saves)  # the older ones


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".zarr"])
def test_a_name_that_is_too_long_is_shortened_in_the_report(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / ("a" * 300 + suffix)
    with pytest.raises(OSError, match=r"a\.\.\.a.*: give a shorter name") as caught:
        save_image(CAPTURE, IMAGE, path)
    assert caught.value.errno == errno.ENAMETOOLONG and len(str(caught.value)) < 300
    assert os.listdir(tmp_path) == []


def test_zarr_is_written_as_its_own_library_writes_it(tmp_path: Path) -> None:
    capture = replace(CAPTURE, source="a wall")
    dataset(capture).to_zarr(tmp_path / "theirs.zarr", consolidated=False)
    save_capture(capture, tmp_path / "ours.zarr")

    def content(folder: Path) -> dict[str, bytes]:
        files = (file for file in folder.rglob("*") if file.is_file())
        return {str(file.relative_to(folder)): file.read_bytes() for file in files}

    assert content(tmp_path / "ours.zarr") == content(tmp_path / "theirs.zarr")


def stopped(*_: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("as_link", [False, True])
def test_an_older_folder_is_replaced_or_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, as_link: bool
) -> None:
    path = tmp_path / "wall.zarr"
    kept = tmp_path / "elsewhere" if as_link else path
    kept.mkdir()
    (kept / "older").write_text("older")
    if as_link:
        path.symlink_to(kept)
    with pytest.raises(FileExistsError):
        save_image(CAPTURE, IMAGE, path)
    with monkeypatch.context() as patched:
        rename = Path.rename
        patched.setattr(
            Path, "rename", lambda a, b: stopped() if a.suffix == ".part" else rename(a, b)
        )
        with pytest.raises(KeyboardInterrupt):
            save_image(CAPTURE, IMAGE, path, overwrite=True)
    assert (path / "older").read_text() == "older"
    save_image(CAPTURE, IMAGE, path, overwrite=True)
    assert not (path / "older").exists()
    assert sorted(os.listdir(tmp_path)) == sorted({path.name, kept.name})


def test_a_folder_that_appears_meanwhile_is_kept_and_so_is_the_older(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "wall.zarr"
    path.mkdir()
    (path / "older").write_text("older")
    rename = Path.rename

    def with_another(source: Path, target: Path) -> Path:
        if source.suffix == ".part":
            target.mkdir()
            (target / "somebody's").write_text("else")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", with_another)
    with pytest.raises(OSError, match="not empty") as caught:
        save_image(CAPTURE, IMAGE, path, overwrite=True)
    assert (path / "somebody's").exists()
    (older,) = (each for each in tmp_path.iterdir() if each.suffix == ".older")
    assert (older / "older").read_text() == "older"
    assert str(older) in caught.value.__notes__[0]


@pytest.mark.parametrize("save", [save_image, save_capture])
def test_a_file_that_appears_meanwhile_is_kept(
    save: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "wall.npz"
    monkeypatch.setattr(os, "fsync", lambda _: path.write_bytes(b"somebody else's"))
    with pytest.raises(FileExistsError, match=r"wall\.npz exists: give another name"):
        save(*((CAPTURE, IMAGE) if save is save_image else (CAPTURE,)), path)
    assert path.read_bytes() == b"somebody else's"
    assert os.listdir(tmp_path) == ["wall.npz"]


def test_a_name_claimed_in_vain_is_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "replace", refused)
    with pytest.raises(PermissionError):
        saved(tmp_path, ".csv")
    assert os.listdir(tmp_path) == []


# -- metadata --------------------------------------------------------------------------------------

FACTS = {
    "bin_width_s": 1e-9,
    "gate_delay_s": 3e-7,
    "n_pulses": 900,
    "detection": "first",
    "pixel_angle_rad": ANGLE,
    "software": f"firstphoton {core.__version__}",
    "source": PLAIN_SOURCE,
}


def test_npz_holds_the_acquisition(tmp_path: Path) -> None:
    with np.load(saved(tmp_path, ".npz"), allow_pickle=False) as archive:
        assert {name: archive[name].item() for name in FACTS} == FACTS
        assert archive["valid"].dtype == bool
    save_image(
        Capture(CAPTURE.cube, Acquisition(100, n_pulses=None, pixel_angle_rad=None)),
        IMAGE,
        tmp_path / "unknown.npz",
    )
    with np.load(tmp_path / "unknown.npz", allow_pickle=False) as archive:
        assert archive["n_pulses"] == 0
        assert "pixel_angle_rad" not in archive


def lines_of(text: str) -> dict[str, str]:
    """Facts of lines ``name: value``."""
    return dict(line.split(": ", 1) for line in text.splitlines() if ": " in line)


def commented(path: Path, mark: str) -> dict[str, str]:
    """Facts of lines that begin with a mark."""
    lines = path.read_bytes().splitlines()
    marked = (line.decode() for line in lines if line.startswith(mark.encode()))
    return lines_of("\n".join(line.removeprefix(mark) for line in marked))


def npz_facts(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name].item() for name in archive if archive[name].ndim == 0}


def hdf5_facts(path: Path) -> dict[str, Any]:
    with h5py.File(path) as file:
        return {name: np.asarray(fact).item() for name, fact in file.attrs.items()}


def tiff_facts(path: Path) -> dict[str, Any]:
    with tifffile.TiffFile(path) as file:
        items = ElementTree.fromstring(file.pages[0].tags["GDAL_METADATA"].value)
    return {item.attrib["name"]: item.text for item in items}


def las_facts(path: Path) -> dict[str, Any]:
    (record,) = laspy.read(path).header.vlrs.get_by_id("firstphoton")
    return lines_of(record.record_data.decode())


def png_facts(path: Path) -> dict[str, Any]:
    with Image.open(path) as picture:
        return lines_of(picture.text["Description"])


def svg_facts(path: Path) -> dict[str, Any]:
    name = "{http://purl.org/dc/elements/1.1/}description"
    return lines_of(next(ElementTree.parse(path).iter(name)).text or "")


FACTS_OF: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".npz": npz_facts,
    ".csv": lambda path: commented(path, "# "),
    ".tif": tiff_facts,
    ".nc": hdf5_facts,
    ".zarr": lambda path: json.loads((path / "zarr.json").read_bytes())["attributes"],
    ".ply": lambda path: commented(path, "comment "),
    ".las": las_facts,
    ".laz": las_facts,
    ".pcd": lambda path: commented(path, "# "),
    ".png": png_facts,
    ".svg": svg_facts,
}


@pytest.mark.parametrize("suffix", [*FORMATS, *FOLDER_WRITERS])
def test_every_file_states_method_settings_version_and_source(tmp_path: Path, suffix: str) -> None:
    made_by = Provenance("tracking", TrackingParameters(l=0.02), 0.05, "no pile-up is undone")
    box = Box(from_m=1.0)
    image = replace(IMAGE, made_by=made_by).confident(0.7).cropped(box)
    found = FACTS_OF[suffix](saved(tmp_path, suffix, image))
    settings = json.loads(found["settings"])
    assert settings == asdict(made_by.settings)
    assert (found["method"], found["remark"]) == ("tracking", "no pile-up is undone")
    assert float(found["false_alarm"]) == 0.05
    assert float(found["least_confidence"]) == 0.7
    assert found["box"] == "ranges from 1 m" == str(box)
    assert found["software"] == f"firstphoton {core.__version__}"
    source = PLAIN_SOURCE
    if suffix in {".ply", ".pcd"}:  # ASCII
        source = source.encode("ascii", "backslashreplace").decode()
    assert found["source"] == source
    assert float(found["bin_width_s"]) == 1e-9


@pytest.mark.parametrize("suffix", [".ply", ".las", ".pcd", ".png"])
def test_a_source_of_any_length_fits(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"wall{suffix}"
    save_image(replace(CAPTURE, source="µ " * 50_000), IMAGE, path)
    READERS[suffix](path)
    assert FACTS_OF[suffix](path)["software"] == f"firstphoton {core.__version__}"
    if suffix == ".ply":
        header, _, _ = path.read_bytes().partition(b"end_header")
        assert max(map(len, header.splitlines())) < 600


def test_estimates_state_how_they_were_made() -> None:
    image = core.estimate(CAPTURE, "coates", false_alarm=0.5)
    remark = core.ESTIMATORS["coates"].remark(CAPTURE)
    assert image.made_by == Provenance("coates", NoParameters(), 0.5, remark)
    sure = image.confident(0.5)
    assert sure.made_by == Provenance("coates", NoParameters(), 0.5, remark, 0.5)
    np.testing.assert_array_equal(sure.valid, image.valid & (image.confidence >= 0.5))
    np.testing.assert_array_equal(np.isfinite(sure.bin), sure.valid)
    np.testing.assert_array_equal(sure.range_m[sure.valid], image.range_m[sure.valid])
    with pytest.raises(ValueError, match="least_confidence = 90"):
        image.confident(90)
    box = Box(((0, 0), (0, 2), (2, 2), (2, 0)), to_m=float(np.nanmedian(image.range_m)))
    inside = image.cropped(box)
    np.testing.assert_array_equal(inside.valid, image.valid & box.contains(image.range_m))
    np.testing.assert_array_equal(np.isfinite(inside.range_m), inside.valid)
    assert inside.made_by == replace(image.made_by, box=box)


def test_netcdf_follows_the_conventions(tmp_path: Path) -> None:
    with h5py.File(saved(tmp_path, ".nc", title=TITLE)) as file:
        attributes = dict(file.attrs)
        names = images_of(CAPTURE, IMAGE)
        units = {name: file[name].attrs["units"] for name in names}
        assert all(file[name].attrs["long_name"] for name in names)
        dimensions = [scale[0].name for scale in file["range_m"].dims]
        assert list(file["valid"].attrs["flag_values"]) == [0, 1]
        assert file["valid"].attrs["flag_meanings"] == "no_estimate estimate"
    assert attributes["Conventions"].startswith("CF-1.")
    assert attributes["title"] == TITLE
    assert {name: attributes[name] for name in FACTS} == FACTS
    assert units == {name: "m" if name == "range_m" else "1" for name in units}
    assert dimensions == ["/row", "/col"]


def test_tiff_names_its_pages_and_units(tmp_path: Path) -> None:
    with tifffile.TiffFile(saved(tmp_path, ".tif")) as file:
        pages = [{tag.name: tag.value for tag in page.tags} for page in file.pages]
        assert {page.dtype for page in file.pages} == {np.dtype(np.float32)}
    assert [page["PageName"] for page in pages] == ["range_m", "confidence", "counts"]
    described = [page["ImageDescription"].split(":")[0] for page in pages]
    assert described == ["range_m [m]", "confidence [1]", "counts [1]"]
    assert np.isnan(float(pages[0]["GDAL_NODATA"]))
    items = ElementTree.fromstring(pages[0]["GDAL_METADATA"])
    metadata = {item.attrib.get("role", item.attrib["name"]): item.text for item in items}
    assert metadata == {
        "description": "range_m",
        "unittype": "m",
        **{name: str(fact) for name, fact in FACTS.items()},
    }


@pytest.mark.parametrize("name", ["sbr", "counts"])
def test_added_images_come_first(name: str) -> None:
    plane = Plane(np.where(VALID, 0.25, np.nan), "1", "signal over background")
    product = Product(CAPTURE, IMAGE, shown={name: plane})
    arrays, pages = io.BytesIO(), io.BytesIO()
    WRITERS[".npz"](product, arrays)
    WRITERS[".tif"](product, pages)
    arrays.seek(0)
    pages.seek(0)
    with np.load(arrays, allow_pickle=False) as archive:
        assert next(each for each in archive if archive[each].ndim == 2) == name
        np.testing.assert_array_equal(archive[name], plane.values)
        np.testing.assert_array_equal(archive["range_m"], IMAGE.range_m)
    with tifffile.TiffFile(pages) as file:
        named = [page.tags["PageName"].value for page in file.pages]
        assert np.isnan(float(file.pages[0].tags["GDAL_NODATA"].value))
        np.testing.assert_array_equal(file.pages[0].asarray(), plane.values)
    assert named == list(dict.fromkeys([name, "range_m", "confidence", "counts"]))
    odd = Plane(plane.values[1:], "1", "signal over background")
    with pytest.raises(ValueError, match=rf"shown '{name}' = .*\(6, 9\).*the image's"):
        Product(CAPTURE, IMAGE, shown={name: odd})


@pytest.mark.parametrize(("suffix", "compressed"), [(".las", 0), (".laz", 0x80)])
def test_las_is_of_version_1_4(tmp_path: Path, suffix: str, compressed: int) -> None:
    path = saved(tmp_path, suffix)
    header = path.read_bytes()[:375]
    assert header[:4] == b"LASF"
    assert header[24:26] == bytes([1, 4])
    assert header[104] == 6 | compressed
    assert struct.unpack_from("<H", header, 6)[0] & 16  # coordinate systems are WKT
    assert struct.unpack_from("<Q", header, 247)[0] == VALID.sum()
    scales = struct.unpack_from("<3d", header, 131)
    assert all(STEP_M / 10 < scale <= STEP_M for scale in scales)
    las = laspy.read(path)
    described = {
        dimension.name: dimension.description for dimension in las.point_format.extra_dimensions
    }
    assert described["range_m"] == "range of the surface, m"
    assert set(described) == {"range_m", "counts", "confidence", "row", "col"}
    np.testing.assert_array_equal(las.intensity, CAPTURE.counts[VALID])
    np.testing.assert_array_equal(np.asarray(las.return_number), 1)
    np.testing.assert_array_equal(np.asarray(las.number_of_returns), 1)


@pytest.mark.parametrize(
    ("bin_width_s", "farthest_m", "step_m"),
    [(1e-12, 0.0, 1.5e-7), (1e-9, 0.0, 1.5e-4), (1e-6, 0.0, 0.15), (1e-12, 2e6, 1e-3)],
)
def test_las_coordinates_are_as_fine_as_32_bits_allow(
    tmp_path: Path, bin_width_s: float, farthest_m: float, step_m: float
) -> None:
    """A thousandth of a bin 21 km away, but coarser where one point is very far."""
    capture = Capture(CAPTURE.cube, Acquisition(100, bin_width_s, 1.4e-4, 900, 1e-5))
    image = image_of(capture, VALID)
    image.range_m[2, 2] = farthest_m or image.range_m[2, 2]
    save_image(capture, image, tmp_path / "far.las")
    expected = (sight_lines((ROWS, COLS), 1e-5) * image.range_m[..., np.newaxis])[VALID]
    found = np.asarray(laspy.read(tmp_path / "far.las").xyz)
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.5 * step_m + 1e-11)


def test_points_keep_the_colours_that_they_are_given(tmp_path: Path) -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (ROWS, COLS, 3), np.uint8)
    for suffix in (".las", ".laz"):
        path = tmp_path / f"cloud{suffix}"
        save_image(CAPTURE, image_of(CAPTURE, VALID), path, rgb=rgb)
        las = laspy.read(path)
        colors = np.stack([las.red, las.green, las.blue], axis=-1)
        np.testing.assert_array_equal(colors, rgb[VALID].astype(np.uint16) * 257)
        assert "range_m" in las.point_format.dimension_names
    save_image(CAPTURE, image_of(CAPTURE, VALID), tmp_path / "cloud.ply", rgb=rgb)
    ply = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(ply.colors[:, :3], rgb[VALID])


def test_intensity_ends_at_16_bits(tmp_path: Path) -> None:
    cube = np.full((ROWS, COLS, 100), 1000, np.uint16)
    capture = Capture(cube, Acquisition(100, n_pulses=None))
    save_image(capture, IMAGE, tmp_path / "bright.las")
    las = laspy.read(tmp_path / "bright.las")
    assert set(np.asarray(las.intensity)) == {65535}
    assert set(np.asarray(las["counts"])) == {100_000}


# -- pictures --------------------------------------------------------------------------------------


def drawn_pixels(path: Path | BinaryIO, shape: tuple[int, int] = (ROWS, COLS)) -> np.ndarray:
    """The range image of this shape within an SVG, RGBA of shape (row, col, 4), right way up."""
    link = "{http://www.w3.org/1999/xlink}href"
    for element in ElementTree.parse(path).iter("{http://www.w3.org/2000/svg}image"):
        data = base64.b64decode(element.attrib[link].partition("base64,")[2])
        with Image.open(io.BytesIO(data)) as picture:
            pixels = np.asarray(picture.convert("RGBA"))
        if pixels.shape[:2] == shape:
            return pixels if "scale(1 -1)" not in element.attrib["transform"] else pixels[::-1]
    raise AssertionError("no range image")


def test_colours_grow_brighter_with_range(tmp_path: Path) -> None:
    sure = RangeImage(IMAGE.range_m, IMAGE.bin, IMAGE.score, VALID * 1.0, VALID)
    pixels = drawn_pixels(saved(tmp_path, ".svg", sure))
    assert {tuple(color) for color in pixels[~VALID]} == {(255, 255, 255, 255)}
    colors = pixels[VALID].astype(int)
    # Every colour map grows brighter with range, which here grows along the rows.
    brightness = colors[:, :3] @ [299, 587, 114]
    assert np.all(np.diff(brightness) > 0)


def test_ranges_beyond_the_confident_ones_are_grey(tmp_path: Path) -> None:
    range_m = IMAGE.range_m.copy()
    range_m[1, 1], range_m[5, 5] = 1.0, 1e4
    confidence = VALID * 0.99
    confidence[1, 1] = confidence[5, 5] = 0.2
    image = RangeImage(range_m, IMAGE.bin, IMAGE.score, confidence, VALID)
    pixels = drawn_pixels(saved(tmp_path, ".svg", image))
    np.testing.assert_array_equal(pixels[1, 1], pixels[5, 5])
    grey = np.all(pixels == pixels[1, 1], axis=-1)
    assert np.argwhere(grey).tolist() == [[1, 1], [5, 5]]


@pytest.mark.parametrize(("shape", "proportions"), [((159, 9), 0.25), ((9, 159), 4), ((30, 60), 2)])
def test_the_frame_of_a_narrow_image_is_wide_enough_to_be_read(
    shape: tuple[int, int], proportions: float
) -> None:
    file, color = io.BytesIO(), "#ff00ff"
    Picture(np.ones(shape), ColorScale("Range", "m", 0.0, 2.0, [color])).write(file, "png")
    pixels = np.asarray(Image.open(file).convert("RGB"))
    in_color = (pixels == tuple(bytes.fromhex(color[1:]))).all(axis=2)
    # The bar at the right has the colour, too: a row and a column of the frame.
    rows = np.flatnonzero(in_color.sum(axis=1) > 0)
    first_run = in_color[rows[rows.size // 2]]
    begin = int(first_run.argmax())
    width = int((~first_run[begin:]).argmax())
    height = int(in_color[:, begin + width // 2].sum())
    assert width / height == pytest.approx(proportions, rel=0.03)
    assert begin < 0.3 * pixels.shape[1]


@pytest.mark.parametrize("color_map", ["bgyw", "viridis"])
def test_a_picture_takes_chosen_limits_and_colours(tmp_path: Path, color_map: str) -> None:
    low_m, high_m = (float(np.nanquantile(IMAGE.range_m, share)) for share in (0.2, 0.8))
    colors = RangeColors(low_m, high_m, color_map)
    path = saved(tmp_path, ".svg", colors=colors)
    pixels, scale = drawn_pixels(path)[VALID], range_scale(CAPTURE, IMAGE, colors)
    range_m = IMAGE.range_m[VALID]
    outside = (range_m < low_m) | (range_m > high_m)
    grey = tuple(bytes.fromhex(OUTSIDE_COLOR[1:]))
    np.testing.assert_array_equal((pixels[:, :3] == grey).all(axis=1), outside)
    np.testing.assert_array_equal(pixels[:, :3], scale.rgb(range_m))
    text = " ".join(ElementTree.parse(path).getroot().itertext())
    assert f"grey: beyond the colours ({outside.sum()})" in text
    assert f"({(~VALID).sum()} of {VALID.size} pixels)" in text


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        ({"color_from_m": 2.0, "color_to_m": 1.0}, "color_to_m = 1.0 .* above color_from_m = 2"),
        ({"color_from_m": float("inf")}, "color_from_m = inf .* or None"),
        ({"color_map": "jet"}, "color_map = 'jet' .*'bgyw' or 'viridis'"),
    ],
)
def test_impossible_colours_are_refused(refused: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RangeColors(**refused)


def test_png_and_svg_show_the_same_colours(tmp_path: Path) -> None:
    with Image.open(saved(tmp_path, ".png")) as picture:
        colors = {color for _, color in picture.convert("RGBA").getcolors(2**24)}
    assert {tuple(color) for color in drawn_pixels(saved(tmp_path, ".svg"))[VALID]} <= colors


@pytest.mark.parametrize("suffix", sorted(PICTURES))
def test_the_same_image_gives_the_same_picture(tmp_path: Path, suffix: str) -> None:
    path = saved(tmp_path, suffix, title=TITLE)
    first = path.read_bytes()
    assert saved(tmp_path, suffix, title=TITLE, overwrite=True).read_bytes() == first
    text = " ".join(ElementTree.parse(path).getroot().itertext()) if suffix == ".svg" else ""
    for label in ("Column (px)", "Row (px)", "Estimated range (m)", TITLE) if text else ():
        assert label in text


# -- one pixel -------------------------------------------------------------------------------------


def test_a_pixels_signals_are_read(tmp_path: Path) -> None:
    path = tmp_path / "pixel.csv"
    settings_ = TrackingParameters(l=0.01, weight="survival")
    save_pixel(CAPTURE, 2, 5, settings_, path)
    with path.open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(without_comments(file), strict=True))
    stages = ("raw", "small", "large", "residual", "enhanced")
    assert list(table[0]) == ["bin", "time_s", "range_m", "counts", *stages]
    columns = {name: np.array([float(line[name]) for line in table]) for name in table[0]}
    bins = np.arange(100)
    signals = tracking_signals(CAPTURE.cube[2, 5], settings_, 900)
    for stage in stages:
        np.testing.assert_array_equal(columns[stage], getattr(signals, stage))
    np.testing.assert_array_equal(columns["bin"], bins)
    np.testing.assert_array_equal(columns["counts"], CAPTURE.cube[2, 5])
    np.testing.assert_array_equal(columns["range_m"], CAPTURE.acquisition.bin_to_range_m(bins))
    np.testing.assert_allclose(columns["time_s"] * (299792458 / 2), columns["range_m"], rtol=1e-12)
    assert all(line["counts"].isdigit() and line["bin"].isdigit() for line in table)


def test_default_settings_of_a_pixel_are_the_recommended(tmp_path: Path) -> None:
    save_pixel(CAPTURE, 0, 0, None, tmp_path / "a.csv")
    save_pixel(CAPTURE, 0, 0, TrackingParameters(), tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    with pytest.raises(FileExistsError):
        save_pixel(CAPTURE, 0, 0, None, tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("row", "col", "name", "message"),
    [
        (-1, 0, "pixel.csv", r"row, col = \(-1, 0\) .* 7 rows and 9 columns"),
        (0, 9, "pixel.csv", r"row, col = \(0, 9\) .* 7 rows and 9 columns"),
        (0, 1.5, "pixel.csv", r"row, col = \(0, 1.5\) .* whole numbers"),
        (0, 0, "pixel.npz", r"suffix = '\.npz' .*one of \.csv"),
    ],
)
def test_a_pixel_that_cannot_be_saved_is_refused(
    tmp_path: Path, row: Any, col: Any, name: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        save_pixel(CAPTURE, row, col, None, tmp_path / name)
    assert os.listdir(tmp_path) == []


def test_arguments_in_another_order_are_refused(tmp_path: Path) -> None:
    path, image = tmp_path / "swapped.npz", core.estimate(CAPTURE, "peak")
    calls: list[tuple[Any, str]] = [
        (lambda: core.save_image(image, CAPTURE, path), r"image = Capture\(.* a core.RangeImage"),  # type: ignore[arg-type]
        (lambda: core.save_image(image, image, path), r"capture = RangeImage\(.* a core.Capture"),  # type: ignore[arg-type]
        (lambda: core.save_capture(image, path), r"capture = .*RangeImage.* a core.Capture"),  # type: ignore[arg-type]
    ]
    for save, message in calls:
        with pytest.raises(ValueError, match=message):
            save()
    assert not path.exists()
