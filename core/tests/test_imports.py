"""Tests of the order in which modules import each other, and of public names."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

import core

PACKAGE = Path(core.__file__).parent

ROOMS = (
    {"kernels", "checks", "deprecation", "notebook", "scripts", "typesetting", "version"},
    {"parameters", "acquisition"},
    {"trigger", "effects", "geometry", "labels", "metrics", "pulse_groups", "tracking_parameters"},
    {"scene", "tracking", "capture"},
    {"simulation", "reductions", "inference"},
    {"corrections", "cost", "photon_budget"},
    {"estimators"},
    {"inspection", "pipeline", "io", "tuning"},
    {"out_of_core", "report", "warmup"},
    {"studies"},
    {"cli"},
)
"""From the bottom up: a module imports from its own room and from rows before its own."""


def imported_names(path: Path) -> Iterator[tuple[str, str]]:
    """Modules and names that a file imports at run time."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and id(node) not in for_types:
            yield from ((node.module or "", alias.name) for alias in node.names)


def sources(package: Path) -> list[Path]:
    """Source files of a package without its tests."""
    return sorted(
        path for path in package.rglob("*.py") if "tests" not in path.relative_to(package).parts
    )


def room_of(module: str, name: str = "") -> str:
    """Part of a dotted name below the package; ``from core import x`` counts as x's."""
    return f"{module}.{name}".split(".")[1]


def imports_of_higher_rooms(package: Path, rooms: tuple[set[str], ...]) -> list[str]:
    """Return imports of a package's modules from rows of rooms that do not precede their own."""
    row_of = {room: row for row, names in enumerate(rooms) for room in names}
    wrong = []
    for path in sources(package):
        room = path.relative_to(package).parts[0].removesuffix(".py")
        if room in ("__init__", "__main__"):
            continue
        for module, name in imported_names(path):
            if module.partition(".")[0] == package.name:
                other = room_of(module, name)
                if other != room and row_of[other] >= row_of[room]:
                    wrong.append(f"{path.relative_to(package)} imports {module}.{name}")
    return wrong


@pytest.mark.uncounted
def test_each_room_imports_from_lower_rooms_only() -> None:
    assert imports_of_higher_rooms(PACKAGE, ROOMS) == []


@pytest.mark.parametrize("name", ["core", *core.PUBLIC_MODULES])
def test_public_names_exist(name: str) -> None:
    module = import_module(name)
    assert module.__doc__
    assert len(module.__all__) == len(set(module.__all__))
    for each in module.__all__:
        assert hasattr(module, each)


def test_old_names_of_attributes_warn() -> None:
    estimator = core.ESTIMATORS["coates"]
    for old, new in (("light", "flux_model"), ("reach", "window_size"), ("spares", "omits")):
        with pytest.warns(DeprecationWarning, match=f"is now called {new}"):
            assert getattr(estimator, old) is getattr(estimator, new)
    assert core.metrics.Told is core.metrics.ReliabilityBin
    assert core.metrics.Detection is core.metrics.DetectionRates
    assert core.inspection.Candidate is core.inspection.RangeCandidate
