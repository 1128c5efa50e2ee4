"""The columns of a flight log, and the rules that decide whether a log is accepted.

docs/flight_logs.md lists the columns with their units. Missing values are null or NaN. Rows are
counted from 1, without a CSV's header. A partial log (marked in its metadata) needs only the time
and one more group.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tracks.common.names import printable


def _xyz(stem: str) -> tuple[str, ...]:
    return tuple(f"{stem}_{axis}" for axis in "xyz")


def _rotors(stem: str) -> tuple[str, ...]:
    return tuple(f"{stem}_{number}" for number in range(1, 5))


GROUPS: dict[str, tuple[str, ...]] = {
    "time": ("time",),
    "pos": _xyz("pos"),
    "quat": tuple(f"quat_{part}" for part in "wxyz"),
    "vel": _xyz("vel"),
    "rate": _xyz("rate"),
    "cmd_thrust": ("cmd_thrust",),
    "cmd_rate": _xyz("cmd_rate"),
    "cmd_torque": _xyz("cmd_torque"),
    "motor": _rotors("motor"),
    "motor_cmd": _rotors("motor_cmd"),
    "pwm": _rotors("pwm"),
    "acc": _xyz("acc"),
    "voltage": ("voltage",),
}
"""Columns of each group; a group is complete or absent."""
NEEDED = ("time", "pos", "quat", "rate")
"""Groups that a whole log must have, together with one of `COMMANDS`."""
COMMANDS = (("cmd_thrust", "cmd_rate"), ("cmd_thrust", "cmd_torque"), ("motor",), ("pwm",))
"""Sets of groups that can drive a model; a whole log has at least one."""
ESTIMATE = "est_"
"""Prefix of the drone's own estimates of position, attitude and velocity."""
KNOWN = frozenset(column for group in GROUPS.values() for column in group)
"""All columns that this file defines."""

LIMITS = {
    "pos": (-100e3, 100e3, "beyond 100 km; positions are in m"),
    "rate": (-200.0, 200.0, "beyond 200 rad/s; rates are in rad/s"),
    "pwm": (-0.05, 1.05, "not from 0 to 1; a motor command is a share of the full one"),
}
"""Group -> least and largest value, and the reason for which others are refused."""
LARGEST = 1e20
"""Larger numbers are damage in any unit (Unix time in ns is 1.8e18); their squares overflow."""
QUATERNION_TOLERANCE = 0.05
"""Quaternions further than this from unit norm are refused."""
DURATION_MIN = 1.0
"""Shorter flights are refused [s]."""

# Column -> usual names of other programs, which a message proposes to rename.
_OTHER_NAMES = {
    "time": ("t", "timestamp", "time_s", "stamp"),
    "cmd_thrust": ("thrust", "thrust_cmd", "c"),
    "voltage": ("vbat", "battery"),
    **{f"pos_{a}": (a, f"p{a}", f"p_{a}", f"position_{a}") for a in "xyz"},
    **{f"vel_{a}": (f"v{a}", f"v_{a}", f"velocity_{a}") for a in "xyz"},
    **{f"quat_{a}": (f"q{a}", f"q_{a}", f"orientation_{a}") for a in "wxyz"},
    **{f"rate_{a}": (f"w{a}", f"omega_{a}", f"gyro_{a}", f"ang_vel_{a}") for a in "xyz"},
    **{f"cmd_rate_{a}": (f"rate_cmd_{a}", f"cmd_w{a}") for a in "xyz"},
    **{f"motor_{n}": (f"motor{n}", f"rotor_{n}", f"rpm_{n}") for n in range(1, 5)},
}


class FlightLogError(ValueError):
    """A flight log is refused; names the file, the column, the row and the reason."""

    def __init__(
        self, name: str | Path, reason: str, column: str | None = None, row: int | None = None
    ) -> None:
        """Keep the parts and join them to one line; `row` is counted from 1."""
        self.name, self.reason, self.column, self.row = str(name), reason, column, row
        where = [part for part in (column and f"column {column}", row and f"row {row}") if part]
        parts = [self.name, ", ".join(where), reason] if where else [self.name, reason]
        super().__init__(": ".join(parts))

    def __reduce__(self) -> tuple[type[FlightLogError], tuple[object, ...]]:
        """Return the parts for pickling."""
        return type(self), (self.name, self.reason, self.column, self.row)


def damaged(path: Path, kind: str, error: Exception) -> FlightLogError:
    """Return the refusal of a file of a `kind` ("a ULog file") whose reader raised `error`.

    It is one line, without unprintable bytes of the file.
    """
    reason = f"{type(error).__name__}: {printable(str(error), keep='')}"
    text = f"{kind} that cannot be read ({reason}); copy it from the vehicle again"
    return FlightLogError(path, text)


def check_columns(
    columns: Mapping[str, np.ndarray], name: str, partial: bool = False, limits: bool = True
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    """Check `columns` (column name to values, one a row) by the rules of a flight log.

    The values are one a row; `name` is the file. A `partial` log may lack position, attitude, rates
    or commands. With `limits`, values that no flight has are refused; checks of a log read it
    without, to name the fault.

    Returns:
        The known columns as float64 without the rows that have no time, NaN where a value is
        missing; a mask (rows,) of the rows that were kept; and warnings about what is odd.

    Raises:
        FlightLogError: where a rule is broken, naming file, column, first bad row and reason.
    """
    needed = ("time",) if partial else NEEDED
    present = _present_groups(columns, name, needed)
    values = {c: as_numbers(columns[c], c, name) for group in present for c in GROUPS[group]}
    for column, data in values.items():
        _refuse_where(np.isinf(data), name, column, data, "infinite")
        _refuse_where(np.abs(data) > LARGEST, name, column, data, "too large for any unit")
    empty = [column for column, data in values.items() if np.isnan(data).all()]
    if missing := [column for group in needed for column in GROUPS[group] if column in empty]:
        raise FlightLogError(name, "missing in every row", missing[0], 1)
    present = [group for group in present if not set(GROUPS[group]) & set(empty)]
    if not partial:
        _refuse_half_a_command(present, columns, name)
        _need_a_command(present, columns, name, empty)
    elif present == ["time"]:
        raise FlightLogError(name, "holds a time and nothing else that is known")

    rows = np.isfinite(values["time"])
    row_number = np.flatnonzero(rows) + 1
    kept = {c: values[c][rows] for group in present for c in GROUPS[group]}
    warnings = []
    if not rows.all():
        warnings.append(f"{name}: {np.sum(~rows)} rows without a time are left out")
    _check_time(kept["time"], row_number, name)
    if limits:
        _check_limits(kept, name, row_number)
    if "quat" in present:
        _check_quaternion(kept, row_number, name)
    step = float(np.median(np.diff(kept["time"])))
    if step > 0.2:
        warnings.append(f"{name}: rows are {step:.3g} s apart, if `time` is in seconds")
    return kept, rows, warnings


def _present_groups(
    columns: Mapping[str, np.ndarray], name: str, needed: tuple[str, ...]
) -> list[str]:
    present = []
    for group, members in GROUPS.items():
        missing = [column for column in members if column not in columns]
        if not missing:
            present.append(group)
        elif group in needed or len(missing) < len(members):
            raise FlightLogError(name, "missing" + _did_you_mean(missing[0], columns), missing[0])
    if not len(columns["time"]):
        raise FlightLogError(name, "no rows; at least 1 s of flight is needed")
    return present


def _refuse_half_a_command(
    present: list[str], columns: Mapping[str, np.ndarray], name: str
) -> None:
    """Refuse a thrust without rates and without torques, and either of these without a thrust."""
    for one, others in (
        ("cmd_thrust", ("cmd_rate", "cmd_torque")),
        ("cmd_rate", ("cmd_thrust",)),
        ("cmd_torque", ("cmd_thrust",)),
    ):
        if one in present and not any(other in present for other in others):
            column = GROUPS[others[0]][0]
            state = "missing in every row" if column in columns else "missing"
            reason = f"{state}; {GROUPS[one][0]} needs it{_did_you_mean(column, columns)}"
            raise FlightLogError(name, reason, column)


def _need_a_command(
    present: list[str], columns: Mapping[str, np.ndarray], name: str, empty: list[str]
) -> None:
    if not any(all(group in present for group in groups) for groups in COMMANDS):
        hint = _did_you_mean("cmd_thrust", columns) or _did_you_mean("motor_1", columns)
        commands = dict.fromkeys(group for groups in COMMANDS for group in groups)
        empty = [column for group in commands for column in GROUPS[group] if column in empty]
        hint = f"; missing in every row: {', '.join(empty)}" if empty else hint
        reason = (
            "neither cmd_thrust with cmd_rate_x, _y, _z (or cmd_torque_x, _y, _z) "
            "nor motor_1 to motor_4 nor pwm_1 to pwm_4 is there"
        )
        raise FlightLogError(name, reason + hint)


def _did_you_mean(column: str, columns: Mapping[str, np.ndarray]) -> str:
    free = {other.lower(): other for other in columns if other not in KNOWN}
    exact = [name for name in (column, *_OTHER_NAMES.get(column, ())) if name in free]
    close = exact or difflib.get_close_matches(column, free, n=1, cutoff=0.7)
    if not close:
        return ""
    what = "Rename it and check its unit, or describe the columns to suite import --map"
    return f"; did you mean {free[close[0]]!r}? {what}"


def as_numbers(values: np.ndarray, column: str, name: str) -> np.ndarray:
    """Return the cells (N,) of a column as numbers, NaN where one is empty.

    Raises:
        FlightLogError: where a cell is neither a number nor empty.
    """
    values = np.asarray(values)
    if values.ndim == 1 and values.dtype.kind in "fiub":
        return values.astype(np.float64)
    if values.dtype.kind in "Mm":
        reason = f"a date or a span ({values.dtype}); write it as a number in the column's unit"
        raise FlightLogError(name, reason, column)
    numbers = np.full(len(values), np.nan)
    for k, value in enumerate(values):
        text = value.strip() if isinstance(value, str) else value
        try:
            if text is not None and text != "":
                numbers[k] = float(text)
        except (TypeError, ValueError):
            hint = "; if this row has the units, delete it" if k == 0 else ""
            raise FlightLogError(name, f"{value!r} is not a number{hint}", column, k + 1) from None
    return numbers


def split_group(group: str, values: Any, field: str, name: str) -> dict[str, np.ndarray]:
    """Return an array (T, N) as the columns of a group, (T,) each; a masked value is missing.

    An array of a group with one column is (T,) or (T, 1). `field` and `name` are for messages.

    Raises:
        FlightLogError: for an array of another shape, or of complex numbers, dates or spans.
    """
    columns, array = GROUPS[group], np.ma.asarray(values)
    flat = array.ndim == 1 and len(columns) == 1
    if not (flat or array.shape[1:] == (len(columns),)) or array.dtype.kind in "cMm":
        allowed = f"(T, {len(columns)})" if len(columns) > 1 else "(T,)"
        reason = f"`{field}` is {array.dtype} of shape {array.shape}"
        raise FlightLogError(name, f"{reason}, allowed are numbers of shape {allowed}")
    numbers = np.ma.filled(array.astype(np.float64), np.nan)
    return dict(zip(columns, numbers.reshape(-1, len(columns)).T, strict=True))


def _check_time(time: np.ndarray, row_number: np.ndarray, name: str) -> None:
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        k = back[0] + 1
        reason = f"{time[k]:.9g} s does not come after {time[k - 1]:.9g} s; time must increase"
        if time[k] == time[k - 1] and (time == time.astype(np.float32)).all():
            reason += "; these times have single precision, which is too coarse: subtract the "
            reason += "first one before they are converted to it"
        raise FlightLogError(name, reason, "time", int(row_number[k]))
    if (duration := time[-1] - time[0]) < DURATION_MIN:
        reason = f"{duration:.3g} s of flight; at least {DURATION_MIN:g} s is needed"
        reason += "; `time` should be in seconds" if duration < 0.1 * DURATION_MIN else ""
        raise FlightLogError(name, reason, "time", int(row_number[-1]))


def _check_limits(kept: Mapping[str, np.ndarray], name: str, row_number: np.ndarray) -> None:
    for group, (low, high, reason) in LIMITS.items():
        for column in GROUPS[group] if GROUPS[group][0] in kept else ():
            bad = (kept[column] > high) | (kept[column] < low)
            reason_of = f"{reason}; suite check names the fault and its fix"
            _refuse_where(bad, name, column, kept[column], reason_of, row_number)


def _check_quaternion(kept: Mapping[str, np.ndarray], row_number: np.ndarray, name: str) -> None:
    norm = np.linalg.norm(np.stack([kept[column] for column in GROUPS["quat"]]), axis=0)
    bad = np.flatnonzero(np.abs(norm - 1) > QUATERNION_TOLERANCE)
    if len(bad):
        reason = f"a quaternion of norm {norm[bad[0]]:.6g}; within 5 % of 1 is allowed"
        raise FlightLogError(name, reason, "quat_w", int(row_number[bad[0]]))


def _refuse_where(
    bad: np.ndarray,
    name: str,
    column: str,
    values: np.ndarray,
    reason: str,
    row_number: np.ndarray | None = None,
) -> None:
    where = np.flatnonzero(bad)
    if len(where):
        k = where[0]
        row = k + 1 if row_number is None else row_number[k]
        raise FlightLogError(name, f"{values[k]:g}, {reason}", column, int(row))
