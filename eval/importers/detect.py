"""Which format a file is in, by its first bytes."""

from __future__ import annotations

from pathlib import Path

from eval.importers.formats import FORMATS
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from eval.logs.head import read_head


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
