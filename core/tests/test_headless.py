"""Tests of core without a screen and without the libraries of the app."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import core

PACKAGE = Path(core.__file__).parent
SOURCES = sorted(
    path for path in PACKAGE.rglob("*.py") if "tests" not in path.relative_to(PACKAGE).parts
)
SCREEN = {"app", "bokeh", "holoviews", "panel", "panel_material_ui", "param", "pyvista", "vtk"}

SLOW_TO_LOAD = ("dask", "h5py", "matplotlib", "PIL", "trimesh", "xarray", "zarr")
SLOW_TO_LOAD += ("colorcet", "laspy", "pypcd4", "tifffile")
SLOW_TO_LOAD += ("scipy.io", "scipy.ndimage", "scipy.optimize", "scipy.stats")
FIRST_IMAGE_THEN_ALL = """
import importlib, sys, core, core.io.writers
acquisition = core.Acquisition(n_pulses=1)
scene = core.Scene(core.scenes["car"]().range_m[:1, :1], acquisition=acquisition)
core.estimate(core.simulate(scene, acquisition, core.Flux()), "tracking")
print(*sys.modules)
for name in sys.argv[1:]:
    importlib.import_module(name)
print(*sys.modules)
"""


def test_a_first_estimate_loads_no_slow_library_and_core_none_of_the_screen() -> None:
    modules = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in SOURCES]
    names = [name.removesuffix(".__init__") for name in modules]
    done = subprocess.run(
        [sys.executable, "-c", FIRST_IMAGE_THEN_ALL, *names],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    first, loaded = (set(line.split()) for line in done.stdout.splitlines())
    assert "core.tracking" in first
    assert not set(SLOW_TO_LOAD) & first
    assert {"core.io.readers.npz", "core.studies.paper.recommend"} <= loaded
    assert not SCREEN & {name.partition(".")[0] for name in loaded}


ONE_KERNEL = """
import numpy
from core.kernels.posterior import smoothed
print(round(smoothed(numpy.ones(3)).sum(), 9))
"""


def test_kernels_run_without_a_writable_cache_folder(tmp_path: Path) -> None:
    shutil.copytree(
        PACKAGE, tmp_path / "core", ignore=shutil.ignore_patterns("__pycache__", "tests")
    )
    for folder in [tmp_path / "core", *filter(Path.is_dir, (tmp_path / "core").rglob("*"))]:
        (folder / "__pycache__").touch()  # a file: not even the superuser writes into it
    nowhere = {"HOME": os.devnull, "XDG_CACHE_HOME": os.devnull}
    done = subprocess.run(
        [sys.executable, "-c", ONE_KERNEL],
        cwd=tmp_path,
        env={name: os.environ[name] for name in os.environ if "CACHE" not in name} | nowhere,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "3.0\n", done.stderr
    assert "NUMBA_CACHE_DIR" in done.stderr
