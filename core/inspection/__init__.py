"""Reports on a pixel, a line, a region and a capture, with uncertainties."""

from core.geometry import pixels_in
from core.inspection.capture import (
    CaptureReport,
    StatedFluxCheck,
    Suggestion,
    capture_report,
)
from core.inspection.echoes import CONFIDENT
from core.inspection.faulty import FaultyPixel, faulty_pixels
from core.inspection.flux import estimate_flux
from core.inspection.line_profile import LineProfile, line_profile
from core.inspection.maps import maps
from core.inspection.mean_flux import estimate_mean_flux, estimate_target_flux
from core.inspection.pixel import PixelReport, RangeCandidate, echo_view, pixel_report
from core.inspection.profile import LEVEL, FluxEstimate
from core.inspection.pulses import Accuracy, accuracy_over_pulses
from core.inspection.region import RegionReport, region_report
from core.inspection.reported import ReportedCheck, reported_check

# Deprecated names, to be removed after the next release.
LightFound, light_found, mean_light = FluxEstimate, estimate_flux, estimate_mean_flux
Candidate = RangeCandidate

__all__ = [
    "CONFIDENT",
    "LEVEL",
    "Accuracy",
    "Candidate",
    "CaptureReport",
    "FaultyPixel",
    "FluxEstimate",
    "LightFound",
    "LineProfile",
    "PixelReport",
    "RangeCandidate",
    "RegionReport",
    "ReportedCheck",
    "StatedFluxCheck",
    "Suggestion",
    "accuracy_over_pulses",
    "capture_report",
    "echo_view",
    "estimate_flux",
    "estimate_mean_flux",
    "estimate_target_flux",
    "faulty_pixels",
    "light_found",
    "line_profile",
    "maps",
    "mean_light",
    "pixel_report",
    "pixels_in",
    "region_report",
    "reported_check",
]
