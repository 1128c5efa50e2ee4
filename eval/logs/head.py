"""The first bytes of a file, by which its format is told."""

from __future__ import annotations

from pathlib import Path

from eval.logs.columns import FlightLogError
from tracks.input.reading import LOG_BYTES, InputError, check_file


def read_head(path: Path) -> bytes:
    """Return the first bytes of the file at `path`.

    Raises:
        FlightLogError: where it cannot be read or is empty.
    """
    try:
        check_file(path, LOG_BYTES)
        with path.open("rb") as file:
            head = file.read(8192)
    except OSError as error:
        reason = f"cannot be read: {error.strerror or error}"
        raise FlightLogError(str(path), None, None, reason) from None
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise FlightLogError(str(path), None, None, reason) from None
    if not head:
        raise FlightLogError(str(path), None, None, "the file is empty; record or copy it again")
    return head


def first_line(head: bytes) -> bytes:
    """Return the first line of a text file's head."""
    return head.split(b"\n", 1)[0]
