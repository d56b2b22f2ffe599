"""What is on the screen, to be taken away: as a script, and as a link."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import param

from app.widgets.component import Component


class TakeAway(Component):
    """Buttons for a script, which a dialog shows, and for the link of the page.

    Parameters
    ----------
    script : callable
        Gives the script when it is asked for.
    """

    asked = param.Integer(default=0, doc="How often the script has been asked for.")
    answer = param.List(default=[], doc="How often that was, and the script.")

    _esm = Path(__file__).with_name("share.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("share.css")]

    def __init__(self, script: Callable[[], str], **params: Any) -> None:
        super().__init__(**params)
        self.param.watch(lambda event: self.param.update(answer=[event.new, script()]), "asked")
