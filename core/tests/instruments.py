"""Builders of small files of instruments."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from datetime import datetime
from typing import Any
from uuid import UUID

import numpy as np
import ptufile
from numpy.typing import NDArray
from sdtfile import sdtfile

IMAGE, COMPRESSED, UINT32, FCS = 0x61, 0x1000, 0x100, 0x20  # block types of SPCM


def ptu_bytes(cube: Any, period_s: float = 100e-9, bin_width_s: float = 1e-9, **more: Any) -> bytes:
    """An image of T3 records: counts as (row, col, bin) or (frame, row, col, channel, bin)."""
    file = io.BytesIO()
    same_each_time = {"guid": UUID(int=1), "datetime": datetime(2026, 1, 1)}
    counts = np.ascontiguousarray(cube, np.uint16)
    ptufile.imwrite(file, counts, period_s, bin_width_s, **same_each_time, **more)
    return file.getvalue()


def split(cube: NDArray[Any]) -> NDArray[np.uint16]:
    """The same counts (row, col, bin) spread over (frame, row, col, channel, bin)."""
    shares = np.random.default_rng(3).multinomial(cube, np.full(4, 0.25))
    return shares.reshape(*cube.shape, 2, 2).transpose(3, 0, 1, 4, 2).astype(np.uint16)


def ptu_with(content: bytes, tag: str, value: int | float) -> bytes:
    """The same file with another value in a tag."""
    place = content.index(tag.encode()) + 40
    word = np.array(value, np.int64 if isinstance(value, int) else np.float64).tobytes()
    return content[:place] + word + content[place + 8 :]


def sdt_bytes(
    *blocks: Any,
    kind: int = IMAGE,
    range_s: float = 100e-9,
    changes: dict[str, int] | None = None,
    of_blocks: dict[str, int] | None = None,
    of_measurement: dict[str, float] | None = None,
) -> bytes:
    """A file with an image (row, col, bin) in each block.

    Parameters
    ----------
    kind : int
        Type of the blocks, as in the format.
    range_s : float
        Time that the bins cover together.
    changes, of_blocks, of_measurement : dict
        Values of fields to replace in the headers of the file, each block, and the measurement.
    """
    info = b"*IDENTIFICATION\r\n  ID        : SPC Setup & Data File\r\n*END\r\n"
    header = np.zeros(1, np.dtype(sdtfile.FILE_HEADER).newbyteorder("<"))
    measurement = np.zeros(1, np.dtype(sdtfile.MEASURE_INFO).newbyteorder("<"))
    rows, cols, n_bins = np.shape(blocks[0])
    fields: dict[str, float] = {"tac_r": range_s, "tac_g": 1, "adc_re": n_bins}
    fields |= {"scan_x": cols, "scan_y": rows, "scan_rx": 1, "scan_ry": 1}
    for name, value in {**fields, **(of_measurement or {})}.items():
        measurement[name] = value
    begin = header.itemsize + len(info) + measurement.itemsize
    body = b"".join(_sdt_blocks(blocks, kind, begin, of_blocks or {}))
    known = {
        "revision": 0x28 << 4 | 15,
        "info_offs": header.itemsize,
        "info_length": len(info),
        "data_block_offs": begin,
        "no_of_data_blocks": len(blocks),
        "meas_desc_block_offs": header.itemsize + len(info),
        "no_of_meas_desc_blocks": 1,
        "meas_desc_block_length": measurement.itemsize,
        "header_valid": 0x5555,
        "chksum": 0x55AA,
    }
    for name, value in {**known, **(changes or {})}.items():
        header[name] = value
    return header.tobytes() + info + measurement.tobytes() + body


def _sdt_blocks(
    blocks: Sequence[Any], kind: int, begin: int, changes: dict[str, int]
) -> list[bytes]:
    parts = []
    for number, block in enumerate(blocks):
        counts = np.asarray(block, "<u4" if kind & UINT32 else "<u2").tobytes()
        kept = zipped(counts) if kind & COMPRESSED else counts
        head = np.zeros(1, np.dtype(sdtfile.BLOCK_HEADER).newbyteorder("<"))
        data = begin + head.itemsize
        fields = {"data_offs": data, "next_block_offs": data + len(kept), "block_type": kind}
        fields |= {"lblock_no": number, "block_length": len(counts)}
        for name, value in {**fields, **changes}.items():
            head[name] = value
        parts += [head.tobytes(), kept]
        begin = data + len(kept)
    return parts


def zipped(content: bytes, method: int = zipfile.ZIP_DEFLATED, claims: int | None = None) -> bytes:
    """A compressed block; its directory may claim another size."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr("data_block", content)
        if claims is not None:
            archive.filelist[0].file_size = claims
    return file.getvalue()


def tmf8820_records(cube: NDArray[Any]) -> list[dict[str, Any]]:
    """Records of histograms (record, zone, bin), without a reference."""
    return [{"hists": zones.tolist(), "time_captured": 0} for zones in cube]


def tmf8820_bytes(cube: NDArray[Any]) -> bytes:
    """Histograms (record, zone, bin), without a reference."""
    return json.dumps(tmf8820_records(cube)).encode()


def tmf8829_log(cubes: NDArray[Any], **of_records: Any) -> dict[str, Any]:
    """A log of histograms (record, row, col, bin), without reference, results or configuration."""
    records = [
        {"info": {}, "mp_histo": [[{"bin": bins} for bins in row] for row in cube], **of_records}
        for cube in cubes.tolist()
    ]
    return {"Result_Set": records, "info": []}


def tmf8829_bytes(cube: NDArray[Any], n_records: int = 3) -> bytes:
    """A log of which the records add up to counts (row, col, bin)."""
    shares = np.random.default_rng(5).multinomial(cube, np.full(n_records, 1 / n_records))
    return json.dumps(tmf8829_log(np.moveaxis(shares, -1, 0))).encode()
