"""How long a new process takes to its first range image, and what of it is compilation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from time import time

import numpy as np

from core.acquisition import Floats

STAGES = ("interpreter", "import core", "simulation", "positions", "light and confidence")
"""What a first image waits for, in this order; each compiles, or loads, its kernels."""

_FIRST_IMAGE = """
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


def first_image(cache: Path) -> Floats:
    """Start a process that simulates the car and ranges it.

    Parameters
    ----------
    cache : Path
        Folder of compiled kernels: an empty one is filled.

    Returns
    -------
    ndarray, shape (stage,)
        Seconds of each of `STAGES`.
    """
    root = Path(__file__).parents[3]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    started = time()
    told = subprocess.run(
        [sys.executable, "-c", _FIRST_IMAGE],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return np.diff([started, *json.loads(told.stdout)])
