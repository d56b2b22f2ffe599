"""Captures to files, in the layout of `core.readers.npz`."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

import numpy as np

from core.capture import Capture
from core.checks import require
from core.readers import npz


def save_capture(
    capture: Capture, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a capture, whole or not at all; `core.readers.read_capture` gives it back.

    Parameters
    ----------
    capture : Capture
    path : path-like
        A name ending in ``.npz``.
    overwrite : bool
        Replace a file of that name.

    Raises
    ------
    ValueError
        If the name has another ending.
    FileExistsError
        If the file exists and is not to be replaced.
    OSError
        If the folder cannot be written; an older file is then left as it was.
    """
    path = Path(path)
    require("path", str(path), path.suffix.lower() == ".npz", "a name ending in .npz")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: give another name, or overwrite=True to replace it.")
    unfinished = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with unfinished.open("xb") as file:
            np.savez_compressed(file, allow_pickle=False, **npz.fields(capture))
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
