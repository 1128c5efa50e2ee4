"""Import flight logs of other programs: one file for each format.

    imported = import_log("log.ulg")
    write_flight("flight.parquet", imported.log)

A format is a module with `SUMMARY`, `detect` and `read` (`eval.importers.formats.Format`);
docs/import.md describes each.
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
    """The result of an import."""

    log: FlightLog
    """With the columns, units and frames of a flight log."""
    findings: tuple[Finding, ...]
    """Results of all checks and corrections."""


def import_log(
    path: str | os.PathLike[str],
    format: str | None = None,
    options: ImportOptions | None = None,
) -> ImportedLog:
    """Read a log of another program, check it and convert it to a flight log.

    Args:
        path: the file.
        format: a name of `eval.importers.formats.FORMATS`; None: detected by the first bytes.
        options: see `eval.importers.options`.

    Raises:
        FlightLogError: for a file that cannot be used; it names the file and the reason.
        ValueError: for an unknown format, or a mapping file that cannot be used.
    """
    from eval.importers.assemble import assemble
    from eval.importers.formats import FORMATS, detect
    from eval.importers.options import ImportOptions

    options = options or ImportOptions()
    file = Path(path)
    name = format or detect(file, options)
    reader = FORMATS.find(name)
    if options.map is not None and not getattr(reader, "TAKES_MAP", True):
        raise ValueError(
            f"{file} is read as {name!r}, whose names are known: leave --map out, or give "
            "--format table if it is a table that --map describes"
        )
    # `source` selects the pose within the file that holds it.
    own = options if options.pose is None else replace(options, source="")
    if own.source and not getattr(reader, "TAKES_SOURCE", True):
        raise ValueError(
            f"{file} is read as {name!r}, whose pose is of one source: leave --source "
            f"{own.source} out"
        )
    return ImportedLog(*assemble(reader.read(file, own), name, options))
