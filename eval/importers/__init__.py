"""Import flight logs of autopilots and other programs as flight logs of this suite.

    imported = import_log("log.ulg")
    write_flight("flight.parquet", imported.log)

Each log format is one module with `SUMMARY`, `detect` and `read`
(`eval.importers.formats.Format`); docs/import.md describes the formats.
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
    """A converted log, and the results of its checks."""

    log: FlightLog
    """The flight in this suite's columns, units and frames."""
    findings: tuple[Finding, ...]
    """Results of all checks and corrections."""


def import_log(
    path: str | os.PathLike[str], format: str | None = None, options: ImportOptions | None = None
) -> ImportedLog:
    """Read a log of another program, check it and convert it to a flight log.

    Without a format (a name of `eval.importers.formats.FORMATS`), the first bytes determine it.

    Returns:
        The flight log and the findings of its checks.

    Raises:
        FlightLogError: for a file that cannot be used; it names the file and the reason.
        ValueError: for an unknown format, or a mapping file that cannot be used.
    """
    from eval.importers.assemble import assemble
    from eval.importers.formats import FORMATS, detect
    from eval.importers.options import ImportOptions
    from eval.importers.signals import check_recording

    options = options or ImportOptions()
    file = Path(path)
    name = format or detect(file, options)
    reader = FORMATS.find(name)
    if options.map is not None and not getattr(reader, "TAKES_MAP", True):
        raise ValueError(
            f"{file} is read as {name!r}, which has fixed names: leave --map out, or give "
            "--format table if it is a table that --map describes"
        )
    # With a pose file, `source` selects the pose in that file, not in this one.
    reader_options = options if options.pose is None else replace(options, source="")
    if reader_options.source and not getattr(reader, "TAKES_SOURCE", True):
        raise ValueError(
            f"{file} is read as {name!r}, which has one source of the pose: leave --source "
            f"{reader_options.source} out"
        )
    recording = reader.read(file, reader_options)
    check_recording(recording, name)
    return ImportedLog(*assemble(recording, name, options))
