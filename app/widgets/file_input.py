"""A button that opens a file, whose uploads are checked on the server, too."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import panel_material_ui as pmui

from app.model.uploads import MAX_UPLOAD_BYTES
from core.checks import require

PART_BYTES = 4 * 2**20
"""Size of the parts in which a file arrives, each in its own message."""

MOST_FILES = 500
"""Files that can be chosen at once."""

_LONGEST_NAME = 1024


def file_button(
    label: str,
    receive: Callable[[dict[str, bytes]], None],
    complain: Callable[[str], None],
    multiple: bool = False,
) -> FileInput:
    """Return a button that opens a file, or several at once.

    Files of any name are received, since readers choose by content: a browser would drop others
    without a message.

    Parameters
    ----------
    label : str
    receive : callable
        Called with the contents of the files by name.
    complain : callable
        Called with the reason where a file is refused.
    multiple : bool
        Whether several files can be chosen.
    """
    made = FileInput(
        complain,
        multiple=multiple,
        label=label,
        uploaded_label=label,  # "Uploaded NAME" would stay where the file could not be read
        max_file_size=MAX_UPLOAD_BYTES,
        variant="outlined",
        size="small",
        sizing_mode="stretch_width",
        margin=(4, 8),
    )

    def take(content: Any) -> None:
        if content:
            made.value = None  # the same file can be chosen again
            names, contents = (made.filename, content) if multiple else ([made.filename], [content])
            receive(dict(zip(names, contents, strict=True)))

    made.param.watch(lambda event: take(event.new), "value")
    return made


class FileInput(pmui.FileInput):
    """Accept one file at a time, or several if `multiple`, of at most `max_file_size` bytes in all.

    The browser checks the size first, but a client may send anything.

    Parameters
    ----------
    complain : callable
        Called with the reason where a file is refused.
    """

    def __init__(self, complain: Callable[[str], None], **params: Any) -> None:
        # panel-material-ui 0.16 adds each file to a sum that has it already, and would refuse one
        # of more than half the limit. The sum itself is checked below.
        most_bytes = 2 * params["max_file_size"]
        super().__init__(chunk_size=PART_BYTES, max_total_file_size=most_bytes, **params)
        self._complain = complain
        self._is_empty = False

    def _handle_msg(self, msg: Mapping[str, Any]) -> None:
        try:
            status = msg.get("status")
            if status == "error":  # the browser refused the file, or could not read it
                raise ValueError(str(msg.get("error"))[:_LONGEST_NAME])
            if status == "initializing":
                self._discard()
                self._is_empty = True
            elif status == "upload_event":
                self._is_empty = False
                self._require_part(msg)
            elif status == "finished" and self._is_empty:  # an empty file has no parts
                raise ValueError("it is empty; save it again, or choose another one.")
            super()._handle_msg(msg)
        except Exception as error:  # a message may be malformed in many ways
            self._discard()
            self._send_msg({"status": "error", "error": str(error)})
            self._complain(str(error))

    def _require_part(self, part: Mapping[str, Any]) -> None:
        """Raise ``ValueError`` unless this is a part of the one file that is being uploaded."""
        name, data = part["name"], part["data"]
        number, total = part["chunk"], part["total_chunks"]
        is_name = isinstance(name, str) and len(name) <= _LONGEST_NAME
        require("file name", str(name)[:80], is_name, f"up to {_LONGEST_NAME} characters")
        most = math.ceil(self.max_file_size / PART_BYTES)
        fits = isinstance(total, int) and 1 <= total <= most
        require("parts of the file", total, fits, f"1 to {most}, each of {PART_BYTES:,} bytes")
        fits = isinstance(number, int) and 1 <= number <= total
        require("number of a part", number, fits, f"1 to {total}")
        fits = isinstance(data, bytes) and len(data) <= PART_BYTES
        require("content of a part", type(data).__name__, fits, f"at most {PART_BYTES:,} bytes")
        earlier = {kept["filename"] for kept in self._buffer}
        is_next = name not in earlier if self.multiple else not earlier
        is_one = is_next and all(kept == name for kept in self._file_buffer)
        require("file name", name, is_one, "one file at a time, each under a name of its own")
        n_files = len(earlier) + 1
        require("files at once", n_files, n_files <= MOST_FILES, f"up to {MOST_FILES}")
        size = len(data) + sum(len(kept["value"]) for kept in self._buffer)
        size += sum(map(len, self._file_buffer.get(name, {"chunks": {}})["chunks"].values()))
        most_bytes = f"at most {self.max_file_size:,}"
        require("bytes of the files", size, size <= self.max_file_size, most_bytes)

    def _discard(self) -> None:
        self._file_buffer.clear()
        self._buffer.clear()
