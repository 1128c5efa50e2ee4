"""Resamples signals of different sampling rates on common rows and at other times.

A log has one row for each time at which any of its signals was sampled, so a slow signal has no
value in most rows. Between a signal's own rows, measurements are interpolated linearly, but not
across holes (long times without a value), and commands are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from eval.importers.rows import continuous
from eval.logs.flight_log import FlightLog
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

MEASURED = ("pos_w", "quat_wxyz", "vel_w", "rate_b", "rotor_speed")
"""Signals of a log that are interpolated between their rows."""
HELD = ("thrust_cmd", "rate_cmd_b", "torque_cmd_b", "pwm", "rotor_speed_cmd")
"""Signals of a log that are held until their next row."""


def on_every_row(log: FlightLog, limits: Thresholds = THRESHOLDS) -> FlightLog:
    """Return `log` with every signal on every row, but not across holes.

    A log whose signals share all rows is returned unchanged.
    """
    filled = {}
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


def without_slow_rotors(
    logs: Sequence[FlightLog], limits: Thresholds = THRESHOLDS
) -> tuple[list[FlightLog], list[str]]:
    """Return `logs` without rotor speeds that are sampled too slowly, and notes on these logs.

    Between rows further apart than the longest hole the rotor speeds are unknown.
    """
    usable, notes = [], []
    for log in logs:
        spacing_s = 0.0 if log.rotor_speed is None else own_spacing_s(log.time_s, log.rotor_speed)
        if spacing_s > limits.longest_hole_s:
            notes.append(
                f"{log.name}: rotor speeds at {1.0 / spacing_s:.2g} Hz are left out; at least "
                f"{1.0 / limits.longest_hole_s:.3g} Hz show what the rotors did between two rows"
            )
            log = replace(log, rotor_speed=None)
        usable.append(log)
    return usable, notes


def with_fewer_rows(
    logs: Sequence[FlightLog], limits: Thresholds = THRESHOLDS
) -> tuple[list[FlightLog], list[str]]:
    """Return `logs` thinned to the largest number of rows, and a note if rows were left out.

    Every n-th value of each signal is used, as each signal may have other rows.
    """
    count = sum(len(log.time_s) for log in logs)
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
            own = np.flatnonzero(np.isfinite(values.reshape(len(values), -1)).all(axis=1))[::stride]
            signals[name][own] = values[own]
        rows = np.zeros(len(log.time_s), bool)
        for values in signals.values():
            rows |= np.isfinite(values.reshape(len(rows), -1)).all(axis=1)
        signals = {name: values[rows] for name, values in signals.items()}
        thinned_logs.append(replace(log, time_s=log.time_s[rows], **signals))
    return thinned_logs, [
        f"every {stride}. row is used of {count} rows: more take minutes, and add little"
    ]


def own_spacing_s(time_s: np.ndarray, values: np.ndarray) -> float:
    """Return the median time [s] between the rows of the slowest column of `values` (T, K).

    Infinite where a column has values in fewer than two rows.
    """
    rows = [time_s[np.isfinite(column)] for column in values.T]
    return max(float(np.median(np.diff(t))) if len(t) > 1 else np.inf for t in rows)


def longest_gap_s(time_s: np.ndarray, since_s: float, until_s: float) -> float:
    """Return the longest time [s] without a row between two times.

    It is counted from the last of the rows `time_s` (T,) at or before `since_s` on.
    """
    first = max(int(np.searchsorted(time_s, since_s + 1e-9)) - 1, 0)
    rows_s = time_s[first : np.searchsorted(time_s, until_s + 1e-9)]
    if not len(rows_s):
        return np.inf
    return float(np.max(np.diff(rows_s, prepend=min(since_s, rows_s[0]), append=until_s)))


def thinned(valid: np.ndarray, time_s: np.ndarray, most: int) -> np.ndarray:
    """Return the indices of at most `most` rows that keep every signal as evenly as possible.

    Args:
        valid: (N, K) bool: which of K signals each row has.
        time_s: (N,) [s].
        most: largest number of rows.
    """
    step = -(-len(valid) // most)
    if step <= 1 or (valid == valid[:1]).all():
        return np.arange(0, len(valid), step)
    # Of each group of rows the one whose signals have gone longest without a row.
    last_s = np.full(valid.shape[1], time_s[0] - 1.0)
    chosen = []
    for first in range(0, len(valid), step):
        group = valid[first : first + step]
        row = first + int((group * (time_s[first] - last_s + 1e-6)).sum(axis=1).argmax())
        last_s = np.where(valid[row], time_s[row], last_s)
        chosen.append(row)
    return np.array(chosen)


def _filled(time_s: np.ndarray, column: np.ndarray, hole_s: float, held: bool) -> np.ndarray:
    """Return `column` (T,) held or interpolated between its own rows; NaN in and near holes."""
    own = np.flatnonzero(np.isfinite(column))
    if len(own) < 2:
        return column
    place = np.clip(np.searchsorted(own, np.arange(len(column)), side="right") - 1, 0, len(own) - 2)
    before, after = own[place], own[place + 1]
    if held:
        values = np.where(np.arange(len(column)) >= own[-1], column[own[-1]], column[before])
    else:
        values = np.interp(time_s, time_s[own], column[own])
    inside = (time_s >= time_s[own[0]]) & (held | (time_s <= time_s[own[-1]]))
    since_last_s = np.where(time_s >= time_s[own[-1]], time_s - time_s[own[-1]], 0.0)
    near = (time_s[after] - time_s[before] <= hole_s) & (since_last_s <= hole_s)
    return np.where(np.isfinite(column), column, np.where(inside & near, values, np.nan))


def sign_continuous(quat: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) with signs chosen so that neighbours do not jump; gaps are NaN."""
    own = np.flatnonzero(np.isfinite(quat).all(axis=1))
    out = quat.copy()
    out[own] = continuous(quat[own])
    return out


def interpolate(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return `series` (T, K) at times `at_s` (S,), linear between finite values.

    A column without any finite value is 0.
    """
    columns = []
    for column in series.T:
        finite = np.isfinite(column)
        columns.append(
            np.interp(at_s, time_s[finite], column[finite]) if finite.any() else 0.0 * at_s
        )
    return np.stack(columns, axis=-1)


def hold(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the last finite row of `series` (T, K) at each of `at_s` (S,); NaN without any row.

    Before the first row that one is held.
    """
    finite = np.flatnonzero(np.isfinite(series).all(axis=1))
    if not len(finite):
        return np.full((len(at_s), series.shape[1]), np.nan)
    place = np.searchsorted(time_s[finite], at_s + 1e-7, side="right") - 1
    return series[finite[np.maximum(place, 0)]]


def voltage_drop(log: FlightLog, at_s: np.ndarray) -> np.ndarray:
    """Return the battery's first voltage less that at times `at_s` (S,), (S,) [V].

    Zeros for a log without a voltage.
    """
    if log.voltage is None or not np.isfinite(log.voltage).any():
        return np.zeros(len(at_s))
    first = log.voltage[np.isfinite(log.voltage)][0]
    return first - interpolate(at_s, log.time_s, log.voltage[:, None])[:, 0]


def follow_lag(commanded: np.ndarray, dt: float, time_constant: float) -> np.ndarray:
    """Return rotor speeds (S, 4) behind a first-order lag, at the end of each step of `dt` [s].

    They begin at the `commanded` speeds (S, 4) of the first step.
    """
    decay = np.exp(-dt / time_constant) if time_constant > 1e-6 else 0.0
    filtered, _ = lfilter([1.0 - decay], [1.0, -decay], commanded, axis=0, zi=decay * commanded[:1])
    return np.asarray(filtered)
