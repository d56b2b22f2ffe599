"""Arrays in chunks, compressed or not, read from where they lie: HDF5's and Zarr's data alike.

The bytes of a chunk are decoded here, never by the libraries that write them: each of them unpacks
as far as the file says, and some read past the end of what they were given. Here a chunk unpacks to
no more than its shape says, and only the filters of `FILTERS` are known.

A box takes its own bytes, and while it is read those of one chunk up to four times: as it is
packed, and before, within and after a filter. A chunk may be twice as large as its array, or
16 MiB; box, chunk and what is packed may be `core.io.readers.guards.MAX_CUBE_BYTES` each.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.checks import require
from core.io.readers.guards import FileVersion, decoding, require_fits

_CHECKSUM_BYTES = 4
_ROOM_FOR_CHECKSUMS = 4 * _CHECKSUM_BYTES  # packed along with the numbers
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SMALL_CHUNK = 2**24  # bytes, however few of them an array fills
_MOST_CHUNKS = 2**24  # of one array; a table of them takes half a gigabyte


class Filter(NamedTuple):
    """A step of decoding: its name in `FILTERS`, and the size of an element where it matters."""

    name: str
    element_bytes: int = 1


class Part(NamedTuple):
    """The bytes of one chunk, and the filters that they still went through, the last one first."""

    data: bytes
    filters: tuple[Filter, ...]


def _deflate(data: bytes, most: int, _: int) -> bytes:
    # 32 more than the window: zlib's header or gzip's, whichever there is.
    inflater = zlib.decompressobj(wbits=32 + zlib.MAX_WBITS)
    found = inflater.decompress(data, most + 1)
    require("bytes unpacked", f"more than {most:,}", len(found) <= most, "a whole chunk")
    require("end of a chunk", "cut short", inflater.eof, "a whole file")
    return found


def _zstd(data: bytes, most: int, _: int) -> bytes:
    from numcodecs import zstd  # noqa: PLC0415 - a tenth of a second for a codec that few files use

    unpacked = _zstd_content_size(data)
    if unpacked is None:  # the library then wants to be told, exactly
        unpacked = most - _ROOM_FOR_CHECKSUMS
    require("bytes unpacked", unpacked, unpacked <= most, f"at most {most:,}")
    room = bytearray(unpacked)
    zstd.decompress(data, room)
    return bytes(room)


def _zstd_content_size(data: bytes) -> int | None:
    """What the first frame unpacks to, by its header (RFC 8878); None if that does not say."""
    require(
        "a zstd frame", data[:4], data[:4] == _ZSTD_MAGIC, f"one that begins with {_ZSTD_MAGIC!r}"
    )
    flags = data[4]
    single_segment = flags >> 5 & 1
    begin = 5 + (1 - single_segment) + (0, 1, 2, 4)[flags & 3]
    n_bytes = (single_segment, 2, 4, 8)[flags >> 6]
    size = int.from_bytes(data[begin : begin + n_bytes], "little")
    return size + 256 * (n_bytes == 2) if n_bytes else None


def _blosc(data: bytes, most: int, _: int) -> bytes:
    from numcodecs import blosc  # noqa: PLC0415

    # The library believes the sizes that stand at the beginning.
    unpacked, packed = (int.from_bytes(data[k : k + 4], "little") for k in (4, 12))
    require("bytes of a blosc chunk", packed, 16 <= packed == len(data), f"{len(data):,}")
    require("bytes unpacked", unpacked, unpacked <= most, f"at most {most:,}")
    return bytes(blosc.decompress(data))


def _shuffled(data: bytes, _: int, element_bytes: int) -> bytes:
    """Undo what gathers the first byte of every element, then the second, and so on."""
    whole = len(data) // element_bytes * element_bytes
    elements = np.empty((whole // element_bytes, element_bytes), np.uint8)
    for k, plane in enumerate(np.frombuffer(data, np.uint8, whole).reshape(element_bytes, -1)):
        elements[:, k] = plane
    return b"".join((elements.data, data[whole:]))


def _lzf(data: bytes, most: int, _: int) -> bytes:
    from core.io.readers.lzf import decompress  # noqa: PLC0415 - compiled when first used

    return decompress(data, most)


def _fletcher32(data: bytes, *_: int) -> bytes:
    from numcodecs.fletcher32 import Fletcher32  # noqa: PLC0415

    return bytes(Fletcher32().decode(data))


def _crc32c(data: bytes, *_: int) -> bytes:
    from google_crc32c import value  # noqa: PLC0415

    content, kept = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    found = int.from_bytes(kept, "little")
    require("checksum of a chunk", found, found == value(content), "a whole file")
    return content


FILTERS: Mapping[str, Callable[[bytes, int, int], bytes]] = {
    "deflate": _deflate,
    "shuffle": _shuffled,
    "lzf": _lzf,
    "fletcher32": _fletcher32,
    "zstd": _zstd,
    "blosc": _blosc,
    "crc32c": _crc32c,
}
"""Ways back from packed bytes. Each takes the bytes, how many may come out, an element's size."""


def _holds(dtype: np.dtype[Any], number: float) -> bool:
    """Whether a type has a number, but for the rounding of floats."""
    if dtype.kind == "f":  # a whole number of JSON may be beyond all floats
        return not float(np.finfo(dtype).max) < abs(number) < np.inf
    low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    return low <= number <= high and number == int(number)


def _picked(box: tuple[slice, ...], shape: tuple[int, ...]) -> list[range]:
    """Places along each axis that slices of positive steps pick."""
    return [range(*slice_.indices(n)) for slice_, n in zip(box, shape, strict=True)]


def _touched(picked: range, chunk: int) -> Iterator[tuple[int, slice, slice]]:
    """Chunks along an axis that hold some of what is picked: index, places in it, places in all."""
    step = picked.step
    for k in range(picked[0] // chunk, picked[-1] // chunk + 1):
        # The first place in this chunk, and the first beyond it.
        first, end = (max(0, -(-(edge * chunk - picked[0]) // step)) for edge in (k, k + 1))
        end = min(end, len(picked))
        if first < end:
            begin = picked[first] - k * chunk
            yield k, slice(begin, picked[end - 1] - k * chunk + 1, step), slice(first, end)


@dataclass(frozen=True)
class Chunked:
    """An array in a file, of which nothing is read before it is asked for.

    Parameters
    ----------
    name : str
        What to call it in a refusal.
    shape : tuple of int
    dtype : dtype
        Of its numbers as they lie in the file.
    chunk : tuple of int
        Shape of a chunk.
    fetch : callable
        Gives the bytes of the chunk at an index along each axis; None where none was written.
    fill : float or int
        What stands where no chunk was written.
    order : tuple of int or None
        The axes of a chunk, slowest first, where they are not in the array's own order.

    Raises
    ------
    ValueError
        If a chunk is too large, or there are too many, or the type does not hold the fill.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk: tuple[int, ...]
    fetch: Callable[[tuple[int, ...]], Part | None]
    fill: float = 0
    order: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        fits = len(self.chunk) == len(self.shape) and min((*self.chunk, *self.shape), default=0) > 0
        whole = f"as many axes as {self.shape}, none of them 0"
        require(f"chunk of {self.name}", self.chunk, fits, whole)
        n_bytes, in_all = (prod(n) * self.dtype.itemsize for n in (self.chunk, self.shape))
        require_fits(f"a chunk of {self.name}", n_bytes)
        most = max(2 * in_all, _SMALL_CHUNK)
        what = f"bytes of a chunk of {self.name}"
        require(what, n_bytes, n_bytes <= most, f"up to {most:,}, as its array has {in_all:,}")
        n_chunks = prod(self.grid)
        require(f"chunks of {self.name}", n_chunks, n_chunks <= _MOST_CHUNKS, "larger chunks")
        held = f"a number that {self.dtype} holds"
        require(f"fill_value of {self.name}", self.fill, _holds(self.dtype, self.fill), held)

    @property
    def grid(self) -> tuple[int, ...]:
        """Chunks along each axis."""
        return tuple(-(-n // step) for n, step in zip(self.shape, self.chunk, strict=True))

    def __getitem__(self, box: tuple[slice, ...]) -> NDArray[Any]:
        """The numbers in a box of slices, in their own type but the byte order of this machine."""
        picked = _picked(box, self.shape)
        shape = [len(places) for places in picked]
        dtype = self.dtype.newbyteorder("=")
        require_fits(self.name, prod(shape) * dtype.itemsize)
        answer = np.empty(shape, dtype)
        touched = product(*map(_touched, picked, self.chunk)) if answer.size else ()
        for parts in touched:
            index, source, target = zip(*parts, strict=True)
            block = self._block(index)
            answer[target] = self.fill if block is None else block[source]
        return answer

    def _block(self, index: tuple[int, ...]) -> NDArray[Any] | None:
        n_bytes = prod(self.chunk) * self.dtype.itemsize
        with decoding(f"chunk {index} of {self.name}"):
            part = self.fetch(index)
            if part is None:
                return None
            data = part.data
            for step in part.filters:
                most = n_bytes + _ROOM_FOR_CHECKSUMS
                data = FILTERS[step.name](data, most, step.element_bytes)
            require("bytes", len(data), len(data) == n_bytes, f"{n_bytes:,}")
            order = self.order or tuple(range(len(self.shape)))
            stored = np.frombuffer(data, self.dtype).reshape([self.chunk[axis] for axis in order])
            return stored.transpose(np.argsort(order))


@dataclass(frozen=True)
class Stretches:
    """Chunks that lie somewhere in one file.

    Parameters
    ----------
    file : FileVersion
        Refused once it has changed.
    places : dict
        Offset and bytes of each chunk, by its index; and the filters that it went through.
    """

    file: FileVersion
    places: Mapping[tuple[int, ...], tuple[int, int, tuple[Filter, ...]]]

    def __call__(self, index: tuple[int, ...]) -> Part | None:
        """The bytes of a chunk."""
        if index not in self.places:
            return None
        offset, n_bytes, filters = self.places[index]
        with self.file.unchanged():
            return Part(read_stretch(self.file.path, offset, n_bytes), filters)


@dataclass(frozen=True)
class Contiguous:
    """An array in one piece in a file, of which any part is read without the rest.

    Parameters
    ----------
    name : str
        What to call it in a refusal.
    shape : tuple of int
    dtype : dtype
        Of its numbers as they lie in the file.
    file : FileVersion
        Refused once it has changed.
    offset : int
        Where it begins, in bytes.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    file: FileVersion
    offset: int

    @property
    def chunk(self) -> tuple[int, ...]:
        """A single number: any box may be read."""
        return (1,) * len(self.shape)

    def __getitem__(self, box: tuple[slice, ...]) -> NDArray[Any]:
        """The numbers in a box of slices, in their own type but the byte order of this machine."""
        picked = _picked(box, self.shape)
        shape = [len(places) for places in picked]
        require_fits(self.name, prod(shape) * self.dtype.itemsize)
        answer = np.empty(shape, self.dtype)
        # The numbers of a run lie side by side: all axes after its own are whole.
        own = len(shape) - 1
        while own > 0 and shape[own] == self.shape[own]:
            own -= 1
        if picked[own].step > 1:
            own += 1
        strides = [self.dtype.itemsize * prod(self.shape[k + 1 :]) for k in range(len(shape))]
        runs = answer.reshape(prod(shape[:own]), -1) if answer.size else ()
        outer = product(*picked[:own])
        with decoding(self.name), self.file.unchanged(), self.file.path.open("rb") as file:
            for index, run in zip(outer, runs, strict=True) if answer.size else ():
                begin = (*index, *(places[0] for places in picked[own:]))
                place = sum(k * step for k, step in zip(begin, strides, strict=True))
                file.seek(self.offset + place)
                found = file.readinto(run.view(np.uint8).data)
                require("bytes read", found, found == run.nbytes, f"{run.nbytes:,}")
        return answer.astype(self.dtype.newbyteorder("="), copy=False)


@dataclass(frozen=True)
class Whole:
    """An array of one chunk that is there already."""

    data: bytes

    def __call__(self, _: tuple[int, ...]) -> Part:
        """All bytes."""
        return Part(self.data, ())


def read_stretch(path: Path, offset: int, n_bytes: int) -> bytes:
    """So many bytes of a file, none of which may be missing."""
    require_fits("a chunk as it is packed", n_bytes)
    with path.open("rb") as file:
        file.seek(offset)
        data = file.read(n_bytes)
    require("bytes read", len(data), len(data) == n_bytes, f"{n_bytes:,}: the file was cut short")
    return data


def boxes(shape: tuple[int, ...], most: int) -> Iterator[tuple[slice, ...]]:
    """Cut an array into boxes of at most `most` elements, one after the other in memory.

    Each box is one stretch of an array in C order, and the next one begins where it ends.
    """
    if not shape:
        yield ()
        return
    first, *rest = shape
    inner = prod(rest)
    if inner > most:
        for k in range(first):
            for box in boxes(tuple(rest), most):
                yield (slice(k, k + 1), *box)
        return
    step = max(1, most // max(1, inner))
    for k in range(0, first, step):
        yield (slice(k, min(k + step, first)), *(slice(0, n) for n in rest))
