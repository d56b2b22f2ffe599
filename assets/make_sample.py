"""Write ``sample_capture.npz``: a small simulated capture, as a file, for the reading path.

``python assets/make_sample.py`` writes it beside this file. It is the car at SBR 0.1 with 500
pulses, stripped of its truth, as a field capture would be.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from core import Capture, Flux, save_capture, scenes, simulate


def sample() -> Capture:
    """The capture that the file holds."""
    scene = scenes["car"]()
    acquisition = replace(scene.acquisition, n_pulses=500)
    capture = simulate(scene, acquisition, Flux(sbr=0.1), seed=2026)
    source = "Sample capture: the built-in car, simulated at SBR 0.1 with 500 pulses, truth removed"
    return replace(capture, truth_range_m=None, signal=None, background=None, source=source)


if __name__ == "__main__":
    save_capture(sample(), Path(__file__).with_name("sample_capture.npz"), overwrite=True)
