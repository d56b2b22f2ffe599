"""The app imports public names of core, and its rooms import lower rooms only."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import app
import core
from core.tests.test_imports import imported_names, imports_of_higher_rooms, sources

PACKAGE = Path(app.__file__).parent

ROOMS = (
    {"theme", "units", "tasks"},
    {"model"},
    {"handout"},
    {"plots"},
    {"widgets"},
    {"pages"},
    {"server"},
)
"""From the bottom up: a module imports from its own room and from rows before its own."""


def test_the_app_uses_public_names_of_core_only() -> None:
    public = {
        (module, name)
        for module in ("core", *core.PUBLIC_MODULES)
        for name in import_module(module).__all__
    }
    private = [
        f"{path.relative_to(PACKAGE)} imports {module}.{name}"
        for path in sources(PACKAGE)
        for module, name in imported_names(path)
        if module.partition(".")[0] == "core" and (module, name) not in public
    ]
    assert private == []


def test_each_room_imports_from_lower_rooms_only() -> None:
    assert imports_of_higher_rooms(PACKAGE, ROOMS) == []
