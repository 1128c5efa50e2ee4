"""Resamples signals of different sampling rates on common rows and at other times.

A log has one row for each time at which any of its signals was sampled. A signal's own rows are
those in which it has a value. Between them, measurements are interpolated linearly, and commands
are held; neither across a hole, which is a long time without a value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

from eval.importers.rows import continuous
from eval.logs.flight_log import FlightLog
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.rotation import quat_to_rot

MEASURED = ("pos_w", "quat_wxyz", "vel_w", "rate_b", "rotor_speed")
"""Signals of a log that are interpolated between their rows."""
HELD = ("thrust_cmd", "rate_cmd_b", "torque_cmd_b", "pwm", "rotor_speed_cmd")
"""Signals of a log that are held until their next row."""
SPARSEST_S = 0.02
"""Longest time between rows of a thinned signal: the windows of a view need several rows [s]."""
HOLE_STEPS = 4.0
"""Rows of a signal further apart than this many median steps are a hole on a grid of times."""


def on_every_row(log: FlightLog, limits: Thresholds = THRESHOLDS) -> FlightLog:
    """Return `log` with every signal in every row, except in holes (see `MEASURED`, `HELD`)."""
    filled: dict[str, Any] = {}
    for name in (*MEASURED, *HELD):
        values = getattr(log, name)
        if values is None or np.isfinite(values).all() or not np.isfinite(values).any():
            continue
        table = values.reshape(len(values), -1)
        if name == "quat_wxyz":
            table = sign_continuous(table)
        columns = [_filled(log.time_s, c, limits.longest_hole_s, name in HELD) for c in table.T]
        table = np.stack(columns, axis=1)
        if name == "quat_wxyz":
            table = table / np.maximum(np.linalg.norm(table, axis=1, keepdims=True), 1e-12)
        filled[name] = table.reshape(values.shape)
    return replace(log, **filled) if filled else log


def without_slow_rotors(logs: Sequence[FlightLog]) -> tuple[list[FlightLog], list[str]]:
    """Return `logs` without rotor speeds whose rows are further apart than a hole, and notes."""
    usable, notes, hole_s = [], [], THRESHOLDS.longest_hole_s
    for log in logs:
        spacing_s = 0.0 if log.rotor_speed is None else own_spacing_s(log.time_s, log.rotor_speed)
        if spacing_s > hole_s:
            notes.append(
                f"{log.name}: rotor speeds at {1.0 / spacing_s:.2g} Hz are left out; at least "
                f"{1.0 / hole_s:.3g} Hz show what the rotors did between two rows"
            )
            log = replace(log, rotor_speed=None)
        usable.append(log)
    return usable, notes


def with_fewer_rows(
    logs: Sequence[FlightLog], limits: Thresholds = THRESHOLDS
) -> tuple[list[FlightLog], list[str]]:
    """Return `logs` with about `limits.most_rows` rows, and a note if rows were left out.

    Each signal is thinned alone, as each may have values in other rows: the first value of every n
    rows, and more of a slow signal, at most `SPARSEST_S` apart. Rates and accelerations are
    averaged about the rows that remain, because vibrations would otherwise alias. Commands are
    averaged until the next row that remains, as they hold until then.
    """
    count = sum(len(log.time_s) for log in logs)
    # -(-a // b) is a / b, rounded up.
    stride = -(-count // limits.most_rows)
    if stride <= 1:
        return list(logs), []
    thinned_logs = []
    for log in logs:
        signals = {}
        for name in (*MEASURED, *HELD, "acc_b", "voltage"):
            values = getattr(log, name)
            if values is None:
                continue
            signals[name] = np.full_like(values, np.nan)
            table, thinned_table = (x.reshape(len(x), -1) for x in (values, signals[name]))
            # Motors may be read one after another, so that no row has the speeds of all.
            columns = np.arange(table.shape[1])
            parts = columns[:, None] if name == "rotor_speed" else columns[None]
            for part in parts:
                own_rows = np.flatnonzero(np.isfinite(table[:, part]).all(axis=1))
                own = np.ix_(own_rows, part)
                if not len(own_rows):
                    continue
                spacing_s = own_spacing_s(log.time_s[own_rows], table[own])
                step = min(stride, max(1, int(SPARSEST_S / spacing_s + 1e-6)))
                series = table[own]
                if name in ("rate_b", "acc_b"):
                    series = uniform_filter1d(series, 2 * (step // 2) + 1, axis=0)
                # The first value of every `width` rows of the log: so all signals keep one row.
                width = step * max(1, round(float(np.median(np.diff(own_rows, prepend=-1)))))
                first = np.unique(own_rows // width, return_index=True)[1]
                if name in HELD:
                    count_of = np.diff(first, append=len(series))[:, None]
                    series[first] = np.add.reduceat(series, first) / count_of
                thinned_table[np.ix_(own_rows[first], part)] = series[first]
        rows = np.zeros(len(log.time_s), bool)
        for values in signals.values():
            rows |= np.isfinite(values.reshape(len(rows), -1)).any(axis=1)
        signals = {name: values[rows] for name, values in signals.items()}
        thinned_logs.append(replace(log, time_s=log.time_s[rows], **signals))
    return thinned_logs, [
        f"every {stride}. row is used of {count} rows: more take minutes, and add little"
    ]


def own_spacing_s(time_s: np.ndarray, values: np.ndarray) -> float:
    """Return the median time [s] between rows of the slowest column of `values` (T, K), or inf."""
    rows = [time_s[np.isfinite(column)] for column in values.T]
    return max(float(np.median(np.diff(t))) if len(t) > 1 else np.inf for t in rows)


def longest_gap_s(time_s: np.ndarray, since_s: float, until_s: float) -> float:
    """Return the longest time [s] between rows at `time_s` (T,) from `since_s` to `until_s`.

    The row before `since_s` counts, and so does the time after the last row.
    """
    first_row = max(int(np.searchsorted(time_s, since_s + 1e-9)) - 1, 0)
    rows_s = time_s[first_row : np.searchsorted(time_s, until_s + 1e-9)]
    if not len(rows_s):
        return np.inf
    return float(np.max(np.diff(rows_s, prepend=min(since_s, rows_s[0]), append=until_s)))


def thinned(valid: np.ndarray, time_s: np.ndarray, most: int) -> np.ndarray:
    """Return the indices of at most `most` rows in which every signal is sampled evenly.

    `valid` (N, K) bool says whether each row, at `time_s` (N,) [s], has a value of K signals.
    """
    step = -(-len(valid) // most)
    if step <= 1 or (valid == valid[:1]).all():
        return np.arange(0, len(valid), step)
    # Of each group of neighbouring rows, choose the one whose signals were not chosen for longest.
    last_s = np.full(valid.shape[1], time_s[0] - 1.0)
    chosen = []
    for begin in range(0, len(valid), step):
        group = valid[begin : begin + step]
        row = begin + int((group * (time_s[begin] - last_s + 1e-6)).sum(axis=1).argmax())
        last_s = np.where(valid[row], time_s[row], last_s)
        chosen.append(row)
    return np.array(chosen)


def _filled(time_s: np.ndarray, column: np.ndarray, hole_s: float, held: bool) -> np.ndarray:
    """Return `column` (T,), `held` or interpolated between its own rows; it is NaN in holes."""
    own_rows = np.flatnonzero(np.isfinite(column))
    if len(own_rows) < 2:
        return column
    own_s = time_s[own_rows]
    unknown = in_hole(time_s, own_s, hole_s)
    if held:
        values = column[own_rows[np.maximum(np.searchsorted(own_s, time_s, side="right") - 1, 0)]]
        since_last_s = time_s - own_s[-1]
        unknown &= (since_last_s < 0.0) | (since_last_s > hole_s)
    else:
        values = np.interp(time_s, own_s, column[own_rows])
    return np.where(np.isfinite(column), column, np.where(unknown, np.nan, values))


def in_hole(at_s: np.ndarray, time_s: np.ndarray, hole_s: float | None = None) -> np.ndarray:
    """Return whether each of `at_s` (S,) is in a hole of rows at `time_s` (R,) or outside them.

    Rows further apart than `hole_s` [s] (default: `HOLE_STEPS` median steps) are a hole.
    """
    if len(time_s) < 2:
        return np.ones(len(at_s), bool)
    step_s = np.diff(time_s)
    if hole_s is None:
        hole_s = HOLE_STEPS * float(np.median(step_s))
    row = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    return (step_s > hole_s + 1e-9)[row] | (at_s < time_s[0]) | (at_s > time_s[-1])


def sign_continuous(quat: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) with signs so that neighbours do not jump; rows with NaN stay."""
    own_rows = np.flatnonzero(np.isfinite(quat).all(axis=1))
    continued = quat.copy()
    continued[own_rows] = continuous(quat[own_rows])
    return continued


def attitude_at(at_s: np.ndarray, time_s: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the attitudes (S, 3, 3) of quaternions (T, 4) at the times `at_s`; NaN in holes."""
    mixed = interpolate(at_s, time_s, sign_continuous(quat_wxyz), holes=True)
    return quat_to_rot(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))


def interpolate(
    at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray, holes: bool = False
) -> np.ndarray:
    """Return `series` (T, K) at the times `at_s` (S,), interpolated between finite values: (S, K).

    A column without any becomes 0. With `holes`, it is NaN in holes (`in_hole`).
    """
    columns = []
    for column in series.T:
        finite = np.isfinite(column)
        own_s = time_s[finite]
        values = np.interp(at_s, own_s, column[finite]) if finite.any() else 0.0 * at_s
        if holes:
            values = np.where(in_hole(at_s, own_s), np.nan, values)
        columns.append(values)
    return np.stack(columns, axis=-1)


def hold(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the last finite row of `series` (T, K) at each of the times `at_s` (S,): (S, K).

    Before the first finite row its value is used; without any it is NaN.
    """
    finite = np.flatnonzero(np.isfinite(series).all(axis=1))
    if not len(finite):
        return np.full((len(at_s), series.shape[1]), np.nan)
    place = np.searchsorted(time_s[finite], at_s + 1e-7, side="right") - 1
    return series[finite[np.maximum(place, 0)]]


def voltage_drop(log: FlightLog, at_s: np.ndarray) -> np.ndarray:
    """Return the fall of the battery voltage since its first value, (S,) [V]; 0 without any."""
    if log.voltage is None or not np.isfinite(log.voltage).any():
        return np.zeros(len(at_s))
    first_voltage = log.voltage[np.isfinite(log.voltage)][0]
    return first_voltage - interpolate(at_s, log.time_s, log.voltage[:, None])[:, 0]


def follow_lag(commanded: np.ndarray, dt: float, time_constant: float) -> np.ndarray:
    """Return rotor speeds (S, 4) after each step `dt` [s], behind `commanded` ones by a lag [s]."""
    decay = np.exp(-dt / time_constant) if time_constant > 1e-6 else 0.0
    filtered, _ = lfilter([1.0 - decay], [1.0, -decay], commanded, axis=0, zi=decay * commanded[:1])
    return np.asarray(filtered)
