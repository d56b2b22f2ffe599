"""Damaged files by the ten thousand: ``python -m core.tests.fuzz --files 20000``, or `make fuzz`.

Every format of `core.tests.formats` is damaged at random places and read by another process, whose
memory is limited. A file may be read or refused by `CaptureError`, in time; whatever else happens,
another exception, a crash, a hang, or memory beyond the limit, is a failure: the file is kept, and
the command ends with 1.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Timer
from typing import Any

from core.cli.options import show_progress
from core.studies.outputs import as_markdown
from core.tests.formats import FORMATS, damaged, put

LARGEST_CUBE_BYTES = 2**26
"""The readers' limit while they are tried."""

HEADROOM_BYTES = 6 * LARGEST_CUBE_BYTES
"""By how much memory may grow: a cube, what it was made of, and what libraries keep for later."""

SECONDS_A_FILE = 20.0
_BATCH = 2000

READ, REFUSED = "read", "refused"


def fuzz(n_files: int, seed: int, kept: Path) -> Counter[tuple[str, str]]:
    """Read damaged files; how many of each format ended in which way.

    Parameters
    ----------
    n_files : int
        Shared out evenly among the formats.
    seed : int
        The same seed damages the same bytes.
    kept : Path
        Where to put files on which a reader failed.
    """
    outcomes: Counter[tuple[str, str]] = Counter()
    names = [name for name, _ in zip(_forever(FORMATS), range(n_files), strict=False)]
    rng = random.Random(seed)
    contents = {name: form.build() for name, form in FORMATS.items()}
    for first in range(0, n_files, _BATCH):
        with TemporaryDirectory() as folder:
            paths = []
            for number, name in enumerate(names[first : first + _BATCH], first):
                path = Path(folder) / str(number) / FORMATS[name].name
                path.parent.mkdir()
                if not isinstance(contents[name], bytes):
                    path.mkdir()
                paths.append((name, put(path, damaged(contents[name], rng))))
            for name, path, outcome in _all_outcomes(paths):
                outcomes[name, outcome] += 1
                if outcome not in (READ, REFUSED):
                    kept.mkdir(parents=True, exist_ok=True)
                    copy = shutil.copytree if path.is_dir() else shutil.copy
                    copy(path, kept / f"{path.parent.name}_{path.name}")
        show_progress(min(first + _BATCH, n_files), n_files)
    return outcomes


def _forever(names: Any) -> Iterator[str]:
    while True:
        yield from names


def _all_outcomes(paths: list[tuple[str, Path]]) -> Iterator[tuple[str, Path, str]]:
    """Each file with how it ended, as many files at a time as there are cores."""
    cores = os.cpu_count() or 1
    shares = [paths[k::cores] for k in range(cores)]
    with ThreadPoolExecutor(cores) as pool:
        for share, found in zip(
            shares, pool.map(lambda share: list(_outcomes(share)), shares), strict=True
        ):
            yield from ((*path, outcome) for path, outcome in zip(share, found, strict=True))


def _outcomes(paths: list[tuple[str, Path]]) -> Iterator[str]:
    """How each file ended; a process that dies or hangs is replaced, and goes on with the next."""
    done = 0
    while done < len(paths):
        with subprocess.Popen(
            [sys.executable, "-m", "core.tests.fuzz", "--read"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as reader:
            assert reader.stdin is not None and reader.stdout is not None
            try:
                reader.stdout.readline()  # it is ready
                for name, path in paths[done:]:
                    reader.stdin.write(f"{name}\t{path}\n")
                    reader.stdin.flush()
                    outcome = _line(reader)
                    done += 1
                    yield outcome
                    if outcome.startswith(("crash", "hang")):
                        break
            finally:
                reader.kill()


def _line(reader: subprocess.Popen[str]) -> str:
    """What the process says of a file, in time."""
    assert reader.stdout is not None
    watchdog = _Watchdog(reader)
    said = reader.stdout.readline().strip()
    if watchdog.stop():
        return f"hang of more than {SECONDS_A_FILE:g} s"
    return said or f"crash, exit code {reader.wait()}"


class _Watchdog:
    """Kills a process that takes too long."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._barked = False
        self._process = process
        self._timer = Timer(SECONDS_A_FILE, self._bark)
        self._timer.start()

    def _bark(self) -> None:
        self._barked = True
        self._process.kill()

    def stop(self) -> bool:
        self._timer.cancel()
        return self._barked


def _read_what_is_asked() -> None:
    """The other process: a line for each line."""
    from core.capture import CaptureError  # noqa: PLC0415
    from core.io.readers import guards, read_capture  # noqa: PLC0415

    for form in FORMATS.values():  # libraries come before memory is limited
        with TemporaryDirectory() as folder:
            path = Path(folder) / form.name
            content = form.build()
            if not isinstance(content, bytes):
                path.mkdir()
            read_capture(put(path, content), **form.needs)
    guards.MAX_CUBE_BYTES = LARGEST_CUBE_BYTES
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + HEADROOM_BYTES,) * 2)
    warnings.simplefilter("ignore")
    print("ready", flush=True)
    for line in sys.stdin:
        name, path = line.rstrip("\n").split("\t")
        try:
            read_capture(path, **FORMATS[name].needs)
            outcome = READ
        except CaptureError as error:
            outcome = "memory beyond the limit" if _is_of_memory(error) else REFUSED
        except BaseException as error:
            outcome = f"{type(error).__name__}"
        print(outcome, flush=True)


def _is_of_memory(error: BaseException | None) -> bool:
    """Whether memory was too small, wherever in the chain of causes that is said."""
    if error is None:
        return False
    return "MemoryError" in f"{type(error)} {error}" or _is_of_memory(error.__cause__)


def main(arguments: list[str] | None = None) -> int:
    """Run from a shell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kept", type=Path, default=Path("fuzz"), help="folder for failures")
    parser.add_argument("--read", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.read:
        _read_what_is_asked()
        return 0
    started = time.perf_counter()
    outcomes = fuzz(chosen.files, chosen.seed, chosen.kept)
    rows = []
    for name in FORMATS:
        found = {way: n for (form, way), n in outcomes.items() if form == name}
        read, refused = found.pop(READ, 0), found.pop(REFUSED, 0)
        failed = ", ".join(f"{n} x {way}" for way, n in found.items()) or "0"
        rows.append((name, read, refused, failed))
    print(f"\n\n{as_markdown(('format', 'read', 'refused', 'failed'), rows)}")
    failures = sum(n for (_, way), n in outcomes.items() if way not in (READ, REFUSED))
    took = time.perf_counter() - started
    print(f"\n{chosen.files} damaged files in {took:.0f} s, {failures} failures.")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
