"""Becker & Hickl ``.sdt``: images of TCSPC histograms, as SPCM saves them.

A file holds one block or several, one for each detector or measurement; ``variable`` picks one,
such as ``"block 0"``. A block is an image (row, col, bin), or curves of one pixel each, which make
an image of one row; the images of several routing channels in one block are summed. The bin's width
follows from the measurement's TAC range and gain. The gate opens with the pulse unless told
otherwise. All photons of a pulse count.

`sdtfile` reads the blocks, all of them, and trusts the file: the chain of its blocks, their claimed
lengths, and what a compressed block unpacks to. Those are checked before.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, cube_capture
from core.io.readers.guards import decoding, require_fits
from core.io.readers.request import Request

_COUNTED_ELSEWHERE = 0x7FFF  # number of blocks that stands for a larger one in another field
_COMPRESSED = 0x1000
_HISTOGRAMS = {0x00: "decay curves", 0x10: "pages", 0x60: "an image"}
_CONTENT = 0xF0
_NEW_HEADER_REVISION = 15
_VALID_AT, _VALID = 32, b"\x55\x55"


def recognizes(start: bytes) -> bool:
    """Whether a file starts with a header of Becker & Hickl that is marked as valid."""
    return start[_VALID_AT : _VALID_AT + 2] == _VALID


def read(path: Path, request: Request) -> Capture:
    """Read the histograms of a block."""
    from sdtfile import SdtFile  # noqa: PLC0415  (only who opens such a file waits for it)

    require_fits("the file", path.stat().st_size)
    data = path.read_bytes()
    with decoding("the header"):
        headers = list(_block_headers(data))
    _require_harmless(data, headers)
    block = _choose(headers, request.variable)
    name = f"block {block}"
    with (
        NamedTemporaryFile() as checked
    ):  # a real file, as `sdtfile` wants, that nobody else changes
        checked.write(data)
        checked.seek(0)
        with decoding("the blocks"):
            file = SdtFile(checked)
            histograms, times = file.data[block], file.times[block]
    # The format's numbers of 4 bytes: the shortest one in decimals is what was meant.
    bin_width_s = float(str(np.float32(times[1]))) if times.size > 1 else 0.0
    if request.bin_width_s is None:
        accepted = "a positive one: tell bin_width_s"
        require(f"bin width of {name}", bin_width_s, 0 < bin_width_s < 1, accepted)
    known = replace(
        request,
        bin_width_s=request.bin_width_s or bin_width_s,
        detection=request.detection or "all",
    )
    cube = _image(histograms, name)
    return cube_capture(cube, name, f"{path.name}, {name}", known, " ".join(AXES))


def _block_headers(data: bytes) -> Iterator[np.void]:
    """The header of each block, along the chain in which each tells where the next one lies."""
    from sdtfile import sdtfile  # noqa: PLC0415

    header = _record(data, sdtfile.FILE_HEADER, 0)
    n_blocks = int(header["no_of_data_blocks"])
    n_blocks = int(header["reserved1"]) if n_blocks == _COUNTED_ELSEWHERE else n_blocks
    is_new = int(header["revision"]) & 0xF >= _NEW_HEADER_REVISION
    layout = sdtfile.BLOCK_HEADER if is_new else sdtfile.BLOCK_HEADER_OLD
    most = len(data) // np.dtype(layout).itemsize
    require(
        "no_of_data_blocks", n_blocks, 1 <= n_blocks <= most, f"1 to {most:,}, as the file fits"
    )
    offset, end = int(header["data_block_offs"]), 0
    for _ in range(n_blocks):
        require(
            "offset of a block", offset, end <= offset < len(data), "a chain that goes forwards"
        )
        block = _record(data, layout, offset)
        yield block
        offset, end = int(block["next_block_offs"]), offset + block.dtype.itemsize


def _record(data: bytes, layout: list[Any], offset: int) -> np.void:
    """A structure of the format, from its place in the file."""
    record: np.void = np.frombuffer(data, np.dtype(layout).newbyteorder("<"), 1, offset)[0]
    return record


def _require_harmless(data: bytes, headers: list[np.void]) -> None:
    """Raise ``ValueError`` if the blocks claim more than lies in the file, or would unpack to."""
    require_fits("all blocks", sum(int(block["block_length"]) for block in headers))
    for number, block in enumerate(headers):
        name, length = f"block {number}", int(block["block_length"])
        begin, end = int(block["data_offs"]), int(block["next_block_offs"])
        if int(block["block_type"]) & _COMPRESSED:
            _require_inflates(data[begin:end], length, name)
        else:
            found = max(0, len(data) - begin)
            require(f"bytes of {name}", found, length <= found, f"{length:,}: copy the file again")


def _require_inflates(packed: bytes, length: int, name: str) -> None:
    """Raise ``ValueError`` unless an archive's one file unpacks to what it claims, and enough.

    What its directory claims is not what it unpacks to: `zipfile` stops at the claim only after all
    was unpacked. And of two files of one name, it would read the last.
    """
    with decoding(name), ZipFile(BytesIO(packed)) as archive:
        files = archive.filelist
    require(f"files packed in {name}", len(files), len(files) == 1, "one: save the file again")
    info = files[0]
    with decoding(name):
        lengths = struct.unpack_from("<HH", packed, info.header_offset + 26)  # name, extra field
        begin = info.header_offset + 30 + sum(lengths)
    plain = info.compress_type in (ZIP_STORED, ZIP_DEFLATED)
    accepted = "0 (stored) or 8 (deflated)"
    require(f"compression method of {name}", info.compress_type, plain, accepted)
    claimed = info.file_size
    require_fits(name, claimed)
    again = "copy or save the file again"
    require(f"bytes of {name}", claimed, claimed >= length, f"{length:,} or more: {again}")
    if info.compress_type == ZIP_DEFLATED:
        with decoding(name):
            inflater = zlib.decompressobj(-zlib.MAX_WBITS)
            compressed = memoryview(packed)[begin : begin + info.compress_size]
            found = len(inflater.decompress(compressed, claimed + 1))
        whole = inflater.eof and found == claimed
        require(f"bytes of {name}, unpacked,", found, whole, f"{claimed:,}: {again}")


def _choose(headers: list[np.void], variable: str | None) -> int:
    """Number of the block asked for, or of the only one that holds histograms."""
    kinds = [_HISTOGRAMS.get(int(block["block_type"]) & _CONTENT) for block in headers]
    fitting = {f"block {number}": number for number, kind in enumerate(kinds) if kind}
    listed = ", ".join(f"{name} ({kinds[number]})" for name, number in fitting.items()) or "none"
    remedy = f"the name of a block with histograms; the file has {listed}"
    if variable is not None:
        require("variable", variable, variable in fitting, remedy)
        return fitting[variable]
    found = ", ".join(fitting) or None
    require("variable", found, len(fitting) == 1, f"as variable {remedy}")
    return next(iter(fitting.values()))


def _image(data: NDArray[Any], name: str) -> NDArray[Any]:
    """Counts (row, col, bin) of a block: curves as one row, routing channels summed."""
    wanted = "curves, or images of them"
    require(f"shape of {name}", data.shape, 2 <= data.ndim <= 5 and data.size > 0, wanted)
    if data.ndim == 2:
        return data[np.newaxis]
    if data.ndim == 3:
        return data
    kind = np.float64 if data.dtype.kind == "f" else np.uint64
    require_fits(name, data[(0,) * (data.ndim - 3)].size * np.dtype(kind).itemsize)
    return np.asarray(data.sum(axis=tuple(range(data.ndim - 3)), dtype=kind))
