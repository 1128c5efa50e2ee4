"""Flight logs: one flight as arrays, read from and written to Parquet or CSV.

The columns and their units are in `docs/flight_logs.md`, the rules for a valid file in
`eval/logs/columns.py`. The suite also records the policy's action, the rows of its decisions and
the next gate, as extra columns. Unknown columns of any origin are kept.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from eval.logs.columns import (
    COMMANDS,
    GROUPS,
    KNOWN,
    NEEDED,
    FlightLogError,
    check_columns,
    split_group,
)
from eval.logs.files import read_columns, write_columns
from eval.logs.flight import Flight
from eval.logs.velocity import velocity_from_position
from policies.spec import ACTIONS
from tracks.common.files import to_json
from tracks.common.provenance import stamp
from tracks.geometry.rotation import quat_to_rot
from tracks.input.ranges import as_path, check_type
from tracks.input.reading import InputError, parse_json

SCHEMA = 1
"""Version of the flight log's layout, in the metadata of every file we write."""
ACTION = ("action_x", "action_y", "action_z")
"""Columns of an action of kind `acceleration`."""
QUATERNION_ROUNDING = 1e-12
"""Quaternions closer to unit norm than this are not normalised, so that a log reads back equal."""


@dataclass(frozen=True)
class FlightLog:
    """One flight as arrays on its T rows; a value that is missing is NaN.

    Row k holds what was measured at `time_s[k]` before the command of row k acts; that command
    holds from `time_s[k]` to the next command.
    """

    name: str
    """The file's path, or another name for messages."""
    time_s: np.ndarray
    """(T,) increasing time; sampling may jitter and rows may be missing [s]."""
    pos_w: np.ndarray
    """(T, 3) position of the centre of mass in the world [m]."""
    quat_wxyz: np.ndarray
    """(T, 4) attitude, quaternion of unit norm from body to world."""
    vel_w: np.ndarray
    """(T, 3) velocity of the centre of mass in the world [m/s]."""
    rate_b: np.ndarray
    """(T, 3) body rates [rad/s]."""
    thrust_cmd: np.ndarray | None = None
    """(T,) commanded collective thrust per nominal mass [m/s^2]."""
    rate_cmd_b: np.ndarray | None = None
    """(T, 3) commanded body rates [rad/s]; comes with `thrust_cmd`, unless `torque_cmd_b` does."""
    rotor_speed: np.ndarray | None = None
    """(T, 4) measured rotor speeds, in the vehicle file's order [rad/s]."""
    rotor_speed_cmd: np.ndarray | None = None
    """(T, 4) commanded rotor speeds, in the same order [rad/s]."""
    acc_b: np.ndarray | None = None
    """(T, 3) specific force measured by an accelerometer [m/s^2]."""
    voltage: np.ndarray | None = None
    """(T,) voltage of the battery [V]."""
    torque_cmd_b: np.ndarray | None = None
    """(T, 3) commanded body torques [N m]; comes with `thrust_cmd`."""
    pwm: np.ndarray | None = None
    """(T, 4) motor commands from 0 to 1, in the vehicle file's order; its `[motors]` and the
    voltage determine their thrust."""
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Unknown columns by name, (T,) each, as they were in the file."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """The JSON of metadata key `flight`: vehicle, source, notes, track, seed, integrator, ..."""
    velocity_derived: bool = False
    """True where `vel_w` was computed from `pos_w`."""
    warnings: tuple[str, ...] = ()
    """Oddities of the file that did not prevent its use."""

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def speed(self) -> np.ndarray:
        """(T,) magnitude of `vel_w` [m/s]."""
        return np.linalg.norm(self.vel_w, axis=1)

    @property
    def rot_w(self) -> np.ndarray:
        """(T, 3, 3) body to world; NaN where the quaternion is missing."""
        return quat_to_rot(self.quat_wxyz)

    @property
    def partial(self) -> tuple[str, ...]:
        """Required groups of columns that a partial log lacks, and `command`; () for a whole log.

        Where `pos`, `quat` or `rate` is among them, that array is NaN in every row.
        """
        return _partial_groups(self.about)

    @property
    def command(self) -> np.ndarray | None:
        """(T, 4) `thrust_cmd` and `rate_cmd_b` as one array; None where the log lacks one."""
        if self.thrust_cmd is None or self.rate_cmd_b is None:
            return None
        return np.concatenate([self.thrust_cmd[:, None], self.rate_cmd_b], axis=1)

    @property
    def whole(self) -> np.ndarray:
        """(T,) bool: rows with a complete state and a complete command."""
        parts = [self.pos_w, self.quat_wxyz, self.vel_w, self.rate_b]
        if (command := self.command) is not None:
            parts.append(command)
        elif self.thrust_cmd is not None and self.torque_cmd_b is not None:
            parts += [self.thrust_cmd[:, None], self.torque_cmd_b]
        elif self.rotor_speed is not None:
            parts.append(self.rotor_speed)
        elif self.pwm is not None:
            parts.append(self.pwm)
        return np.all(np.isfinite(np.concatenate(parts, axis=1)), axis=1)

    @property
    def integrator(self) -> str | None:
        """The simulator's integrator, `euler` (semi-implicit); None where the log has none.

        A flight without it counts as continuous in time.
        """
        named = self.about.get("integrator")
        return named if isinstance(named, str) else None

    @property
    def step_s(self) -> float | None:
        """Length of the steps of `integrator` [s], or None where the log has none."""
        step = self.about.get("step_s")
        if isinstance(step, bool) or not isinstance(step, (int, float)):
            return None
        return float(step) if step > 0.0 else None

    @property
    def action_b(self) -> np.ndarray | None:
        """(T, 3) the policy's acceleration in use [m/s^2]; None where the log has none."""
        return self._numbers(ACTION)

    @property
    def policy_step(self) -> np.ndarray | None:
        """(T,) bool: rows at which a new action starts; None where the log has none."""
        values = self._numbers(("policy_step",))
        return None if values is None else values[:, 0] > 0

    @property
    def gate(self) -> np.ndarray | None:
        """(T,) int32: the next gate's number from 0 (-1: missing); None where the log has none."""
        values = self._numbers(("gate",))
        return None if values is None else np.nan_to_num(values[:, 0], nan=-1).astype(np.int32)

    def _numbers(self, names: tuple[str, ...]) -> np.ndarray | None:
        columns = [self.extra.get(name) for name in names]
        numbers = [
            c.astype(np.float64) for c in columns if c is not None and c.dtype.kind in "fiub"
        ]
        return np.stack(numbers, axis=1) if len(numbers) == len(names) else None


# Group of columns (`columns.GROUPS`) -> field of `FlightLog`.
_FIELDS = {
    "pos": "pos_w",
    "quat": "quat_wxyz",
    "vel": "vel_w",
    "rate": "rate_b",
    "cmd_thrust": "thrust_cmd",
    "cmd_rate": "rate_cmd_b",
    "cmd_torque": "torque_cmd_b",
    "motor": "rotor_speed",
    "motor_cmd": "rotor_speed_cmd",
    "pwm": "pwm",
    "acc": "acc_b",
    "voltage": "voltage",
}


def log_from_flight(flight: Flight, name: str = "flight") -> FlightLog:
    """Return a recorded `flight` as a log, its action, decisions and gates as extra columns."""
    names = [f"action_{name}" for name in ACTIONS[flight.action_kind]]
    extra = dict(zip(names, np.asarray(flight.action_b).T, strict=True))
    extra |= {"policy_step": np.asarray(flight.policy_step), "gate": np.asarray(flight.gate)}
    return FlightLog(
        name,
        flight.time_s,
        flight.pos_w,
        flight.quat_wxyz,
        flight.vel_w,
        flight.rate_b,
        flight.thrust_cmd,
        flight.rate_cmd_b,
        flight.rotor_speed,
        extra=extra,
        about=flight.about,
    )


def log_from_columns(
    columns: Mapping[str, np.ndarray], about: Mapping[str, Any], name: str, limits: bool = True
) -> FlightLog:
    """Return `columns` (column name to (T,) values) as a log.

    Rows without a time are left out. Quaternions are normalised. A missing velocity is computed
    (`eval/logs/velocity.py`). Where `about` lists groups under `partial`, any required group may be
    missing: it is NaN, and `partial` of the log lists it. Without `limits` values are accepted that
    no flight has (`columns.LIMITS`).

    Raises:
        FlightLogError: where the columns break a rule; it names column, row and reason.
    """
    is_partial = bool(_partial_groups(about))
    checked, rows, warnings = check_columns(columns, name, is_partial, limits)
    if is_partial:
        about = {**about, "partial": _missing_groups(checked)}

    values: dict[str, np.ndarray] = {
        _FIELDS[key]: np.full((len(checked["time"]), len(GROUPS[key])), np.nan)
        for key in NEEDED
        if key != "time"
    }
    for key, attribute in _FIELDS.items():
        if GROUPS[key][0] in checked:
            parts = [checked[column] for column in GROUPS[key]]
            values[attribute] = parts[0] if len(parts) == 1 else np.stack(parts, axis=1)
    time_s, quat = checked["time"], values["quat_wxyz"]
    norm = np.linalg.norm(quat, axis=1, keepdims=True)
    off = np.abs(norm - 1) > QUATERNION_ROUNDING
    values["quat_wxyz"] = np.where(off, quat / norm, quat)
    derived = "vel_w" not in values
    if derived:
        values["vel_w"] = velocity_from_position(time_s, values["pos_w"])
    extra = {key: np.asarray(columns[key])[rows] for key in columns if key not in KNOWN}
    return FlightLog(
        name=name,
        time_s=time_s,
        extra=extra,
        about=dict(about),
        velocity_derived=derived,
        warnings=tuple(warnings),
        **values,
    )


def _partial_groups(about: Mapping[str, Any]) -> tuple[str, ...]:
    groups = about.get("partial")
    return tuple(str(group) for group in groups) if isinstance(groups, list) else ()


def _missing_groups(columns: Container[str]) -> list[str]:
    """Return the required groups that a log with these columns lacks; "command" for the last."""
    has = {group for group, names in GROUPS.items() if names[0] in columns}
    missing = [group for group in NEEDED if group not in has]
    return missing + ["command"] * (not any(has.issuperset(groups) for groups in COMMANDS))


def columns_from_log(log: FlightLog) -> dict[str, np.ndarray]:
    """Return the columns of `log` by name; a computed velocity is left out.

    Raises:
        FlightLogError: where an array has another shape or type than its field, or an extra column
            has the name of a known one.
    """
    columns = split_group("time", log.time_s, "time_s", log.name)
    for key, attribute in _FIELDS.items():
        values = getattr(log, attribute)
        lacks = key in log.partial or (key == "vel" and log.velocity_derived)
        if values is None or lacks:
            continue
        columns |= split_group(key, values, attribute, log.name)
    for name, values in log.extra.items():
        if not isinstance(name, str) or name in KNOWN:
            reason = "allowed in `extra` are texts that are no column of a flight log"
            raise FlightLogError(log.name, reason, str(name))
        columns[name] = np.asarray(values)
    for column, values in columns.items():
        if values.shape != columns["time"].shape:
            kind = f"{len(values)} values" if values.ndim == 1 else f"shape {values.shape}"
            reason = f"{kind}, but `time` has {len(columns['time'])}"
            raise FlightLogError(log.name, reason, column)
    return columns


def flight_metadata(text: str | None, name: str) -> tuple[dict[str, Any], list[str]]:
    """Return the metadata in a JSON text, {} without a text, and warnings."""
    if text is None:
        return {}, []
    try:
        about = parse_json(text, name)
    except InputError:
        about = None
    if not isinstance(about, dict):
        return {}, [f"{name}: metadata `flight` is not a JSON object; ignored"]
    return about, []


def read_flight(path: str | Path, partial: bool = False, limits: bool = True) -> FlightLog:
    """Read a flight from a Parquet or CSV file; `partial` allows a partial log.

    `limits` is as in `log_from_columns`.

    Raises:
        FlightLogError: where the file cannot be read or breaks a rule; the message has the file,
            the column, the first bad row (counted from 1) and the reason.
    """
    columns, text, warnings = read_columns(as_path("path", path))
    about, more = flight_metadata(text, str(path))
    warnings += more
    log = log_from_columns(columns, about, str(path), limits)
    if log.partial and not partial:
        reason = f"a partial log, without {', '.join(log.partial)}; this command needs whole ones"
        raise FlightLogError(path, reason)
    return replace(log, warnings=(*warnings, *log.warnings))


def logs_in(folder: Path) -> list[Path]:
    """Return the flight logs in `folder`, sorted by name."""
    return sorted([*folder.glob("*.parquet"), *folder.glob("*.csv")])


def flight_files(paths: Sequence[Path]) -> list[Path]:
    """Return the flight logs among `paths` and in folders among them, each once.

    Raises:
        ValueError: if there is none.
    """
    files = []
    if not paths:
        raise ValueError("flights is empty, allowed are flight logs and folders of them")
    for path in paths:
        files += logs_in(path) if path.is_dir() else [path]
    if not files:
        folders = ", ".join(map(str, paths))
        raise ValueError(f"no flight logs in {folders}; record some with suite collect")
    return list({path.resolve(): path for path in reversed(files)}.values())[::-1]


def read_flights(
    paths: Iterable[str | Path], partial: bool = False, limits: bool = True
) -> tuple[list[FlightLog], list[str]]:
    """Read many flights; the warnings name files that cannot be used.

    Partial logs are accepted with `partial`; `limits` is as in `log_from_columns`.

    Returns:
        The flights in the order of `paths`, and the warnings of all files.

    Raises:
        FlightLogError: where no file can be used, with the reason of each.
    """
    flights: list[FlightLog] = []
    warnings: list[str] = []
    refused: list[str] = []
    for path in paths:
        try:
            flights.append(read_flight(path, partial, limits))
            warnings.extend(flights[-1].warnings)
        except FlightLogError as error:
            refused.append(str(error))
            warnings.append(f"not used: {error}")
    if not flights:
        reasons = refused or ["no file was given"]
        between = "\n" if len(reasons) > 1 else ": "
        raise FlightLogError("flights", between.join(["none can be used", *reasons]))
    return flights, warnings


def write_flight(path: str | Path, log: FlightLog) -> Path:
    """Write `log` as Parquet (`.parquet`) or CSV (`.csv`); the file appears only when complete.

    Parquet holds `log.about` with the keys of `provenance.stamp` as JSON in the metadata key
    `flight`; CSV holds the same JSON in the first row of a column `flight`.

    Raises:
        FlightLogError: where the log would be refused on reading, or the ending is another.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    file = as_path("path", path)
    check_type("log", log, (FlightLog,), "a FlightLog; of a Flight, log_from_flight makes one")
    for name in ("about", "extra"):
        check_type(f"log.{name}", getattr(log, name), (Mapping,), "a dict")
    columns = columns_from_log(log)
    check_columns(columns, log.name, bool(log.partial))
    about = {**log.about, **stamp(SCHEMA, log.about.get("seed"))}
    return write_columns(file, columns, to_json(about))
