"""Scenes from files: surfaces in their places, and refusals of damaged files."""

from __future__ import annotations

import io
import json
import os
import random
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import trimesh
from PIL import Image

from core.geometry import points_m, sight_lines
from core.io.readers import guards
from core.io.scene_files import SceneError, read_scene, suitable_acquisition
from core.tests.formats import put
from core.tests.refusing import assert_refused, count_refused, with_peak
from core.tests.samples import mutated

pytestmark = pytest.mark.files

Write = Callable[[str, bytes], Path]

BOX = trimesh.creation.box((2.0, 1.0, 1.5))  # right, away, up, around the origin
MESHES = ("ply", "stl", "obj", "glb")


def mesh_bytes(kind: str, mesh: Any = BOX) -> bytes:
    """A mesh of the axes x right, y away, z up; glTF, whose y is up, holds it turned."""
    if kind == "glb":
        turned = mesh.copy()
        turned.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
        return bytes(trimesh.Scene(turned).export(file_type="glb"))
    text = mesh.export(file_type=kind)
    return text.encode() if isinstance(text, str) else bytes(text)


def triangle(*corners: tuple[float, float, float]) -> bytes:
    """One triangle as binary STL."""
    face = np.array([(0.0, 0.0, 0.0), *corners], "<f4").tobytes() + bytes(2)
    return bytes(80) + struct.pack("<I", 1) + face


def png_bytes(depths: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.asarray(depths)).save(file, "png")
    return file.getvalue()


def tiff_bytes(depths: Any, **more: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, np.asarray(depths), **more)
    return file.getvalue()


# -- meshes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", MESHES)
def test_a_box_fills_its_image(kind: str, write: Write) -> None:
    scene = read_scene(write(f"box.{kind}", mesh_bytes(kind)), size=(30, 40))
    assert scene.range_m.shape == (30, 40)
    assert scene.acquisition.pixel_angle_rad == pytest.approx(np.arctan(2 / 50 / 40), rel=1e-6)
    assert np.isfinite(scene.range_m).all()  # 40 x 30 pixels of 2 m x 1.5 m
    away = sight_lines((30, 40), scene.acquisition.pixel_angle_rad)[..., 1]
    np.testing.assert_allclose(scene.range_m * away, 50.0, atol=1e-4)


@pytest.mark.parametrize("kind", MESHES)
def test_every_format_has_the_same_axes(kind: str, write: Write) -> None:
    """A wedge at the upper left, which no turn or mirror maps to itself."""
    wedge = trimesh.Trimesh(
        [[-1, 0, 1], [0, 0, 1], [-1, 0, 0], [-1, 2, 1]], [[0, 1, 2], [0, 3, 2], [1, 3, 2]]
    )
    block = trimesh.util.concatenate([wedge, trimesh.creation.box((0.1, 0.1, 0.1))])
    block.vertices[-8:] += [1, 0, -1]
    scene = read_scene(write(f"a.{kind}", mesh_bytes(kind, block)), size=(20, 20))
    assert np.isfinite(scene.range_m[2, 2]) and np.isfinite(scene.range_m[-1, -1])
    assert np.isnan(scene.range_m[2, -2]) and np.isnan(scene.range_m[-2, 2])


def test_the_cloud_lies_on_the_mesh(write: Write) -> None:
    """Check that surfaces drawn by the package's conventions lie where the mesh is."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    scene = read_scene(write("s.ply", mesh_bytes("ply", sphere)), size=(63, 63))
    points = points_m(scene.range_m, scene.acquisition.pixel_angle_rad)
    from_middle = np.linalg.norm(points.xyz_m - [0, 52, 0], axis=1)
    np.testing.assert_allclose(from_middle, 2.0, atol=3e-3)  # the facets' sagitta
    assert scene.range_m[31, 31] == pytest.approx(50, abs=3e-3)
    # A circle in a square, but for what stands behind the horizon of so near a ball.
    assert np.isfinite(scene.range_m).mean() == pytest.approx(np.pi / 4, abs=0.01)


def test_position_and_direction_of_the_sensor(write: Write) -> None:
    path = write("box.stl", mesh_bytes("stl"))
    options = {"size": (9, 9), "pixel_angle_rad": 1e-3}
    side = read_scene(path, position_m=(-11, 0, 0), direction=(3, 0, 0), **options)
    assert side.range_m[4, 4] == pytest.approx(10, abs=1e-5)
    assert side.acquisition.pixel_angle_rad == 1e-3
    above = read_scene(path, distance_m=5, direction=(0, 0, -1), **options)
    assert above.range_m[4, 4] == pytest.approx(5, abs=1e-5)
    slanted = read_scene(path, distance_m=5, direction=(0, 1, -1), **options)
    corner = np.sqrt(0.5) * (0.5 + 0.75)  # the nearest edge, from the middle
    assert slanted.range_m[4, 4] == pytest.approx(5 + corner - 0.5 * np.sqrt(2), abs=1e-5)
    inside = read_scene(path, position_m=(0, 0, 0), **options)
    assert inside.range_m[4, 4] == pytest.approx(0.5, abs=1e-6)


def test_units_and_places_far_from_the_origin(write: Write) -> None:
    """Millimetres, in the coordinates of a map."""
    far = BOX.copy()
    far.apply_scale(1000)
    far.apply_translation([5e8, 4e9, 2e5])
    text = mesh_bytes("obj", far)
    scene = read_scene(write("far.obj", text), unit_m=1e-3, size=(15, 20), distance_m=800)
    assert np.nanmin(scene.range_m) == pytest.approx(800, abs=1e-3)
    assert scene.acquisition.pixel_angle_rad == pytest.approx(2 / 800 / 20, rel=1e-4)


def test_parts_of_a_scene_stand_in_their_places(write: Write) -> None:
    scene = trimesh.Scene()
    for x_m in (-2, 2):
        place = trimesh.transformations.translation_matrix([x_m, 0, -x_m])  # glTF: z to the front
        scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=place)
    seen = read_scene(write("two.glb", scene.export(file_type="glb")), size=(10, 50))
    middle = seen.range_m[5]
    assert np.isnan(middle[25])
    assert middle[45] - middle[3] == pytest.approx(4, abs=0.1)


# -- depth maps ---------------------------------------------------------------------------------

DEPTHS = np.array([[0, 1500, 2000], [65535, 1, 30000]], np.uint16)


def test_16_bits_are_millimetres(write: Write) -> None:
    expected = [[np.nan, 1.5, 2.0], [65.535, 0.001, 30.0]]
    for name, content in {
        "a.png": png_bytes(DEPTHS),
        "a.tif": tiff_bytes(DEPTHS),
        "b.TIFF": tiff_bytes(DEPTHS.astype(">u2"), byteorder=">"),
        "c.tif": tiff_bytes(DEPTHS, compression="zlib"),
    }.items():
        scene = read_scene(write(name, content))
        np.testing.assert_allclose(scene.range_m, expected, rtol=1e-12)
        assert scene.acquisition.pixel_angle_rad is None and scene.reflectivity is None
    half = read_scene(write("a.png", png_bytes(DEPTHS)), unit_m=5e-4, pixel_angle_rad=1e-3)
    np.testing.assert_allclose(half.range_m, np.array(expected) / 2, rtol=1e-12)
    assert half.acquisition.pixel_angle_rad == 1e-3


def test_floats_are_metres(write: Write) -> None:
    depths = np.array([[0, 1.5], [np.nan, 800.25]], np.float32)
    scene = read_scene(write("a.tif", tiff_bytes(depths)))
    np.testing.assert_array_equal(scene.range_m, [[np.nan, 1.5], [np.nan, 800.25]])
    pages = np.stack([depths, np.ones((2, 2), np.float32)])  # as this package saves range images
    several = read_scene(write("b.tif", tiff_bytes(pages, photometric="minisblack")))
    np.testing.assert_array_equal(several.range_m, scene.range_m)


# -- the gate -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("nearest_m", "farthest_m", "n_bins", "width_ns"),
    [
        (50.0, 50.0, 100, 1),
        (50.0, 57.0, 100, 1),
        (0.1, 0.2, 100, 1),
        (100.0, 200.0, 708, 1),
        (100.0, 247.0, 1021, 1),
        (100.0, 248.0, 535, 2),
        (1.0, 9000.0, 1009, 62),
    ],
)
def test_the_gate_holds_everything(
    nearest_m: float, farthest_m: float, n_bins: int, width_ns: int
) -> None:
    chosen = suitable_acquisition(np.array([[nearest_m, np.nan, farthest_m]]), 1e-3)
    assert (chosen.n_bins, chosen.n_pulses, chosen.pixel_angle_rad) == (n_bins, 1000, 1e-3)
    assert chosen.bin_width_s == pytest.approx(width_ns * 1e-9)
    first, last = chosen.range_m_to_bin([nearest_m, farthest_m])
    assert chosen.gate_delay_s >= 0
    assert first >= 19 or chosen.gate_delay_s == 0
    assert last <= chosen.n_bins - 20


def test_any_span_of_ranges_fits_in_a_gate() -> None:
    rng = np.random.default_rng(0)
    for nearest_m, span_m in 10 ** rng.uniform(-2, 7, (300, 2)):
        chosen = suitable_acquisition(np.array([nearest_m, nearest_m + span_m]), None)
        bins = chosen.range_m_to_bin([nearest_m, nearest_m + span_m])
        assert 100 <= chosen.n_bins <= 1024
        assert bins[0] >= 0 and bins[1] <= chosen.n_bins - 19


# -- what must be refused -----------------------------------------------------------------------


def glb_bytes(described: Any, binary: bytes = b"\0" * 64) -> bytes:
    text = described if isinstance(described, bytes) else json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def described(**changes: Any) -> dict[str, Any]:
    """One triangle of the 36 first bytes."""
    known = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 64}],
    }
    return {**known, **changes}


def png_of(width: int, height: int) -> bytes:
    """A picture whose header claims another size."""
    content = bytearray(png_bytes(DEPTHS))
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
    return bytes(content)


AROUND = ((-1.0, 5.0, -1.0), (1.0, 5.0, -1.0), (0.0, 5.0, 1.0))
FACING = triangle(*AROUND)
GLB_ELSEWHERE = glb_bytes(described(buffers=[{"byteLength": 64, "uri": "secret.bin"}]))
GLB_OF_MANY = glb_bytes(
    described(
        nodes=[{"mesh": 0}, {"children": [0] * 200}],
        accessors=[{"componentType": 5126, "count": 10**5, "type": "VEC3"}],
    ),
    bytes(2**20),
)
CLAIMING = {"componentType": 5126, "count": 10**9, "type": "VEC3"}
SIZELESS = b"element vertex 999999999999"
NO_MESH = "cannot be read|faces of the mesh = 0"

REFUSED: tuple[tuple[str, bytes, dict[str, Any], str], ...] = (
    ("a.fbx", b"1", {}, r"suffix = '.fbx'.*\.ply, .*\.png"),
    *((f"a.{kind}", b"", {}, NO_MESH) for kind in (*MESHES, "png", "tif")),
    *((f"a.{kind}", bytes(300), {}, NO_MESH) for kind in (*MESHES, "png", "tif")),
    *((f"a.{kind}", mesh_bytes(kind)[:-40], {}, NO_MESH) for kind in ("ply", "stl", "glb")),
    # Meshes
    ("a.ply", mesh_bytes("ply").replace(b"element vertex 8", SIZELESS), {}, "mesh cannot be read"),
    ("a.ply", trimesh.PointCloud(BOX.vertices).export(file_type="ply"), {}, "faces of .* = 0"),
    ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), {}, NO_MESH),
    ("a.stl", triangle((0.0, 5.0, np.nan), *AROUND[1:]), {}, "vertices without a place = 1"),
    ("a.stl", triangle((0.0, 5.0, 1e30), *AROUND[1:]), {}, r"coordinates = .*e\+29 .*1e\+08"),
    ("a.stl", triangle(*[AROUND[0]] * 3), {}, "pixel_angle_rad = 0"),
    ("a.obj", b"v 0 5 0\nv 1 5 0\nv 0 5 1\nf 1 2 9\n", {}, "the mesh cannot be read"),
    ("a.obj", b"v\n" * 2**23, {}, "faces of the mesh = 0"),
    ("a.glb", glb_bytes(b"[" * 10**5), {}, "the mesh cannot"),
    ("a.glb", GLB_ELSEWHERE, {}, "the mesh cannot be read"),
    ("a.glb", glb_bytes(described(accessors=[CLAIMING])), {}, "the mesh cannot be read"),
    ("a.glb", GLB_OF_MANY, {}, "the mesh|faces of the mesh"),
    ("a.glb", glb_bytes(described(nodes=[{}])), {}, "faces .* = 0"),
    # Depth maps
    ("a.png", png_bytes(DEPTHS.astype(np.uint8)), {}, "kind of pixels = 'L' .*16-bit"),
    ("a.png", png_bytes(np.zeros((2, 3, 3), np.uint8)), {}, "kind of pixels = 'RGB'"),
    ("a.png", tiff_bytes(DEPTHS), {}, "image .* damaged"),
    ("a.png", png_bytes(DEPTHS)[:-30], {}, "image .* damaged"),
    ("a.tif", tiff_bytes(DEPTHS)[:-6], {}, "image .* damaged"),
    ("a.png", png_of(12_000, 9_000), {}, "pixels of the image = 108000000 .*67,108,864"),
    ("a.png", png_of(2**31 - 1, 2**31 - 1), {}, "image .* damaged"),
    (
        "a.tif",
        tiff_bytes(np.array([[1, 2], [-0.5, 1]], np.float32)),
        {},
        r"depth of pixel \(1, 0\) = -0.5",
    ),
    ("a.tif", tiff_bytes(np.array([[1, np.inf]], np.float32)), {}, r"pixel \(0, 1\) = inf"),
    ("a.tif", tiff_bytes(np.array([[1, 1e30]], np.float32)), {}, "ranges = "),
    ("a.png", png_bytes(0 * DEPTHS), {}, "pixels with a target = 0"),
    ("a.png", png_bytes(DEPTHS), {"size": (2, 3)}, r"size = \(2, 3\) .*depth map"),
    ("a.png", png_bytes(DEPTHS), {"distance_m": 3.0}, "distance_m = 3.0 .*depth map"),
    # Views
    ("a.stl", FACING, {"size": (0, 3)}, r"size = \(0, 3\)"),
    ("a.stl", FACING, {"size": (1, 2, 3)}, "size = "),
    ("a.stl", FACING, {"size": (10**5, 10**5)}, "smaller size"),
    ("a.stl", FACING, {"pixel_angle_rad": 2.0}, "_rad = 2.0"),
    ("a.stl", FACING, {"unit_m": 0.0}, "unit_m = 0.0"),
    ("a.stl", FACING, {"distance_m": -1}, "distance_m = -1"),
    ("a.stl", FACING, {"distance_m": 1.0, "position_m": (0, 0, 0)}, "distance_m = 1.0 .*position"),
    ("a.stl", FACING, {"position_m": (0, np.nan, 0)}, "position_m = .*nan"),
    ("a.stl", FACING, {"direction": (0, 0, 0)}, "direction = "),
    ("a.stl", FACING, {"direction": (0, 1)}, "direction = "),
    ("a.stl", FACING, {"position_m": (0, 9, 0)}, "vertices in front of the sensor = 0"),
    (
        "a.stl",
        FACING,
        {"position_m": (50, 0, 0), "pixel_angle_rad": 1e-3},
        "pixels with a target = 0",
    ),
)


@pytest.mark.parametrize(
    ("name", "content", "options", "message"), REFUSED, ids=[f"{e[0]}: {e[3]}" for e in REFUSED]
)
def test_refused(
    name: str, content: bytes, options: dict[str, Any], message: str, write: Write
) -> None:
    path = write(name, content)
    most_bytes = 2**20 + 30 * len(content)
    assert_refused(partial(read_scene, **options), path, message, SceneError, most_bytes)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"absent.ply: path = .*an existing file"):
        read_scene(tmp_path / "absent.ply")


def test_no_other_file_is_opened(write: Write, tmp_path: Path) -> None:
    """Materials and textures elsewhere are ignored; buffers elsewhere are refused."""
    for name in ("other.mtl", "other.png", "secret.bin"):
        os.mkfifo(tmp_path / name)  # opening one blocks until the time is up
    textured = described(
        images=[{"uri": "other.png"}],
        textures=[{"source": 0}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    )
    textured["meshes"][0]["primitives"][0]["material"] = 0
    corners = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], "<f4").tobytes()
    contents = {
        "a.obj": b"mtllib other.mtl\nusemtl m\n" + mesh_bytes("obj") + b"v 1e30 0 0\n",
        "b.obj": b"mtllib /etc/passwd\nusemtl m\n" + mesh_bytes("obj"),
        "a.ply": mesh_bytes("ply").replace(
            b"end_header", b"comment TextureFile other.png\nend_header"
        ),
        "a.glb": glb_bytes(textured, corners + bytes(28)),
    }
    for name, content in contents.items():
        assert np.isfinite(read_scene(write(name, content), size=(3, 3)).range_m).any()
    with pytest.raises(SceneError, match="the mesh cannot be read"):
        read_scene(write("b.glb", GLB_ELSEWHERE))


def test_what_is_too_large_is_refused_before_it_is_read(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2**16)
    large = np.ones((300, 300))
    for name, content in {
        "a.stl": mesh_bytes("stl", trimesh.creation.icosphere(subdivisions=3)),
        "b.stl": mesh_bytes("stl", trimesh.creation.icosphere(subdivisions=2)),
        "a.png": png_bytes(large.astype(np.uint16)),
        "a.tif": tiff_bytes(large.astype(np.float32), compression="zlib"),
    }.items():
        with pytest.raises(SceneError, match=r"bytes of .* 65,536 bytes|pixels of .* to 2,048"):
            read_scene(write(name, content), **({"size": (2, 2)} if "stl" in name else {}))


WHOLE: dict[str, Callable[[], bytes]] = {
    **{f"a.{kind}": lambda kind=kind: mesh_bytes(kind) for kind in MESHES},
    "ascii.ply": lambda: bytes(BOX.export(file_type="ply", encoding="ascii")),
    "ascii.stl": lambda: BOX.export(file_type="stl_ascii").encode(),
    "a.png": lambda: png_bytes(DEPTHS),
    "a.tif": lambda: tiff_bytes(DEPTHS.astype(np.float32)),
    "zlib.tif": lambda: tiff_bytes(DEPTHS, compression="zlib"),
}


@pytest.mark.uncounted
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", WHOLE)
def test_damaged_bytes_give_nothing_but_a_scene_error(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = 2**24
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", limit)
    content, path, rng = WHOLE[name](), tmp_path / name, random.Random(name)
    read = partial(read_scene, **({"size": (9, 9)} if path.suffix[1:] in MESHES else {}))
    read(put(path, content))  # loads the library
    contents = (mutated(content, rng) for _ in range(50))
    n_refused, peak = with_peak(lambda: count_refused(read, path, contents, SceneError))
    assert n_refused > 15
    assert peak < 2 * limit
