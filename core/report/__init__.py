"""A capture, its range image and one pixel as a report: one HTML file that needs no network."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from core.capture import Capture
from core.checks import require
from core.estimators import RangeImage, require_capture
from core.geometry import WHOLE, Box
from core.io.writers.colors import RangeColors
from core.io.writers.whole import whole_file

__all__ = ["LEAST_CONFIDENCE", "representative_pixel", "save_report", "write_report"]

LEAST_CONFIDENCE = 0.9
"""Confidence below which maps and cloud hide an estimate, unless stated otherwise."""


def save_report(
    capture: Capture,
    image: RangeImage,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    pixel: tuple[int, int] | None = None,
    least_confidence: float = LEAST_CONFIDENCE,
    pixel_angle_rad: float | None = None,
    box: Box = WHOLE,
    colors: RangeColors | None = None,
    title: str = "",
    script: str = "",
) -> None:
    """Write a report on a capture and its range image atomically, as one HTML file.

    The file has what was read and assumed, fluxes with intervals and suggested settings, maps,
    histograms, one pixel with its range intervals and candidates, a point cloud to turn, error
    figures if the truth is known, and settings and versions. It refers to no other file or address.
    Maps and cloud have at most 65,536 pixels: larger images are thinned, and the report says so. It
    is the same for the same arguments, byte for byte.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture by `core.estimate`, which states its method and settings.
    path : path-like
        A name ending in ``.html``.
    overwrite : bool
        Replace a file of that name.
    pixel : (int, int), optional
        Row and column of the pixel to show; by default `representative_pixel`.
    least_confidence : float
        Maps and cloud hide estimates of less confidence, 0 to 1. Figures of error include them.
    pixel_angle_rad : float, optional
        Angle between the lines of sight of neighbouring pixels, in radians; the capture's own where
        None, or a guess, which the report mentions.
    box : Box
        Part of the scene that the cloud shows.
    colors : core.io.RangeColors, optional
        Limits and colour map of ranges; by default those of the app.
    title : str
        Such as the name of the capture's file.
    script : str
        Python code that repeats the report, shown at its end.

    Raises
    ------
    ValueError
        If the name has another ending, the image states no method, its shape is not the capture's,
        the pixel lies outside, or the confidence or the angle is out of its range.
    FileExistsError
        If the file exists and is not to be replaced.
    OSError
        If the folder cannot be written; an older file is then left as it was.
    """
    path = Path(path)
    require("suffix", path.suffix, path.suffix.lower() == ".html", ".html")
    with whole_file(path, overwrite=overwrite) as file:
        write_report(
            capture,
            image,
            file,
            pixel=pixel,
            least_confidence=least_confidence,
            pixel_angle_rad=pixel_angle_rad,
            box=box,
            colors=colors,
            title=title,
            script=script,
        )


def write_report(
    capture: Capture,
    image: RangeImage,
    file: BinaryIO,
    *,
    pixel: tuple[int, int] | None = None,
    least_confidence: float = LEAST_CONFIDENCE,
    pixel_angle_rad: float | None = None,
    box: Box = WHOLE,
    colors: RangeColors | None = None,
    title: str = "",
    script: str = "",
) -> None:
    """Write the report of `save_report` to a file that is open for bytes.

    Raises
    ------
    ValueError
        As `save_report`.
    """
    from core.report.page import page_of  # noqa: PLC0415 - loads Matplotlib

    require_capture(capture)
    shape = image.range_m.shape
    require("image", f"shape {shape}", shape == capture.shape, f"shape {capture.shape}")
    made_by = image.made_by
    require("image.made_by", made_by, made_by is not None, "an image that core.estimate returned")
    known = representative_pixel(capture, image) if pixel is None else pixel
    page = page_of(
        capture,
        image,
        known,
        least_confidence,
        pixel_angle_rad,
        box,
        colors,
        title=title,
        script=script,
    )
    file.write(page.encode("utf-8", "backslashreplace"))


def representative_pixel(capture: Capture, image: RangeImage) -> tuple[int, int]:
    """Return the pixel nearest to the centre with a target, or else with a confident estimate.

    Without any of these, the pixel in the centre.
    """
    truth_m = capture.truth_range_m
    good = image.confidence >= LEAST_CONFIDENCE if truth_m is None else np.isfinite(truth_m)
    rows, cols = capture.shape
    row, col = np.nonzero(good) if good.any() else np.nonzero(np.ones((rows, cols), bool))
    nearest = np.argmin((row - rows / 2) ** 2 + (col - cols / 2) ** 2)
    return int(row[nearest]), int(col[nearest])
