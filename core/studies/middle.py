"""Parts of captures that are too large to be studied whole."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from core.capture import Capture

MAX_COUNTS = 2**21
"""Larger captures are studied by their middle."""


def middle(capture: Capture) -> Capture:
    """Return the middle of a capture, of its proportions; the capture itself if it is small.

    The source says so.
    """
    if capture.cube.size <= MAX_COUNTS:
        return capture
    share = math.sqrt(MAX_COUNTS / capture.cube.size)
    sides = [max(1, int(size * share)) for size in capture.shape]
    rows, cols = (
        slice((size - side) // 2, (size - side) // 2 + side)
        for size, side in zip(capture.shape, sides, strict=True)
    )
    return replace(
        capture,
        cube=np.ascontiguousarray(capture.cube[rows, cols]),
        **capture.images(lambda image: image[rows, cols]),
        groups=capture.groups and capture.groups.mapped(lambda cube: cube[rows, cols]),
        source=f"{capture.source}; the middle {sides[0]} x {sides[1]} pixels",
    )
