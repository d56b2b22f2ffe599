"""Decode files with the libraries of their formats, in a process of limited memory and time.

`core.io.readers.isolation` starts this script. The libraries are not robust to malformed files:
some files keep them busy forever, others crash them. The script imports nothing of the package.

Each line of the standard input is a JSON object: ``task``, its arguments, and the ``memory_bytes``
and ``seconds`` that it may take. Each reply is a line of JSON followed by the bytes of its arrays.
Nothing outside the given path is read, and no object is unpickled: links, virtual and external
datasets, types other than plain numbers, and unknown codecs are refused.
"""

from __future__ import annotations

import base64
import json
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

MOST_LINKS = 10_000
MOST_DEPTH = 10
MOST_IN_ATTRIBUTE = 2**20
MOST_METADATA_BYTES = 2**24
MOST_REPLY_CHARACTERS = 2**24
IDLE_SECONDS = 60
_NETCDF_ATTRIBUTES = ("CLASS", "_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties")
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
_ZARR_MARKS = ("zarr.json", ".zarray", ".zgroup")
_ZARR_CODECS = {"zlib", "gzip", "zstd", "blosc", "shuffle", "fletcher32", "crc32c", "delta", "lz4"}
_TMF8829_REFERENCES = {"mp_histo": "ref_histo", "mp_histo_HA": "ref_histo_HA"}
_PAGE_NAME = 285  # number of a tag
_DEPTH_MODES = ("I;16", "I;16L", "I;16B", "I;16N", "F")

Reply = tuple[dict[str, Any], list[Any]]
"""A description in JSON, and arrays."""


class Refused(ValueError):
    """Refusal of a file; the message is a sentence for the user."""


def require(name: str, value: object, accepted: bool, what: str) -> None:
    """Refuse a value with the message of `core.checks.require`."""
    if not accepted:
        raise Refused(f"{name} = {value!r} is not accepted: give {what}.")


def _require_numbers(dtype: np.dtype[Any]) -> None:
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise ValueError("no numbers")


def _plain(attributes: dict[str, Any]) -> dict[str, Any]:
    """Keep the attributes that are numbers, lists of numbers, or text."""
    found: dict[str, Any] = {}
    for name, value in attributes.items():
        if isinstance(value, bytes):
            found[name] = value.decode("utf-8", "replace")
        elif isinstance(value, str):
            found[name] = value
        elif not isinstance(value, bool | dict) and np.asarray(value).dtype.kind in "iuf":
            array = np.asarray(value)
            found[name] = array.item() if array.size == 1 else array.ravel().tolist()
    return found


def _slices(box: list[list[int]]) -> tuple[slice, ...]:
    return tuple(slice(*edges) for edges in box)


# -- HDF5, netCDF-4 and MATLAB 7.3 -----------------------------------------------------------------


def _open_hdf5(path: str) -> Any:
    import h5py  # noqa: PLC0415

    return h5py.File(path, "r", locking=False)


def list_hdf5(path: str) -> Reply:
    """Describe all arrays of a file: name, shape, type, chunk, axes and attributes.

    An array that is one number without axes counts as an attribute of its group, too.
    """
    import h5py  # noqa: PLC0415

    arrays: list[dict[str, Any]] = []
    with _open_hdf5(path) as file:
        groups = {"": _hdf5_attributes(file)}
        for name, found in _walk_hdf5(file):
            if found is None:
                arrays.append({"name": name, "refused": "a link"})
            elif isinstance(found, h5py.Group):
                groups[name] = _hdf5_attributes(found)
            else:
                known, about = _hdf5_attributes(found), _described_hdf5(found)
                if not str(known.get("NAME", "")).startswith(_NO_VARIABLE):
                    arrays.append({"name": name, "attributes": known, **about})
                if "value" in about:
                    group, _, own_name = name.rpartition("/")
                    groups[group].setdefault(own_name, about["value"])
    return {"arrays": arrays, "groups": groups}, []


def _walk_hdf5(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name of each object in a group, and the object; None for a link, never followed."""
    import h5py  # noqa: PLC0415

    groups, n_links = [(group, "")], 0
    while groups:
        group, prefix = groups.pop(0)
        for key in group:
            n_links += 1
            most = f"up to {MOST_LINKS:,}: split the file"
            require("arrays of the file", n_links, n_links <= MOST_LINKS, most)
            name = prefix + key.encode(errors="surrogateescape").decode("utf-8", "replace")
            if name.startswith("#"):  # the contents of MATLAB's cells
                continue
            if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                yield name, None
                continue
            found = group.get(key)
            if isinstance(found, h5py.Group) and name.count("/") < MOST_DEPTH:
                groups.append((found, name + "/"))
            if isinstance(found, h5py.Group | h5py.Dataset):
                yield name, found


def _described_hdf5(array: Any) -> dict[str, Any]:
    import h5py  # noqa: PLC0415

    try:
        _require_inside(array.id)
        if h5py.check_ref_dtype(array.dtype) is not None:
            return {"refused": "references", "references": array.shape}
        _require_numbers(array.dtype)
        return {
            "shape": array.shape or (),
            "type": array.dtype.newbyteorder("=").str,
            "chunk": array.chunks,
            "axes": _axes(array),
            **({"value": array[()].item()} if array.shape == () else {}),
        }
    except (ValueError, TypeError, RuntimeError, KeyError, OSError) as error:
        return {"refused": str(error)}


def _require_inside(array: Any) -> None:
    """Raise ``ValueError`` if an array lies partly in other files, before anything opens them."""
    from h5py import h5d  # noqa: PLC0415

    if not isinstance(array, h5d.DatasetID):
        raise ValueError("no array")
    layout = array.get_create_plist().get_layout()
    if layout == h5d.VIRTUAL:
        raise ValueError("a virtual array")
    if layout != h5d.CHUNKED and array.get_create_plist().get_external_count():
        raise ValueError("an array kept in other files")


def _axes(array: Any) -> list[str | None]:
    """Return the names of the axes, from scales or labels."""
    if array.is_scale and array.ndim == 1:
        names = [array.name]
    else:
        names = [axis[0].name if len(axis) else axis.label for axis in array.dims]
    return [(name or "").rpartition("/")[2] or None for name in names]


def _hdf5_attributes(place: Any) -> dict[str, Any]:
    """Return attributes that are numbers or text; one that is too long becomes a remark."""
    known: dict[str, Any] = {}
    for name in place.attrs:
        try:
            length = place.attrs.get_id(name).get_space().get_simple_extent_npoints()
            if length > MOST_IN_ATTRIBUTE:
                known[name] = f"{length:,} values, more than {MOST_IN_ATTRIBUTE:,}"
            elif name not in _NETCDF_ATTRIBUTES:
                known[name] = place.attrs[name]
        except (OSError, TypeError, ValueError):  # of a type that is neither number nor text
            continue
    return _plain(known)


def read_hdf5(path: str, name: str, box: list[list[int]]) -> Reply:
    """Read the numbers in a box of an array."""
    with _open_hdf5(path) as file:
        _require_inside(file[name].id)
        return {}, [file[name][_slices(box)]]


def read_cells(path: str, name: str, most_values: int) -> Reply:
    """Read the vectors that the cells of a MATLAB cell array refer to, and their sizes."""
    import h5py  # noqa: PLC0415
    from h5py import h5o, h5r  # noqa: PLC0415

    with _open_hdf5(path) as file:
        array = h5o.open(file.id, name.encode())
        _require_inside(array)
        n_cells = array.get_space().get_simple_extent_npoints()
        require(f"cells of {name}", n_cells, 0 < n_cells <= most_values, f"up to {most_values:,}")
        references = np.empty(array.shape, h5py.ref_dtype)
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, references)
        values, n_left = [], most_values
        for k, reference in enumerate(references.ravel().tolist()):
            try:
                values.append(_vector(h5r.dereference(reference, file.id), n_left))
            except ValueError as error:
                # MATLAB's first axis is HDF5's last.
                place = tuple(int(n) for n in np.unravel_index(k, array.shape)[::-1])
                raise Refused(f"{name} in pixel {place} = {error}") from error
            n_left -= values[-1].size
    return {}, _joined(values)


def _joined(vectors: list[Any]) -> list[Any]:
    """Return the values of all cells one after the other, and the size of each cell."""
    filled = [vector for vector in vectors if vector.size] or vectors[:1]
    sizes = np.array([vector.size for vector in vectors], np.int64)
    return [np.concatenate(filled, axis=None), sizes]


def _vector(array: Any, most: int) -> Any:
    """Read the numbers of one cell."""
    import h5py  # noqa: PLC0415
    from h5py import h5a  # noqa: PLC0415

    try:
        _require_inside(array)
        dtype = array.dtype
        _require_numbers(dtype)
        if h5a.exists(array, b"MATLAB_int_decode"):
            raise ValueError("text or logical")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{error} is not accepted: give real numbers.") from error
    if h5a.exists(array, b"MATLAB_empty"):
        return np.empty(0, dtype)
    shape = array.shape
    n_values = math.prod(shape)
    if n_values != max(shape, default=1):
        raise ValueError(f"array of shape {shape[::-1]} is not accepted: give a vector.")
    if n_values > most:
        raise ValueError(
            f"{n_values:,} photons is not accepted: give {most:,}, the rest of the limit."
        )
    values = np.empty(n_values, dtype)
    if n_values:
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, values.reshape(shape))
    return values


# -- Zarr ------------------------------------------------------------------------------------------


def _open_zarr(folder: Path) -> Any:
    import zarr  # noqa: PLC0415
    from numcodecs import blosc, registry  # noqa: PLC0415

    # Codecs outside the list, above all pickle, no longer exist in this process.
    registry.entries.clear()
    for name in set(registry.codec_registry) - _ZARR_CODECS:
        del registry.codec_registry[name]
    blosc.Blosc.decode = _decode_blosc
    zarr.config.set({"threading.max_workers": 1, "async.concurrency": 2})
    is_new = (folder / "zarr.json").exists()
    return zarr.open(folder, mode="r", zarr_format=3 if is_new else 2, use_consolidated=False)


def _decode_blosc(_: Any, data: Any, out: Any = None) -> Any:
    """Decode a Blosc chunk of the size that its header gives: numcodecs reads on past its end."""
    from numcodecs import blosc  # noqa: PLC0415

    data = np.frombuffer(data, np.uint8)
    packed = int.from_bytes(data[12:16].tobytes(), "little")
    if packed != data.size:
        raise ValueError(f"a Blosc chunk of {data.size} bytes claims {packed}")
    return blosc.decompress(data, out)


def list_zarr(path: str) -> Reply:
    """Describe the arrays of a Zarr directory, with its folders and files that must not change.

    An array that is one number without axes counts as an attribute of its group, too.
    """
    root, n_bytes = Path(path), 0
    groups: dict[str, dict[str, Any]] = {}
    arrays: list[dict[str, Any]] = []

    def version(place: Path) -> tuple[str, int, int]:
        status = place.stat()
        return place.relative_to(root).as_posix(), status.st_size, status.st_mtime_ns

    for folder, files in _walk_zarr(root):
        described = [folder / name for name in _ZARR_MARKS if name in files]
        inside = folder.relative_to(root).as_posix().removeprefix(".")
        if not described:
            if arrays and folder.is_relative_to(root / arrays[-1]["folders"][0][0]):
                arrays[-1]["folders"].append(version(folder))
            continue
        metadata = [folder / name for name in (*_ZARR_MARKS, ".zattrs") if name in files]
        n_bytes += sum(file.stat().st_size for file in metadata)
        most = f"up to {MOST_METADATA_BYTES:,}"
        require("bytes of metadata", n_bytes, n_bytes <= MOST_METADATA_BYTES, most)
        mixed = "zarr.json" in files and bool(files & {".zarray", ".zgroup"})
        require(f"metadata of {inside or root.name}", "versions 2 and 3", not mixed, "one of them")
        place = {"version": version(described[0]), "folders": [version(folder)]}
        one = _described_zarr(folder)
        if "group" in one:
            groups[inside] = one["group"]
        else:
            arrays.append({"name": inside or root.name, **place, **one})
        if "value" in one:
            group, _, own_name = inside.rpartition("/")
            groups.setdefault(group, {}).setdefault(own_name, one["value"])
    require("arrays", 0, bool(arrays), "a directory that holds some, of Zarr version 2 or 3")
    return {"arrays": arrays, "groups": groups}, []


def _walk_zarr(root: Path) -> Iterator[tuple[Path, set[str]]]:
    """Yield every directory, depth first, with the names of its files; refuse links and pipes."""
    folders = [root]
    while folders:
        folder = folders.pop()
        files = set()
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name, reverse=True):
                if entry.is_dir(follow_symlinks=False):
                    folders.append(folder / entry.name)
                    continue
                inside = Path(entry.path).relative_to(root).as_posix()
                plain = entry.is_file(follow_symlinks=False)
                require("a file of the directory", inside, plain, "plain files, no links")
                files.add(entry.name)
        yield folder, files


def _described_zarr(folder: Path) -> dict[str, Any]:
    """Describe the array in a folder, or give the attributes of a group."""
    known: dict[str, Any] = {}
    try:
        found = _open_zarr(folder)
        known = _plain(found.attrs.asdict())
        if not hasattr(found, "shape"):
            return {"group": known}
        _require_numbers(found.dtype)
        known |= _missing(found, known)
        is_old = found.metadata.zarr_format == 2
        axes = found.attrs.get("_ARRAY_DIMENSIONS") if is_old else found.metadata.dimension_names
        named = isinstance(axes, list | tuple) and len(axes) == found.ndim
        return {
            "attributes": known,
            "axes": [axis if isinstance(axis, str) and named else None for axis in axes or ()],
            "shape": found.shape,
            "type": found.dtype.newbyteorder("=").str,
            "chunk": found.shards or found.chunks,
            **({"value": found[()].item()} if _is_stored_number(folder, found) else {}),
        }
    except Exception as error:  # undocumented: any
        return {"attributes": known, "refused": f"{type(error).__name__}: {str(error)[:500]}"}


def _is_stored_number(folder: Path, array: Any) -> bool:
    """Whether an array is one number without axes, and not merely its fill value."""
    return not array.shape and (folder / str(array.metadata.encode_chunk_key(()))).exists()


def _missing(array: Any, known: dict[str, Any]) -> dict[str, float]:
    """Return the value that marks missing numbers, as xarray stores it.

    In version 2 it is the fill value unless that is 0; in version 3 an attribute, that of floats
    the base64 of a double.
    """
    if array.metadata.zarr_format == 2:
        return {"_FillValue": array.fill_value.item()} if array.fill_value else {}
    value = known.get("_FillValue")
    if not isinstance(value, str):
        return {}
    (number,) = np.frombuffer(base64.b64decode(value, validate=True), "<f8").tolist()
    return {"_FillValue": number}


def read_zarr(path: str, name: str, box: list[list[int]]) -> Reply:
    """Read the numbers in a box of the array in a folder, and whether a chunk is absent."""
    folder = Path(path) / name if (Path(path) / name).is_dir() else Path(path)
    array = _open_zarr(folder)
    found = np.asarray(array[_slices(box)])
    steps = array.shards or array.chunks
    touched = (
        sorted({k // step for k in range(*edges)}) for edges, step in zip(box, steps, strict=True)
    )
    absent = any(
        not (folder / array.metadata.encode_chunk_key(index)).exists()
        for index in product(*touched)
    )
    return {"absent": absent}, [found]


# -- SciPy: classic netCDF, and MATLAB before version 7.3 ------------------------------------------


def _open_netcdf3(path: str) -> Any:
    from scipy.io import netcdf_file  # noqa: PLC0415

    return netcdf_file(path, mmap=True)


def list_netcdf3(path: str) -> Reply:
    """Describe all variables of a file.

    A variable that is one number without axes counts as an attribute of the file, too.
    """
    file, arrays = _open_netcdf3(path), []
    known = _plain(file._attributes)
    for name, variable in file.variables.items():
        one = {"name": name, "attributes": _plain(variable._attributes)}
        if variable.data.dtype.kind in "iuf" and variable.data.size:
            dtype = variable.data.dtype.newbyteorder("=")
            one |= {"shape": variable.data.shape, "type": dtype.str, "chunk": None}
            one["axes"] = list(variable.dimensions)
            if variable.data.shape == ():
                known.setdefault(name, variable.data.item())
        else:
            one["refused"] = "no numbers"
        arrays.append(one)
    return {"arrays": arrays, "groups": {"": known}}, []


def read_netcdf3(path: str, name: str, box: list[list[int]]) -> Reply:
    """Read the numbers in a box of a variable."""
    return {}, [_open_netcdf3(path).variables[name].data[_slices(box)]]


def list_mat5(path: str) -> Reply:
    """List name, shape and class of the variables of a MATLAB file before version 7.3."""
    from scipy.io import whosmat  # noqa: PLC0415

    return {"variables": whosmat(path)}, []


def read_mat5(path: str, name: str) -> Reply:
    """Read an array, the vectors and sizes of cells, or the parts of a sparse matrix."""
    from scipy.io import loadmat  # noqa: PLC0415
    from scipy.sparse import issparse  # noqa: PLC0415

    found = loadmat(path, variable_names=[name])[name]
    if issparse(found):
        arrays = [found.data, found.indices, found.indptr]
    else:
        arrays = found.ravel().tolist() if found.dtype == object else [found]
    numeric = all(isinstance(each, np.ndarray) and each.dtype.kind in "iuf" for each in arrays)
    other = "a nested, complex or non-numeric array"
    require(f"content of {name}", other, numeric, "real numbers, a vector in each cell")
    if issparse(found) or found.dtype != object:
        return {}, arrays
    for k, vector in enumerate(arrays):
        if vector.size > max(vector.shape):
            odd = f"{name} in pixel {divmod(k, found.shape[1])} = array of shape {vector.shape}"
            raise Refused(f"{odd} is not accepted: give a vector.")
    return {}, _joined(arrays)


# -- instruments -----------------------------------------------------------------------------------


def list_sdt(path: str) -> Reply:
    """List the types of the blocks of a Becker & Hickl file."""
    from sdtfile import SdtFile  # noqa: PLC0415

    with SdtFile(path) as file:
        return {"types": [int(header.block_type) for header in file.block_headers]}, []


def read_sdt(path: str, block: int) -> Reply:
    """Read the counts and the times of a block."""
    from sdtfile import SdtFile  # noqa: PLC0415

    with SdtFile(path) as file:
        data, claimed = file.data[block], int(file.block_headers[block].block_length)
        if data.nbytes <= claimed - data.itemsize:
            raise ValueError(f"block {block} has {data.nbytes:,} of {claimed:,} bytes")
        return {}, [data, file.times[block]]


def list_ptu(path: str) -> Reply:
    """List the tags of a PicoQuant file that are numbers, and where its records begin."""
    from ptufile import PtuFile  # noqa: PLC0415

    with PtuFile(path, trimdims="T") as file:
        tags = {name: value for name, value in file.tags.items() if isinstance(value, int | float)}
        return {"tags": tags, "record_offset": int(file.record_offset)}, []


def read_ptu(path: str, channel: int | None, shape: list[int], span: list[int] | None) -> Reply:
    """Read the histograms (row, col, bin) of a channel, or of all, summed over a span of frames.

    There are no arrays if the file has no such channel or frames.
    """
    from ptufile import PtuFile  # noqa: PLC0415

    with PtuFile(path, trimdims="T") as file:
        channels = [int(one) for one in file.active_channels]
        n_frames = int(file.shape[0])
        known = {"channels": channels, "n_frames": n_frames}
        first, last = span or (0, n_frames - 1)
        if channel not in (None, *channels) or not channels or last >= n_frames:
            return known, []
        rows, cols, n_bins = shape
        n_bins = min(n_bins, int(file.number_bins_max))
        image = file.decode_image(
            (slice(first, last + 1, -1), ...),  # a step of -1 sums
            channel=-1 if channel is None else channel,
            dtime=n_bins,
            dtype=np.uint16 if file.number_records < 2**16 else np.uint32,  # no bin holds more
        )
        return known, [image.reshape(rows, cols, n_bins)]


def read_tmf8820(path: str, variable: str | None, span: list[int] | None) -> Reply:
    """Read histograms, plane distances and, if there are such, other parts of a list of records.

    Parameters
    ----------
    variable : str or None
        Name of one record, such as ``"record 17"``.
    span : list of int or None
        First and last record, None for all; without arrays if they are not in the file.
    """
    records = json.loads(Path(path).read_bytes(), parse_constant=_refuse_constant)
    named = _named_records("the file", records)
    last = f"None for all, or 'record 0' to 'record {len(named) - 1}'"
    require("variable", variable, variable is None or variable in named, last)
    chosen = _within(named, span) if variable is None else {variable: named[variable]}
    for name, record in chosen.items():
        what = "a record with the histograms of a TMF8820, hists"
        require(name, type(record).__name__, "hists" in record, what)
    if not chosen:
        return {"n_records": len(named), "parts": []}, []
    distances_m = [
        _metres(record.get("dist_to_plane"), f"dist_to_plane of {name}")
        for name, record in chosen.items()
    ]
    parts = {"counts": _stacked(chosen, "hists", 2), "distances_m": np.array(distances_m, float)}
    if any("reference_hist" in record for record in chosen.values()):
        parts["reference"] = _stacked(chosen, "reference_hist", 1)
    reported_m = [_depths_m(record, parts["counts"].shape[1]) for record in chosen.values()]
    if None not in reported_m:
        parts["reported_m"] = np.array(reported_m, float)
    return {"n_records": len(named), "parts": list(parts)}, list(parts.values())


def _depths_m(record: dict[str, Any], n_zones: int) -> list[float] | None:
    """Return the distance of the first target that the sensor found in each zone, in metres."""
    match record.get("distances"):
        case [{"depths_1": [*depths_mm], "confs_1": [*confidences]}, *_] if (
            len(depths_mm) == len(confidences) == n_zones
        ):
            return [
                _metres(depth, "depths_1", 1e-3) if confidence else math.nan
                for depth, confidence in zip(depths_mm, confidences, strict=True)
            ]
    return None


def read_tmf8829(path: str, variable: str | None, span: list[int] | None) -> Reply:
    """Read histograms and, if there are such, other parts of the records of a log.

    Parameters
    ----------
    variable : str or None
        Name of the histograms; without arrays if it is unknown, or if it is None and there are
        several or none.
    span : list of int or None
        First and last record, None for all; without arrays if they are not in the file.
    """
    log = json.loads(Path(path).read_bytes(), parse_constant=_refuse_constant)
    require("the file", type(log).__name__, isinstance(log, dict), "the log of a TMF8829")
    named, settings = _named_records("Result_Set", log.get("Result_Set")), log.get("configuration")
    known: dict[str, Any] = {"n_records": len(named), "parts": []}
    known["histograms"] = [name for name in _TMF8829_REFERENCES if name in named["record 0"]]
    settings = settings if isinstance(settings, dict) else {}
    known["settings"] = {name: value for name, value in settings.items() if type(value) is int}
    chosen = _within(named, span)
    wanted = known["histograms"] if variable is None else [variable]
    if not chosen or len(wanted) != 1 or wanted[0] not in known["histograms"]:
        return known, []
    name, reference = wanted[0], _TMF8829_REFERENCES[wanted[0]]
    plain = {
        record: {
            name: _bins(each.get(name)),
            reference: _bins(each.get(reference)),
            "results": _results_m(each.get("results")),
        }
        for record, each in chosen.items()
    }
    parts = {"counts": _stacked(plain, name, 3)}
    if any(reference in each for each in chosen.values()):
        parts["reference"] = _stacked(plain, reference, 2)
    if all("results" in each for each in chosen.values()):
        parts["reported_m"] = _stacked(plain, "results", 2)
    return known | {"parts": list(parts)}, list(parts.values())


def _bins(histograms: Any) -> Any:
    """Return nested lists of histograms with their counts in place of ``{"bin": counts}``."""
    if isinstance(histograms, list):
        return [_bins(each) for each in histograms]
    return histograms.get("bin") if isinstance(histograms, dict) else histograms


def _results_m(results: Any) -> Any:
    """Return the distance of the peak of highest SNR of each pixel in metres, NaN without one."""
    if isinstance(results, list):
        return [_results_m(each) for each in results]
    peaks = results.get("peaks", ()) if isinstance(results, dict) else ()
    best: dict[str, Any] = max(peaks, key=lambda peak: peak.get("snr", 0), default={})
    return _metres(best.get("distance"), "distance of a peak", 1e-3) or math.nan


def _named_records(what: str, records: Any) -> dict[str, dict[str, Any]]:
    """Return records by their names."""
    require(what, type(records).__name__, isinstance(records, list), "a list of records")
    require("records", len(records), len(records) > 0, "at least one")
    named = {f"record {k}": record for k, record in enumerate(records)}
    for name, record in named.items():
        require(name, type(record).__name__, isinstance(record, dict), "a record with histograms")
    return named


def _within(named: dict[str, dict[str, Any]], span: list[int] | None) -> dict[str, dict[str, Any]]:
    """Return the records of a span."""
    first, last = span or (0, len(named) - 1)
    return dict(list(named.items())[first : last + 1])


def _metres(value: Any, name: str, unit_m: float = 1.0) -> float:
    """Return a distance in metres; NaN for None."""
    plain = value is None or (isinstance(value, int | float) and 0 <= value < math.inf)
    require(name, value, plain, "a distance, or null")
    return math.nan if value is None else value * unit_m


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


def _stacked(records: dict[str, Any], field: str, n_axes: int) -> Any:
    """Return lists of numbers, the same field of each record, as one array (record, ...)."""
    found: list[Any] = []
    for record, known in records.items():
        name, value = f"{field} of {record}", known.get(field)
        # As objects first: one long text would make room for itself in place of every number.
        array = np.array(value, object)
        if {*map(type, array.flat)} <= {int, float}:
            array = np.array(value)
        fits = array.ndim == n_axes and array.size > 0 and array.dtype.kind in "iuf"
        what = f"numbers in {n_axes} axes, as many in each list"
        require(name, f"{array.dtype} array of shape {array.shape}", fits, what)
        found.append(array)
        same = array.shape == found[0].shape
        require(f"shape of {name}", array.shape, same, f"{found[0].shape}, that of the first")
    return np.stack(found)


# -- scenes ----------------------------------------------------------------------------------------


def read_depths(path: str, kind: str, most_pixels: int) -> Reply:
    """Read a picture of 16-bit numbers or 32-bit floats."""
    from PIL import Image  # noqa: PLC0415

    with Image.open(path, formats=[kind]) as image:
        return {}, [_numbers(image, most_pixels, _DEPTH_MODES)]


def _numbers(image: Any, most_pixels: int, modes: Sequence[str]) -> np.ndarray[Any, Any]:
    n_pixels, most = image.width * image.height, f"up to {most_pixels:,}"
    require("pixels of the image", n_pixels, n_pixels <= most_pixels, most)
    what = "one 16-bit number or 32-bit float for each"
    require("kind of pixels", image.mode, image.mode in modes, what)
    return np.asarray(image)


def list_tiff(path: str) -> Reply:
    """List name and shape of the pages of a TIFF."""
    from PIL import Image  # noqa: PLC0415

    image: Any
    with Image.open(path, formats=["TIFF"]) as image:
        most = f"up to {MOST_LINKS:,}"
        require("pages of the image", image.n_frames, image.n_frames <= MOST_LINKS, most)
        pages = []
        for page in range(image.n_frames):
            image.seek(page)
            name = str(image.tag_v2.get(_PAGE_NAME, ""))[: MOST_METADATA_BYTES // MOST_LINKS]
            pages.append((name, (image.height, image.width)))
    return {"pages": pages}, []


def read_tiff(path: str, page: int, most_pixels: int) -> Reply:
    """Read a page of whole numbers or 32-bit floats."""
    from PIL import Image  # noqa: PLC0415

    with Image.open(path, formats=["TIFF"]) as image:
        image.seek(page)
        return {}, [_numbers(image, most_pixels, (*_DEPTH_MODES, "L", "I"))]


def read_mesh(path: str, suffix: str, most_faces: int) -> Reply:
    """Read vertices (vertex, 3) and faces (face, 3) of all parts of a mesh, each in its place."""
    import trimesh  # noqa: PLC0415

    # From memory and without a resolver of names, a loader cannot open another file.
    data = Path(path).read_bytes()
    if b"\0" not in data:  # text: do not guess its encoding
        data = data.decode(errors="replace").encode()
    scene = trimesh.load_scene(
        trimesh.util.wrap_as_stream(data),
        file_type=suffix[1:],
        process=False,
        skip_materials=True,
    )
    vertices, faces, n_vertices, n_faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0, 0
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        part = scene.geometry[name]
        if not len(getattr(part, "faces", ())):
            continue
        n_faces += len(part.faces)
        require("faces of the mesh", n_faces, n_faces <= most_faces, f"1 to {most_faces:,}")
        placed, triangles = _placed(part, np.asarray(matrix, float))
        vertices.append(placed)
        faces.append(triangles + n_vertices)
        n_vertices += len(placed)
    require("faces of the mesh", n_faces, n_faces > 0, f"1 to {most_faces:,}")
    return {}, [np.concatenate(vertices), np.concatenate(faces)]


def _placed(part: Any, matrix: np.ndarray[Any, Any]) -> tuple[Any, Any]:
    """Move a part by a (4, 4) matrix; leave out vertices that no face has."""
    vertices, faces = np.asarray(part.vertices, float), np.asarray(part.faces, np.int64)
    lowest, highest, last = int(faces.min()), int(faces.max()), len(vertices) - 1
    inside = lowest >= 0 and highest <= last
    require("vertices of a face", (lowest, highest), inside, f"from 0 to {last}, the last one")
    is_used = np.zeros(len(vertices), bool)
    is_used[faces] = True
    vertices = vertices[is_used]
    n_odd = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
    require("vertices without a place", n_odd, n_odd == 0, "finite coordinates")
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], (np.cumsum(is_used) - 1)[faces]


# -- the process -----------------------------------------------------------------------------------

TASKS: dict[str, Callable[..., Reply]] = {
    name: task for name, task in globals().items() if name.startswith(("list_", "read_"))
}


def limit(memory_bytes: int, seconds: int) -> None:
    """Limit what this process may take from now on; on Windows only the caller limits the time."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    limits = {
        resource.RLIMIT_AS: memory_bytes,
        resource.RLIMIT_CPU: math.ceil(used.ru_utime + used.ru_stime) + seconds,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_CORE: 0,
    }
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (least, hard))


def reply(line: bytes, target: BinaryIO) -> None:
    """Do the task of a line, and write the reply."""
    arrays: list[Any] = []
    try:
        request = json.loads(line)
        limit(request.pop("memory_bytes"), request.pop("seconds"))
        most_bytes, what = request.pop("most_bytes"), request.get("name", "the file")
        found, arrays = TASKS[request.pop("task")](**request)
        n_bytes = max((array.nbytes for array in arrays), default=0)
        smaller = f"a smaller file: at most {most_bytes:,} bytes are read"
        require(f"bytes of {what}", n_bytes, n_bytes <= most_bytes, smaller)
    except Refused as error:
        found, arrays = {"refused": str(error)}, []
    except MemoryError:
        found, arrays = {"error": "more memory than it may have", "exhausted": True}, []
    except ModuleNotFoundError as error:
        found = {"missing": f"{type(error).__name__}: {error}"}
    except Exception as error:  # undocumented: any
        found = {"error": f"{type(error).__name__}: {str(error)[:2000]}"}
    arrays = [np.ascontiguousarray(array, array.dtype.newbyteorder("=")) for array in arrays]
    text = json.dumps({"found": found, "arrays": [(one.dtype.str, one.shape) for one in arrays]})
    if len(text) > MOST_REPLY_CHARACTERS:
        refused = {"refused": "attributes = too many: give fewer."}
        text, arrays = json.dumps({"found": refused, "arrays": []}), []
    target.write(text.encode() + b"\n")
    for array in arrays:
        target.write(array.reshape(-1).view(np.uint8).data)
    target.flush()


def main() -> None:
    """Serve requests until the input ends, or none has come for a while."""
    warnings.simplefilter("ignore")
    # What the libraries print goes nowhere, not among the replies.
    target = os.fdopen(os.dup(1), "wb", buffering=2**16)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    while True:
        if os.name == "posix":
            import select  # noqa: PLC0415

            if not select.select([0], [], [], IDLE_SECONDS)[0]:
                return
        line = sys.stdin.buffer.readline()
        if not line:
            return
        reply(line, target)


if __name__ == "__main__":
    main()
