"""Small files that take much memory or time, given to the command line."""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from core.io.readers import read_capture
from core.io.readers.labelled import dataset
from core.tests.formats import put
from core.tests.labelled_files import zarr_files
from core.tests.samples import OWN_FIELDS, cells_of, mat_bytes, npz_bytes
from tests.attacks.attack import MIB, Attack, Ended, Outcome, command, last_line

MOST_BYTES = 1536 * MIB
MOST_S = 30.0
"""Limits on a command for one of these files, its start and compilation included."""

CUBE = np.random.default_rng(0).poisson(0.1, (3, 4, 100)).astype(np.uint8)


def zarr_of(folder: Path, element_bytes: float) -> Path:
    """A capture as Zarr whose chunks claim elements of this size to have been shuffled."""
    path = put(folder / "whole.npz", npz_bytes(**OWN_FIELDS))
    files = zarr_files(dataset(read_capture(path)), 2)
    (name,) = (each for each in files if each.endswith("counts/.zarray"))
    known = json.loads(files[name])
    known["filters"] = [{"id": "shuffle", "elementsize": element_bytes}]
    return put(folder / "shuffled.zarr", files | {name: json.dumps(known).encode()})


def numbers(**changed: Any) -> bytes:
    """Our own layout with some of its fields changed."""
    return npz_bytes(**OWN_FIELDS | changed)


def stray(*times: float) -> bytes:
    """Arrival times in seconds of twelve pixels, each with these photons."""
    return mat_bytes(arrivals=cells_of([np.array(times)] * 12, (3, 4)))


HUNGRY: dict[str, bytes] = {
    "one pixel of 10⁶ bins.npz": npz_bytes(cube=np.zeros((1, 1, 1_000_000), np.uint8)),
    "9·10⁶ pixels of one bin.npz": npz_bytes(cube=np.zeros((3000, 3000, 1), np.uint8)),
    "a pulse of 2²⁰ samples.npz": npz_bytes(
        cube=CUBE,
        bin_width_s=1e-9,
        pulse_shape="measured",
        pulse_tau_s=1e-9,
        pulse_samples=np.ones(2**20),
    ),
}
"""Files of some kilobytes whose estimates would take minutes or gigabytes."""

STRAY: dict[str, bytes] = {
    "photons at 1 ms and 1 ps.mat": stray(1e-3 - 1e-9, 1e-12),
    "photons at 10⁸ and 1.mat": stray(1e8, 1.0),
    "most photons near 1 µs, one at 1 s.mat": stray(
        *(1e-6 + 1e-9 * np.random.default_rng(1).integers(0, 200, 50)), 1.0
    ),
}

IMPOSSIBLE: dict[str, bytes] = {
    "2⁶³ pulses.npz": numbers(n_pulses=2.0**63),
    "1e300 pulses.npz": numbers(n_pulses=1e300),
    "tau of 1e300 s.npz": numbers(pulse_shape="gaussian", pulse_tau_s=1e300, pulse_samples=[]),
    "bins of 5e-324 s.npz": numbers(bin_width_s=5e-324),
}
"""Numbers that must be refused."""

EXTREME: dict[str, bytes] = {
    "tau of 5e-324 s.npz": numbers(pulse_shape="gaussian", pulse_tau_s=5e-324, pulse_samples=[]),
    "bins of 1e300 s.npz": numbers(bin_width_s=1e300),
    "gate after 1e300 s.npz": numbers(gate_delay_s=1e300),
    "angle of 1e300 rad.npz": numbers(pixel_angle_rad=1e300),
    "samples of 1e300.npz": numbers(pulse_samples=np.array([1e300, 1e300, 1e300])),
    "samples of 5e-324.npz": numbers(pulse_samples=np.array([5e-324, 5e-324, 5e-324])),
    "background of 1e300.npz": numbers(background=1e300),
}
"""Numbers that no instrument writes: refused, or processed without harm."""


def verdict(ended: Ended, must_refuse: bool = False) -> tuple[str, bool]:
    """Return how a command ended, and whether that is acceptable."""
    n_mib = ended.peak_bytes / MIB
    took = f"{ended.seconds:.1f} s, {n_mib:.0f} MiB"
    if ended.status is None:
        return f"STOPPED after {took}", False
    trace = "Traceback" in ended.printed
    said = {0: "ranged", 2: "refused"}.get(ended.status, f"status {ended.status}")
    words = f"{said} in {took}" + (": " + last_line(ended.printed) if ended.status else "")
    fine = ended.status == 2 or (ended.status == 0 and not must_refuse)
    is_small = ended.seconds < MOST_S and ended.peak_bytes < MOST_BYTES
    return words + (", with a traceback" if trace else ""), fine and is_small and not trace


def judged(ended: Ended, must_refuse: bool = False) -> Outcome:
    """The outcome of one command."""
    said, held = verdict(ended, must_refuse)
    return Outcome(1, said, held, ended.peak_bytes)


def ranged(name: str, content: bytes, folder: Path) -> Outcome:
    """Estimate ranges by the tracking differentiator."""
    path = put(folder / name, content)
    return judged(command("-m", "core", "estimate", "tracking", "--capture", path))


def looked_into(name: str, content: bytes, folder: Path) -> Outcome:
    """Describe a file."""
    return judged(command("-m", "core", "info", put(folder / name, content)))


EVERY_METHOD = """
import sys
from core import ESTIMATORS, estimate, read_capture
capture = read_capture(sys.argv[1])
for name in ESTIMATORS:
    try:
        estimate(capture, name)
    except ValueError as error:
        print(name, error)
"""


def by_every_method(name: str, content: bytes, folder: Path) -> Outcome:
    """Estimate ranges by every method, one after the other."""
    ended = command("-c", EVERY_METHOD, put(folder / name, content), limit_s=60)
    said, _ = verdict(ended)
    held = ended.status == 0 and ended.peak_bytes < MOST_BYTES
    return Outcome(1, said, held, ended.peak_bytes)


def shuffled(folder: Path) -> Outcome:
    """A chunk of 2.4 kB with elements of 10⁹ bytes."""
    path = zarr_of(folder, 1_000_000_000)
    return judged(command("-m", "core", "info", path, limit_s=40), must_refuse=True)


def extremes(folder: Path) -> Outcome:
    """Numbers in a file that no instrument writes."""
    wrong, known = [], IMPOSSIBLE | EXTREME
    script = """
import sys, warnings
warnings.simplefilter("ignore")
from core import CaptureError, estimate, read_capture
for path in sys.argv[1:]:
    try:
        estimate(read_capture(path), "tracking")
        print("ranged")
    except CaptureError as error:
        print("refused", " ".join(str(error).split()))
    except BaseException as error:
        print("FAILED", type(error).__name__, " ".join(str(error).split()))
"""
    paths = [put(folder / name, content) for name, content in known.items()]
    ended = command("-c", script, *paths, limit_s=45)
    said = [line for line in ended.printed.splitlines() if re.match("ranged|refused|FAILED", line)]
    for name, line in zip(known, said, strict=False):
        if line.startswith("FAILED") or (name in IMPOSSIBLE and line == "ranged"):
            wrong.append(f"{name.removesuffix('.npz')}: {last_line(line, 50)}")
    if len(said) < len(known):
        wrong.append(f"only {len(said)} of {len(known)} looked at: {last_line(ended.printed)}")
    said_ = "; ".join(wrong) or "refused by their fields, or ranged without harm"
    return Outcome(len(known), said_, not wrong, ended.peak_bytes)


def ports(folder: Path) -> Outcome:
    """Ports that do not exist."""
    said, wrong, peak = [], [], 0
    for port in ("70000", "-1", "1e3"):
        ended = command("-m", "app", f"--port={port}", limit_s=30)
        peak = max(peak, ended.peak_bytes)
        said.append(last_line(ended.printed, 60))
        if ended.status in (0, None) or "Traceback" in ended.printed:
            wrong.append(f"--port {port}: {last_line(ended.printed, 60)}")
    return Outcome(3, "; ".join(wrong or said), not wrong, peak)


def long_name(folder: Path) -> Outcome:
    """A name that no file system accepts, to read and to write."""
    name, wrong, peak = "x" * 300, [], 0
    sample = "assets/sample_capture.npz"
    for arguments in (
        ("info", f"{folder}/{name}.npz"),
        ("estimate", "tracking", "--capture", sample, "--out", f"{folder}/{name}.tif"),
        ("estimate", "tracking", "--capture", f"{folder}/{name}.zarr"),
    ):
        ended = command("-m", "core", *arguments)
        peak = max(peak, ended.peak_bytes)
        printed = last_line(ended.printed, 999)
        own = "Errno" not in printed and "Traceback" not in ended.printed
        if ended.status in (0, None) or not own:
            wrong.append(f"{arguments[0]}: status {ended.status}, {printed.replace(name, 'x…x')}")
    return Outcome(3, "; ".join(wrong) or "refused in our own words", not wrong, peak)


def full_disk(folder: Path) -> Outcome:
    """A TIFF, an NPZ and a PLY of which only the first 4 kB can be written."""
    wrong, peak = [], 0

    for suffix in (".tif", ".npz", ".ply"):
        out = folder / f"cut{suffix}"
        sample = "assets/sample_capture.npz"
        ended = command(
            *("-m", "core", "estimate", "tracking", "--capture", sample, "--out", str(out)),
            largest_file_bytes=4096,
        )
        peak = max(peak, ended.peak_bytes)
        printed = last_line(ended.printed)
        own = out.name in printed and "Traceback" not in ended.printed
        if ended.status != 1 or not own or out.exists():
            left = ", half a file left" if out.exists() else ""
            wrong.append(f"{suffix}: status {ended.status}, {printed}{left}")
    said = "; ".join(wrong) or f"reported by the file's name ({os.strerror(errno.EFBIG)})"
    return Outcome(3, said, not wrong, peak)


def plain_locale(folder: Path) -> Outcome:
    """A file name beyond ASCII with an ASCII locale."""
    content, wrong, peak, said = numbers(), [], 0, []
    (folder / "Dämmerung").mkdir(exist_ok=True)
    path = put(folder / "Dämmerung" / "größe.npz", content)
    out = folder / "Dämmerung" / "größe.tif"
    for environment in ({"LC_ALL": "C"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}):
        out.unlink(missing_ok=True)
        ranging = ("estimate", "tracking", "--capture", path, "--out", out)
        ended = command("-m", "core", *ranging, **environment)
        peak = max(peak, ended.peak_bytes)
        said.append(ended.status)
        if ended.status != 0 or not out.exists():
            how = " ".join(f"{key}={value}" for key, value in environment.items())
            wrong.append(f"{how}: {last_line(ended.printed, 90)}")
    return Outcome(len(said), "; ".join(wrong) or "read and written", not wrong, peak)


def _attack(title: str, run: Callable[[Path], Outcome]) -> Attack:
    return Attack(title, run, needs_server=False)


ATTACKS = [
    *(
        _attack(f"command, {name}", partial(ranged, name, content))
        for name, content in (HUNGRY | STRAY).items()
    ),
    *(
        _attack(f"info, {name}", partial(looked_into, name, content))
        for name, content in list(HUNGRY.items())[:2]
    ),
    _attack(
        "every method, one pixel of 10⁶ bins", partial(by_every_method, *next(iter(HUNGRY.items())))
    ),
    _attack("Zarr, elements of 10⁹ bytes shuffled", shuffled),
    _attack("extreme numbers in files", extremes),
    _attack("--port 70000, -1, 1e3", ports),
    _attack("file names of 300 characters", long_name),
    _attack("a disk that is full after 4 kB", full_disk),
    _attack("LC_ALL=C and a name beyond ASCII", plain_locale),
]
