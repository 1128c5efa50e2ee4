"""One file a format: what it reads, how it is told from others, and how it is read.

Another package adds one with an entry point of the group `diffracing_suite.formats`, a program for
its own process with `FORMATS.register(name, module)`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from eval.importers.options import ImportOptions
from eval.importers.signals import Recording
from eval.logs.columns import FlightLogError
from eval.logs.files import read_head
from tracks.common.names import Registry


class Format(Protocol):
    """A module (or an object) that reads one format.

    One that takes whatever has columns says `ASKED_LAST = True`: the others are asked before it.
    One to which a mapping file says nothing says `TAKES_MAP = False`, one whose pose is of one
    source `TAKES_SOURCE = False`.
    """

    SUMMARY: str
    """What it reads, for people."""

    def detect(self, head: bytes, options: ImportOptions) -> bool:
        """Return whether a file with these first bytes is of the format.

        Raises:
            ValueError: for a file that could be read after something has been done to it.
        """
        ...

    def read(self, path: Path, options: ImportOptions) -> Recording:
        """Return what the file holds."""
        ...


def _wrong(name: str, module: Any) -> str | None:
    missing = [part for part in ("SUMMARY", "detect", "read") if not hasattr(module, part)]
    return f"it has no {' and no '.join(missing)}" if missing else None


FORMATS: Registry[Format] = Registry(
    "format",
    "diffracing_suite.formats",
    {
        name: f"eval.importers.formats.{name}"
        for name in ("px4", "betaflight", "ardupilot", "crazyflie", "table", "mcap")
    },
    _wrong,
)


def detect(path: Path, options: ImportOptions) -> str:
    """Return the name of the format of the file at `path`.

    Formats that take whatever has columns, such as tables, are asked after all others.

    Raises:
        FlightLogError: where the file cannot be read, or is of no known format.
    """
    head = read_head(path)
    asked = sorted(FORMATS.items(), key=lambda item: getattr(item[1], "ASKED_LAST", False))
    reason = "of no known format; name it with --format, and a table's columns with --map"
    for name, format in asked:
        try:
            if format.detect(head, options):
                return name
        except ValueError as error:
            reason = str(error)
            break
    raise FlightLogError(str(path), None, None, reason)
