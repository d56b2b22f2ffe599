"""Read files with the libraries of their formats, in a process of limited memory and time.

`core.io.readers.isolation` starts this script. The libraries are not robust to malformed files:
some keep them busy forever, others crash them. The script imports nothing of the package.

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
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

MOST_LINKS = 10_000
MOST_DEPTH = 10
MOST_IN_ATTRIBUTE = 2**20
MOST_REPLY_CHARACTERS = 2**24
IDLE_SECONDS = 60
_OF_NETCDF = ("CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties")
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
_ZARR_CODECS = {"zlib", "gzip", "zstd", "blosc", "shuffle", "fletcher32", "crc32c", "delta", "lz4"}


class Refused(ValueError):
    """The file holds no capture; the message is a sentence."""


Reply = tuple[dict[str, Any], list[Any]]
"""A description in JSON, and arrays."""


def list_hdf5(path: str) -> Reply:
    """Describe all arrays of a file: name, shape, type, chunk, axes and attributes."""
    import h5py  # noqa: PLC0415

    arrays: list[dict[str, Any]] = []
    with _open_hdf5(path) as file:
        groups = {"": _attributes(file)}
        for name, found in _walk(file):
            if isinstance(found, str):
                arrays.append({"name": name, "refused": found})
            elif isinstance(found, h5py.Group):
                groups[name] = _attributes(found)
            else:
                known = _attributes(found)
                if not str(known.get("NAME", "")).startswith(_NO_VARIABLE):
                    arrays.append({"name": name, "attributes": known, **_described(found)})
    return {"arrays": arrays, "groups": groups}, []


def _open_hdf5(path: str) -> Any:
    import h5py  # noqa: PLC0415

    return h5py.File(path, "r", locking=False)


def _walk(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name of each object in a group, and the object or why it is refused."""
    import h5py  # noqa: PLC0415

    waiting, seen = [(group, "")], 0
    while waiting:
        group, prefix = waiting.pop(0)
        for key in group:
            seen += 1
            if seen > MOST_LINKS:
                raise Refused(f"arrays of the file = more than {MOST_LINKS:,}: split the file.")
            name = prefix + key.encode(errors="surrogateescape").decode("utf-8", "replace")
            if name.startswith("#"):  # the contents of MATLAB's cells
                continue
            link = group.get(key, getlink=True)
            if not isinstance(link, h5py.HardLink):
                external = isinstance(link, h5py.ExternalLink)
                yield name, "an external link" if external else "a soft link"
                continue
            found = group.get(key)
            if isinstance(found, h5py.Group) and name.count("/") < MOST_DEPTH:
                waiting.append((found, name + "/"))
            if isinstance(found, h5py.Group | h5py.Dataset):
                yield name, found


def _described(array: Any) -> dict[str, Any]:
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
        }
    except (ValueError, TypeError, RuntimeError, KeyError) as error:
        return {"refused": str(error)}


def _require_inside(array: Any) -> None:
    """Raise ``ValueError`` if an array lies partly in other files, before anything opens them."""
    from h5py import h5d  # noqa: PLC0415

    if not isinstance(array, h5d.DatasetID):
        raise ValueError("no array")
    created = array.get_create_plist()
    if created.get_layout() == h5d.VIRTUAL:
        raise ValueError("a virtual array")
    if created.get_layout() != h5d.CHUNKED and created.get_external_count():
        raise ValueError("an array kept in other files")


def _require_numbers(dtype: np.dtype[Any]) -> None:
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise ValueError("no numbers")


def _axes(array: Any) -> list[str | None]:
    """Names of the axes where scales or labels give any."""
    if array.is_scale and array.ndim == 1:
        return [_last(array.name)]
    names = []
    for axis in array.dims:
        scale = axis[0].name if len(axis) else axis.label
        names.append(_last(scale) or None)
    return names


def _last(name: str | None) -> str:
    return (name or "").rpartition("/")[2]


def _attributes(place: Any) -> dict[str, Any]:
    """Attributes that are numbers or text; one that is too long becomes a text saying so."""
    known: dict[str, Any] = {}
    for name in place.attrs:
        try:
            length = place.attrs.get_id(name).get_space().get_simple_extent_npoints()
            if length > MOST_IN_ATTRIBUTE:
                known[name] = f"{length:,} values, more than {MOST_IN_ATTRIBUTE:,}"
            elif name not in _OF_NETCDF or name == "NAME":
                known[name] = place.attrs[name]
        except (OSError, TypeError, ValueError):  # of a type that is neither number nor text
            continue
    return _plain(known)


def _plain(known: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in known.items():
        if isinstance(value, bytes):
            found[name] = value.decode("utf-8", "replace")
        elif isinstance(value, str):
            found[name] = value
        elif not isinstance(value, bool | dict) and np.asarray(value).dtype.kind in "iuf":
            array = np.asarray(value)
            found[name] = array.item() if array.size == 1 else array.ravel().tolist()
    return found


def read_hdf5(path: str, name: str, box: list[list[int]]) -> Reply:
    """Read the numbers in a box of an array."""
    with _open_hdf5(path) as file:
        _require_inside(file[name].id)
        return {}, [file[name][tuple(slice(*edges) for edges in box)]]


def read_cells(path: str, name: str, most_values: int) -> Reply:
    """Read the vectors that the cells of a MATLAB cell array refer to, and their sizes."""
    import h5py  # noqa: PLC0415
    from h5py import h5o, h5r  # noqa: PLC0415

    with _open_hdf5(path) as file:
        array = h5o.open(file.id, name.encode())
        _require_inside(array)
        n_cells = array.get_space().get_simple_extent_npoints()
        if not 0 < n_cells <= most_values:
            raise Refused(f"cells of {name} = {n_cells:,}: give up to {most_values:,}.")
        references = np.empty(array.shape, h5py.ref_dtype)
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, references)
        values, sizes, total = [], np.zeros(n_cells, np.int64), 0
        for k, reference in enumerate(references.ravel().tolist()):
            try:
                vector = _vector(h5r.dereference(reference, file.id), most_values - total)
            except ValueError as error:
                # MATLAB's first axis is HDF5's last.
                place = tuple(int(n) for n in np.unravel_index(k, array.shape)[::-1])
                raise Refused(f"{name} in pixel {place} = {error}") from error
            sizes[k] = vector.size
            total += vector.size
            values.append(vector)
        filled = [vector for vector in values if vector.size] or values[:1]
        return {}, [np.concatenate(filled), sizes]


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
        raise ValueError(f"{n_values:,} photons, too many with those before: give fewer.")
    values = np.empty(n_values, dtype)
    if n_values:
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, values.reshape(shape))
    return values


def _open_zarr(path: str) -> Any:
    import zarr  # noqa: PLC0415
    from numcodecs import blosc, registry  # noqa: PLC0415

    # Codecs outside the list, above all pickle, no longer exist in this process.
    registry.entries.clear()
    for name in set(registry.codec_registry) - _ZARR_CODECS:
        del registry.codec_registry[name]
    blosc.Blosc.decode = _decode_blosc
    zarr.config.set({"threading.max_workers": 1, "async.concurrency": 2})
    is_new = (Path(path) / "zarr.json").exists()
    return zarr.open_array(path, mode="r", zarr_format=3 if is_new else 2)


def _decode_blosc(_: Any, data: Any, out: Any = None) -> Any:
    """Decode a Blosc chunk of the size that its header gives: numcodecs reads on past its end."""
    from numcodecs import blosc  # noqa: PLC0415

    data = np.frombuffer(data, np.uint8)
    packed = int.from_bytes(data[12:16].tobytes(), "little")
    if packed != data.size:
        raise ValueError(f"a Blosc chunk of {data.size} bytes claims {packed}")
    return blosc.decompress(data, out)


def list_zarr(path: str, described_folders: list[str]) -> Reply:
    """Describe the arrays in some folders of a Zarr directory."""
    arrays, groups = [], {}
    for name in described_folders:
        folder = Path(path) / name
        try:
            attributes = folder / ".zattrs"
            if not (folder / "zarr.json").exists():
                is_array = (folder / ".zarray").exists()
                about = json.loads(attributes.read_bytes()) if attributes.exists() else {}
                axes = about.get("_ARRAY_DIMENSIONS")
            else:
                metadata = json.loads((folder / "zarr.json").read_bytes())
                is_array = metadata.get("node_type") == "array"
                about = metadata.get("attributes") or {}
                axes = metadata.get("dimension_names")
            known = _plain(about)
            if not is_array:
                groups[name] = known
                continue
            one: dict[str, Any] = {"name": name or Path(path).name, "attributes": known}
        except (ValueError, AttributeError, RecursionError) as error:
            raise Refused(
                f"metadata of {name!r} cannot be read ({error}): copy it again."
            ) from error
        try:
            array = _open_zarr(str(folder))
            _require_numbers(array.dtype)
            known |= _missing(array, known)
            named = isinstance(axes, list) and len(axes) == array.ndim
            one["axes"] = (
                [axis if isinstance(axis, str) else None for axis in axes if named] if axes else []
            )
            one |= {"shape": array.shape, "type": array.dtype.newbyteorder("=").str}
            one["chunk"] = array.shards or array.chunks
        except Exception as error:  # undocumented: any
            one["refused"] = f"{type(error).__name__}: {str(error)[:500]}"
        arrays.append(one)
    return {"arrays": arrays, "groups": groups}, []


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
    """Read the numbers in a box of the array in a folder; tell whether a chunk is absent."""
    folder = Path(path) / name if (Path(path) / name).is_dir() else Path(path)
    array = _open_zarr(str(folder))
    found = np.asarray(array[tuple(slice(*edges) for edges in box)])
    steps = array.shards or array.chunks
    touched = (
        sorted({k // step for k in range(*edges)}) for edges, step in zip(box, steps, strict=True)
    )
    absent = any(
        not (folder / array.metadata.encode_chunk_key(index)).exists()
        for index in product(*touched)
    )
    return {"absent": absent}, [found]


def _open_netcdf3(path: str) -> Any:
    from scipy.io import netcdf_file  # noqa: PLC0415

    return netcdf_file(path, mmap=True)


def list_netcdf3(path: str) -> Reply:
    """Describe all variables of a file."""
    file, arrays = _open_netcdf3(path), []
    for name, variable in file.variables.items():
        one = {"name": name, "attributes": _plain(variable._attributes)}
        if variable.data.dtype.kind in "iuf" and variable.data.size:
            dtype = variable.data.dtype.newbyteorder("=")
            one |= {"shape": variable.data.shape, "type": dtype.str, "chunk": None}
            one["axes"] = list(variable.dimensions)
        else:
            one["refused"] = "no numbers"
        arrays.append(one)
    return {"arrays": arrays, "groups": {"": _plain(file._attributes)}}, []


def read_netcdf3(path: str, name: str, box: list[list[int]]) -> Reply:
    """Read the numbers in a box of a variable."""
    data = _open_netcdf3(path).variables[name].data
    return {}, [data[tuple(slice(*edges) for edges in box)]]


def list_mat5(path: str) -> Reply:
    """List name, shape and class of the variables of a MATLAB file before version 7.3."""
    from scipy.io import whosmat  # noqa: PLC0415

    return {"variables": [(name, list(shape), kind) for name, shape, kind in whosmat(path)]}, []


def read_mat5(path: str, name: str) -> Reply:
    """Read an array, the vectors and sizes of cells, or the parts of a sparse matrix."""
    from scipy.io import loadmat  # noqa: PLC0415
    from scipy.sparse import issparse  # noqa: PLC0415

    found = loadmat(path, variable_names=[name])[name]
    if issparse(found):
        arrays = [found.data, found.indices, found.indptr]
    elif found.dtype == object:
        vectors = found.ravel().tolist()
        arrays = [vector for vector in vectors if isinstance(vector, np.ndarray)]
        arrays = arrays if len(arrays) == len(vectors) else [found]
    else:
        arrays = [found]
    if any(array.dtype.kind not in "iuf" for array in arrays):
        found = "'a nested, complex or non-numeric array' is not accepted"
        raise Refused(f"content of {name} = {found}: give real numbers, a vector in each cell.")
    if issparse(found) or found.dtype != object:
        return {}, arrays
    for k, vector in enumerate(arrays):
        if vector.size > max(vector.shape):
            place = divmod(k, found.shape[1])
            what = f"{name} in pixel {place} = array of shape {vector.shape}"
            raise Refused(f"{what} is not accepted: give a vector.")
    sizes = np.array([vector.size for vector in arrays], np.int64)
    return {}, [np.concatenate(arrays, axis=None), sizes]


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


def read_ptu(path: str, channel: int | None, shape: list[int]) -> Reply:
    """Read the histograms (row, col, bin) of a channel, or of all, summed over the frames."""
    from ptufile import PtuFile  # noqa: PLC0415

    with PtuFile(path, trimdims="T") as file:
        channels = [int(one) for one in file.active_channels]
        told = {"channels": channels, "n_frames": int(file.shape[0])}
        if not channels or channel not in (None, *channels):
            return told, []
        rows, cols, n_bins = shape
        n_bins = min(n_bins, int(file.number_bins_max))
        image = file.decode_image(
            frame=-1,
            channel=-1 if channel is None else channel,
            dtime=n_bins,
            dtype=np.uint16 if file.number_records < 2**16 else np.uint32,  # no bin holds more
        )
        return told, [image.reshape(rows, cols, n_bins)]


def read_mesh(path: str, suffix: str, most_faces: int) -> Reply:
    """Read vertices (vertex, 3) and faces (face, 3) of all parts of a mesh, each in its place."""
    import trimesh  # noqa: PLC0415

    # From memory and without a resolver of names, a loader cannot reach another file.
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
        if n_faces > most_faces:
            raise Refused(
                f"faces of the mesh = {n_faces} is not accepted: give 1 to {most_faces:,}."
            )
        placed, triangles = _placed(part, np.asarray(matrix, float))
        vertices.append(placed)
        faces.append(triangles + n_vertices)
        n_vertices += len(placed)
    return {}, [np.concatenate(vertices), np.concatenate(faces)]


def _placed(part: Any, matrix: np.ndarray[Any, Any]) -> tuple[Any, Any]:
    """Move a part by a (4, 4) matrix; leave out vertices that no face has."""
    vertices, faces = np.asarray(part.vertices, float), np.asarray(part.faces, np.int64)
    lowest, highest, last = int(faces.min()), int(faces.max()), len(vertices) - 1
    if lowest < 0 or highest > last:
        found = f"vertices of a face = {(lowest, highest)}"
        raise Refused(f"{found} is not accepted: give from 0 to {last}, the last one.")
    is_used = np.zeros(len(vertices), bool)
    is_used[faces] = True
    vertices = vertices[is_used]
    n_odd = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
    if n_odd:
        raise Refused(f"vertices at no place = {n_odd} is not accepted: give finite coordinates.")
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], (np.cumsum(is_used) - 1)[faces]


TASKS: dict[str, Callable[..., Reply]] = {
    task.__name__: task
    for task in (
        list_hdf5,
        read_hdf5,
        read_cells,
        list_zarr,
        read_zarr,
        list_netcdf3,
        read_netcdf3,
        list_mat5,
        read_mat5,
        list_sdt,
        read_sdt,
        list_ptu,
        read_ptu,
        read_mesh,
    )
}


def limit(memory_bytes: int, seconds: int) -> None:
    """Limit what this process may take from now on; on Windows only the caller limits the time."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    wanted = {
        resource.RLIMIT_AS: memory_bytes,
        resource.RLIMIT_CPU: math.ceil(used.ru_utime + used.ru_stime) + seconds,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_CORE: 0,
    }
    for kind, most in wanted.items():
        hard = resource.getrlimit(kind)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (least, hard))


def reply(line: bytes, target: BinaryIO) -> None:
    """Do what a line asks for, and write the reply."""
    arrays: list[Any] = []
    try:
        asked = json.loads(line)
        limit(asked.pop("memory_bytes"), asked.pop("seconds"))
        most_bytes, what = asked.pop("most_bytes"), asked.get("name", "the file")
        told, arrays = TASKS[asked.pop("task")](**asked)
        n_bytes = max((array.nbytes for array in arrays), default=0)
        if n_bytes > most_bytes:
            accepted = f"give a smaller file: at most {most_bytes:,} bytes are read"
            raise Refused(f"bytes of {what} = {n_bytes} is not accepted: {accepted}.")
    except Refused as error:
        told, arrays = {"refused": str(error)}, []
    except MemoryError:
        told = {"error": "more memory than it may have", "exhausted": True}
    except ModuleNotFoundError as error:
        told = {"missing": f"{type(error).__name__}: {error}"}
    except Exception as error:  # undocumented: any
        told = {"error": f"{type(error).__name__}: {str(error)[:2000]}"}
    arrays = [np.ascontiguousarray(array, array.dtype.newbyteorder("=")) for array in arrays]
    text = json.dumps({"told": told, "arrays": [(one.dtype.str, one.shape) for one in arrays]})
    if len(text) > MOST_REPLY_CHARACTERS:
        refused = {"refused": "attributes = too many: give fewer."}
        text, arrays = json.dumps({"told": refused, "arrays": []}), []
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
