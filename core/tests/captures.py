"""What a machine may lack, such as published captures, which are too large for the project."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NoReturn

import pytest

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"


def absent(reason: str) -> NoReturn:
    """Skip a test for something that this machine lacks; in CI, fail."""
    is_ci = os.environ.get("CI", "").lower() not in ("", "0", "false")
    (pytest.fail if is_ci else pytest.skip)(reason)


def real_capture_path(name: str) -> Path:
    """Path of a published capture; where it is missing, the test is `absent`."""
    path = CAPTURES / name
    if not path.exists():
        absent(f"{path} is absent: put the published captures there (CONTRIBUTING.md)")
    return path
