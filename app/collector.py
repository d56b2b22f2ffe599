"""Python's collector of garbage, kept from walking through every open page time and again.

A page is some ten thousands of objects. With twenty of them a full collection takes more than half
a second, in which nobody is answered; sliders that are dragged and pages that open bring it about.
"""

from __future__ import annotations

import gc


def spare() -> None:
    """Have later collections pass over all that is in use now, until `collect_all`."""
    gc.collect()
    gc.freeze()


def collect_all() -> None:
    """Look through everything: a page is gone, and has left something behind."""
    gc.unfreeze()
    spare()
