"""Typed notifications."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Signal(Generic[Value]):
    """A notification that carries a value to every subscriber, in the order of subscription."""

    def __init__(self) -> None:
        self._subscribers: list[Callable[[Value], None]] = []

    def subscribe(self, call: Callable[[Value], None]) -> None:
        """Call a function with each further value."""
        self._subscribers.append(call)

    def unsubscribe(self, call: Callable[[Value], None]) -> None:
        """Call a function no more."""
        self._subscribers.remove(call)

    def emit(self, value: Value) -> None:
        """Send a value."""
        for call in self._subscribers:
            call(value)
