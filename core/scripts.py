"""Python code of calls and settings, for scripts that repeat what was computed.

Settings are written as the ``repr`` of their dataclasses without fields at their default, so that a
new field needs no line here. Text from outside can only become a string literal.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

__all__ = ["LINE_LENGTH", "assign", "call", "changed_fields", "literal"]

LINE_LENGTH = 88
"""Characters of a line; a longer call has one argument per line, as formatters write it."""


def changed_fields(settings: Any) -> dict[str, str]:
    """Return the fields of a dataclass object that differ from their default, as code."""
    values = {each: getattr(settings, each.name) for each in fields(settings)}
    return {each.name: literal(value) for each, value in values.items() if value != each.default}


def literal(value: Any) -> str:
    """Return the code of a value: a literal, or the call that makes a dataclass of `core`."""
    if is_dataclass(value):
        return call(f"core.{type(value).__name__}", **changed_fields(value))
    if isinstance(value, tuple):
        items = [literal(each) for each in value]
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(value, str):
        code = repr(value)
        # Formatters prefer double quotes where the text has none.
        return f'"{code[1:-1]}"' if code[0] == "'" and '"' not in code else code
    if isinstance(value, bool | int | float):
        return repr(value)
    raise TypeError(f"no code for {type(value).__name__}")


def call(function: str, *positional: str, **named: str) -> str:
    """Return a call on one line."""
    return f"{function}({', '.join(_arguments(*positional, **named))})"


def assign(name: str, function: str, *positional: str, **named: str) -> str:
    """Return a call, its result assigned to `name` unless empty, on as many lines as needed."""
    start = f"{name} = " if name else ""
    line = start + call(function, *positional, **named)
    if len(line) <= LINE_LENGTH:
        return line
    arguments = "".join(f"    {each},\n" for each in _arguments(*positional, **named))
    return f"{start}{function}(\n{arguments})"


def _arguments(*positional: str, **named: str) -> list[str]:
    return [*positional, *(f"{name}={value}" for name, value in named.items())]
