"""Read CSV and Parquet tables whose columns a mapping file (TOML) describes.

Without a mapping the columns are those of a flight log. A signal slower than the rows leaves cells
empty; only rows with all its columns are read. A cell may hold a list, `[0.33 -0.07 2.17]`, whose
numbers are the columns `name[0]`, `name[1]`, ... docs/import.md shows a mapping with every key.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from eval.importers.mapping import recording_of
from eval.importers.mapping_file import LogMap, own_map, read_map
from eval.importers.options import ImportOptions
from eval.importers.signals import Part, Recording
from eval.logs.columns import FlightLogError, as_numbers
from eval.logs.faults.finding import Finding
from eval.logs.files import PARQUET_MAGIC, first_line, read_columns
from eval.logs.flight_log import flight_metadata
from tracks.common.names import closest

SUMMARY = "CSV or Parquet, described by a mapping file (--map)"
ASKED_LAST = True
"""Other formats are tried before this one, which accepts any table."""
WRAPS = tuple((bits, 2.0**bits * unit) for bits in (32, 16) for unit in (1.0, 1e-3, 1e-6))
"""Bits of a counter, and the number at which it starts again, in its own or a larger unit."""
WRAP_STEPS, COUNTER_STEPS = 5.0, 100.0
"""A counter goes on within the first number of usual steps, and counts more than the second."""
_LIST_ENTRY = re.compile(r"^(.*)\[(\d)\]$")
"""Name of one number of a list column, such as `pos[0]`."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is Parquet, or text that may be a table."""
    if head.startswith(PARQUET_MAGIC):
        return True
    return b"\0" not in head and (options.map is not None or b"," in first_line(head))


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the table at `path`, by the mapping `options.map`.

    Raises:
        FlightLogError: for a file that is no table, or lacks a column of the mapping.
        ValueError: for a mapping file that cannot be used.
    """
    file_map = None if options.map is None else read_map(options.map)
    columns, text, warnings = read_columns(path)
    mapping = file_map or own_map(columns)
    name, about = str(path), {}
    if file_map is None:  # a flight log has metadata
        about, more_warnings = flight_metadata(text, name)
        warnings += more_warnings
    flag = "--pose-map" if path == options.pose else "--map"
    hint = "name it in the mapping's [time]" if file_map else f"describe the columns with {flag}"
    time_s, clock_findings = _time(columns, mapping, name, hint)

    def find(names: tuple[str, ...]) -> Part | None:
        values = [_values(columns, column, name) for column in names]
        present = [value for value in values if value is not None]
        if len(present) < len(names):
            return None
        return time_s, np.concatenate(present, axis=1)

    recording = recording_of(path, mapping, find, lambda c: _missing(columns, c), options)
    notes = tuple(Finding("note", "file", text) for text in warnings)
    about |= recording.about
    findings = (*notes, *clock_findings, *recording.findings)
    return replace(recording, findings=findings, about=about)


def _time(
    columns: Mapping[str, np.ndarray], mapping: LogMap, name: str, hint: str
) -> tuple[np.ndarray, list[Finding]]:
    """Return the times (N,) of the rows [s], and findings; `hint` says how to name the column."""
    if "time" not in mapping.columns:
        present = ", ".join(list(columns)[:12])
        raise FlightLogError(name, f"no column for the time; {hint}. There are: {present}", "time")
    alternatives = mapping.columns["time"]
    column = next((c for c in alternatives if c.names[0] in columns), alternatives[0])
    values = numbers(columns, column.names[0], name)
    if len(values) and values.dtype.kind in "iu" and abs(int(values[0])) > 2**52:
        # Unix times in nanoseconds exceed a float64's precision: subtract the first as integers.
        values = (values - values[0]).astype(np.int64)  # unsigned differences wrap below 0
    values, findings = unwrapped(values.astype(np.float64))
    return values * column.factor[0], findings


def unwrapped(time: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """Return times (N,) in any unit as one clock where a full counter restarts, and a finding.

    A step back counts as such where the time goes on as usual after it.
    """
    known = np.flatnonzero(np.isfinite(time))
    step = np.diff(time[known])
    usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0
    for bits, period in WRAPS:
        is_back = step < -0.5 * period
        onward = step[is_back] + period
        if not is_back.any() or period < COUNTER_STEPS * usual:
            continue
        if (onward > 0.0).all() and (onward < WRAP_STEPS * usual).all():
            time = time.copy()
            time[known[1:]] += period * np.cumsum(is_back)
            text = f"its {bits}-bit counter starts again {is_back.sum()} times: taken as one clock"
            return time, [Finding("corrected", "time", text)]
    return time, []


def numbers(columns: Mapping[str, np.ndarray], column: str, name: str) -> np.ndarray:
    """Return a column of the file `name` as numbers (N,), NaN where a cell is empty.

    Raises:
        FlightLogError: where the column is missing or holds anything but numbers.
    """
    if column not in columns:
        raise FlightLogError(name, _missing(columns, column), column)
    values = np.asarray(columns[column])
    if values.dtype.kind in "fiub":
        return values
    return as_numbers(values, column, name)


def _missing(columns: Mapping[str, np.ndarray], column: str) -> str:
    similar = closest(column, list(columns))
    hint = f"; did you mean {similar!r}?" if similar else f"; there are: {', '.join(columns)}"
    return "missing" + hint


def _values(columns: Mapping[str, np.ndarray], column: str, name: str) -> np.ndarray | None:
    """Return a column as (N, C) with C numbers a cell; None where the table lacks it."""
    if column in columns:
        if _holds_lists(columns[column]):
            return _lists(columns[column], column, name)
        return numbers(columns, column, name).astype(np.float64)[:, None]
    list_entry = _LIST_ENTRY.match(column)
    if list_entry is None or list_entry.group(1) not in columns:
        return None
    list_column, index = list_entry.group(1), int(list_entry.group(2))
    values = _lists(columns[list_column], list_column, name)
    return values[:, index : index + 1] if index < values.shape[1] else None


def _holds_lists(values: np.ndarray) -> bool:
    if values.dtype.kind != "O":
        return False
    first = next((v for v in values if isinstance(v, str) and v.strip()), "")
    return first.strip().startswith(("[", "("))


def _lists(values: np.ndarray, column: str, name: str) -> np.ndarray:
    """Return the numbers (N, C) in cells such as `[0.33 -0.07 2.17]` or `(1, 2, 3)`."""
    rows: list[list[float]] = []
    for k, value in enumerate(values):
        text = value.strip().strip("[]()") if isinstance(value, str) else ""
        try:
            rows.append([float(part) for part in text.replace(",", " ").split()])
        except ValueError:
            reason = f"{value!r} is not a list of numbers"
            raise FlightLogError(name, reason, column, k + 1) from None
    width = max((len(row) for row in rows), default=0)
    for k, row in enumerate(rows):
        if len(row) not in (0, width):
            reason = f"a list of {len(row)} numbers, where others have {width}"
            raise FlightLogError(name, reason, column, k + 1)
    return np.array([row or [np.nan] * width for row in rows])
