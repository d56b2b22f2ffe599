"""How kernels are compiled and entered, in one place."""

from __future__ import annotations

import threading
from typing import Any

# "contract" alone lets a multiply and an add fuse; full fastmath would drop NaN and infinity.
COMPILED: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "fastmath": {"contract"},
    "error_model": "numpy",  # a division by zero gives infinity or NaN, as in numpy
}
PARALLEL: dict[str, Any] = {**COMPILED, "parallel": True}

# Where OpenMP is missing numba falls back to a threading layer that aborts the process when two
# Python threads enter parallel kernels at once.
KERNEL_LOCK = threading.Lock()

# Counts in a cube below which starting threads costs more than it saves.
SERIAL_BELOW = 2_000_000
