"""Confidence of the estimates of any method, judged by the posterior of the image."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

from core.capture import Capture
from core.checks import require
from core.cost import require_memory
from core.estimators.base import RangeImage
from core.estimators.image_model import image_model_of
from core.estimators.image_posterior import probability_near

Judge = Literal["pixel", "image"]
JUDGES: tuple[Judge, ...] = get_args(Judge)
"""What determines the confidence: counts of the pixel alone, or those of its neighbours, too."""


def require_judge(judged_by: str) -> None:
    """Raise ``ValueError`` unless it is one of `JUDGES`."""
    require("judged_by", judged_by, judged_by in JUDGES, " or ".join(map(repr, JUDGES)))


def judged_by_image(capture: Capture, image: RangeImage) -> RangeImage:
    """Replace the confidence of an estimate by the probability that neighbours give it, too.

    It is the mass of the posterior of the image (`core.estimators.image_posterior`) within 3 bins
    of the estimate. A pixel alone may not show whether an estimate is right that is certain to its
    neighbours. Where neighbours carry no information about each other, it is the confidence by the
    pixel alone.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture by any method, without returns. That of a method that follows motion
        is returned unchanged: the posterior of the image is that of surfaces at rest.

    Raises
    ------
    ValueError
        If the image is of another shape, or has returns, whose confidence would remain that of the
        pixel alone; or if memory is not sufficient (`core.cost`).
    """
    shape, returns = image.bin.shape, image.returns
    require("image", f"shape {shape}", shape == capture.shape, f"shape {capture.shape}")
    accepted = "an image without returns; add them afterwards (`with_returns`)"
    require("image.returns", f"{returns and len(returns)} returns", returns is None, accepted)
    if image.velocity is not None:
        return image
    require_memory(capture, "image_posterior")
    confidence = probability_near(capture, image_model_of(capture), image.bin)
    made_by = image.made_by and image.made_by.after(judged_by="image")
    return replace(image, confidence=confidence, made_by=made_by)
