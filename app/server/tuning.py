"""Settings of Bokeh and of the interpreter for many short messages."""

from __future__ import annotations

import sys

from bokeh.settings import settings

SWITCH_S = 1e-4
"""Time after which a computing thread lets the page's thread run, which releases the interpreter
for each message. Python's default is 5 ms."""


def tune() -> None:
    """Apply the settings to this process."""
    settings.simple_ids.set_value(True)  # otherwise looked up in the environment for each array
    # Checks that find mistakes of the code only, run for each new page.
    settings.perform_document_validation.set_value(False)
    settings.perform_error_diagnostics.set_value(False)
    sys.setswitchinterval(SWITCH_S)
