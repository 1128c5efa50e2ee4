"""Registry of the log formats that can be imported; each module here detects and reads one.

Another package adds a format with an entry point of the group `diffracing_suite.formats`. A program
adds one for its own process with `FORMATS.register(name, module)`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from eval.importers.options import ImportOptions
from eval.importers.signals import Recording
from eval.logs.columns import FlightLogError
from eval.logs.files import NO_COMMAS, OTHER_MARKS, first_line, read_head
from tracks.common.names import Registry


class Format(Protocol):
    """A module or object that reads one format.

    Optional attributes: `ASKED_LAST = True` for a format that accepts any table, so that the others
    are tried before it; `TAKES_MAP = False` if it uses no mapping file; `TAKES_SOURCE = False` if
    its pose has a single source.
    """

    SUMMARY: str
    """Description for users."""

    def detect(self, head: bytes, options: ImportOptions) -> bool:
        """Return whether a file with these first bytes has this format.

        Raises:
            ValueError: for a file that needs a conversion first.
        """
        ...

    def read(self, path: Path, options: ImportOptions) -> Recording:
        """Return the signals of the file at `path`, in the flight log's units and frames."""
        ...


def _registration_error(name: str, module: Any) -> str | None:
    """Return why `module` is not a format, or None."""
    missing = [part for part in ("SUMMARY", "detect", "read") if not hasattr(module, part)]
    return f"it has no {' and no '.join(missing)}" if missing else None


FORMATS: Registry[Format] = Registry(
    "format",
    "diffracing_suite.formats",
    {
        name: f"eval.importers.formats.{name}"
        for name in ("px4", "betaflight", "ardupilot", "crazyflie", "table", "mcap")
    },
    _registration_error,
)
"""Name of a format -> module that detects and reads it."""


def detect(path: Path, options: ImportOptions) -> str:
    """Return the name of the format of the file at `path`.

    Formats that accept any table are tried last.

    Raises:
        FlightLogError: where the file cannot be read, or has no known format.
    """
    head = read_head(path)
    candidates = sorted(FORMATS.items(), key=lambda item: getattr(item[1], "ASKED_LAST", False))
    for name, format in candidates:
        try:
            if format.detect(head, options):
                return name
        except ValueError as error:
            raise FlightLogError(path, str(error)) from None
    reason = "of no known format; name it with --format, and a table's columns with --map"
    if b"\0" not in head and any(mark.encode() in first_line(head) for mark in OTHER_MARKS):
        reason = NO_COMMAS
    raise FlightLogError(path, reason)
