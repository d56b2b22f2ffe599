"""The Panel app; uses public names of `core` only."""

from __future__ import annotations

import gc
import sys

THRESHOLD = gc.get_threshold()
"""When Python looks for garbage; `app.__main__` sets it again once the app has started."""

# What is made while the libraries are imported stays. To look for garbage after every 700 new
# objects, as Python does by default, takes an eighth of the start.
gc.set_threshold(50_000, 20, 20)


def main() -> int:
    """Run the command ``firstphoton``, which is ``python -m app``."""
    try:
        from app.__main__ import main as serve  # noqa: PLC0415  (needs the app's libraries)
    except ModuleNotFoundError as error:
        print(f"The app needs {error.name}: pip install 'firstphoton[app]'", file=sys.stderr)
        return 1
    return serve()
