"""What the part of Trade-off says that sweeps settings."""

from __future__ import annotations

from core.parameters import Number

EXPLANATION = """
Each setting of a method is swept, everything else as it comes, on depths that are uniform over the
gate, at the first SBR at which the method finds nine pixels in ten. A value is trusted where it
loses no more than a tenth of the pixels against the best one. Upright lines are the ends of the
zones that sliders mark as doubtful.
"""

METHOD_HELP = "Whose settings are swept; methods without a number to set are left out."

TABLE = "Where settings are to be trusted, degrade and fail"


def swept(spec: Number) -> str:
    """What stands in a plot's place until it is there."""
    return f"{spec.symbol} is still to be swept."
