"""Flight logs of other programs as flight logs of ours: one file a format, and the table of them.

    imported = import_log("log.ulg")
    write_flight("flight.parquet", imported.log)

A format is a module with `SUMMARY`, `detect` and `read` (`eval.importers.formats.Format`).
docs/import.md says what each reads.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from eval.importers.options import ImportOptions
    from eval.logs.faults.finding import Finding
    from eval.logs.flight_log import FlightLog


class ImportedLog(NamedTuple):
    """A flight of another program."""

    log: FlightLog
    """In our columns, units and frames."""
    findings: tuple[Finding, ...]
    """What was checked, corrected and doubted."""


def import_log(
    path: str | os.PathLike[str],
    format: str | None = None,
    options: ImportOptions | None = None,
) -> ImportedLog:
    """Read a log of another program, check it, and bring it to our columns, units and frames.

    Args:
        path: the file.
        format: a name of `eval.importers.formats.FORMATS`; by default told by the file's first
            bytes.
        options: see `eval.importers.options`.

    Raises:
        FlightLogError: for a file that cannot be used; it names the file and the reason.
        ValueError: for an unknown format, or a mapping file that cannot be used.
    """
    from eval.importers.assemble import assemble
    from eval.importers.formats import FORMATS, detect
    from eval.importers.options import ImportOptions

    told = options or ImportOptions()
    file = Path(path)
    name = format or detect(file, told)
    reader = FORMATS.find(name)
    if told.map is not None and not getattr(reader, "TAKES_MAP", True):
        raise ValueError(
            f"{file} is read as {name!r}, whose names are known: leave --map out, or say "
            "--format table if it is a table that --map describes"
        )
    # Where the pose is another file's, the source is that one's.
    own = told if told.pose is None else replace(told, source="")
    if own.source and not getattr(reader, "TAKES_SOURCE", True):
        raise ValueError(
            f"{file} is read as {name!r}, whose pose is of one source: leave --source "
            f"{own.source} out"
        )
    return ImportedLog(*assemble(reader.read(file, own), name, told))
