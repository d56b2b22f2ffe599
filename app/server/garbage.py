"""Freeze long-lived objects so that full garbage collections stay cheap.

A page has some ten thousand objects. With twenty pages a full collection takes more than half a
second, during which the server does not respond. Dragging sliders and opening pages trigger it.
"""

from __future__ import annotations

import ctypes
import gc
import os


def freeze_all() -> None:
    """Exclude all present objects from collections until `collect_all`."""
    gc.collect()
    gc.freeze()


def collect_all() -> None:
    """Collect all garbage, that of closed pages included, and return the memory."""
    gc.unfreeze()
    freeze_all()
    _return_freed_memory()


def _return_freed_memory() -> None:
    """Return freed memory to the system, most of which glibc would keep."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
