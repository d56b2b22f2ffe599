"""Old names of public attributes, kept for one release."""

from __future__ import annotations

import warnings
from typing import Any


def renamed(new: str) -> Any:
    """Return a property that warns and reads the attribute called `new`."""

    def read(self: Any) -> Any:
        message = f"This attribute of {type(self).__name__} is now called {new}."
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(self, new)

    return property(read, doc=f"Deprecated name of `{new}`.")
