"""HDF5, netCDF and Zarr: read whole or in parts, of any layout; damaged files are refused."""

from __future__ import annotations

import io
import json
import os
import pickle
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numcodecs
import numpy as np
import pytest
import xarray as xr
import zarr
from scipy.constants import speed_of_light
from zarr import codecs

from core.acquisition import Acquisition, Pulse
from core.capture import Capture, CaptureError
from core.io.readers import guards, isolation, open_capture, read_capture
from core.io.readers.labelled import dataset, describe, oriented
from core.io.readers.options import ReadOptions
from core.tests.formats import Content, bare, put
from core.tests.labelled_files import Reads, hdf5_bytes, netcdf_bytes, zarr_files
from core.tests.refusing import assert_refused, with_peak
from core.tests.samples import ACQUISITION, CUBE, npy_bytes

pytestmark = pytest.mark.files

CAPTURE = Capture(
    CUBE.astype(np.uint8),
    ACQUISITION,
    Pulse.measured([1, 2, 1], 1e-9),
    truth_range_m=np.arange(150.0, 162.0).reshape(3, 4),
    reported_range_m=np.arange(1.0, 13.0).reshape(3, 4),
    signal=np.full((3, 4), 0.5),
    background=1.5,
    source="a wall",
)

OWN: dict[str, Callable[[], Content]] = {
    "c.nc": lambda: netcdf_bytes(dataset(CAPTURE)),
    "c.h5": lambda: netcdf_bytes(dataset(CAPTURE), zlib=True, chunksizes=(2, 3, 64)),
    "two.zarr": lambda: zarr_files(dataset(CAPTURE), 2),
    "three.zarr": lambda: zarr_files(dataset(CAPTURE), 3, chunks=(2, 3, 64)),
}


@pytest.mark.parametrize("name", OWN)
def test_our_own_layout_keeps_everything(name: str, tmp_path: Path) -> None:
    path = put(tmp_path / name, OWN[name]())
    read = read_capture(path)
    assert read.cube.dtype == np.uint8
    np.testing.assert_array_equal(read.cube, CAPTURE.cube)
    for field in ("acquisition", "pulse", "background", "source", "detection"):
        assert getattr(read, field) == getattr(CAPTURE, field), field
    np.testing.assert_array_equal(read.truth_range_m, CAPTURE.truth_range_m)
    np.testing.assert_array_equal(read.reported_range_m, CAPTURE.reported_range_m)
    np.testing.assert_array_equal(read.signal, CAPTURE.signal)
    opened = open_capture(path)
    assert describe(opened, ReadOptions()) == (ACQUISITION, CAPTURE.pulse, "first", "a wall")
    assert opened.attrs["background"] == 1.5
    again = read_capture(put(tmp_path / "again.nc", netcdf_bytes(opened.to_dataset())))
    np.testing.assert_array_equal(again.cube, CAPTURE.cube)
    assert again.acquisition == ACQUISITION


# -- arrays of other programs ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["t.nc", "t.zarr"])
def test_axes_and_times_are_known_by_their_names(name: str, tmp_path: Path) -> None:
    times = ("time", 250.0 + 0.5 * np.arange(100), {"units": "ns"})
    array = xr.Dataset(
        {"hist": (("time", "x", "y"), CUBE.T)}, {"time": times, "y": ("y", [1.0, 2.0, 3.0])}
    )
    path = tmp_path / name
    if name == "t.nc":
        array.to_netcdf(path, engine="h5netcdf")
    else:
        array.to_zarr(path, consolidated=True, zarr_format=2)
    capture = read_capture(path)
    np.testing.assert_array_equal(capture.cube, CUBE)
    acquisition = capture.acquisition
    assert acquisition.bin_width_s == pytest.approx(0.5e-9)
    assert acquisition.gate_delay_s == pytest.approx(250e-9)
    guessed = (
        f"{name}, variable hist; guessed: time is when a bin opens, "
        "pulse Gaussian of 500 ps (one bin: width not determined)"
    )
    assert capture.source == f"{guessed}, all photons of a pulse"
    opened = open_capture(path, n_pulses=500)
    assert opened.dims == ("row", "col", "bin") and opened.dtype == np.uint16
    assert opened.chunks is not None and opened.chunks[2] == (100,)
    np.testing.assert_array_equal(opened, CUBE)
    found = describe(opened, ReadOptions())
    assert found.acquisition == replace(acquisition, n_pulses=500)
    assert found.source == f"{guessed}, first photons only"


def test_ranges_determine_times(tmp_path: Path) -> None:
    ranges = ("bin", 30.0 + 0.15 * np.arange(100))
    array = xr.Dataset({"counts": (("row", "col", "bin"), CUBE)}, {"range_m": ranges})
    capture = read_capture(put(tmp_path / "r.nc", netcdf_bytes(array)))
    assert capture.acquisition.bin_width_s == pytest.approx(0.3 / speed_of_light)
    assert capture.acquisition.gate_delay_s == pytest.approx(60 / speed_of_light)


def test_plain_hdf5_guesses_its_axes(tmp_path: Path) -> None:
    known = {"bin_width_s": 2e-9, "n_pulses": 500}
    kept = {"data": CUBE.transpose(2, 0, 1), "attributes": known}
    path = put(tmp_path / "p.h5", hdf5_bytes(**{"raw/hist": kept, "depth": np.ones((3, 4))}))
    capture = read_capture(path, axes="bin row col")
    np.testing.assert_array_equal(capture.cube, CUBE)
    assert capture.acquisition == Acquisition(100, 2e-9, 0.0, 500, None)
    assert "axes" not in capture.source and capture.detection == "first"
    np.testing.assert_array_equal(open_capture(path, axes="bin row col"), CUBE)
    guessed = read_capture(path, n_pulses=1)
    assert guessed.cube.shape == (100, 3, 4)
    assert "guessed: axes (row, col, bin), gate" in guessed.source
    assert guessed.detection == "all"  # some pixels have more than 1


def test_common_stop_counts_backwards(tmp_path: Path) -> None:
    path = put(tmp_path / "b.h5", hdf5_bytes(counts=CUBE[:, :, ::-1]))
    options = {"stop_s": 1.1e-6, "bin_width_s": 1e-9}
    capture, opened = read_capture(path, **options), open_capture(path, **options)
    for counts, acquisition in (
        (capture.cube, capture.acquisition),
        (opened.values, describe(opened, ReadOptions()).acquisition),
    ):
        np.testing.assert_array_equal(counts, CUBE)
        assert acquisition.gate_delay_s == pytest.approx(1e-6, rel=1e-12)
    path = put(tmp_path / "t.nc", netcdf_bytes(dataset(CAPTURE)))
    with pytest.raises(CaptureError, match=r"stop_s = 1.1e-06 .*None: time_s gives"):
        read_capture(path, **options)


def test_variable_chooses(tmp_path: Path) -> None:
    path = put(tmp_path / "two.h5", hdf5_bytes(**{"a/night": CUBE, "day": 2 * CUBE}))
    with pytest.raises(CaptureError, match=r"give day or a/night, each.*day \(3 x 4 x 100\)"):
        read_capture(path)
    np.testing.assert_array_equal(read_capture(path, variable="a/night").cube, CUBE)


def test_unwritten_chunks_hold_the_fill_value(tmp_path: Path) -> None:
    file = io.BytesIO()
    with h5py.File(file, "w") as target:
        some = target.create_dataset("some", CUBE.shape, "u2", chunks=(2, 2, 50), fillvalue=3)
        some[0, 0, 0] = 9
    cube = read_capture(put(tmp_path / "f.h5", file.getvalue())).cube
    assert cube[0, 0, 0] == 9 and cube.sum() == 9 + 3 * (cube.size - 1)


# -- lazy reading ----------------------------------------------------------------------------------


LARGE = np.random.default_rng(5).poisson(0.05, (64, 48, 200)).astype(np.uint16)


def large() -> Any:
    return xr.Dataset({"counts": (("row", "col", "bin"), LARGE)})


LAZY: dict[str, Callable[[], Content]] = {
    "contiguous.h5": lambda: hdf5_bytes(counts=LARGE),
    "chunked.h5": lambda: hdf5_bytes(
        counts={"data": LARGE, "chunks": (8, 8, 50), "compression": "gzip"}
    ),
    "netcdf.nc": lambda: netcdf_bytes(large(), chunksizes=(8, 8, 200)),
    "two.zarr": lambda: zarr_files(large(), 2, chunks=(8, 8, 200)),
    "three.zarr": lambda: zarr_files(large(), 3, chunks=(8, 8, 50)),
}


@pytest.mark.parametrize("name", LAZY)
def test_opening_reads_no_counts(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", LARGE.nbytes // 4)
    monkeypatch.setattr("core.io.readers.labelled.BLOCK_BYTES", LARGE.nbytes // 16)
    path = put(tmp_path / name, LAZY[name]())
    with pytest.raises(CaptureError, match=r"bytes of .*counts.* are read"):
        read_capture(path)
    open_capture(put(tmp_path / "first.h5", hdf5_bytes(counts=CUBE)))  # what it imports
    reads = Reads(monkeypatch)
    known = {"pulse": Pulse.gaussian(1e-9), "detection": "all"}
    opened, peak = with_peak(lambda: open_capture(path, **known))
    assert reads.n_bytes == 0
    assert peak < LARGE.nbytes // 4
    assert opened.shape == LARGE.shape and opened.chunks is not None
    assert len(opened.chunks[0]) > 1 and opened.chunks[2] == (200,)
    np.testing.assert_array_equal(opened[5, 7], LARGE[5, 7])
    assert 0 < reads.n_bytes <= LARGE.nbytes // 8
    for box in np.s_[::-1, 3, ::-7], np.s_[-1, 40:2:-3, 5:5], np.s_[60:, ::9, [1, 5, 2]]:
        np.testing.assert_array_equal(opened[box], LARGE[box])
    np.testing.assert_array_equal(opened.sum("bin"), LARGE.sum(axis=2))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(opened))[60:], LARGE[60:])


def test_bins_first_are_read_whole_along_the_bins(tmp_path: Path) -> None:
    path = put(tmp_path / "b.h5", hdf5_bytes(counts=LARGE.transpose(2, 0, 1)))
    opened = open_capture(path, axes="bin row col")
    np.testing.assert_array_equal(opened[3:5, 6:9], LARGE[3:5, 6:9])


def test_counts_are_checked_when_they_are_read(tmp_path: Path) -> None:
    for value, message in ((-1, "= -1.* 0 or more"), (0.5, "whole counts"), (np.nan, "nan")):
        odd = CUBE.astype(float)
        odd[2, 1, 5] = value
        path = put(tmp_path / "o.h5", hdf5_bytes(counts={"data": odd, "chunks": (1, 4, 100)}))
        opened = open_capture(path, pulse=Pulse.gaussian(1e-9), detection="all")
        assert opened.dtype == np.uint32
        with pytest.raises(CaptureError, match=message) as caught:
            opened.compute(scheduler="synchronous")
        assert str(caught.value).startswith("o.h5: ")
        for way_in in (read_capture, open_capture):  # which looks, to guess
            with pytest.raises(CaptureError, match=rf"^o\.h5: counts.*{message.strip('.*')}"):
                way_in(path)


def test_other_files_are_opened_by_reading_them(tmp_path: Path) -> None:
    opened = open_capture(put(tmp_path / "c.npy", npy_bytes(CUBE)), bin_width_s=2e-9)
    np.testing.assert_array_equal(opened, CUBE)
    assert describe(opened, ReadOptions()).acquisition.bin_width_s == 2e-9
    assert opened.attrs["source"].startswith("c.npy; guessed: axes")
    with pytest.raises(CaptureError, match=r"c.npy: n_bins = 99"):
        open_capture(tmp_path / "c.npy", n_bins=99)
    with pytest.raises(TypeError, match="colour"):
        open_capture(tmp_path / "c.npy", colour="red")
    with pytest.raises(CaptureError, match="an existing file"):
        open_capture(tmp_path / "absent.zarr")


def test_any_labelled_array_is_described() -> None:
    array = xr.DataArray(CUBE, dims=("y", "x", "t"), coords={"t": 5.0 + np.arange(100)})
    array.t.attrs["units"] = "ns"
    known = describe(oriented(array, ReadOptions()), ReadOptions(), "mine")
    assert known.acquisition.gate_delay_s == pytest.approx(5e-9)
    assert known.source == (
        "mine; guessed: t is when a bin opens, "
        "pulse Gaussian of 1 ns (one bin: width not determined), all photons of a pulse"
    )
    array.t.attrs["units"] = "furlongs"
    known = describe(oriented(array, ReadOptions()), ReadOptions(), "mine")
    assert "guessed: t, of unit 'furlongs', left out, bin width 1 ns" in known.source
    array.t.attrs["units"] = "nanoseconds"
    assert describe(oriented(array, ReadOptions()), ReadOptions()).acquisition.bin_width_s == 1e-9


# -- Zarr ------------------------------------------------------------------------------------------

CODECS: dict[str, tuple[int, dict[str, Any]]] = {
    "zlib": (2, {"compressors": numcodecs.Zlib()}),
    "zstd": (2, {"compressors": numcodecs.Zstd(checksum=True)}),
    "blosc": (2, {"compressors": numcodecs.Blosc("lz4hc", shuffle=2)}),
    "shuffle": (2, {"compressors": numcodecs.Zlib(), "filters": [numcodecs.Shuffle(2)]}),
    "fletcher32": (2, {"compressors": numcodecs.Zlib(), "filters": [numcodecs.Fletcher32()]}),
    "none": (3, {"compressors": None}),
    "crc32c": (3, {"compressors": [codecs.GzipCodec(), codecs.Crc32cCodec()]}),
    "blosc, 3": (3, {"compressors": codecs.BloscCodec()}),
    "transposed": (3, {"filters": [codecs.TransposeCodec(order=(2, 0, 1))]}),
    "big-endian": (3, {"serializer": codecs.BytesCodec(endian="big")}),
}


@pytest.mark.parametrize("codec", CODECS)
def test_codecs(codec: str, tmp_path: Path) -> None:
    version, encoding = CODECS[codec]
    path = put(tmp_path / "c.zarr", zarr_files(bare(), version, chunks=(2, 3, 64), **encoding))
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)


@pytest.mark.parametrize("separator", [".", "/"])
def test_an_array_of_zarr_2_may_be_partly_written(separator: str, tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    array = zarr.create_array(
        path,
        name="data",
        shape=CUBE.shape,
        dtype=">u2",
        chunks=(2, 3, 64),
        order="F",
        zarr_format=2,
        chunk_key_encoding={"name": "v2", "separator": separator},
        fill_value=0,
    )
    array[:, :3] = CUBE[:, :3]
    capture = read_capture(path)
    np.testing.assert_array_equal(capture.cube[:, :3], CUBE[:, :3])
    assert np.all(capture.cube[:, 3] == 0)
    assert capture.source.startswith("a.zarr, variable data; guessed: axes")


@pytest.mark.parametrize(
    ("dtype", "version", "encoding"),
    [("u2", 2, {"_FillValue": 65535}), ("f4", 2, {}), ("f4", 3, {}), ("f8", 3, {})],
)
def test_a_fill_value_that_does_not_occur_is_accepted(
    dtype: str, version: int, encoding: dict[str, int], tmp_path: Path
) -> None:
    """xarray declares NaN as the fill value of every array of floats."""
    content = zarr_files(bare().astype(dtype), version, **encoding)
    assert version == 2 or b"AAAAAAAA+H8=" in content["counts/zarr.json"]
    path = put(tmp_path / "f.zarr", content)
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)
    np.testing.assert_array_equal(open_capture(path), CUBE)


def test_an_array_alone_is_a_zarr_directory(tmp_path: Path) -> None:
    zarr.create_array(tmp_path / "a.zarr", data=CUBE, chunks=(2, 3, 64))
    np.testing.assert_array_equal(read_capture(tmp_path / "a.zarr").cube, CUBE)


# -- what must be refused --------------------------------------------------------------------------


def written(fill: Callable[[h5py.File], Any]) -> bytes:
    """A file that a function fills."""
    file = io.BytesIO()
    with h5py.File(file, "w", libver="latest") as target:  # in which attributes may be long
        fill(target)
    return file.getvalue()


def known(**attributes: Any) -> bytes:
    return hdf5_bytes(counts={"data": CUBE, "attributes": attributes})


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(CUBE.shape, "u2")
    layout[:] = h5py.VirtualSource("/etc/secret.h5", "counts", CUBE.shape)
    file.create_virtual_dataset("counts", layout)


def external(file: h5py.File) -> None:
    file.create_dataset("counts", CUBE.shape, "u2", external=[("/etc/passwd", 0, 2400)])


def linked(file: h5py.File) -> None:
    file["counts"] = h5py.ExternalLink("/etc/secret.h5", "/counts")


def ragged(file: h5py.File) -> None:
    file.create_dataset("counts", (3, 4, 5), h5py.vlen_dtype("u2"))


def huge_chunk(file: h5py.File) -> None:
    shape = (1500, 1000, 1000)
    file.create_dataset("counts", shape, "u2", chunks=shape, compression="gzip")


def wrong_checksum(file: h5py.File) -> None:
    array = file.create_dataset("counts", (3, 4, 100), "u2", chunks=(3, 4, 100), fletcher32=True)
    array.id.write_direct_chunk((0, 0, 0), CUBE.tobytes() + b"\1\2\3\4")


def uneven(file: h5py.File) -> None:
    file["counts"] = CUBE
    file["time_s"] = np.arange(100.0) ** 2
    file["time_s"].make_scale()
    file["counts"].dims[2].attach_scale(file["time_s"])
    for axis, name in enumerate(("row", "col")):
        file["counts"].dims[axis].label = name


def long_attributes(file: h5py.File) -> None:
    for k in range(600):
        file.create_group(f"g{k}").attrs["long"] = np.full(4000, 1e-300)


def many_links(file: h5py.File) -> None:
    for k in range(10_001):
        file[f"{k}"] = h5py.SoftLink("/nowhere")


LARGE_TRUTH = {"data": np.zeros((2000, 2000), np.uint8), "compression": "gzip"}
COORDINATES = {f"c{k}": ("bin", np.arange(100.0)) for k in range(101)}

HDF5_REFUSED: tuple[tuple[Callable[[], bytes], str], ...] = (
    (lambda: bytes(5000), "file cannot be read"),
    (hdf5_bytes, "variable = None .*has nothing"),
    (lambda: hdf5_bytes(counts=CUBE[0]), "axes of counts = 2"),
    (lambda: hdf5_bytes(counts=CUBE[:0]), r"counts = .*\(0, 4, 100\)"),
    (lambda: hdf5_bytes(counts=CUBE * 1j), "counts = 'no numbers'"),
    (lambda: hdf5_bytes(counts=np.zeros((3, 4, 5), [("a", "u2")])), "counts = 'no numbers'"),
    (lambda: written(ragged), "counts = 'no numbers'"),
    (lambda: written(virtual), "counts = 'a virtual array'"),
    (lambda: written(external), "counts = 'an array kept in other files'"),
    (lambda: written(linked), "counts = 'a link'"),
    (lambda: written(huge_chunk), "a chunk of counts = 3000000000 "),
    (lambda: written(wrong_checksum), "counts cannot be read"),
    (lambda: known(_FillValue=np.uint16(3)), "_FillValue of counts = 3.0 .*without gaps"),
    (lambda: known(missing_value=np.uint16(3)), "missing_value of counts = 3.0"),
    (lambda: known(scale_factor=0.5), "scale_factor of counts = 0.5"),
    (
        lambda: hdf5_bytes(counts=CUBE, truth_range_m=LARGE_TRUTH),
        r"truth_range_m = .*\(2000, 2000\)",
    ),
    (lambda: written(uneven), "steps of time_s"),
    (lambda: known(pulse_tau_s="long"), "pulse_tau_s = 'long'"),
    (lambda: known(detection="some"), "detection = 'some'"),
    (lambda: netcdf_bytes(bare().assign_coords(COORDINATES)), "coordinates = 101"),
    (lambda: written(many_links), "arrays of the file = 10001 .*10,000"),
    (lambda: written(long_attributes), "attributes = too many"),
)


@pytest.mark.parametrize(("content", "message"), HDF5_REFUSED, ids=[m for _, m in HDF5_REFUSED])
def test_hdf5_refused(content: Callable[[], bytes], message: str, tmp_path: Path) -> None:
    path = put(tmp_path / "a.h5", content())
    assert_refused(read_capture, path, message, CaptureError, 2**22)


def test_long_pulses_are_kept_and_longer_ones_refused(tmp_path: Path) -> None:
    pulse = Pulse.measured(np.linspace(1, 2, 70_000), 1e-12)
    content = netcdf_bytes(dataset(replace(CAPTURE, pulse=pulse)))
    assert read_capture(put(tmp_path / "l.nc", content)).pulse == pulse

    def longer(file: h5py.File) -> None:
        file["counts"] = CUBE
        file["counts"].attrs.update(pulse_tau_s=1e-12, pulse_samples=np.ones(2**20 + 1, np.uint8))

    with pytest.raises(CaptureError, match="pulse_samples = '1,048,577 values, more than 1,048,57"):
        read_capture(put(tmp_path / "l.h5", written(longer)))


def test_external_data_is_never_opened(tmp_path: Path) -> None:
    """Opening a pipe that nobody writes to would block until the time is up."""
    pipe = tmp_path / "pipe.h5"
    os.mkfifo(pipe)

    def links(file: h5py.File) -> None:
        file["link"] = h5py.ExternalLink(str(pipe), "/counts")
        layout = h5py.VirtualLayout(CUBE.shape, "u2", maxshape=(None, 4, 100))
        source = h5py.VirtualSource(str(pipe), "c", (3, 4, 100), maxshape=(None, 4, 100))
        layout[: h5py.h5s.UNLIMITED, :, :] = source[: h5py.h5s.UNLIMITED, :, :]
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("outside", CUBE.shape, "u2", external=[(str(pipe), 0, 2400)])
        file["counts"] = CUBE

    path = put(tmp_path / "a.h5", written(links))
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)
    for name in ("link", "virtual", "outside"):
        with pytest.raises(CaptureError, match=f"variable {name} = "):
            read_capture(path, variable=name)


@cache
def chunked(version: int) -> dict[str, bytes]:
    return zarr_files(bare(), version, chunks=(2, 3, 64))


def in_2(**changes: Any) -> dict[str, bytes]:
    """Files of version 2 with changed metadata."""
    name = "counts/.zarray"
    return chunked(2) | {name: json.dumps(json.loads(chunked(2)[name]) | changes).encode()}


def in_3(**changes: Any) -> dict[str, bytes]:
    name = "counts/zarr.json"
    return chunked(3) | {name: json.dumps(json.loads(chunked(3)[name]) | changes).encode()}


def first_chunk(data: bytes, compressor: Any) -> dict[str, bytes]:
    return in_2(compressor=compressor) | {"counts/0.0.0": data}


PICKLE = [{"id": "pickle", "protocol": 5}]
LEAVING = {"name": "v2", "configuration": {"separator": "/../"}}
SHORT_BLOSC = numcodecs.Blosc().encode(bytes(2 * 3 * 64 * 2))[:-2]
BLOSC = {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1, "blocksize": 0}
BOMB = zlib.compress(bytes(2**24))

ZARR_REFUSED: tuple[tuple[Callable[[], dict[str, bytes]], str], ...] = (
    (lambda: {"zarr.json": b'{"zarr_format": 3, "node_type": "group"}'}, "arrays = 0"),
    (lambda: chunked(3) | {"counts/zarr.json": b"{"}, "variable counts = 'JSONDecodeError"),
    (
        lambda: chunked(3) | {"counts/zarr.json": b"[" * 100_000},
        "variable counts = 'RecursionError",
    ),
    (lambda: chunked(3) | {"counts/.zarray": b"{}"}, "versions 2 and 3"),
    (lambda: in_3(zarr_format=4), "variable counts"),
    (lambda: in_2(dtype="|O", filters=PICKLE), "variable counts"),
    (lambda: in_2(filters=PICKLE), "'pickle'"),
    (lambda: in_2(dtype="<c16"), "no numbers"),
    (lambda: in_3(chunk_key_encoding=LEAVING), "variable counts"),
    (lambda: in_2(dimension_separator="../"), "variable counts"),
    (lambda: in_2(chunks=[10**4] * 3), "a chunk of counts = 2000000000000"),
    (lambda: in_2(chunks=[512] * 3), "bytes of a chunk of counts = 268435456 .*16,777,216"),
    (lambda: zarr_files(bare(), 2, _FillValue=3), "_FillValue of counts = 3.0"),
    (lambda: in_2(shape=[10**5] * 3, chunks=[1000] * 3), "bytes of counts = 2000"),
    (lambda: in_2(shape=[10**5] * 3), "chunks of counts = "),
    (lambda: first_chunk(b"", None), "counts cannot be read"),
    (lambda: first_chunk(BOMB, {"id": "zlib", "level": 1}), "counts cannot be read"),
    (lambda: first_chunk(SHORT_BLOSC, BLOSC), "counts cannot be read.*Blosc"),
)


@pytest.mark.parametrize(("content", "message"), ZARR_REFUSED, ids=[m for _, m in ZARR_REFUSED])
def test_zarr_refused(
    content: Callable[[], dict[str, bytes]], message: str, tmp_path: Path
) -> None:
    path = put(tmp_path / "a.zarr", content())
    assert_refused(read_capture, path, message, CaptureError, 2**22)


@pytest.mark.parametrize("make", [lambda path: path.symlink_to("/etc/passwd"), os.mkfifo])
@pytest.mark.parametrize("place", ["counts/0.0.0", "more"])
def test_zarr_holds_no_links_and_no_pipes(
    make: Callable[[Path], Any], place: str, tmp_path: Path
) -> None:
    files = {name: content for name, content in chunked(2).items() if name != place}
    path = put(tmp_path / "a.zarr", files)
    make(path / place)
    message = rf"a file of the directory = '{place}' .*no links"
    assert_refused(read_capture, path, message, CaptureError, 2**22)


# -- isolation -------------------------------------------------------------------------------------


def replying(array: list[Any]) -> str:
    return f"import json; print(json.dumps(dict(found={{}}, arrays=[{array}])))"


FAILURES = {
    "import os; os.abort()": "its library ended by SIGABRT",
    "import time; time.sleep(60)": "more than 1 s",
    "import sys; sys.exit(3)": "its library ended by status 3",
    "print('no reply')": "damaged",
    replying(["O", [1]]): "bytes of a reply",
    replying(["u1", [99999999999]]): "bytes of a reply",
}


def test_a_process_that_fails_is_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path / "c.h5", hdf5_bytes(counts=CUBE))
    script = tmp_path / "script.py"
    with monkeypatch.context() as patched:
        patched.setattr(isolation, "WORKER", script)
        patched.setattr(isolation, "LEAST_SECONDS", 1)
        patched.setattr(isolation, "WAIT_FACTOR", 1)
        isolation.end_idle_processes()
        for does, message in FAILURES.items():
            script.write_text(does)
            with pytest.raises(CaptureError, match=f"^c.h5: .*{message}"):
                read_capture(path)
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)


def test_a_process_may_wait_for_a_busy_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "script.py"
    script.write_text('import time; time.sleep(1.1); print(\'{"found": {}, "arrays": []}\')')
    with monkeypatch.context() as patched:
        patched.setattr(isolation, "WORKER", script)
        patched.setattr(isolation, "LEAST_SECONDS", 1)
        isolation.end_idle_processes()
        assert isolation.isolated(script, "the file", "any") == ({}, [])
    isolation.end_idle_processes()


def test_a_process_has_limited_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = hdf5_bytes(counts={"data": CUBE, "chunks": CUBE.shape, "compression": "gzip"})
    path = put(tmp_path / "c.h5", content)
    monkeypatch.setattr(isolation, "BASE_BYTES", 2**24)
    # A process that has read before may have enough free memory for so small a file.
    isolation.end_idle_processes()
    with pytest.raises(CaptureError, match=r"cannot be read|ended by"):
        read_capture(path)


def test_threads_read_at_the_same_time(tmp_path: Path) -> None:
    path = put(tmp_path / "c.h5", hdf5_bytes(counts=LARGE))
    opened = open_capture(path, pulse=Pulse.gaussian(1e-9), detection="all")
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: opened[k].compute(scheduler="synchronous").data, range(64)))
    np.testing.assert_array_equal(found, LARGE)
