"""Signals with different sampling rates on common rows, and the time steps of the model.

The rows of a log are the times of all its signals together, so a slower signal has no value in most
rows. Each signal is used on its own rows. Between them measurements are interpolated linearly, but
not across holes, and commands are held.

A command acts from the time of its row on, and the rate loop starts its period there, so every step
of the model lies between two rows. Within them the loop samples about as often as the vehicle's
own, or every `LONGEST_S` if that is longer, and predicts the rates over the difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from eval.effects.interface import GRAVITY
from eval.importers.rows import continuous
from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

MEASURED = ("pos_w", "quat_wxyz", "vel_w", "rate_b", "rotor_speed")
HELD = ("thrust_cmd", "rate_cmd_b", "torque_cmd_b", "pwm", "rotor_speed_cmd")


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
            table = on_one_side(table)
        columns = [_column(log.time_s, c, limits.longest_hole_s, name in HELD) for c in table.T]
        table = np.stack(columns, axis=1)
        if name == "quat_wxyz":
            table = table / np.maximum(np.linalg.norm(table, axis=1, keepdims=True), 1e-12)
        filled[name] = table.reshape(values.shape)
    return replace(log, **filled) if filled else log


def without_slow_rotors(
    logs: Sequence[FlightLog], limits: Thresholds = THRESHOLDS
) -> tuple[list[FlightLog], list[str]]:
    """Return `logs` without rotor speeds that are sampled too slowly, and notes on them.

    Between rows further apart than the longest hole the motors are unknown.
    """
    kept, notes = [], []
    for log in logs:
        spacing_s = 0.0 if log.rotor_speed is None else own_spacing_s(log.time_s, log.rotor_speed)
        if spacing_s > limits.longest_hole_s:
            notes.append(
                f"{log.name}: rotor speeds at {1.0 / spacing_s:.2g} Hz are left out; at least "
                f"{1.0 / limits.longest_hole_s:.3g} Hz show what the rotors did between two rows"
            )
            log = replace(log, rotor_speed=None)
        kept.append(log)
    return kept, notes


def with_fewer_rows(
    logs: Sequence[FlightLog], limits: Thresholds = THRESHOLDS
) -> tuple[list[FlightLog], list[str]]:
    """Return `logs` thinned to the largest number of rows, and a note on it.

    Every n-th value of each signal is kept, as signals may have rows of their own.
    """
    count = sum(len(log.time_s) for log in logs)
    every = -(-count // limits.most_rows)
    if every <= 1:
        return list(logs), []
    thin = []
    for log in logs:
        kept = {}
        for name in (*MEASURED, *HELD, "acc_b", "voltage"):
            values = getattr(log, name)
            if values is None:
                continue
            table = np.full_like(values, np.nan)
            own = np.flatnonzero(np.isfinite(values.reshape(len(values), -1)).all(axis=1))[::every]
            table[own] = values[own]
            kept[name] = table
        rows = np.zeros(len(log.time_s), bool)
        for table in kept.values():
            rows |= np.isfinite(table.reshape(len(rows), -1)).all(axis=1)
        parts = {name: table[rows] for name, table in kept.items()}
        thin.append(replace(log, time_s=log.time_s[rows], **parts))
    return thin, [f"every {every}. row is used of {count} rows: more take minutes, and add little"]


def own_spacing_s(time_s: np.ndarray, values: np.ndarray) -> float:
    """Return the median time [s] between a column's own rows, the slowest column's of (T, K).

    Infinite where a column has fewer than two rows.
    """
    rows = [time_s[np.isfinite(column)] for column in values.T]
    return max(float(np.median(np.diff(t))) if len(t) > 1 else np.inf for t in rows)


def longest_gap_s(time_s: np.ndarray, since_s: float, until_s: float) -> float:
    """Return the longest time [s] without a row, from the last row at or before `since_s` on."""
    first = max(int(np.searchsorted(time_s, since_s + 1e-9)) - 1, 0)
    rows = time_s[first : np.searchsorted(time_s, until_s + 1e-9)]
    held = np.diff(rows, prepend=min(since_s, rows[0]), append=until_s) if len(rows) else [np.inf]
    return float(np.max(held))


def thinned(seen: np.ndarray, time_s: np.ndarray, most: int) -> np.ndarray:
    """Return the indices of at most `most` rows that keep every signal as evenly as possible.

    Args:
        seen: (N, K) bool: what the rows have of K signals.
        time_s: (N,) [s].
        most: rows that are kept at most.
    """
    step = -(-len(seen) // most)
    if step <= 1 or (seen == seen[:1]).all():
        return np.arange(0, len(seen), step)
    # In each part the row that has most of what was not seen for longest.
    last = np.full(seen.shape[1], time_s[0] - 1.0)
    kept = []
    for first in range(0, len(seen), step):
        part = seen[first : first + step]
        row = first + int((part * (time_s[first] - last + 1e-6)).sum(axis=1).argmax())
        last = np.where(seen[row], time_s[row], last)
        kept.append(row)
    return np.array(kept)


def _column(time_s: np.ndarray, column: np.ndarray, hole_s: float, held: bool) -> np.ndarray:
    own = np.flatnonzero(np.isfinite(column))
    if len(own) < 2:
        return column
    place = np.clip(np.searchsorted(own, np.arange(len(column)), side="right") - 1, 0, len(own) - 2)
    before, after = own[place], own[place + 1]
    if held:
        whole = np.where(np.arange(len(column)) >= own[-1], column[own[-1]], column[before])
    else:
        whole = np.interp(time_s, time_s[own], column[own])
    inside = (time_s >= time_s[own[0]]) & (held | (time_s <= time_s[own[-1]]))
    since = np.where(time_s >= time_s[own[-1]], time_s - time_s[own[-1]], 0.0)
    near = (time_s[after] - time_s[before] <= hole_s) & (since <= hole_s)
    return np.where(np.isfinite(column), column, np.where(inside & near, whole, np.nan))


def on_one_side(quat: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) of which neighbours do not differ by sign alone."""
    own = np.flatnonzero(np.isfinite(quat).all(axis=1))
    out = quat.copy()
    out[own] = continuous(quat[own])
    return out


def interpolate(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return `series` (T, K) at `at_s` (S,), linear between what is finite; 0 where nothing is."""
    columns = []
    for column in series.T:
        good = np.isfinite(column)
        columns.append(np.interp(at_s, time_s[good], column[good]) if good.any() else 0.0 * at_s)
    return np.stack(columns, axis=-1)


def hold(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the last finite row of `series` (T, K) at each of `at_s` (S,); NaN where is none.

    Before the first row that one is held.
    """
    good = np.flatnonzero(np.isfinite(series).all(axis=1))
    if not len(good):
        return np.full((len(at_s), series.shape[1]), np.nan)
    held = np.searchsorted(time_s[good], at_s + 1e-7, side="right") - 1
    return series[good[np.maximum(held, 0)]]


def follow_lag(wanted: np.ndarray, dt: float, time_constant: float) -> np.ndarray:
    """Return first-order rotor speeds (S, 4) at the end of each step of `dt` [s].

    They begin as wanted in the first step.
    """
    left = np.exp(-dt / time_constant) if time_constant > 1e-6 else 0.0
    return np.asarray(lfilter([1.0 - left], [1.0, -left], wanted, axis=0, zi=left * wanted[:1])[0])


LONGEST_S = 0.002
"""A step is about so long at most [s]; the integrator's error over a second is far below noise."""
LOST = 1.75
"""Rows further apart than this multiple of the usual spacing have lost rows between them."""

LEAST_START_ERROR = 1e-3
"""Lower limit of the error of rotor speeds at a window's start [rad/s]."""


class StepGrid(NamedTuple):
    """T consecutive steps."""

    edge_s: np.ndarray
    """(T + 1,) ends of steps [s]."""
    sample_s: np.ndarray
    """(T,) until the rate loop's next sample; 0 where it takes none at the step's start [s]."""
    lead_s: np.ndarray
    """(T,) mean delay of the vehicle's samples after those of the steps [s]."""


def step_grid(row_s: np.ndarray, period_s: float, longest_s: float = LONGEST_S) -> StepGrid:
    """Return steps from the first to the last of `row_s` (R,), R >= 2.

    Args:
        row_s: times at which commands may change [s], increasing.
        period_s: of the rate loop, which starts anew at each row.
        longest_s: about the longest step.
    """
    row_s = np.asarray(row_s, dtype=float)
    spacing = np.diff(row_s)
    kept = _kept(row_s, 0.75 * longest_s)
    # Mean age of the loop's rates over a row.
    whole = np.floor(spacing / period_s + 1e-6)
    rest = np.maximum(spacing - whole * period_s, 0.0)
    old = np.add.reduceat(0.5 * (whole * period_s**2 + rest**2), kept[:-1])
    length = np.diff(row_s[kept])
    samples = np.maximum(np.rint(length / max(period_s, longest_s)), 1).astype(int)
    hold = length / samples
    parts = np.maximum(np.rint(hold / longest_s), 1).astype(int)
    count = samples * parts
    of_row = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(of_row)) - np.repeat(np.cumsum(count) - count, count)
    edge_s = row_s[kept][of_row] + number * (length / count)[of_row]
    lead = 0.5 * hold - old / length
    return StepGrid(
        np.append(edge_s, row_s[-1]),
        np.where(number % parts[of_row] == 0, hold[of_row], 0.0),
        lead[of_row],
    )


def with_lost_rows(time_s: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `time_s` (R,) and `command` (R, K) with lost rows interpolated linearly.

    The vehicle received a command at each lost row; holding the last known one would be too late.
    """
    spacing = np.diff(time_s)
    if not len(spacing):
        return time_s, command
    usual = float(np.median(spacing))
    missing = np.where(spacing > LOST * usual, np.rint(spacing / usual) - 1.0, 0.0).astype(int)
    if not missing.any():
        return time_s, command
    count = missing + 1
    share = np.concatenate([np.arange(n) / n for n in count] + [[0.0]])
    before = np.append(np.repeat(np.arange(len(spacing)), count), len(spacing))
    after = np.minimum(before + 1, len(spacing))
    filled_s = time_s[before] + share * (time_s[after] - time_s[before])
    return filled_s, command[before] + share[:, None] * (command[after] - command[before])


def integral_of_held(time: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the integral (K, 4) of a held `command` (K, 4) from the first of `time` (K,) on."""
    span = np.diff(np.where(np.isfinite(time), time, time[np.isfinite(time)].max()))
    return np.concatenate([np.zeros((1, 4)), np.cumsum(span[:, None] * command[:-1], axis=0)])


def padded_grid(grid: StepGrid, count: int, at_front: bool = False) -> StepGrid:
    """Return `grid` padded to `count` steps with steps of zero length, which have no influence."""
    missing = count - len(grid.sample_s)
    ends = (missing, 0) if at_front else (0, missing)
    return StepGrid(
        np.pad(grid.edge_s, ends, mode="edge"),
        np.pad(grid.sample_s, ends),
        np.pad(grid.lead_s, ends),
    )


def _kept(row_s: np.ndarray, shortest_s: float) -> np.ndarray:
    """Return the rows that end steps, first and last among them, `shortest_s` apart or more."""
    if len(row_s) < 3 or np.diff(row_s).min() >= shortest_s:
        return np.arange(len(row_s))
    kept = [0]
    for place in range(1, len(row_s) - 1):
        if row_s[place] - row_s[kept[-1]] >= shortest_s:
            kept.append(place)
    if len(kept) > 1 and row_s[-1] - row_s[kept[-1]] < shortest_s:
        kept.pop()
    return np.array([*kept, len(row_s) - 1])


def rotors_at(
    at_s: np.ndarray,
    time_s: np.ndarray,
    speed: np.ndarray,
    vehicle: Vehicle,
    smooth: bool,
    every: int = 1,
) -> np.ndarray:
    """Return rotor speeds (S, 4) at `at_s` (S,) [s] from `every` so many of each rotor's own rows.

    Between rows they follow the first-order response to one command. A firmware's loop changes its
    commands all the time, by filtered derivatives of rates: a `smooth` spline is closer then.
    """
    columns = []
    for column in speed.T:
        good = np.flatnonzero(np.isfinite(column))[::every]
        if smooth:
            columns.append(CubicSpline(time_s[good], column[good])(at_s))
            continue
        row = np.clip(np.searchsorted(time_s[good], at_s, side="right") - 1, 0, len(good) - 2)
        before, after = good[row], good[row + 1]
        span, passed = time_s[after] - time_s[before], at_s - time_s[before]
        lag = max(vehicle.rotors.time_constant, 1e-4)
        share = (1.0 - np.exp(-passed / lag)) / (1.0 - np.exp(-span / lag))
        columns.append(column[before] + share * (column[after] - column[before]))
    return np.stack(columns, axis=1)


def torque_between_rows(vehicle: Vehicle, step_s: float) -> np.ndarray:
    """Return the share (3,) of the rotors' torque that rows `step_s` [s] apart do not show.

    A rate loop that samples more often than the log has rows commands less as the body turns: the
    slope of an angular acceleration `a` falls by `gain * step * a / lag` from a row to the next,
    and the trapezoid misses `step / 12` of that fall (Euler and Maclaurin). Where rows are further
    apart than the lag, rotors settle between them: without any lag half of the fall is missed.
    Settings of a firmware's loop are no gain; it is assumed to be as fast as the rotors.
    """
    lag, loop = vehicle.rotors.time_constant, vehicle.controller
    if step_s <= 1.0 / loop.frequency:
        return np.zeros(3)
    gain = np.array(loop.rate_gain) if loop.kind == "p" else np.full(3, 1.0 / max(lag, step_s))
    settled = 2.0 * step_s if step_s >= lag else 0.0
    return gain * step_s**2 / (12.0 * lag + settled)


def rows_show_torque(vehicle: Vehicle, step_s: float) -> bool:
    """Return whether rotor speeds `step_s` [s] apart converge to what the rotors did in between.

    A smooth curve does for a firmware's loop; else the lag has to be longer than the step.
    """
    return vehicle.controller.kind != "p" or step_s <= vehicle.rotors.time_constant


def with_hidden_torque(speed: np.ndarray, vehicle: Vehicle, step_s: float) -> np.ndarray:
    """Return rotor speeds (S, 4) from rows `step_s` [s] apart with the torque that these hide.

    They are as they were where rows show the torque: fewer of them show the error then.
    """
    if rows_show_torque(vehicle, step_s):
        return speed
    rotors, share = vehicle.rotors, torque_between_rows(vehicle, step_s)
    ratio = rotors.torque_coefficient / rotors.thrust_coefficient
    mixer = mixer_matrix(np.array(rotors.position), np.array(rotors.spin), ratio)
    more = np.linalg.inv(mixer) @ (np.append(0.0, share)[:, None] * mixer)
    return speed + (speed - speed.mean(axis=0)) @ more.T


def start_rotor_error(time_s: np.ndarray, rate_b: np.ndarray, vehicle: Vehicle) -> float:
    """Return the RMS error [rad/s] of rotor speeds that follow commands at measured rates (N, 3).

    Between rows the rates are not known. By how far a line between every second row misses the row
    in the middle, the loop commands other rotor speeds; a line between neighbours misses by a
    quarter of it where rates are smooth and by about all of it where they are noise: half is taken.
    """
    if len(time_s) < 3:
        return LEAST_START_ERROR
    share = ((time_s[1:-1] - time_s[:-2]) / (time_s[2:] - time_s[:-2]))[:, None]
    missed = rate_b[1:-1] - (rate_b[:-2] + share * (rate_b[2:] - rate_b[:-2]))
    missed = missed[np.isfinite(missed).all(axis=1)]
    if not len(missed):
        return LEAST_START_ERROR
    plant = make_plant(vehicle, LONGEST_S)
    hover = Command(np.full(4, GRAVITY), np.zeros((4, 3)))
    rates = np.concatenate([np.zeros((1, 3)), 0.1 * np.eye(3)])
    wanted = np.asarray(wanted_speed(plant, hover, rates))
    error = 0.5 * missed @ ((wanted[1:] - wanted[0]) / 0.1)
    return max(float(np.sqrt((error**2).mean())), LEAST_START_ERROR)
