"""Sensitivity of each method to its settings and to the scene."""

from core.studies.sensitivity.page import ranges_table, setting_plot
from core.studies.sensitivity.sweep import Sweep, along, numbers, setting_sweep

__all__ = [
    "Sweep",
    "along",
    "numbers",
    "ranges_table",
    "setting_plot",
    "setting_sweep",
]
