"""One way to refuse a value: say which, what it was, and what would be accepted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def require(name: str, value: object, accepted: bool, what: str) -> None:
    """Raise ``ValueError`` naming the field, the value and what would be accepted.

    A NaN fails every comparison, so a check written as what *is* accepted refuses it too.
    """
    if not accepted:
        raise ValueError(f"{name} = {value!r} is not accepted: give {what}.")


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
