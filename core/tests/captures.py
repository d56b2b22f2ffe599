"""Published captures, which are too large for the project and belong to others."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"


def real_capture_path(name: str) -> Path:
    """Path of a published capture; without it a test fails in CI, and elsewhere is skipped."""
    path = CAPTURES / name
    if path.exists():
        return path
    reason = f"{path} is absent: put the published captures there (CONTRIBUTING.md)"
    if os.environ.get("CI", "").lower() not in ("", "0", "false"):
        pytest.fail(reason)
    pytest.skip(reason)
