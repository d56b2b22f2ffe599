"""Write captures and range images to files for other software, one module per format family.

A new format is a module with a ``write(product, file)`` and a line in `WRITERS`. Captures are
written in the layouts of `core.io.readers.npz` and `core.io.readers.labelled`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture, CaptureInfo
from core.checks import require, require_pixel, require_type
from core.estimators import RangeImage, require_capture, settings_of
from core.inference import RangeInterval
from core.io.readers.npz import fields
from core.io.writers import las, netcdf, npz, pcd, picture, ply, table, tiff
from core.io.writers.colors import (
    COLOR_MAPS,
    MOST_ELONGATED,
    OUTSIDE_COLOR,
    ColorScale,
    RangeColors,
    colors_of,
    p_value_scale,
    range_scale,
)
from core.io.writers.picture import Picture
from core.io.writers.product import P_VALUE, Product, guessed_angle
from core.io.writers.table import decimals_of, write_columns, write_points
from core.io.writers.whole import whole_file, whole_folder
from core.labels import Plane

__all__ = [
    "CAPTURE_SUFFIXES",
    "CLOUD_SUFFIXES",
    "COLOR_MAPS",
    "FOLDER_WRITERS",
    "MOST_ELONGATED",
    "OUTSIDE_COLOR",
    "P_VALUE",
    "WRITERS",
    "ColorScale",
    "Picture",
    "Plane",
    "Product",
    "RangeColors",
    "colors_of",
    "decimals_of",
    "guessed_angle",
    "p_value_scale",
    "range_scale",
    "save_capture",
    "save_image",
    "save_pixel",
    "write_columns",
    "write_points",
]

WRITERS: dict[str, Callable[[Product, BinaryIO], None]] = {
    ".npz": npz.write,
    ".csv": table.write,
    ".tif": tiff.write,
    ".tiff": tiff.write,
    ".nc": netcdf.write,
    ".h5": netcdf.write,
    ".ply": ply.write,
    ".las": las.write,
    ".laz": las.write_compressed,
    ".pcd": pcd.write,
    ".png": picture.write_png,
    ".svg": picture.write_svg,
}


FOLDER_WRITERS: dict[str, Callable[[Product, Path], None]] = {".zarr": netcdf.write_zarr}
"""Formats that are folders."""

CLOUD_SUFFIXES = (".ply", ".las", ".laz", ".pcd")

CAPTURE_SUFFIXES = (".npz", ".nc", ".h5", ".zarr")


def save_capture(
    capture: Capture, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a capture atomically, so that `core.read_capture` reads it back.

    Parameters
    ----------
    capture : Capture
    path : path-like
        A name ending in ``.npz``; ``.nc`` or ``.h5``, netCDF-4, which is HDF5; or ``.zarr``, which
        is a folder.
    overwrite : bool
        Replace a file of that name.

    Raises
    ------
    ValueError
        If the name has another ending, or the capture has groups of pulses, which only ``.npz``
        keeps.
    FileExistsError
        If the file exists and is not to be replaced.
    OSError
        If the folder cannot be written; an older file is then left as it was.
    """
    require_capture(capture)
    path, suffix = _path_and_suffix(path, CAPTURE_SUFFIXES)
    if suffix != ".npz" and capture.groups is not None:
        n_groups = f"{len(capture.groups.counts)} groups of pulses"
        require("groups", n_groups, False, "a name ending in .npz, or a capture without groups")
    if suffix == ".zarr":
        with whole_folder(path, overwrite=overwrite) as folder:
            netcdf.write_folder(capture.to_xarray(), folder)
        return
    with whole_file(path, overwrite=overwrite) as file:
        if suffix == ".npz":
            np.savez_compressed(file, allow_pickle=False, **fields(capture))
        else:
            compressed = {"counts": {"compression": "gzip", "shuffle": True}}
            file.write(capture.to_xarray().to_netcdf(engine="h5netcdf", encoding=compressed))


def save_image(
    capture: CaptureInfo,
    image: RangeImage,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    pixel_angle_rad: float | None = None,
    title: str = "",
    rgb: NDArray[np.uint8] | None = None,
    remark: str = "",
    interval: RangeInterval | None = None,
    interval_68: RangeInterval | None = None,
    p_value: NDArray[np.float64] | None = None,
    colors: RangeColors | None = None,
) -> None:
    """Write a range image atomically; the suffix determines the format.

    ==================  ===========================================================================
    suffix              what is written
    ==================  ===========================================================================
    ``.npz``            NumPy: every array as it is, the acquisition, the source
    ``.nc``, ``.h5``    netCDF-4, which is HDF5: the same, with units
    ``.zarr``           Zarr, a folder: the same
    ``.csv``            one line a pixel; ranges in steps of a tenth of a bin or less
    ``.tif``, ``.tiff`` pages of 32-bit floats: ``range_m``, ``confidence``, ``counts``, intervals
    ``.ply``, ``.pcd``  point cloud; coordinates as 32-bit floats
    ``.las``, ``.laz``  point cloud, LAS 1.4; coordinates in steps of a thousandth of a bin or less
    ``.png``, ``.svg``  picture of the range image
    ==================  ===========================================================================

    Every file states acquisition, method, settings, version and source. Without a detection, an
    image holds NaN, a line of text an empty field, a cloud no point. The modules of
    `core.io.writers` describe the formats, `core.geometry` the coordinates.

    Parameters
    ----------
    capture : Capture
        Source of the range image; for one larger than memory, the overview that
        `core.out_of_core.tiles.as_image` returns.
    image : RangeImage
        Estimates, of the capture's shape.
    path : path-like
        A name ending in one of the suffixes of `WRITERS`.
    overwrite : bool
        Replace a file of that name.
    pixel_angle_rad : float, optional
        Angle between the lines of sight of neighbouring pixels, in radians; the capture's own where
        None. Clouds need it.
    title : str
        Title of a picture.
    rgb : ndarray of uint8, shape (row, col, 3), optional
        Colours of a cloud's points.
    remark : str
        Text that the file states next to that of the method, such as `core.io.guessed_angle`.
    interval : RangeInterval, optional
        95 % interval of each range (`core.range_intervals`), for the formats that hold pixels: NPZ,
        netCDF, HDF5, Zarr, CSV and TIFF, as ``range_low_m`` and ``range_high_m``.
    interval_68 : RangeInterval, optional
        68 % interval, likewise as ``range_low_68_m`` and ``range_high_68_m``. Point clouds hold
        half its width, ``range_sd_m``.
    p_value : ndarray, shape (row, col), optional
        P-value of the goodness of fit of each pixel (`core.inference.fit_p_values`), for NPZ,
        netCDF, HDF5, Zarr and CSV.
    colors : core.io.RangeColors, optional
        Limits and colour map of a picture; by default those of the app.

    Raises
    ------
    ValueError
        If an argument is of another type, the suffix is unknown, image and capture, colours,
        interval or p-values differ in shape, the angle is not between 0 and π/2, or a cloud needs
        an angle that is unknown.
    FileExistsError
        If the file exists and is not to be replaced.
    OSError
        If the folder cannot be written; an older file is then left as it was.
    """
    order = "in the order save_image(capture, image, path)"
    require_type("image", image, RangeImage, f"a core.RangeImage, {order}")
    require_type("capture", capture, CaptureInfo, f"a core.Capture, {order}")
    path, suffix = _path_and_suffix(path, (*WRITERS, *FOLDER_WRITERS))
    if pixel_angle_rad is None:
        pixel_angle_rad = capture.acquisition.pixel_angle_rad
    product = Product(
        capture,
        image,
        pixel_angle_rad,
        title,
        rgb,
        remark=remark,
        interval=interval,
        interval_68=interval_68,
        p_value=p_value,
        colors=colors,
    )
    if suffix in FOLDER_WRITERS:
        with whole_folder(path, overwrite=overwrite) as folder:
            FOLDER_WRITERS[suffix](product, folder)
        return
    with whole_file(path, overwrite=overwrite) as file:
        WRITERS[suffix](product, file)


def save_pixel(
    capture: Capture,
    row: int,
    col: int,
    settings: Any,
    path: str | os.PathLike[str],
    *,
    method: str = "tracking",
    overwrite: bool = False,
) -> None:
    """Write the signals of one pixel as CSV, one line a bin.

    The columns are ``bin``, ``time_s`` and ``range_m`` (where the bin begins), ``counts`` (whole
    numbers), and the stages of `core.Signals` in counts: ``raw``, ``small``, ``large``,
    ``residual``, ``enhanced``; of methods other than the tracking differentiator, ``score``, and of
    the image posterior also the probabilities of `core.estimators.base.Evidence`: ``alone``,
    ``neighbours`` and ``posterior``.

    Parameters
    ----------
    capture : Capture
    row, col : int
        The pixel.
    settings : object or None
        Settings of the method, as for `core.estimate`; its defaults where None.
    path : path-like
        A name ending in ``.csv``.
    method : str
        As for `core.estimate`.
    overwrite : bool
        Replace a file of that name.

    Raises
    ------
    ValueError
        If the name has another ending, the pixel lies outside the image, the method is unknown or
        its settings are another's, or the weight "survival"
        lacks the capture's pulses.
    FileExistsError
        If the file exists and is not to be replaced.
    OSError
        If the folder cannot be written; an older file is then left as it was.
    """
    path, _ = _path_and_suffix(path, (".csv",))
    settings = settings_of(method, settings)
    require_pixel(row, col, capture.shape)
    with whole_file(path, overwrite=overwrite) as file:
        table.write_pixel(capture, row, col, method, settings, file)


def _path_and_suffix(path: str | os.PathLike[str], accepted: Sequence[str]) -> tuple[Path, str]:
    """Return a path and its suffix in lower case, which must be one of those accepted."""
    path = Path(path)
    suffix = path.suffix.lower()
    require("suffix", path.suffix, suffix in accepted, f"one of {', '.join(accepted)}")
    return path, suffix
