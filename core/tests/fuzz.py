"""Read damaged files by the ten thousand: ``python -m core.tests.fuzz --files 20000``.

Every format of `core.tests.formats` is damaged at random places and read by another process, whose
memory is limited. A file may be read or refused by `CaptureError`, in time. Anything else, such as
another exception, a crash, a hang, or memory beyond the limit, is a failure: the file is kept, and
the command ends with 1.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory

from core.cli.options import show_progress
from core.studies.outputs import as_markdown
from core.tests.formats import FORMATS, damaged, put

LARGEST_CUBE_BYTES = 2**26
"""The readers' limit during the test."""

HEADROOM_BYTES = 6 * LARGEST_CUBE_BYTES
"""Growth of memory that is allowed: a cube, its source, and what libraries keep."""

SECONDS_A_FILE = 20
_BATCH = 2000

READ, REFUSED = "read", "refused"


def fuzz(n_files: int, seed: int, kept: Path) -> Counter[tuple[str, str]]:
    """Read damaged files; count the outcomes of each format.

    Parameters
    ----------
    n_files : int
        Distributed evenly among the formats.
    seed : int
        The same seed damages the same bytes.
    kept : Path
        Folder for the files on which a reader failed.
    """
    outcomes: Counter[tuple[str, str]] = Counter()
    names = list(islice(cycle(FORMATS), n_files))
    rng = random.Random(seed)
    contents = {name: form.build() for name, form in FORMATS.items()}
    for first in range(0, n_files, _BATCH):
        with TemporaryDirectory() as folder:
            files = []
            for number, name in enumerate(names[first : first + _BATCH], first):
                path = Path(folder) / str(number) / FORMATS[name].name
                path.parent.mkdir()
                files.append((name, put(path, damaged(contents[name], rng))))
            n_shares = os.cpu_count() or 1
            shares = [files[k::n_shares] for k in range(n_shares)]
            with ThreadPoolExecutor() as pool:
                found = pool.map(
                    lambda share: list(zip(share, _outcomes(share), strict=True)), shares
                )
            for (name, path), outcome in (pair for share in found for pair in share):
                outcomes[name, outcome] += 1
                if outcome not in (READ, REFUSED):
                    kept.mkdir(parents=True, exist_ok=True)
                    copy = shutil.copytree if path.is_dir() else shutil.copy
                    copy(path, kept / f"{path.parent.name}_{path.name}")
        show_progress(min(first + _BATCH, n_files), n_files)
    return outcomes


def _outcomes(files: list[tuple[str, Path]]) -> Iterator[str]:
    """Yield the outcome of each file; a process that dies is replaced for the remaining files."""
    while files:
        done = subprocess.run(
            [sys.executable, "-m", "core.tests.fuzz", "--read"],
            input="".join(f"{name}\t{path}\n" for name, path in files),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            check=False,
        )
        found = done.stdout.splitlines()
        yield from found
        if len(found) < len(files):
            hung = done.returncode == -signal.SIGALRM
            yield f"more than {SECONDS_A_FILE} s" if hung else f"crash, exit code {done.returncode}"
        files = files[len(found) + 1 :]


def read_files() -> None:
    """Print the outcome of each file of the standard input; runs in a process of its own."""
    from core.capture import CaptureError  # noqa: PLC0415
    from core.io.readers import guards, read_capture  # noqa: PLC0415

    with TemporaryDirectory() as folder:
        for number, form in enumerate(
            FORMATS.values()
        ):  # import libraries before memory is limited
            path = Path(folder) / str(number) / form.name
            path.parent.mkdir()
            read_capture(put(path, form.build()), **form.needs)
    guards.MAX_CUBE_BYTES = LARGEST_CUBE_BYTES
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + HEADROOM_BYTES,) * 2)
    warnings.simplefilter("ignore")
    for line in sys.stdin:
        name, path = line.rstrip("\n").split("\t")
        signal.alarm(SECONDS_A_FILE)  # ends the process
        try:
            read_capture(path, **FORMATS[name].needs)
            outcome = READ
        except CaptureError as error:
            outcome = "memory beyond the limit" if _is_of_memory(error) else REFUSED
        except BaseException as error:
            outcome = f"{type(error).__name__}"
        print(outcome, flush=True)


def _is_of_memory(error: BaseException | None) -> bool:
    """Return whether any error in the chain of causes is one of memory."""
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
        read_files()
        return 0
    started = time.perf_counter()
    outcomes = fuzz(chosen.files, chosen.seed, chosen.kept)
    rows = []
    for name in FORMATS:
        found = {outcome: n for (form, outcome), n in outcomes.items() if form == name}
        read, refused = found.pop(READ, 0), found.pop(REFUSED, 0)
        failed = ", ".join(f"{n} x {outcome}" for outcome, n in found.items()) or "0"
        rows.append((name, read, refused, failed))
    print(f"\n\n{as_markdown(('format', 'read', 'refused', 'failed'), rows)}")
    failures = sum(n for (_, outcome), n in outcomes.items() if outcome not in (READ, REFUSED))
    took = time.perf_counter() - started
    print(f"\n{chosen.files} damaged files in {took:.0f} s, {failures} failures.")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
