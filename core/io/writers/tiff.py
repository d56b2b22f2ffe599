"""TIFF: pages of 32-bit floats: images that the product adds, range, confidence, counts, intervals,
radial velocities.

Ranges are exact to 6e-8 of themselves, counts up to 2**24. Each page has its name (the tag
PageName), its meaning and unit (ImageDescription, and for GIS the tags of GDAL), and as tags of
GDAL the acquisition, method, settings (JSON), version and source. Image programs open the pages as
a stack; a GIS opens the first, and the others as subdatasets. Invalid ranges are NaN; a page with
NaN declares it "no data".
"""

from __future__ import annotations

from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np

from core.io.writers.product import Product
from core.labels import Plane, software

PAGES = ("range_m", "confidence", "counts")

_PAGE_NAME, _GDAL_METADATA, _GDAL_NODATA = 285, 42112, 42113  # numbers of tags


def write(product: Product, file: BinaryIO) -> None:
    """Write the pages."""
    from tifffile import TiffWriter  # noqa: PLC0415 - slow to import

    planes = product.planes
    with TiffWriter(file) as pages:
        further = (*product.interval_columns, *product.velocity_columns)
        for name in dict.fromkeys((*product.shown, *PAGES, *further)):
            plane = planes[name]
            tags = {_PAGE_NAME: name, _GDAL_METADATA: _gdal_metadata(name, plane, product)}
            if np.isnan(plane.values).any() or name == "range_m":
                tags[_GDAL_NODATA] = "nan"
            pages.write(
                plane.values.astype(np.float32),
                photometric="minisblack",
                description=f"{name} [{plane.unit}]: {plane.meaning}",
                metadata=None,
                software=software(),
                extratags=[(tag, "s", 0, text, True) for tag, text in tags.items()],
            )


def _gdal_metadata(name: str, plane: Plane, product: Product) -> str:
    """Return the GDAL metadata that most GIS read: names, units and more; ASCII."""
    root = ElementTree.Element("GDALMetadata")
    for role, text in (("description", name), ("unittype", plane.unit)):
        attributes = {"name": role.upper(), "sample": "0", "role": role}
        ElementTree.SubElement(root, "Item", attributes).text = text
    for fact, value in product.facts.items():
        ElementTree.SubElement(root, "Item", {"name": fact}).text = str(value)
    xml: bytes = ElementTree.tostring(root)  # ASCII, all else as character references
    return xml.decode("ascii")
