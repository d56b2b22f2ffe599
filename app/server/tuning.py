"""Settings of Bokeh and Python for many short messages."""

from __future__ import annotations

import sys

from bokeh.settings import settings

SWITCH_S = 1e-4
"""Time after which a computing thread yields to the event loop, which releases the interpreter for
each message. Python's default is 5 ms."""


def tune() -> None:
    """Apply the settings to this process."""
    settings.simple_ids.set_value(True)  # else read from the environment for each array
    # Checks for errors in code, which would run for each new page.
    settings.perform_document_validation.set_value(False)
    settings.perform_error_diagnostics.set_value(False)
    sys.setswitchinterval(SWITCH_S)
