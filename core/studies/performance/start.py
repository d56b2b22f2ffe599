"""Time from the start of a process to its first range image, stage by stage."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from time import time

import numpy as np

from core.acquisition import Floats

STAGES = ("interpreter", "import core", "simulation", "positions", "flux and confidence")
"""In this order; each compiles its kernels or loads them from the cache."""

FIRST_IMAGE = """
from time import time
marks = [time()]
import core
from core.tracking import track
marks.append(time())
scene = core.scenes["car"]()
capture = core.simulate(scene, scene.acquisition, core.Flux(0.1041, 0.06), seed=1)
marks.append(time())
track(capture.blocks, core.PRESETS["recommended"])
marks.append(time())
core.estimate(capture, "tracking")
marks.append(time())
print(marks)
"""
"""Prints the time at the end of each stage."""


def first_image(cache: Path, script: str = FIRST_IMAGE) -> Floats:
    """Return the seconds of each of `STAGES` in a process that simulates and ranges the car.

    Compiled kernels are cached in the folder `cache`.
    """
    started = time()
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parents[3],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=True,
    )
    return np.diff([started, *json.loads(done.stdout)])
