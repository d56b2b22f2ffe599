"""What is known of a pixel, of a region and of a capture, and how well."""

from core.inspection.capture import CaptureReport, Suggestion, capture_report
from core.inspection.flux import light_found
from core.inspection.maps import maps
from core.inspection.mean_flux import mean_light
from core.inspection.pixel import Candidate, PixelReport, pixel_report
from core.inspection.profile import LEVEL, LightFound
from core.inspection.pulses import Accuracy, accuracy_over_pulses
from core.inspection.region import RegionReport, pixels_in, region_report

__all__ = [
    "LEVEL",
    "Accuracy",
    "Candidate",
    "CaptureReport",
    "LightFound",
    "PixelReport",
    "RegionReport",
    "Suggestion",
    "accuracy_over_pulses",
    "capture_report",
    "light_found",
    "maps",
    "mean_light",
    "pixel_report",
    "pixels_in",
    "region_report",
]
