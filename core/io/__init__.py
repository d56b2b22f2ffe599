"""Files: readers of captures, writers of results, and scenes."""

from core.io.readers import READERS, SUFFIXES, bytes_of, open_capture, read_capture
from core.io.readers.options import (
    Option,
    ReadOptions,
    add_read_options,
    read_options_from,
    reading_options,
    with_flags,
)
from core.io.scene_files import SceneError, read_scene
from core.io.writers import (
    WRITERS,
    Plane,
    Product,
    save_capture,
    save_image,
    save_pixel,
    write_columns,
)

__all__ = [
    "READERS",
    "SUFFIXES",
    "WRITERS",
    "Option",
    "Plane",
    "Product",
    "ReadOptions",
    "SceneError",
    "add_read_options",
    "bytes_of",
    "open_capture",
    "read_capture",
    "read_options_from",
    "read_scene",
    "reading_options",
    "save_capture",
    "save_image",
    "save_pixel",
    "with_flags",
    "write_columns",
]
