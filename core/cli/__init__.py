"""The headless command line, ``python -m core <command> --help``."""

from __future__ import annotations

import argparse
import io
import os
import sys
from pathlib import Path

import core
from core.cli import ablation, batch, budget, captures, report, studies, tradeoff
from core.cli.results import CheckFailed, Incomplete
from core.io import TRUTH_OPTIONS, with_flags

ACCEPTED, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done; the machine (such as a full disk), a check or a part failed; bad input; Ctrl-C.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack letters of a file name
            stream.reconfigure(errors="backslashreplace")
    is_installed = Path(sys.argv[0]).stem == "firstphoton-core"
    parser = argparse.ArgumentParser(
        prog="firstphoton-core" if is_installed else "python -m core",
        description="First-photon lidar without a screen: read, simulate and range captures, and "
        "repeat every study.",
    )
    parser.add_argument("--version", action="version", version=f"firstphoton {core.__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    for room in (captures, budget, report, batch, studies, tradeoff, ablation):
        room.add(commands)
    chosen = parser.parse_args(arguments)
    chosen.arguments = sys.argv[1:] if arguments is None else arguments
    try:
        chosen.work(chosen)
        sys.stdout.flush()
    except (ValueError, FileExistsError) as error:
        message = with_flags(str(error), *TRUTH_OPTIONS)
        return _report(FAILED if _is_of_machine(error) else REFUSED, message)
    except BrokenPipeError:  # the reader of our output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (OSError, CheckFailed, Incomplete) as error:
        return _report(FAILED, error)
    except MemoryError as error:
        return _report(FAILED, f"not enough memory: {error}")
    except KeyboardInterrupt:
        return _report(INTERRUPTED, "Interrupted.")
    return ACCEPTED


def _is_of_machine(error: BaseException | None) -> bool:
    """Return whether a file was refused because the machine failed."""
    if error is None:
        return False
    failed = isinstance(error, OSError | MemoryError) and not isinstance(error, FileExistsError)
    return failed or _is_of_machine(error.__cause__)


def _report(code: int, reason: object) -> int:
    print(f"\n{reason}", file=sys.stderr)
    return code
