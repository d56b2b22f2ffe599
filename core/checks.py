"""One way to refuse a value: say which, what it was, and what would be accepted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import Any


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


@contextmanager
def refusing(path: Path, kind: type[ValueError]) -> Iterator[None]:
    """Turn whatever goes wrong with a file into one type of error that names the file."""
    try:
        yield
    except ValueError as error:
        if isinstance(error, kind) and str(error).startswith(f"{path.name}: "):
            raise  # said already, by what reads a part of the file
        raise kind(f"{path.name}: {error}") from error
    except Exception as error:  # from a closed folder to memory too small
        raise kind(
            f"{path.name}: cannot be read ({type(error).__name__}: {error}): "
            "give a whole file that may be opened and fits in memory."
        ) from error
