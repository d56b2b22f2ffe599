"""LZF, the fast compression of h5py: its decoder, which never leaves its buffers.

The packed bytes are a series of runs. A first byte below 32 says how many bytes follow as they are,
less one. Above, its upper 3 bits and, if these are all set, another byte tell how many bytes, less
two, are copied from what was unpacked before; its lower 5 bits and one more byte, how far back,
less one.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.checks import require
from core.kernels.parallel import COMPILED

_LITERALS_BELOW = 32
_LONG = 7


def decompress(data: bytes, most: int) -> bytes:
    """Unpack `data` to no more than `most` bytes.

    Raises
    ------
    ValueError
        If the bytes are no LZF, or there are more.
    """
    room = np.empty(most, np.uint8)
    found = _unpack(np.frombuffer(data, np.uint8), room)
    require("LZF bytes", "damaged", found >= 0, f"a whole chunk of at most {most:,} bytes")
    return room[:found].tobytes()


@njit(**COMPILED)  # type: ignore[untyped-decorator]
def _unpack(packed: NDArray[np.uint8], room: NDArray[np.uint8]) -> int:
    """Bytes written to `room`, or -1 where a run would leave either buffer."""
    at = end = 0
    while at < packed.size:
        first = int(packed[at])
        at += 1
        if first < _LITERALS_BELOW:
            length = first + 1
            if at + length > packed.size or end + length > room.size:
                return -1
            for k in range(length):
                room[end + k] = packed[at + k]
            at += length
        else:
            length = first >> 5
            if length == _LONG:
                if at >= packed.size:
                    return -1
                length += int(packed[at])
                at += 1
            length += 2
            if at >= packed.size:
                return -1
            source = end - ((first & 31) << 8) - int(packed[at]) - 1
            at += 1
            if source < 0 or end + length > room.size:
                return -1
            for k in range(length):  # one by one: a run may copy what it has just written
                room[end + k] = room[source + k]
        end += length
    return end
