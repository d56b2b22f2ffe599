"""One way to refuse a value: say which, what it was, and what would be accepted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import Any

__all__ = [
    "refusing",
    "require",
]

_MOST_SHOWN = 200  # characters of a file's path


def require(name: str, value: object, accepted: bool, what: str) -> None:
    """Raise ``ValueError`` naming the field, the value and what would be accepted.

    A NaN fails every comparison, so a check written as what *is* accepted refuses it too.
    """
    if not accepted:
        raise ValueError(f"{name} = {value!r} is not accepted: give {what}.")


def require_whole(name: str, value: Any, most: int, also: str = "") -> None:
    """Raise ``ValueError`` unless a value is a whole number from 1 to `most`.

    Parameters
    ----------
    name, value
        As `require` takes them.
    most : int
        Largest number accepted.
    also : str
        What else would be accepted, for the message.
    """
    accepted = isinstance(value, Integral) and 1 <= int(value) <= most
    require(name, value, accepted, f"a whole number from 1 to {most:,}{also}")


def printable(text: str) -> str:
    """Text that any encoding of Unicode can hold: a file name may have bytes that are no text."""
    try:
        found = text.encode("utf-8", "surrogateescape")  # the bytes of the name
    except UnicodeEncodeError:
        found = text.encode("utf-8", "backslashreplace")
    return found.decode("utf-8", "backslashreplace")


def shown(path: Path | str) -> str:
    """A file name as messages show it, shortened in its middle where it is very long."""
    name = printable(str(path))
    if len(name) <= _MOST_SHOWN:
        return name
    return f"{name[: _MOST_SHOWN // 2]}...{name[-_MOST_SHOWN // 4 :]}"


def reason(error: BaseException) -> str:
    """Message of an error, without the file names that a system's error repeats."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return printable(text)


@contextmanager
def refusing(path: Path, kind: type[ValueError]) -> Iterator[None]:
    """Turn whatever goes wrong with a file into one type of error that names the file."""
    name = shown(path.name)
    try:
        yield
    except ValueError as error:
        if isinstance(error, kind) and str(error).startswith((f"{path.name}: ", f"{name}: ")):
            raise  # said already, by what reads a part of the file
        raise kind(f"{name}: {error}") from error
    except Exception as error:  # from a closed folder to memory too small
        raise kind(
            f"{name}: cannot be read ({type(error).__name__}: {reason(error)}): "
            "give a whole file that may be opened and fits in memory."
        ) from error
