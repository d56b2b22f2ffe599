"""Changes to Panel and Bokeh, one file each.

A patch is a module with a function ``apply``, or a script that runs in the browser once Bokeh is
loaded. Each file states what the library does, the upstream issue, and its gain or the error that
it fixes. ``python -m tests.patches`` measures gains by switching off one patch at a time. A patch
is left out, with a line in the log, with another version of a library than it was read against, and
by name in the environment variable ``FIRSTPHOTON_PATCHES_OFF``. The app works without any of them.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

__all__ = ["OFF_VARIABLE", "PATCHES", "Patch", "apply_patches", "in_use", "scripts"]

log = logging.getLogger(__name__)

OFF_VARIABLE = "FIRSTPHOTON_PATCHES_OFF"
"""Names of patches to leave out, separated by commas, or ``all``."""

_FOLDER = Path(__file__).parent
_BOKEH = {"bokeh": "3.9"}
_PANEL = {"panel": "1.9"}


@dataclass(frozen=True)
class Patch:
    """A file of this folder."""

    name: str
    """Name of the file, without ``.py`` or ``.js``."""
    versions: Mapping[str, str]
    """Version of each patched library that it was read against."""

    @property
    def mismatch(self) -> str | None:
        """The first library of another version; None if all match."""
        for library, expected in self.versions.items():
            found = version(library)
            if found != expected and not found.startswith(f"{expected}."):
                return f"{library} {found} instead of {expected}"
        return None


PATCHES = (
    # In the server
    Patch("callback_errors", _BOKEH | _PANEL),
    Patch("debounce", _PANEL),
    Patch("default_values", _BOKEH),
    Patch("early_changes", _BOKEH | _PANEL),
    Patch("freed_memory", _PANEL),
    Patch("removed_models", _BOKEH),
    Patch("outgoing_messages", _BOKEH),
    Patch("whole_messages", _BOKEH),
    # In the browser
    Patch("fold_titles", _PANEL),
    Patch("glyph_views", _BOKEH),
    Patch("immediate_paint", _BOKEH),
    Patch("latest_value", _BOKEH),
    Patch("legend_items", _BOKEH),
    Patch("list_keys", {"panel-material-ui": "0.16"}),
    Patch("lost_graphics", _BOKEH),
    Patch("narrow_window", _PANEL),
    Patch("one_layout", _BOKEH | _PANEL),
    Patch("plot_names", _BOKEH),
    Patch("server_wins", _PANEL),
    Patch("session_ended", _BOKEH),
    Patch("theme_at_once", _PANEL),
    Patch("unchanged_styles", _BOKEH),
    Patch("unfinished_layout", _BOKEH),
)


def in_use(patches: tuple[Patch, ...] = PATCHES) -> Iterator[Patch]:
    """Return the patches that are neither switched off nor made for other versions.

    Raises
    ------
    ValueError
        If ``FIRSTPHOTON_PATCHES_OFF`` names a patch that does not exist.
    """
    off = {name.strip() for name in os.environ.get(OFF_VARIABLE, "").split(",")} - {""}
    names = [patch.name for patch in patches]
    if unknown := off - {*names, "all"}:
        accepted = ", ".join(names)
        raise ValueError(f"{OFF_VARIABLE} names {min(unknown)!r}; accepted: all, {accepted}")
    for patch in patches:
        if "all" in off or patch.name in off:
            log.info("patch %s is switched off", patch.name)
        elif patch.mismatch is not None:
            log.warning("patch %s is left out: %s", patch.name, patch.mismatch)
        else:
            yield patch


def apply_patches() -> None:
    """Apply the patches of the server to this process."""
    for patch in in_use():
        if (_FOLDER / f"{patch.name}.py").exists():
            import_module(f"{__name__}.{patch.name}").apply()


@cache
def scripts() -> str:
    """JavaScript of the patches of the browser, to run before anything is drawn."""
    files = (_FOLDER / f"{patch.name}.js" for patch in in_use())
    return "\n".join(file.read_text(encoding="utf-8") for file in files if file.exists())
