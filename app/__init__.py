"""The Panel app; uses public names of `core` only."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command ``firstphoton``, which is ``python -m app``."""
    try:
        from app.__main__ import main as serve  # noqa: PLC0415  (needs the app's libraries)
    except ModuleNotFoundError as error:
        print(f"The app needs {error.name}: pip install 'firstphoton[app]'", file=sys.stderr)
        return 1
    return serve()
