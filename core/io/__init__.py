"""Files: readers of captures, writers of results, and scenes."""

from core.io.readers import READERS, SUFFIXES, bytes_of, open_capture, read_capture
from core.io.readers.options import Option, ReadOptions, reading_options
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
    "bytes_of",
    "open_capture",
    "read_capture",
    "read_scene",
    "reading_options",
    "save_capture",
    "save_image",
    "save_pixel",
    "write_columns",
]
