"""What a binary glTF file claims, before a parser believes it.

A file of a few kilobytes can claim meshes of any size: views of the same bytes again and again,
numbers of which there are none in the file, and nodes that place one mesh a million times.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from core.checks import require
from core.io.readers.guards import decoding, require_fits

_MAGIC, _JSON = b"glTF", b"JSON"
_HEADER = struct.Struct("<4sIII4s")
_MEMORY_A_BYTE = 32  # of JSON's text
_CORNERS = 3
_VIEWS_A_BYTE, _NUMBERS_A_BYTE = 2, 4  # how often the same byte may be used


def require_harmless(data: bytes, most_faces: int) -> None:
    """Raise ``ValueError`` if the file's claims are too large, or refer to other files."""
    with decoding("the header"):
        magic, version, _, length, kind = _HEADER.unpack_from(data)
    known = (magic, version, kind) == (_MAGIC, 2, _JSON)
    require("the header", (magic, version, kind), known, "a binary glTF 2.0 file")
    text = data[_HEADER.size : _HEADER.size + length]
    require_fits("the description", len(text) * _MEMORY_A_BYTE)
    with decoding("the description"):
        described = json.loads(text)
        claims = _claims(described)
        away = [buffer["uri"] for buffer in described.get("buffers", []) if "uri" in buffer]
    require("buffers elsewhere", away[:1], not away, "a file that holds all its buffers itself")
    most_of = {
        "bytes of all views": _VIEWS_A_BYTE * len(data),
        "numbers of all accessors": _NUMBERS_A_BYTE * len(data),
        "corners of all meshes": _CORNERS * most_faces,
    }
    for name, most in most_of.items():
        require(name, claims[name], claims[name] <= most, f"at most {most:,}, as the file holds")


def _claims(described: dict[str, Any]) -> dict[str, int]:
    """How much the file claims to hold; corners count once for each place of their mesh."""
    counts = [_count(accessor["count"]) for accessor in described.get("accessors", [])]
    corners = [
        sum(_corners(primitive, counts) for primitive in mesh["primitives"])
        for mesh in described.get("meshes", [])
    ]
    # A node stands once below each parent, and all of that once for each way from the roots; the
    # parser follows each pair of parent and child once.
    parents = np.ones(len(described.get("nodes", [])), np.int64)
    for node in described.get("nodes", []):
        for child in node.get("children", []):
            parents[child] += 1
    placed = [
        int(times) * corners[node["mesh"]]
        for node, times in zip(described.get("nodes", []), parents, strict=True)
        if "mesh" in node
    ]
    return {
        "bytes of all views": sum(
            _count(view["byteLength"]) for view in described.get("bufferViews", [])
        ),
        "numbers of all accessors": sum(counts),
        "corners of all meshes": sum(corners) + sum(placed),
    }


def _corners(primitive: dict[str, Any], counts: list[int]) -> int:
    """The numbers that a primitive copies: its indices and its vertices."""
    used = [primitive["attributes"]["POSITION"], primitive.get("indices")]
    return sum(counts[index] for index in used if index is not None)


def _count(value: object) -> int:
    require("count", value, isinstance(value, int) and value >= 0, "a whole number, 0 or more")
    return int(value)  # type: ignore[call-overload,no-any-return]  # as was just required
