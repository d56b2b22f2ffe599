"""Captures larger than memory: tiles and windows."""

from core.out_of_core.tiles import as_image, computed, estimate_large
from core.out_of_core.windows import Window, WindowReader, read_window, sampled_flux_prior

__all__ = [
    "Window",
    "WindowReader",
    "as_image",
    "computed",
    "estimate_large",
    "read_window",
    "sampled_flux_prior",
]
