"""Results of many small computations with `core`, stored to the last bit.

``python -m core.tests.unchanged --write`` writes ``unchanged.npz``, with which
`core.tests.test_unchanged` compares the results. Rewrite it only if a result is meant to change,
and say so in the commit. Only public names of `core` are used, so that modules may be moved.

The file holds one record per case, such as ``estimate: car``, whose fields are arrays, such as
``tracking.range_m``. Since last bits depend on processor and libraries, it also names these.
"""

from __future__ import annotations

import argparse
import json
import platform
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import llvmlite
import numba
import numpy as np
import scipy

import core

FILE = Path(__file__).with_suffix(".npz")
FINGERPRINT = "fingerprint"  # key of the description of the machine
SAMPLE = Path(core.__file__).parents[1] / "assets" / "sample_capture.npz"

METHODS = [name for name, each in core.ESTIMATORS.items() if not each.follows_motion]
"""Methods with cases; without groups of pulses, those that follow motion are the likelihood."""

Answers = Iterable[tuple[str, Any]]
"""Names, and values of any type that contain numbers."""

Record = dict[str, np.ndarray]
"""Arrays by name, such as ``tracking.range_m``."""


# -- scenes and captures ---------------------------------------------------------------------------


def cut(scene: Any, rows: slice, cols: slice) -> Any:
    """Cut all images of a scene, or of a part of one, to some pixels."""
    changed = {}
    for each in fields(scene):
        value = getattr(scene, each.name)
        if isinstance(value, np.ndarray):
            changed[each.name] = value[rows, cols]
        elif is_dataclass(value) and hasattr(value, "shape"):
            changed[each.name] = cut(value, rows, cols)
    return replace(scene, **changed)


def some_of(name: str, size: int = 64) -> core.Scene:
    """Cut a built-in scene to 5 x 6 pixels with and without targets."""
    row, col = size * 7 // 16, size // 8
    return cut(core.scenes[name](size), slice(row, row + 5), slice(col, col + 6))


def everything() -> core.Scene:
    """Return a scene with every part."""
    foggy, worn, edges = some_of("fog"), some_of("worn"), some_of("edges", 16)
    bright = np.linspace(0.2, 1.5, 30).reshape(5, 6)
    behind_m = foggy.range_m + 3.0
    return replace(
        foggy,
        reflectivity=bright,
        second_surface=replace(edges.second_surface, range_m=behind_m, share=bright / 4),
        faulty_pixels=worn.faulty_pixels,
        motion=some_of("approach").motion,
        jitter=worn.jitter,
    )


def depths(acquisition: core.Acquisition, seed: int = 5) -> core.Scene:
    """Return 5 x 6 random depths in any gate, with one pixel without a target."""
    onset = np.random.default_rng(seed).uniform(0.15, 0.85, (5, 6)) * acquisition.n_bins
    onset[2, 3] = np.nan
    return core.Scene(acquisition.bin_to_range_m(onset), acquisition=acquisition)


def drawn(scene: core.Scene, *light: float, seed: int = 0, **more: Any) -> core.Capture:
    return core.simulate(scene, scene.acquisition, core.Flux(*light), seed=seed, **more)


def photons(n_pulses: int | None) -> core.Capture:
    """Draw multi-detection data (TCSPC) in bins of 250 ps with a measured pulse."""
    acquisition = core.Acquisition(80, 250e-12, 100e-9, n_pulses, 1e-3)
    pulse = core.Pulse.measured([0, 1, 6, 4, 2, 1], 250e-12)
    scene = depths(acquisition)
    onset = acquisition.range_m_to_bin(scene.range_m)
    rate = core.rate_per_bin(onset, np.full(onset.shape, 30.0), 60.0, pulse, acquisition)
    cube = np.random.default_rng(2).poisson(rate).astype(np.uint16)
    return core.Capture(cube, acquisition, pulse, scene.range_m, detection="all")


def sample() -> core.Capture:
    """Read a window of the sample capture of the package."""
    return core.read_window(core.open_capture(SAMPLE), core.Window((20, 30), (16, 28), 2))


FEW, MANY = core.Acquisition(32, 2e-9, 50e-9, 300), core.Acquisition(400, 0.1e-9, 1e-7, 20_000)

CAPTURES: dict[str, Callable[[], core.Capture]] = {
    "car": lambda: drawn(some_of("car"), 0.1041, 0.06),
    "car, SBR 2": lambda: drawn(some_of("car"), 0.2, 2.0, seed=1),
    "building, SBR 0.1": lambda: drawn(some_of("building", 16), 0.1041, 0.1, seed=2),
    "staircase, SBR 0.02": lambda: drawn(some_of("staircase", 16), 0.1041, 0.02, seed=3),
    "uniform, no background": lambda: drawn(some_of("uniform", 16), 0.05, np.inf, seed=4),
    "edges": lambda: drawn(some_of("edges", 16), 0.2, 0.1, seed=5),
    "fog": lambda: drawn(some_of("fog"), 0.5, 1.0, seed=6),
    "approach": lambda: drawn(some_of("approach"), 0.2, 0.5, seed=7),
    "worn": lambda: drawn(some_of("worn"), 0.2, 0.1, seed=8),
    "every part": lambda: drawn(everything(), 0.5, 0.5, seed=9),
    "few bins": lambda: drawn(depths(FEW), 0.4, 0.1, pulse=core.Pulse.gaussian(2e-9)),
    "many bins": lambda: drawn(depths(MANY), 0.02, 0.1, pulse=core.Pulse(0.4e-9)),
    "all photons": lambda: photons(400),
    "unknown pulses": lambda: photons(None),
    "first of all photons": lambda: core.first_photons(photons(400), 500, seed=3),
    "sample": sample,
}

MORE_SETTINGS: dict[str, tuple[dict[str, Any], ...]] = {
    "tracking": (
        vars(replace(core.PRESETS["literal"], l=0.001)),
        {"weight": "survival", "l": 0.01, "sigma_from": "before T_n"},
        {"weight": "none", "m": 2.0, "h": 0.8, "n": 300.0, "t_n": 5},
    ),
    "kde": ({"neighbourhood": "1x1"}, {"neighbourhood": "5x5", "bandwidth_bins": 1.0}),
    "shi": ({"width_bins": 1.0}, {"width_bins": 3.5}),
    "chi": ({"bandwidth_bins": 0.2}, {"bandwidth_bins": 1.5}),
    "cfar": ({"smoothing_bins": 0.0}, {"guard_bins": 1, "training_bins": 20}),
    "unmixing": ({"false_acceptance": 0.2, "growth": 1}, {"smoothness": 0.1}),
    "likelihood": ({"steps_per_bin": 5}, {"depths": "learned"}),
    "oracle": ({"steps_per_bin": 1}, {"depths": "learned"}),
}
"""Settings other than the defaults."""


def whole_bins(method: str) -> Any:
    """Return default settings of a method, tracking without its refinement below a bin.

    The likelihood, by which it is refined, has cases of its own.
    """
    return core.ESTIMATORS[method].parameters(
        **({"refine": "none"} if method == "tracking" else {})
    )


# -- cases -----------------------------------------------------------------------------------------


def estimates(name: str, _: Path) -> Answers:
    """Counts of a capture, and estimates of all applicable methods."""
    capture = CAPTURES[name]()
    yield "capture", capture
    known = capture.signal is not None and capture.background is not None
    for method in METHODS:
        if known or method != "oracle":
            yield method, core.estimate(capture, method, whole_bins(method))


def settings(method: str, _: Path) -> Answers:
    """Estimates of a method with other settings, and with a false-alarm rate."""
    capture = drawn(some_of("car"), 0.15, 0.15, seed=10)
    for each in MORE_SETTINGS.get(method, ()):
        name = ", ".join(f"{key} {value}" for key, value in each.items())
        yield name, core.estimate(capture, method, replace(whole_bins(method), **each))
    short = core.reductions.cut_gate(capture, 0, 60)
    yield "false alarms 0.1", core.estimate(short, method, whole_bins(method), false_alarm=0.1)


def tracking(_: Path) -> Answers:
    capture = CAPTURES["car"]()
    survival = core.TrackingParameters(weight="survival", start="zero", sigma_from="before T_n")
    settings = {
        "recommended": core.PRESETS["recommended"],
        "as printed": replace(core.PRESETS["literal"], l=0.001),
        "survival": survival,
    }
    for name, parameters in settings.items():
        yield name, core.tracking_signals(capture.cube[2, 3], parameters, 1000)
    yield "two pixels", core.tracking_signals(capture.cube[:2, 0, :40], survival, 1000)


def reductions(_: Path) -> Answers:
    capture, reduce = CAPTURES["worn"](), core.reductions
    yield "merge_bins", reduce.merge_bins(capture, 3)
    yield "cut_gate", reduce.cut_gate(capture, 15, 70)
    yield "skip_pixels", reduce.skip_pixels(capture, 2)
    yield "pool_pixels", reduce.pool_pixels(capture, 3)
    yield "first_pulses", reduce.first_pulses(capture, 200, seed=4)
    yield "of all photons", reduce.first_pulses(photons(400), 100)
    yield "of unknown pulses", reduce.share_of_pulses(photons(None), 0.3, seed=1)
    several = reduce.Reduction(merge=2, gate=(4, 90), skip=2, pulses=0.5)
    reduced = several.of(CAPTURES["car"]())
    yield "several", reduced
    image = core.estimate(reduced, "matched_filter")
    yield "spread", several.spread(image.range_m, (5, 6))


def corrections(_: Path) -> Answers:
    capture = drawn(some_of("car"), 0.3, 0.15, seed=11)
    for correction in core.CORRECTIONS:
        without = core.without_correction(capture, correction)
        for method in ("likelihood", "coates", "kde"):
            yield f"{correction}, {method}", core.estimate(without, method)
    scene = everything()
    for part in core.parts_of(scene):
        yield f"without {part}", drawn(core.without(scene, part), 0.5, 0.5).counts


def pixels(_: Path) -> Answers:
    for name in ("car", "worn", "all photons", "unknown pulses"):
        capture = CAPTURES[name]()
        for method in ("tracking", "likelihood", "shi"):
            chosen = method, whole_bins(method)
            image = core.estimate(capture, *chosen)
            report = core.inspection.pixel_report(capture, image, 1, 3, *chosen)
            flux = report.flux if method == "tracking" else None
            yield f"{name}, {method}", {"report": report, "flux": flux}


def regions(_: Path) -> Answers:
    for name, method in (("car", "tracking"), ("fog", "coates"), ("all photons", "likelihood")):
        capture = CAPTURES[name]()
        mask = core.inspection.pixels_in([(0, 0), (0, 4), (4, 4), (3, 0)], capture.shape)
        chosen = method, whole_bins(method)
        image = core.estimate(capture, *chosen)
        report = core.inspection.region_report(capture, image, mask, *chosen)
        yield name, {"mask": mask, "report": report, "flux": report.pixel.flux}


def whole(_: Path) -> Answers:
    for name in ("car, SBR 2", "worn", "all photons", "unknown pulses", "sample"):
        capture = CAPTURES[name]()
        yield name, core.inspection.capture_report(capture)
        # Of newer maps, the tests are elsewhere.
        maps = {key: of for key, of in core.inspection.maps.items() if key != "Returns"}
        yield f"{name}, maps", {key: of(capture) for key, of in maps.items()}
    for name in ("car, SBR 2", "sample"):
        chosen = "tracking", whole_bins("tracking")
        steps = core.inspection.accuracy_over_pulses(CAPTURES[name](), [0.1, 0.5], *chosen)
        yield f"{name}, fewer pulses", list(steps)


def figures(_: Path) -> Answers:
    capture, of = CAPTURES["edges"](), core.metrics
    ran = core.run(capture, "tracking", whole_bins("tracking"), false_alarm=0.2)
    answer_m, truth_m = ran.image.range_m, ran.capture.truth_range_m
    yield "run", {"image": ran.image, "figures": ran.figures}
    right = np.abs(of.errors_m(answer_m, np.nan_to_num(truth_m))) < 0.5
    reliability = of.reliability(ran.image.confidence.ravel(), right.ravel())
    again_m = [
        core.estimate(drawn(some_of("car"), 1.0, 1.0, seed=s), "peak").range_m for s in (1, 2)
    ]
    yield (
        "metrics",
        {
            "errors_m": of.errors_m(answer_m, truth_m),
            "precision": of.precision_recall(ran.image.valid, truth_m),
            "wilson": of.wilson(7, 30),
            "reliability": reliability,
            "calibration_error": of.calibration_error(reliability),
            "rd_variance": of.rd_variance([0.3, 0.7, 0.45]),
            "variance_m2": of.estimator_variance_m2(again_m, some_of("car").range_m),
        },
    )


def formulas(_: Path) -> Answers:
    acquisition = core.Acquisition(40, 1e-9, 2e-7, 300)
    onset, signal = np.linspace(3.3, 33.9, 7), np.geomspace(0.01, 2.0, 7)
    pulses = {
        "gamma": core.Pulse(1.3e-9),
        "gaussian": core.Pulse.gaussian(0.8e-9),
        "measured": core.Pulse.measured([0, 2, 5, 3, 1], 0.7e-9),
    }
    for name, pulse in pulses.items():
        light = (onset, signal, 0.7, pulse, acquisition)
        rate = core.rate_per_bin(*light)
        trigger = core.trigger_probability(rate)
        time_s = np.linspace(-2e-9, 9e-9, 15)
        yield (
            name,
            {
                "cdf": pulse.cdf(time_s),
                "density": pulse.density(time_s),
                "span_s": pulse.span_s,
                "taps": pulse.taps(40, 1e-9, [0.1, 0.6]),
                "trigger": trigger[::2],
                "no_trigger": core.no_trigger_probability(rate),
                "difference": core.first_difference(trigger[3]),
                "coates": core.coates_rate(np.round(300 * trigger[::3]), 300),
                "cramer_rao_m": core.limits.cramer_rao_m(*light),
                "right_bin": core.limits.right_bin_probability(*light),
                "exposure": core.limits.best_exposure(*light),
            },
        )
    yield "limit", core.limits.limit(CAPTURES["car"]())


def files(folder: Path) -> Answers:
    """Files written and read, windows read, and estimates in tiles."""
    capture = drawn(some_of("car"), 0.2, 0.2, seed=12)
    for suffix in (".npz", ".nc", ".zarr"):
        path = folder / f"capture{suffix}"
        core.save_capture(capture, path)
        yield f"capture{suffix}", core.read_capture(path)
        counts = core.open_capture(path)
        yield f"window{suffix}", core.read_window(counts, core.Window((1, 5), (0, 5), 2))
    yield "flux_prior", core.sampled_flux_prior(counts)
    for method, estimator in core.ESTIMATORS.items():
        if not estimator.whole_image and method != "oracle":
            alarms = 0.1 if method == "peak" else None
            parts = core.estimate_large(
                counts.chunk(row=4, col=3), method, whole_bins(method), false_alarm=alarms
            )
            ranged = parts.compute(scheduler="synchronous")
            yield f"parts, {method}", {key: ranged[key].to_numpy() for key in ranged}
    image = core.estimate(capture, "tracking", refine="none")
    core.save_image(capture, image, folder / "image.csv")
    core.save_pixel(capture, 2, 2, None, folder / "pixel.csv")
    for name in ("image", "pixel"):
        lines = (folder / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        table = [line for line in lines if not line.startswith("#")]
        yield f"{name}.csv", np.genfromtxt(table, delimiter=",", skip_header=1)
    core.save_image(capture, image, folder / "image.npz")
    with np.load(folder / "image.npz") as stored:
        provenance = {"method", "settings", "software"}  # tested with every format
        yield "image.npz", {key: stored[key] for key in stored.files if key not in provenance}


def scene_files(folder: Path) -> Answers:
    """Scenes from a mesh of a tetrahedron."""
    corners, faces = (
        np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [1, 1, 2]]),
        np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]]),
    )
    solid = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[face].ravel(), 0) for face in faces)
    path = folder / "tetrahedron.stl"
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + solid)
    yield "from afar", core.read_scene(path, size=(6, 8))
    near = core.read_scene(path, size=(6, 8), position_m=(4, -9, 3), direction=(-0.4, 1, -0.2))
    yield "from the right", near


CASES: dict[str, Callable[[Path], Answers]] = {
    **{f"estimate: {name}": partial(estimates, name) for name in CAPTURES},
    **{f"settings: {method}": partial(settings, method) for method in METHODS},
    "tracking signals": tracking,
    "reductions": reductions,
    "corrections and parts": corrections,
    "pixel reports": pixels,
    "region reports": regions,
    "capture reports": whole,
    "figures": figures,
    "formulas": formulas,
    "files": files,
    "scene files": scene_files,
}
"""Functions by case; each may write into a folder."""


# -- records ---------------------------------------------------------------------------------------


def numbers_in(value: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield all numbers in a value, with a name for each array."""
    if isinstance(value, bool | int | float | np.generic | np.ndarray):
        array = np.asarray(value)
        if array.dtype.kind in "biuf":
            yield name, array
        return
    if is_dataclass(value):
        inside = {each.name: getattr(value, each.name) for each in fields(value) if each.repr}
    elif hasattr(value, "_asdict"):
        inside = value._asdict()
    elif isinstance(value, dict):
        inside = value
    elif isinstance(value, list | tuple):
        inside = dict(enumerate(value))
    else:
        inside = {}
    for key, each in inside.items():
        yield from numbers_in(each, f"{name}.{key}")


def answers(case: str, folder: Path) -> Record:
    """Compute one of `CASES`."""
    named = (numbers_in(value, name) for name, value in CASES[case](folder))
    return dict(chain.from_iterable(named))


def stored() -> tuple[dict[str, Record], dict[str, Any]]:
    """Read the records of all cases, and the `fingerprint` of the machine that wrote them."""
    with np.load(FILE, max_header_size=10**6) as file:
        records = {case: file[case] for case in file.files}
    written_by: dict[str, Any] = json.loads(str(records.pop(FINGERPRINT)))
    found = {
        case: {name: np.asarray(record[name]) for name in record.dtype.names}
        for case, record in records.items()
    }
    return found, written_by


def fingerprint() -> dict[str, Any]:
    """Describe the processor and libraries on which last bits depend."""
    config: Any = np.show_config(mode="dicts")
    return {
        "machine": platform.machine(),
        "system": platform.system(),
        "processor": llvmlite.binding.get_host_cpu_name(),
        "numba's processor": [numba.config.CPU_NAME, numba.config.CPU_FEATURES],
        "numpy's instructions": config["SIMD Extensions"].get("found", []),
        "BLAS": [config["Build Dependencies"]["blas"].get(key) for key in ("name", "version")],
        "C library": list(platform.libc_ver()),
        "python": list(platform.python_version_tuple()[:2]),
        **{each.__name__: each.__version__ for each in (np, numba, llvmlite, scipy)},
    }


def write() -> None:
    """Write the file."""
    records: dict[str, np.ndarray] = {FINGERPRINT: np.array(json.dumps(fingerprint()))}
    n_arrays = 0
    for case in CASES:
        with TemporaryDirectory() as folder:
            found = answers(case, Path(folder))
        kind = [(name, array.dtype, array.shape) for name, array in found.items()]
        records[case] = np.array(tuple(found.values()), kind)
        n_arrays += len(found)
    np.savez_compressed(FILE, allow_pickle=False, **records)
    size = f"{FILE.stat().st_size:,} bytes"
    print(f"{n_arrays} arrays of {len(CASES)} cases: {size}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", action="store_true", required=True, help="rewrite the file")
    parser.parse_args()
    write()
