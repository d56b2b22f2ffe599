"""What keeps a damaged or hostile file from doing more than being refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from core.capture import CaptureError
from core.checks import require

# Largest cube, file, and decompressed part of a file. Checked before memory is asked for: a header
# of a hundred bytes can claim any size.
MAX_CUBE_BYTES = 2 * 1024**3


def require_fits(name: str, n_bytes: int, remedy: str = "a smaller file") -> None:
    """Raise ``ValueError`` if something would take more than `MAX_CUBE_BYTES`."""
    allowed = f"{remedy}: at most {MAX_CUBE_BYTES:,} bytes are read"
    require(f"bytes of {name}", n_bytes, 0 <= n_bytes <= MAX_CUBE_BYTES, allowed)


@contextmanager
def decoding(what: str) -> Iterator[None]:
    """Turn whatever a library raises on a damaged file into one clear refusal.

    The decoders document no list of their exceptions, so every one of them is taken.
    """
    try:
        yield
    except Exception as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise CaptureError(
            f"{what} cannot be read, the file is damaged ({reason}): copy or save it again."
        ) from error
