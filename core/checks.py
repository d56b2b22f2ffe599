"""One way to refuse a value: say which, what it was, and what would be accepted."""

from __future__ import annotations


def require(name: str, value: object, accepted: bool, what: str) -> None:
    """Raise ``ValueError`` naming the field, the value and what would be accepted.

    A NaN fails every comparison, so a check written as what *is* accepted refuses it too.
    """
    if not accepted:
        raise ValueError(f"{name} = {value!r} is not accepted: give {what}.")
