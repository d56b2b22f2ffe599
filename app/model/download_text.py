"""Texts of downloads: their formats, and reasons for failures."""

from __future__ import annotations

import errno

from app.model.text import cause

FORMATS = {
    "png": "picture",
    "svg": "picture, to enlarge and edit",
    "csv": "the numbers on screen, as text",
    "npz": "image and arrays of the estimate with intervals, for NumPy",
    "tif": "image, range with intervals, confidence and counts, for GIS",
    "html": "report: maps, cloud, numbers and script on one page",
    "ply": "the points on screen, with colours",
    "las": "the points on screen, for survey software",
    "laz": "the same, compressed",
}

NOTHING_DRAWN = "There is nothing to save: nothing is drawn here yet. Try again later."

NO_INTERVALS = (
    "the intervals of the ranges are left out, since they take too long on this server; "
    "python -m core estimate --intervals writes them"
)

NO_POINTS = (
    "There is nothing to save: no estimate is confident enough to be shown. Lower “Show from "
    "confidence”, then try again."
)

NO_POINTS_INSIDE = (
    "There is nothing to save: no estimate that is shown lies inside the box. Widen it under “Crop "
    "the cloud”, then try again."
)

_GOES_ON = "The page works as before."

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def not_saved(error: Exception) -> str:
    """Return why a file could not be written, and what to do."""
    if isinstance(error, OSError) and error.errno in _FULL:
        return (
            "Nothing was saved: the server's disk for temporary files is full. Make room there, or "
            f"choose a smaller format, then try again. {_GOES_ON}"
        )
    if isinstance(error, MemoryError):
        return (
            "Nothing was saved: not enough memory on the server for this file. Show fewer pixels, "
            f"or choose another format, then try again. {_GOES_ON}"
        )
    if isinstance(error, ValueError):
        return cause(error)
    return (
        f"Nothing was saved: the file could not be written ({type(error).__name__}). Try again, or "
        f"choose another format. {_GOES_ON}"
    )


def no_picture(reason: str) -> str:
    """Return why the browser could not make a picture."""
    return f"Nothing was saved: the picture could not be made ({reason}). {_GOES_ON}"
