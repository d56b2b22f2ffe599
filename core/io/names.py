"""Names of files that results are written to, the same on the command line and in the app."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from core.parameters import spec_of

MOST_LETTERS = 120
"""Longest file name; some systems accept at most 143 bytes."""

_MOST_OF_PART = 40  # letters


def file_name(
    what: str,
    suffix: str,
    *,
    capture: str,
    part: str = "",
    estimator: str = "",
    settings: Sequence[str] = (),
) -> str:
    """Return a file name that is safe for every system and shell.

    Parameters
    ----------
    what : str
        Content of the file, such as ``"range image"``.
    suffix : str
        Suffix of the format without the point.
    capture : str
        Name of the capture, such as that of its file without the suffix.
    part : str
        Rows and columns of the capture, if not all.
    estimator : str
        Empty for several or none.
    settings : sequence of str
        As `changed_settings` returns them; those that make the name too long are left out.

    Examples
    --------
    >>> file_name("range image", "tif", capture="my file", estimator="cfar", settings=["k3"])
    'my-file_cfar_k3_range-image.tif'
    """
    capture = plain(capture)[:_MOST_OF_PART].strip("-._") or "capture"
    what = plain(what)[:_MOST_OF_PART]
    begin = "_".join(filter(None, (capture, part, estimator)))
    room = MOST_LETTERS - len(f"{begin}_{what}.{suffix}")
    chosen = ""
    for each in settings:
        if len(chosen) + len(each) < room:
            chosen += f"_{each}"
    return f"{begin}{chosen}_{what}.{suffix}"


def changed_settings(settings: Any) -> list[str]:
    """Return the settings that differ from their default, as ``symbol value`` without the space.

    Parameters
    ----------
    settings : dataclass
        Its fields are made with `core.parameters.parameter`.

    Examples
    --------
    >>> import core
    >>> changed_settings(core.TrackingParameters(l=0.01, t_n=15))
    ['l0.01', 'Tn15']
    """
    return [
        named(_symbol(each), getattr(settings, each.name))
        for each in fields(settings)
        if getattr(settings, each.name) != each.default
    ]


def named(symbol: str, value: Any) -> str:
    """Return a symbol and its value as a part of a file name."""
    text = plain(value)
    return text if text.startswith(symbol) else symbol + text


def plain(value: Any) -> str:
    """Reduce a value to letters without accents, digits, points, dashes and underscores."""
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    ascii_ = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[^\w.+-]+", "-", ascii_).strip("-._")


def _symbol(field: Any) -> str:
    """Return a setting's symbol, or its name where the symbol has other than plain letters."""
    symbol = spec_of(field).symbol.replace("_", "")
    return symbol if symbol.isascii() and symbol.isalnum() else field.name.replace("_", "-")


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each of several files, no two alike even where case is ignored.

    The names are the files' stems; where some are equal, the folders and stems, else the file
    names, else numbered stems.

    Examples
    --------
    >>> distinct_names([Path("night/a.mat"), Path("day/a.mat")])
    ['night-a', 'day-a']
    """
    kinds: tuple[Callable[[Path], str], ...] = (
        lambda path: path.stem,
        lambda path: f"{path.absolute().parent.name}-{path.stem}",
        lambda path: path.name,
    )
    for kind in kinds:
        found = [plain(kind(path))[:_MOST_OF_PART].strip("-._") or "capture" for path in paths]
        if len({name.casefold() for name in found}) == len(found):
            return found
    room = _MOST_OF_PART - 8
    return [f"{plain(path.stem)[:room] or 'capture'}-{n}" for n, path in enumerate(paths, 1)]
