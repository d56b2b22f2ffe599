"""Pictures of a range image: PNG and SVG, the same bytes each time for the same image.

The colours span the confident estimates; ranges beyond them are grey, pixels without one white.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from core.io.writers.product import Product

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OUTSIDE, _INVALID = "#9aa2ab", "#ffffff"


def write_png(product: Product, file: BinaryIO) -> None:
    """Write PNG."""
    _write(product, file, format="png", dpi=150, metadata={"Software": None})


def write_svg(product: Product, file: BinaryIO) -> None:
    """Write SVG; its text stays text."""
    _write(product, file, format="svg", metadata={"Date": None, "Creator": "firstphoton"})


def _write(product: Product, file: BinaryIO, **options: Any) -> None:
    import matplotlib  # noqa: PLC0415 - slow to import

    # The salt makes the identifiers within an SVG the same each time.
    with matplotlib.rc_context({"svg.hashsalt": "firstphoton", "svg.fonttype": "none"}):
        _drawn(product).savefig(file, **options)


def _drawn(product: Product) -> Figure:
    import matplotlib  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    rows, cols = product.image.range_m.shape
    low_m, high_m = _limits_m(product)
    colors = matplotlib.colormaps["viridis"].with_extremes(
        bad=_INVALID, under=_OUTSIDE, over=_OUTSIDE
    )
    figure = Figure(
        figsize=(6.4, float(np.clip(5.2 * rows / cols, 1.6, 10.0))), layout="constrained"
    )
    axes = figure.add_subplot()
    shown = axes.imshow(
        product.image.range_m, vmin=low_m, vmax=high_m, cmap=colors, interpolation="none"
    )
    axes.set_title(product.heading, parse_math=False, wrap=True)
    axes.set(xlabel="Column (px)", ylabel="Row (px)")
    figure.colorbar(shown, ax=axes, label="Range (m)", extend="both")
    figure.supxlabel("white: no estimate · grey: beyond the colours", fontsize="small")
    return figure


def _limits_m(product: Product) -> tuple[float, float]:
    """Return the ends of the colours: of confident estimates, else of all, else of the gate."""
    image, acquisition = product.image, product.capture.acquisition
    sure = image.range_m[image.valid & (image.confidence >= 0.9)]
    sure = sure if sure.size else image.range_m[image.valid]
    if not sure.size:
        low_m, high_m = acquisition.bin_to_range_m([0, acquisition.n_bins])
        return float(low_m), float(high_m)
    low_m, high_m = np.percentile(sure, [1, 99])
    margin_m = acquisition.bin_length_m + 0.05 * (high_m - low_m)
    return float(low_m - margin_m), float(high_m + margin_m)
