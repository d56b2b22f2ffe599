"""Published captures, too large and not ours to keep in the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"


def real_capture_path(name: str) -> Path:
    """Where a published capture lies; CI always has them, and fails without."""
    path = CAPTURES / name
    if not path.exists():
        reason = f"{path} is absent: the published captures are kept beside the checkout"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    return path
