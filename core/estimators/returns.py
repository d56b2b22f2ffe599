"""Several returns of each pixel of a range image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.checks import require
from core.estimators.base import RangeImage
from core.estimators.image_layers import image_layers_of
from core.inference.returns import FALSE_RETURN, Surfaces, as_returns, returns_of


def with_returns(
    capture: Capture, image: RangeImage, most: int = 2, false_return: float = FALSE_RETURN
) -> RangeImage:
    """Add `RangeImage.returns` to the estimate of a capture.

    Each pixel is tested by itself, or together with its neighbours if the method is
    "image_posterior", `most` is 2 and neighbours carry information
    (`core.estimators.image_layers`). Where a pixel has several, the most probable one becomes the
    estimate of the image, and of those as probable the strongest. Other pixels keep their
    estimates.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture by any method; pixels without an estimate get no return.
    most : int
        Returns of a pixel, at most `core.inference.MOST_RETURNS`.
    false_return : float
        Share of pixels with one surface that may get a second return, 0.001 to 1.

    Raises
    ------
    ValueError
        If the image is of another shape, or an argument is out of its bounds.
    """
    shape = image.bin.shape
    require("image", f"shape {shape}", shape == capture.shape, f"shape {capture.shape}")
    layers = None
    if most == 2 and image.made_by and image.made_by.method == "image_posterior":
        layers = image_layers_of(capture, false_return)
    if layers is None:
        returns = returns_of(capture, image.bin, image.confidence, most, false_return)
    else:
        found = np.isfinite(image.bin)
        parts = (np.moveaxis(each, 0, -1)[found] for each in layers)
        delay, signal, confidence = parts
        surfaces = Surfaces(delay, signal, confidence, np.isfinite(delay))
        returns = as_returns(capture, image.bin, image.confidence, surfaces)
    best = returns.most_probable(shape)
    changed = returns.count(shape) > 1

    def updated(before: Floats, values: Floats) -> Floats:
        after = before.copy()
        after[changed] = values[best[changed]]
        return after

    return replace(
        image,
        range_m=updated(image.range_m, returns.range_m),
        bin=updated(image.bin, returns.bin),
        confidence=updated(image.confidence, returns.confidence),
        returns=returns,
        made_by=image.made_by
        and image.made_by.after(most_returns=int(most), false_return=false_return),
    )
