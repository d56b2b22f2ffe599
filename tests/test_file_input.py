"""The server checks the parts in which a file arrives, whatever the browser checks."""

from __future__ import annotations

import pytest

from app.model.uploads import MAX_UPLOAD_BYTES
from app.widgets.file_input import PART_BYTES, FileInput

PART = {
    "status": "upload_event",
    "name": "a.npz",
    "chunk": 1,
    "total_chunks": 2,
    "mime_type": "",
    "data": b"one",
}


class Receiver(FileInput):
    """A file input that is given messages in place of a browser."""

    def receive(self, message):
        self._handle_msg(message)


@pytest.fixture
def complaints():
    return []


@pytest.fixture
def given(complaints):
    """A file input that receives messages as from a browser."""
    return Receiver(complaints.append, max_file_size=MAX_UPLOAD_BYTES)


def send(given, **changes):
    given.receive(PART | changes)


def begin(given):
    given.receive({"status": "initializing"})


def finish(given):
    given.receive({"status": "finished"})


def test_a_file_in_parts_arrives_whole(given, complaints):
    begin(given)
    send(given)
    send(given, chunk=2, data=b" two")
    finish(given)
    assert (given.filename, given.value) == ("a.npz", b"one two")
    assert complaints == []


def test_several_files_arrive_together_within_one_limit(complaints):
    given = Receiver(complaints.append, max_file_size=10, multiple=True)
    for content, arrived in ((b"12345", [b"abcde", b"12345"]), (b"123456", None)):
        given.clear()
        begin(given)
        send(given, name="1.npz", total_chunks=1, data=b"abcde")
        send(given, name="2.npz", total_chunks=1, data=content)
        finish(given)
        assert given.value == arrived
    assert len(complaints) == 1 and "bytes of the files = 11" in complaints[0]
    for _ in range(2):
        send(given, name="1.npz", total_chunks=1)
    assert "one file at a time" in complaints[1]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"total_chunks": MAX_UPLOAD_BYTES // PART_BYTES + 1}, "parts of the file = 26"),
        ({"total_chunks": "2"}, "parts of the file"),
        ({"total_chunks": 10**30}, "parts of the file"),
        ({"chunk": 0}, "number of a part = 0"),
        ({"chunk": 3}, "number of a part = 3"),
        ({"data": bytes(PART_BYTES + 1)}, "content of a part"),
        ({"data": 10**12}, "content of a part"),
        ({"data": [1] * 10}, "content of a part"),
        ({"name": "x" * 2000}, "file name"),
        ({"name": 7}, "file name"),
        ({"status": "unheard of"}, "unheard of"),
        ({"status": "error", "error": "too large"}, "too large"),
    ],
)
def test_a_malformed_message_is_refused_and_the_next_file_arrives(given, complaints, changes, text):
    send(given)
    send(given, **changes)
    assert len(complaints) == 1
    assert text in complaints[0]
    assert not given.value
    begin(given)
    send(given, total_chunks=1, data=b"x")
    finish(given)
    assert given.value == b"x"


def test_unfinished_files_are_not_kept(given, complaints):
    for n in range(50):
        send(given, name=f"{n}.npz")
    assert "one file at a time" in complaints[0]
    assert len(complaints) == 25  # every second one is refused, with the one before it


def test_an_empty_file_of_which_no_part_arrives_is_refused(given, complaints):
    begin(given)
    finish(given)
    assert given.value is None
    assert complaints == ["it is empty; save it again, or choose another one."]
