"""HDF5, netCDF and Zarr: whole or in parts, from others or our own; and what must be refused."""

from __future__ import annotations

import io
import json
import os
import pickle
import tracemalloc
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numcodecs
import numpy as np
import pytest
import scipy
import xarray as xr
from scipy.constants import speed_of_light

from core.acquisition import Acquisition, Pulse
from core.capture import Capture, CaptureError
from core.io.readers import guards, isolation, open_capture, read_capture
from core.io.readers.labelled import dataset, describe, oriented
from core.io.readers.options import ReadOptions
from core.io.readers.stored import Stored, choose
from core.tests.formats import Content, bare, put
from core.tests.labelled_files import Reads, hdf5_bytes, netcdf_bytes, zarr_files
from core.tests.refusing import assert_refused
from core.tests.samples import ACQUISITION, CUBE, npy_bytes

pytestmark = pytest.mark.files

CAPTURE = Capture(
    CUBE.astype(np.uint8),
    ACQUISITION,
    Pulse.measured([1, 2, 1], 1e-9),
    truth_range_m=np.arange(12.0).reshape(3, 4),
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
    np.testing.assert_array_equal(read.signal, CAPTURE.signal)
    opened = open_capture(path)
    assert describe(opened, ReadOptions()) == (ACQUISITION, CAPTURE.pulse, "first", "a wall")
    assert opened.attrs["background"] == 1.5
    again = read_capture(put(tmp_path / "again.nc", netcdf_bytes(opened.to_dataset())))
    np.testing.assert_array_equal(again.cube, CAPTURE.cube)
    assert again.acquisition == ACQUISITION


# -- arrays of others ------------------------------------------------------------------------------


def test_axes_and_times_are_known_by_their_names(tmp_path: Path) -> None:
    times = ("time", 250.0 + 0.5 * np.arange(100), {"units": "ns"})
    array = xr.Dataset(
        {"hist": (("time", "x", "y"), CUBE.T)}, {"time": times, "y": ("y", [1.0, 2.0, 3.0])}
    )
    content = array.to_netcdf(engine="h5netcdf")
    files: dict[str, Content] = {"t.nc": bytes(content)}
    array.to_zarr(tmp_path / "t.zarr", consolidated=True, zarr_format=2)
    for name in ("t.nc", "t.zarr"):
        path = put(tmp_path / name, files[name]) if name in files else tmp_path / name
        capture = read_capture(path)
        np.testing.assert_array_equal(capture.cube, CUBE)
        assert capture.acquisition.bin_width_s == pytest.approx(0.5e-9)
        assert capture.acquisition.gate_delay_s == pytest.approx(250e-9)
        guessed = "time is when a bin opens, pulse Gaussian of 500 ps"
        assert (
            capture.source == f"{name}, variable hist; guessed: {guessed}, all photons of a pulse"
        )
        opened = open_capture(path, n_pulses=500)
        assert opened.dims == ("row", "col", "bin") and opened.dtype == np.uint16
        assert opened.chunks is not None and opened.chunks[2] == (100,)
        np.testing.assert_array_equal(opened, CUBE)
        found = describe(opened, ReadOptions())
        assert found.acquisition == Acquisition(100, *_timing(capture), 500, None)
        assert found.source.endswith(f"guessed: {guessed}, first photons only")


def _timing(capture: Capture) -> tuple[float, float]:
    return capture.acquisition.bin_width_s, capture.acquisition.gate_delay_s


def test_ranges_tell_times(tmp_path: Path) -> None:
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
    told = {"stop_s": 1.1e-6, "bin_width_s": 1e-9}
    capture, opened = read_capture(path, **told), open_capture(path, **told)
    for counts, acquisition in (
        (capture.cube, capture.acquisition),
        (opened.values, describe(opened, ReadOptions()).acquisition),
    ):
        np.testing.assert_array_equal(counts, CUBE)
        assert acquisition.gate_delay_s == pytest.approx(1e-6, rel=1e-12)
    path = put(tmp_path / "t.nc", netcdf_bytes(dataset(CAPTURE)))
    with pytest.raises(CaptureError, match=r"stop_s = 1.1e-06 .*None: time_s tells"):
        read_capture(path, **told)


def test_variable_chooses(tmp_path: Path) -> None:
    path = put(tmp_path / "two.h5", hdf5_bytes(**{"a/night": CUBE, "day": 2 * CUBE}))
    with pytest.raises(CaptureError, match=r"variable = 'day, a/night'.*day \(3 x 4 x 100\)"):
        read_capture(path)
    np.testing.assert_array_equal(read_capture(path, variable="a/night").cube, CUBE)


def test_what_was_never_written_is_its_fill(tmp_path: Path) -> None:
    file = io.BytesIO()
    with h5py.File(file, "w") as target:
        target.create_dataset("all", CUBE.shape, "u2", fillvalue=3)
        some = target.create_dataset("some", CUBE.shape, "u2", chunks=(2, 2, 50), fillvalue=3)
        some[0, 0, 0] = 9
        target.create_dataset("compact", data=CUBE[:1, :2, :50])
    path = put(tmp_path / "f.h5", file.getvalue())
    assert np.all(read_capture(path, variable="all").cube == 3)
    cube = read_capture(path, variable="some").cube
    assert cube[0, 0, 0] == 9 and cube.sum() == 9 + 3 * (cube.size - 1)
    np.testing.assert_array_equal(read_capture(path, variable="compact").cube, CUBE[:1, :2, :50])


def test_variables_that_grow_lie_among_each_other(tmp_path: Path) -> None:
    """Classic netCDF keeps the rows of all variables of an unlimited dimension in turn."""
    path = tmp_path / "r.nc"
    with scipy.io.netcdf_file(path, "w") as file:
        for name, size in (("row", None), ("col", 4), ("bin", 100)):
            file.createDimension(name, size)
        file.createVariable("counts", "i4", ("row", "col", "bin"))[:] = CUBE.astype("i4")
        file.createVariable("time", "f8", ("row",))[:] = np.arange(3.0)
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)


def test_compact_arrays(tmp_path: Path) -> None:
    file = io.BytesIO()
    with h5py.File(file, "w") as target:
        kept = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        kept.set_layout(h5py.h5d.COMPACT)
        space = h5py.h5s.create_simple(CUBE.shape)
        array = h5py.h5d.create(target.id, b"c", h5py.h5t.STD_U16BE, space, dcpl=kept)
        array.write(h5py.h5s.ALL, h5py.h5s.ALL, CUBE)
    capture = read_capture(put(tmp_path / "c.h5", file.getvalue()))
    np.testing.assert_array_equal(capture.cube, CUBE)


# -- nothing is read before it is asked for --------------------------------------------------------


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
def test_opening_reads_nothing_that_is_told(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", LARGE.nbytes // 4)
    monkeypatch.setattr("core.io.readers.labelled.BLOCK_BYTES", LARGE.nbytes // 16)
    path = put(tmp_path / name, LAZY[name]())
    with pytest.raises(CaptureError, match=r"bytes of .*counts.* are read"):
        read_capture(path)
    open_capture(put(tmp_path / "first.h5", hdf5_bytes(counts=CUBE)))  # what it imports
    reads = Reads(monkeypatch)
    tracemalloc.start()
    try:
        opened = open_capture(path, pulse=Pulse.gaussian(1e-9), detection="all")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
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
    guessed = "t is when a bin opens, pulse Gaussian of 1 ns, all photons of a pulse"
    assert known.source == f"mine; guessed: {guessed}"
    array.t.attrs["units"] = "furlongs"
    known = describe(oriented(array, ReadOptions()), ReadOptions(), "mine")
    assert "guessed: t, of unit 'furlongs', left out, bin width 1 ns" in known.source
    array.t.attrs["units"] = "nanoseconds"
    assert describe(oriented(array, ReadOptions()), ReadOptions()).acquisition.bin_width_s == 1e-9


# -- filters and codecs ----------------------------------------------------------------------------

CODECS: dict[str, tuple[int, dict[str, Any]]] = {
    "none, 2": (2, {"compressors": None}),
    "zlib": (2, {"compressors": numcodecs.Zlib()}),
    "gzip": (2, {"compressors": numcodecs.GZip()}),
    "zstd, 2": (2, {"compressors": numcodecs.Zstd(checksum=True)}),
    **{
        f"blosc {name} {shuffle}": (2, {"compressors": numcodecs.Blosc(name, shuffle=shuffle)})
        for name in ("lz4", "lz4hc", "blosclz", "zlib", "zstd")
        for shuffle in (0, 1, 2)
    },
    "shuffle": (2, {"compressors": numcodecs.Zlib(), "filters": [numcodecs.Shuffle(2)]}),
    "fletcher32": (2, {"compressors": numcodecs.Zlib(), "filters": [numcodecs.Fletcher32()]}),
    "none, 3": (3, {"compressors": None}),
    "gzip, 3": (3, {"compressors": "gzip"}),
    "crc32c": (3, {"compressors": "crc32c"}),
    "blosc, 3": (3, {"compressors": "blosc"}),
    "transposed": (3, {"filters": "transpose"}),
    "big-endian": (3, {"serializer": "big"}),
}


@pytest.mark.parametrize("what", CODECS)
def test_codecs(what: str, tmp_path: Path) -> None:
    from zarr import codecs  # noqa: PLC0415

    of_3 = {
        "gzip": codecs.GzipCodec(),
        "crc32c": [codecs.GzipCodec(), codecs.Crc32cCodec()],
        "blosc": codecs.BloscCodec(),
        "transpose": [codecs.TransposeCodec(order=(2, 0, 1))],
        "big": codecs.BytesCodec(endian="big"),
    }
    version, told = CODECS[what]
    encoding = {k: of_3.get(v, v) if isinstance(v, str) else v for k, v in told.items()}
    path = put(tmp_path / "c.zarr", zarr_files(bare(), version, chunks=(2, 3, 64), **encoding))
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)


def test_every_order_and_key_of_zarr_2(tmp_path: Path) -> None:
    import zarr  # noqa: PLC0415

    for order in "CF":
        for separator in "./":
            path = tmp_path / f"{order}{separator == '.'}.zarr"
            array = zarr.create_array(
                path,
                name="data",
                shape=CUBE.shape,
                dtype=">u2",
                chunks=(2, 3, 64),
                order=order,
                zarr_format=2,
                chunk_key_encoding={"name": "v2", "separator": separator},
                fill_value=0,
            )
            array[:, :3] = CUBE[:, :3]
            capture = read_capture(path)
            np.testing.assert_array_equal(capture.cube[:, :3], CUBE[:, :3])
            assert np.all(capture.cube[:, 3] == 0)
            assert capture.source.startswith(f"{path.name}, variable data; guessed: axes")


def test_what_stands_for_gaps_may_not_occur(tmp_path: Path) -> None:
    """xarray tells NaN of every array of floats."""
    for k, (kind, version, how) in enumerate(
        [("u2", 2, {"_FillValue": 65535}), ("f4", 2, {}), ("f4", 3, {}), ("f8", 3, {})]
    ):
        content = zarr_files(bare().astype(kind), version, **how)
        assert version == 2 or b"AAAAAAAA+H8=" in content["counts/zarr.json"]
        path = put(tmp_path / f"{k}.zarr", content)
        np.testing.assert_array_equal(read_capture(path).cube, CUBE)
        np.testing.assert_array_equal(open_capture(path), CUBE)


def test_an_array_alone_is_a_zarr_directory(tmp_path: Path) -> None:
    import zarr  # noqa: PLC0415

    zarr.create_array(tmp_path / "a.zarr", data=CUBE, chunks=(2, 3, 64))
    np.testing.assert_array_equal(read_capture(tmp_path / "a.zarr").cube, CUBE)


# -- what must be refused --------------------------------------------------------------------------


def written(build: Callable[[h5py.File], Any]) -> Callable[[], bytes]:
    """A file that a function fills."""

    def content() -> bytes:
        file = io.BytesIO()
        with h5py.File(file, "w") as target:
            build(target)
        return file.getvalue()

    return content


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(CUBE.shape, "u2")
    layout[:] = h5py.VirtualSource("/etc/secret.h5", "counts", CUBE.shape)
    file.create_virtual_dataset("counts", layout)


def external(file: h5py.File) -> None:
    file.create_dataset("counts", CUBE.shape, "u2", external=[("/etc/passwd", 0, 2400)])


def linked(file: h5py.File) -> None:
    file["counts"] = h5py.ExternalLink("/etc/secret.h5", "/counts")


def soft(file: h5py.File) -> None:
    file["counts"] = h5py.SoftLink("/other")


def compound(file: h5py.File) -> None:
    file["counts"] = np.zeros((3, 4, 5), [("a", "u2"), ("b", "u2")])


def ragged(file: h5py.File) -> None:
    file.create_dataset("counts", (3, 4, 5), h5py.vlen_dtype("u2"))


def texts(file: h5py.File) -> None:
    file.create_dataset("counts", (3, 4, 5), h5py.string_dtype())


def huge_chunk(file: h5py.File) -> None:
    shape = (1500, 1000, 1000)
    file.create_dataset("counts", shape, "u2", chunks=shape, compression="gzip")


def wrong_checksum(file: h5py.File) -> None:
    array = file.create_dataset("counts", (3, 4, 100), "u2", chunks=(3, 4, 100), fletcher32=True)
    array.id.write_direct_chunk((0, 0, 0), CUBE.tobytes() + b"\1\2\3\4")


def gaps(file: h5py.File) -> None:
    file["counts"] = CUBE
    file["counts"].attrs["_FillValue"] = np.uint16(3)


def gaps_by_another_name(file: h5py.File) -> None:
    file["counts"] = CUBE
    file["counts"].attrs["missing_value"] = np.uint16(3)


def packed(file: h5py.File) -> None:
    file["counts"] = CUBE
    file["counts"].attrs["scale_factor"] = 0.5


def known(**attributes: Any) -> Callable[[], bytes]:
    return lambda: hdf5_bytes(counts={"data": CUBE, "attributes": attributes})


def uneven(file: h5py.File) -> None:
    file["counts"] = CUBE
    file["time_s"] = np.arange(100.0) ** 2
    file["time_s"].make_scale()
    file["counts"].dims[2].attach_scale(file["time_s"])
    for axis, name in enumerate(("row", "col")):
        file["counts"].dims[axis].label = name


HDF5_REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "file cannot be read"),
    "no HDF5": (lambda: bytes(5000), "file cannot be read"),
    "truncated": (lambda: hdf5_bytes(counts=CUBE)[:-100], "file cannot be read"),
    "no arrays": (hdf5_bytes, "variable = None .*has nothing"),
    "flat": (lambda: hdf5_bytes(counts=CUBE[0]), "axes of counts = 2"),
    "no pixels": (lambda: hdf5_bytes(counts=CUBE[:0]), r"counts = .*\(0, 4, 100\)"),
    "complex": (lambda: hdf5_bytes(counts=CUBE * 1j), "counts = 'no numbers'"),
    "booleans": (lambda: hdf5_bytes(counts=CUBE > 0), "counts = 'no numbers'"),
    "virtual": (written(virtual), "counts = 'a virtual array'"),
    "kept in another file": (written(external), "counts = 'an array kept in other files'"),
    "linked to another file": (written(linked), "counts = 'an external link'"),
    "linked softly": (written(soft), "counts = 'a soft link'"),
    "compound": (written(compound), "counts = 'no numbers'"),
    "ragged": (written(ragged), "counts = 'no numbers'"),
    "text": (written(texts), "counts = 'no numbers'"),
    "a huge chunk": (written(huge_chunk), "a chunk of counts = 3000000000 "),
    "a wrong checksum": (written(wrong_checksum), "counts cannot be read"),
    "gaps": (written(gaps), "_FillValue of counts = 3.0 .*without gaps"),
    "gaps by another name": (written(gaps_by_another_name), "missing_value of counts = 3.0"),
    "truth of many pixels": (
        lambda: hdf5_bytes(
            counts=CUBE,
            truth_range_m={"data": np.zeros((2000, 2000), np.uint8), "compression": "gzip"},
        ),
        r"truth_range_m = .*\(2000, 2000\)",
    ),
    "a pulse of no time": (known(pulse_shape="gamma"), "pulse_tau_s = None"),
    "scaled": (written(packed), "scale_factor of counts = 0.5"),
    "uneven bins": (written(uneven), "steps of time_s"),
    "no bin width": (known(bin_width_s=0.0), "bin_width_s = 0.0"),
    "two bin widths": (known(bin_width_s=[1.0, 2.0]), "bin_width_s = .*one number"),
    "half a pulse": (known(n_pulses=0.5), "n_pulses = 0.5"),
    "a pulse of text": (known(pulse_tau_s="long"), "pulse_tau_s = 'long'"),
    "unknown detection": (known(detection="some"), "detection = 'some'"),
}


@pytest.mark.parametrize("what", HDF5_REFUSED)
def test_hdf5_refused(what: str, tmp_path: Path) -> None:
    build, message = HDF5_REFUSED[what]
    path = put(tmp_path / "a.h5", build())
    assert_refused(read_capture, path, message, CaptureError, 2**22)


def test_long_pulses_are_kept_and_longer_ones_refused(tmp_path: Path) -> None:
    pulse = Pulse.measured(np.linspace(1, 2, 70_000), 1e-12)
    content = netcdf_bytes(dataset(replace(CAPTURE, pulse=pulse)))
    assert read_capture(put(tmp_path / "l.nc", content)).pulse == pulse

    def longer(file: h5py.File) -> None:
        file["counts"] = CUBE
        file["counts"].attrs.update(pulse_tau_s=1e-12, pulse_samples=np.ones(2**20 + 1, np.uint8))

    file = io.BytesIO()
    with h5py.File(file, "w", libver="latest") as target:  # in which attributes may be so long
        longer(target)
    with pytest.raises(CaptureError, match="pulse_samples = '1,048,577 values, more than 1,048,57"):
        read_capture(put(tmp_path / "l.h5", file.getvalue()))


def test_what_is_beyond_the_limit_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2**20)
    pixels = xr.Dataset({"counts": (("row", "col", "bin"), np.zeros((512, 512, 1), np.int8))})
    for name, content in {
        "whole.nc": bytes(pixels.astype("i4").isel(bin=[0] * 2).to_netcdf(engine="scipy")),
        "sums.nc": bytes(pixels.to_netcdf(engine="scipy")),
    }.items():
        with pytest.raises(CaptureError, match=rf"{name}: bytes of .* at most 1,048,576 bytes"):
            read_capture(put(tmp_path / name, content))


def test_external_data_is_never_touched(tmp_path: Path) -> None:
    """A pipe that nobody writes to would keep whoever opens it waiting for ever."""
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

    path = put(tmp_path / "a.h5", written(links)())
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)
    for name in ("link", "virtual", "outside"):
        with pytest.raises(CaptureError, match=f"variable {name} = "):
            read_capture(path, variable=name)


def test_what_repeats_or_swells_is_refused(tmp_path: Path) -> None:
    twice = [Stored("counts"), Stored("counts")]
    with pytest.raises(ValueError, match="arrays named 'counts' = 2"):
        choose(twice, ReadOptions())

    def told(file: h5py.File) -> None:
        for k in range(600):
            file.create_group(f"g{k}").attrs["long"] = np.full(4000, 1e-300)

    def many(file: h5py.File) -> None:
        for k in range(10_001):
            file[f"{k}"] = h5py.SoftLink("/nowhere")

    along = {f"c{k}": ("bin", np.arange(100.0)) for k in range(101)}
    for content, message in (
        (netcdf_bytes(bare().assign_coords(along)), "coordinates = 101"),
        (written(many)(), "arrays of the file = more than 10,000"),
        (written(told)(), "attributes = too many"),
    ):
        assert_refused(read_capture, put(tmp_path / "r.h5", content), message, CaptureError, 2**22)


def files_3() -> dict[str, bytes]:
    return zarr_files(bare(), 3, chunks=(2, 3, 64))


def files_2() -> dict[str, bytes]:
    return zarr_files(bare(), 2, chunks=(2, 3, 64))


def edited(files: dict[str, bytes], name: str, **changes: Any) -> dict[str, bytes]:
    return {**files, name: json.dumps({**json.loads(files[name]), **changes}).encode()}


def in_2(**changes: Any) -> Callable[[], Mapping[str, bytes]]:
    return lambda: edited(files_2(), "counts/.zarray", **changes)


def in_3(**changes: Any) -> Callable[[], Mapping[str, bytes]]:
    return lambda: edited(files_3(), "counts/zarr.json", **changes)


def codec_3(**codec: Any) -> Callable[[], Mapping[str, bytes]]:
    plain = {"name": "bytes", "configuration": {"endian": "little"}}
    return in_3(codecs=[plain, codec])


def first_chunk(data: bytes, **changes: Any) -> Callable[[], Mapping[str, bytes]]:
    return lambda: {**edited(files_2(), "counts/.zarray", **changes), "counts/0.0.0": data}


SIZE = 2 * 3 * 64 * 2
ZLIB = {"id": "zlib", "level": 1}
BLOSC = {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1, "blocksize": 0}

ZARR_REFUSED: dict[str, tuple[Callable[[], Mapping[str, bytes]], str]] = {
    "no arrays": (lambda: {"zarr.json": b'{"zarr_format": 3, "node_type": "group"}'}, "arrays = 0"),
    "no JSON": (lambda: files_3() | {"counts/zarr.json": b"{"}, "metadata of 'counts'"),
    "deep JSON": (
        lambda: files_3() | {"counts/zarr.json": b"[" * 100_000},
        "metadata of 'counts'",
    ),
    "two versions": (lambda: files_3() | {"counts/.zarray": b"{}"}, "versions 2 and 3"),
    "another version": (in_3(zarr_format=4), "variable counts"),
    "pickled objects": (
        in_2(dtype="|O", filters=[{"id": "pickle", "protocol": 5}]),
        "variable counts",
    ),
    "a pickling filter": (in_2(filters=[{"id": "pickle", "protocol": 5}]), "'pickle'"),
    "complex": (in_2(dtype="<c16"), "no numbers"),
    "a key that leaves": (
        in_3(chunk_key_encoding={"name": "v2", "configuration": {"separator": "/../"}}),
        "variable counts",
    ),
    "a separator that leaves": (in_2(dimension_separator="../"), "variable counts"),
    "a huge chunk": (in_2(chunks=[10**4] * 3), "a chunk of counts = 2000000000000"),
    "a chunk much larger than its array": (
        in_2(chunks=[512, 512, 512]),
        "bytes of a chunk of counts = 268435456 .*16,777,216",
    ),
    "gaps": (lambda: zarr_files(bare(), 2, _FillValue=3), "_FillValue of counts = 3.0"),
    "a huge array": (in_2(shape=[10**5] * 3, chunks=[1000] * 3), "bytes of counts = 2000"),
    "too many chunks": (in_2(shape=[10**5] * 3), "chunks of counts = "),
    "a short chunk": (first_chunk(b"", compressor=None), "counts cannot be read"),
    "a bomb": (first_chunk(zlib.compress(bytes(2**24)), compressor=ZLIB), "counts cannot be read"),
    "blosc cut short": (
        first_chunk(numcodecs.Blosc().encode(bytes(SIZE))[:-2], compressor=BLOSC),
        "counts cannot be read.*Blosc",
    ),
}


@pytest.mark.parametrize("what", ZARR_REFUSED)
def test_zarr_refused(what: str, tmp_path: Path) -> None:
    build, message = ZARR_REFUSED[what]
    path = tmp_path / "a.zarr"
    path.mkdir()
    assert_refused(read_capture, put(path, build()), message, CaptureError, 2**22)


def test_zarr_holds_no_links_and_no_pipes(tmp_path: Path) -> None:
    secret = put(tmp_path / "secret", bytes(SIZE))
    for k, make in enumerate((lambda path: path.symlink_to(secret), os.mkfifo)):
        path = put(tmp_path / f"{k}.zarr", files_2())
        chunk = path / "counts" / "0.0.0"
        chunk.unlink()
        make(chunk)
        assert_refused(
            read_capture,
            path,
            r"a file of the directory = 'counts/0.0.0' .*no links",
            CaptureError,
            2**22,
        )
    path = put(tmp_path / "d.zarr", files_2())
    (path / "more").symlink_to(tmp_path, target_is_directory=True)
    assert_refused(read_capture, path, "a file of the directory = 'more'", CaptureError, 2**22)


# -- isolation -------------------------------------------------------------------------------------


def replying(array: list[Any]) -> str:
    return f"import json; print(json.dumps(dict(told={{}}, arrays=[{array}])))"


@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("import os; os.abort()", "its library ended by SIGABRT"),
        ("import time; time.sleep(60)", "more than 1 s"),
        ("import sys; sys.exit(3)", "its library ended by status 3"),
        ("print('no reply')", "damaged"),
        (replying(["O", [1]]), "bytes of a reply"),
        (replying(["u1", [99999999999]]), "bytes of a reply"),
    ],
)
def test_a_process_that_fails_is_a_refusal(
    does: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = put(tmp_path / "c.h5", hdf5_bytes(counts=CUBE))
    script = tmp_path / "script.py"
    script.write_text(does)
    with monkeypatch.context() as patched:
        patched.setattr(isolation, "WORKER", script)
        patched.setattr(isolation, "LEAST_SECONDS", 1)
        isolation.end_idle_processes()
        with pytest.raises(CaptureError, match=f"^c.h5: .*{message}"):
            read_capture(path)
    np.testing.assert_array_equal(read_capture(path).cube, CUBE)


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
