"""CSV and Parquet tables, described by a mapping file (TOML).

A table of the mapping is a signal: which columns it has, in which unit. Without a mapping the
columns are those of a flight log. Slower signals leave cells empty; each signal is read at the
rows where it is whole. docs/import.md shows a mapping with every key.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.importers.checks.units import TIMES
from eval.importers.findings import Finding
from eval.importers.frames import (
    BODIES,
    WORLDS,
    attitude,
    body_vector,
    conjugate,
    from_euler,
    world_vector,
)
from eval.importers.head import first_line
from eval.importers.options import ImportOptions
from eval.importers.rows import in_world
from eval.importers.signals import Recording, collect
from eval.logs.columns import GROUPS, FlightLogError
from eval.logs.files import read_columns
from tracks.common.names import closest
from tracks.common.toml_table import Table, read_toml

SUMMARY = "CSV or Parquet, described by a mapping file (--map)"
ASKED_LAST = True
PARQUET = b"PAR1"
DEG = float(np.pi / 180.0)
RPM = float(2.0 * np.pi / 60.0)
_LENGTH = {"m": 1.0, "cm": 0.01, "mm": 1e-3}
_TURN = {"rad/s": 1.0, "deg/s": DEG}
_FORCE = {"m/s^2": 1.0, "g": 9.81}
UNITS: dict[str, dict[str, float]] = {
    "time": TIMES,
    "pos": _LENGTH,
    "quat": {"1": 1.0},
    "euler": {"rad": 1.0, "deg": DEG},
    "vel": {f"{unit}/s": factor for unit, factor in _LENGTH.items()},
    "rate": _TURN,
    "cmd_rate": _TURN,
    "cmd_thrust": _FORCE,
    "throttle": {"1": 1.0, "%": 0.01},
    "acc": _FORCE,
    "motor": {"rad/s": 1.0, "rpm": RPM, "Hz": float(2.0 * np.pi)},
    "motor_cmd": {"rad/s": 1.0, "rpm": RPM, "Hz": float(2.0 * np.pi)},
    "voltage": {"V": 1.0, "mV": 1e-3},
}
"""Signal -> the units it may be in, and their factors; the first is the default."""
WIDTHS = {name: len(GROUPS[name]) if name in GROUPS else 3 for name in UNITS} | {"throttle": 1}


@dataclass(frozen=True)
class Column:
    """Where one signal of a table is."""

    names: tuple[str, ...]
    """Columns, in our order (quaternions: wxyz)."""
    factor: tuple[float, ...]
    """From the column's unit and sign to ours."""
    body: bool = False
    """A velocity in body axes."""
    inverse: bool = False
    """A quaternion from world to body."""


@dataclass(frozen=True)
class TableMap:
    """What a mapping file says."""

    columns: Mapping[str, Column] = field(default_factory=dict)
    """By signal."""
    world: str = "z-up"
    """One of `frames.WORLDS`."""
    body: str = "flu"
    """One of `frames.BODIES`."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is Parquet, or text that may be a table."""
    if head.startswith(PARQUET):
        return True
    return b"\0" not in head and (options.map is not None or b"," in first_line(head))


def read(path: Path, options: ImportOptions) -> Recording:
    """Return what the table at `path` holds, read as `options.map` says.

    Raises:
        FlightLogError: for a file that is no table, or lacks a column of the mapping.
        ValueError: for a mapping file that cannot be used.
    """
    return read_table(path, options.map)


def read_table(path: Path, map_path: Path | None) -> Recording:
    """Return what the table at `path` holds; see `read`."""
    told = None if map_path is None else read_map(map_path)
    columns, _, warnings = read_columns(path)
    mapping = told or own_columns(columns)
    name = str(path)
    values = {signal: _values(columns, c, name) for signal, c in mapping.columns.items()}
    if "time" not in values:
        hint = "name it in the mapping's [time]" if map_path else "describe the columns with --map"
        there = ", ".join(list(columns)[:12])
        reason = f"no column for the time; {hint}. There are: {there}"
        raise FlightLogError(name, "time", None, reason)
    time_s = values.pop("time")[:, 0]
    if "euler" in values:
        values["quat"] = from_euler(values.pop("euler"))
    for signal, value in values.items():
        values[signal] = _ours(signal, value, mapping)
    parts = {signal: (time_s, value) for signal, value in values.items()}
    signals, more = collect(parts, name)
    if mapping.columns.get("vel", Column((), ())).body and "quat" in signals and "vel" in signals:
        signals["vel"] = in_world(signals["vel"], signals["quat"])
    notes = tuple(Finding("note", "file", text) for text in warnings)
    return Recording(name, signals, (*notes, *more))


def own_columns(columns: Mapping[str, np.ndarray]) -> TableMap:
    """Return the mapping of a table whose columns are named as in a flight log."""
    there = {
        group: Column(names, (1.0,) * len(names))
        for group, names in GROUPS.items()
        if all(name in columns for name in names)
    }
    if "throttle" in columns:
        there["throttle"] = Column(("throttle",), (1.0,))
    return TableMap(there)


def read_map(path: Path) -> TableMap:
    """Read a mapping file.

    Raises:
        ValueError: naming the file, the key, its value and what is allowed.
    """
    top = read_toml(path)
    world, body = "z-up", "flu"
    if top.has("frames"):
        frames = top.table("frames")
        world = _choice(frames, "world", WORLDS)
        body = _choice(frames, "body", BODIES)
        frames.close()
    columns = {}
    for signal in UNITS:
        if top.has(signal):
            table = top.table(signal)
            columns[signal] = _column(signal, table)
            table.close()
    top.has("topics")  # of MCAP files; see mcap.py
    top.close()
    return TableMap(columns, world, body)


def _column(signal: str, table: Table) -> Column:
    width = WIDTHS[signal]
    names = [table.text("column")] if width == 1 else _strings(table, width)
    unit = _choice(table, "unit", tuple(UNITS[signal]))
    sign = table.vector("sign", width, [1.0] * width)
    if not np.all(np.abs(sign) == 1.0):
        raise table.error("sign", sign.tolist(), "1 or -1 for each column")
    inverse = body = False
    if signal == "quat":
        if _choice(table, "order", ("wxyz", "xyzw")) == "xyzw":
            names, sign = [names[k] for k in (3, 0, 1, 2)], sign[[3, 0, 1, 2]]
        inverse = _choice(table, "maps", ("body to world", "world to body")) == "world to body"
    if signal == "vel":
        body = _choice(table, "axes", ("world", "body")) == "body"
    factor = tuple(float(s) * UNITS[signal][unit] for s in sign)
    return Column(tuple(names), factor, body, inverse)


def _choice(table: Table, key: str, allowed: tuple[str, ...]) -> str:
    value = table.text(key, allowed[0])
    if value not in allowed:
        raise table.error(key, value, " or ".join(repr(choice) for choice in allowed))
    return value


def _strings(table: Table, width: int) -> list[str]:
    value = table.texts("columns")
    if len(value) != width:
        raise table.error("columns", value, f"{width} column names")
    return value


def _values(columns: Mapping[str, np.ndarray], column: Column, name: str) -> np.ndarray:
    parts = [numbers(columns, each, name) for each in column.names]
    if len(parts[0]) and np.all([p.dtype.kind in "iu" for p in parts]):
        # Unix times in nanoseconds do not fit a float64: take the first away while whole.
        parts = [
            p - p[0] if len(column.names) == 1 and abs(int(p[0])) > 2**52 else p for p in parts
        ]
    return np.stack([p.astype(np.float64) for p in parts], axis=1) * np.asarray(column.factor)


def numbers(columns: Mapping[str, np.ndarray], column: str, name: str) -> np.ndarray:
    """Return a column as numbers, NaN where a cell is empty.

    Raises:
        FlightLogError: where the column is missing or holds something else.
    """
    if column not in columns:
        guess = closest(column, list(columns))
        hint = f"; did you mean {guess!r}?" if guess else f"; there are: {', '.join(columns)}"
        raise FlightLogError(name, column, None, "missing" + hint)
    values = np.asarray(columns[column])
    if values.dtype.kind in "fiub":
        return values
    out = np.full(len(values), np.nan)
    for k, value in enumerate(values):
        text = value.strip() if isinstance(value, str) else value
        try:
            if text is not None and text != "":
                out[k] = float(text)
        except (TypeError, ValueError):
            raise FlightLogError(name, column, k + 1, f"{value!r} is not a number") from None
    return out


def _ours(signal: str, value: np.ndarray, mapping: TableMap) -> np.ndarray:
    column = mapping.columns.get(signal, Column((), ()))
    change: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "pos": lambda v: world_vector(v, mapping.world),
        "vel": lambda v: (
            body_vector(v, mapping.body) if column.body else world_vector(v, mapping.world)
        ),
        "quat": lambda q: attitude(
            conjugate(q) if column.inverse else q, mapping.world, mapping.body
        ),
    } | dict.fromkeys(("rate", "cmd_rate", "acc"), lambda v: body_vector(v, mapping.body))
    return change[signal](value) if signal in change else value
