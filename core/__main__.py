"""The headless command line: ``python -m core <command> --help``."""

from __future__ import annotations

import argparse
import sys

from core.experiments import recommend, table2
from core.tracking import PRESETS


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m core", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    table = commands.add_parser("table2", help="the car under six SBRs, beside the paper's Table 2")
    table.add_argument("--seeds", type=int, default=20, help="simulated captures a row, 2 or more")
    table.add_argument("--preset", choices=PRESETS, default="recommended")
    commands.add_parser("recommend", help="the search that found the recommended preset")
    chosen = parser.parse_args(arguments)
    if chosen.command == "table2":
        most = recommend.SEEDS.start  # from there on they are the search's own
        if not 2 <= chosen.seeds <= most:
            table.error(f"--seeds {chosen.seeds} is not accepted: give 2 to {most}.")
        settings = PRESETS[chosen.preset]
        print(f"Preset {chosen.preset}, seeds 0 to {chosen.seeds - 1}: {settings}\n")
        print(table2.as_markdown(list(table2.table2(settings, range(chosen.seeds)))))
    else:
        _print_recommendation()
    return 0


def _print_recommendation() -> None:
    found = []
    for candidate in recommend.candidates():
        found.append(candidate)
        print(f"\r{len(found)} settings tried", end="", file=sys.stderr, flush=True)
    found.sort(key=lambda candidate: (candidate.passes, candidate.mean_rd), reverse=True)
    print("\n\n| mean RD | RD at each SBR | passes Table 2 | l | n | m | weight |")
    print("|---|---|---|---|---|---|---|")
    for candidate in found[:12]:
        s = candidate.settings
        each = " ".join(f"{rd:.3f}" for rd in candidate.rd)
        passes = "yes" if candidate.passes else "no"
        tried = f"{s.l} | {s.n:g} | {s.m} | {s.weight}"
        print(f"| {candidate.mean_rd:.4f} | {each} | {passes} | {tried} |")


if __name__ == "__main__":
    sys.exit(main())
