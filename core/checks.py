"""Checks of values, whose errors name the field, its value and what would be accepted."""

from __future__ import annotations

import reprlib
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import Any

__all__ = [
    "refusing",
    "require",
]

_MOST_OF_VALUE = 80  # characters
_MOST_SHOWN = 200  # characters of a file's path


def require(name: str, value: object, accepted: bool, what: str) -> None:
    """Raise ``ValueError`` unless a value is `accepted`.

    Write the check as a comparison that accepted values satisfy: NaN then fails it.

    Parameters
    ----------
    name : str
        Field, as the message names it.
    value : object
        Shown with ``repr``.
    accepted : bool
        Result of the check.
    what : str
        Values that would be accepted, for the message.
    """
    if not accepted:
        raise ValueError(f"{name} = {value!r} is not accepted: give {what}.")


def require_type(
    name: str, value: object, kind: type[Any] | tuple[type[Any], ...], what: str
) -> None:
    """Raise ``ValueError`` unless a value is of a type.

    Call it before comparing a value, which raises an error without a name for a value of another
    type.

    Parameters
    ----------
    name, what
        As for `require`.
    value : object
        Shown shortened.
    kind : type or tuple of type
        Such as ``numbers.Real`` for a number.
    """
    if not isinstance(value, kind):
        short = textwrap.shorten(reprlib.repr(value), _MOST_OF_VALUE, placeholder=" ...")
        raise ValueError(f"{name} = {short} is not accepted: give {what}.")


def require_whole(name: str, value: Any, most: int, also: str = "") -> None:
    """Raise ``ValueError`` unless a value is a whole number from 1 to `most`.

    Parameters
    ----------
    name, value
        As for `require`.
    most : int
        Largest accepted number.
    also : str
        Other accepted values, for the message.
    """
    accepted = isinstance(value, Integral) and 1 <= int(value) <= most
    require(name, value, accepted, f"a whole number from 1 to {most:,}{also}")


def require_pixel(row: Any, col: Any, shape: tuple[int, int]) -> None:
    """Raise ``ValueError`` unless a pixel lies within an image of a shape (row, col)."""
    (rows, cols), is_whole = shape, isinstance(row, Integral) and isinstance(col, Integral)
    inside = is_whole and 0 <= row < rows and 0 <= col < cols
    accepted = f"a pixel of {rows} rows and {cols} columns, by whole numbers from 0"
    require("row, col", (row, col), inside, accepted)


def printable(text: str) -> str:
    """Replace the bytes of a file name that are not valid text, so that it can be encoded."""
    try:
        found = text.encode("utf-8", "surrogateescape")  # the bytes of the name
    except UnicodeEncodeError:
        found = text.encode("utf-8", "backslashreplace")
    return found.decode("utf-8", "backslashreplace")


def shown(path: Path | str) -> str:
    """Return a file name for a message, with the middle of a very long one cut out."""
    name = printable(str(path))
    if len(name) <= _MOST_SHOWN:
        return name
    return f"{name[: _MOST_SHOWN // 2]}...{name[-_MOST_SHOWN // 4 :]}"


def reason(error: BaseException) -> str:
    """Return the message of an error, without the file names that the system appends."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return printable(text)


@contextmanager
def refusing(path: Path, kind: type[ValueError]) -> Iterator[None]:
    """Turn any error into one of type `kind` whose message begins with the file's name."""
    name = shown(path.name)
    try:
        yield
    except ValueError as error:
        if isinstance(error, kind) and str(error).startswith((f"{path.name}: ", f"{name}: ")):
            raise  # already names the file
        raise kind(f"{name}: {error}") from error
    except Exception as error:  # a missing permission, a lack of memory, ...
        raise kind(
            f"{name}: cannot be read ({type(error).__name__}: {reason(error)}): "
            "give a whole file that may be opened and fits in memory."
        ) from error
