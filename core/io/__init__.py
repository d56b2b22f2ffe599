"""Files: readers of captures, writers of results, and scenes."""

from core.io.names import MOST_LETTERS, changed_settings, distinct_names, file_name
from core.io.readers import READERS, SUFFIXES, bytes_of, open_capture, read_capture
from core.io.readers.options import (
    Option,
    ReadOptions,
    add_read_options,
    read_options_from,
    reading_options,
    with_flags,
)
from core.io.readers.truth import TRUTH_UNITS, read_truth
from core.io.scene_files import SceneError, read_scene
from core.io.writers import (
    COLOR_MAPS,
    OUTSIDE_COLOR,
    WRITERS,
    ColorScale,
    Picture,
    Plane,
    Product,
    RangeColors,
    colors_of,
    guessed_angle,
    range_scale,
    save_capture,
    save_image,
    save_pixel,
    write_columns,
)

__all__ = [
    "COLOR_MAPS",
    "MOST_LETTERS",
    "OUTSIDE_COLOR",
    "READERS",
    "SUFFIXES",
    "TRUTH_UNITS",
    "WRITERS",
    "ColorScale",
    "Option",
    "Picture",
    "Plane",
    "Product",
    "RangeColors",
    "ReadOptions",
    "SceneError",
    "add_read_options",
    "bytes_of",
    "changed_settings",
    "colors_of",
    "distinct_names",
    "file_name",
    "guessed_angle",
    "open_capture",
    "range_scale",
    "read_capture",
    "read_options_from",
    "read_scene",
    "read_truth",
    "reading_options",
    "save_capture",
    "save_image",
    "save_pixel",
    "with_flags",
    "write_columns",
]
