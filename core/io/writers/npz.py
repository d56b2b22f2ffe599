"""NumPy ``.npz``: the arrays of a range image as they are, without pickles.

In addition to `RangeImage`'s fields and ``counts``, it holds, if they are given, the limits of
intervals (``range_low_m`` and ``range_high_m`` for 95 %, ``range_low_68_m`` and
``range_high_68_m`` for 68 %), the p-values ``fit_p_value``, and the returns: ``returns``, their
number, and ``return_1_range_m`` and so on, with strength and confidence. Scalars are
``bin_width_s``, ``gate_delay_s``, ``n_pulses`` (0 where not known) and ``pixel_angle_rad`` (absent
where not known), texts ``format``, ``detection`` (`core.capture.Detection`), ``method``,
``settings`` (JSON), ``software`` and ``source``; where they apply, ``false_alarm``,
``least_confidence``, ``remark``.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from core.io.writers.product import Product

FORMAT = "firstphoton-range-image-1"


def write(product: Product, file: BinaryIO) -> None:
    """Write an archive of arrays."""
    arrays = {name: plane.values for name, plane in product.planes.items()}
    facts = {name: np.asarray(fact) for name, fact in product.facts.items()}
    known = {"format": np.asarray(FORMAT), **facts}
    np.savez_compressed(file, allow_pickle=False, **known, **arrays)
