"""Flight logs cut into short stretches on the physics steps of the model.

A window starts at a row of the log. Commands are held from row to row as the log says; measured
rotor speeds are joined by the curve of the rotors' lag. What was measured stays on its own times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.scene import Array

LENGTH_S = 1.0
"""A window's length [s]."""
HISTORY_S = 0.1
"""Commands before a window that a delay may reach [s]."""
WARM_S = 0.2
"""Before a window: the rotors follow the commands at the measured rates [s]."""
SHORTEST_STEP_S = 0.002
"""The model's step is the rate loop's period, or this where that is shorter [s]."""
STRIDE_S = LENGTH_S
"""From the start of one window to the next [s]: no row counts twice."""
ROWS = 101
"""Measured rows in a window; a log that has more of them is thinned."""
HOLE_S = 0.1
"""A window with a hole longer than this is left out [s]."""
CHANNELS = 19
"""pos_w 3, attitude 3, vel_w 3, rate_b 3, acc_b 3, rotor speeds 4."""
SLICES = {
    "position": slice(0, 3),
    "attitude": slice(3, 6),
    "velocity": slice(6, 9),
    "rates": slice(9, 12),
    "accelerometer": slice(12, 15),
    "rotor speed": slice(15, 19),
}
UNITS = {
    "position": "m", "attitude": "rad", "velocity": "m/s", "rates": "rad/s",
    "accelerometer": "m/s^2", "rotor speed": "rad/s",
}  # fmt: skip


class Windows(NamedTuple):
    """W windows of S steps with N measured rows each."""

    flight: Array
    """(W,) number of the flight."""
    start_s: Array
    """(W,) since the first row of the flight [s]."""
    command: Array
    """(W, H + S, 4) thrust and rates held during each step, H of them before the window."""
    warm_rate_b: Array
    """(W, warm steps, 3) measured [rad/s]."""
    rotor_speed: Array
    """(W, S, 4) measured [rad/s]; zeros where there is none."""
    voltage_drop: Array
    """(W, S) [V]; zeros where there is none."""
    pos_w: Array
    """(W, 3) at the start, measured, and so on."""
    rot_w: Array
    vel_w: Array
    rate_b: Array
    row_s: Array
    """(W, N) times of the rows since the window's start [s]."""
    row_pos_w: Array
    """(W, N, 3), and so on."""
    row_rot_w: Array
    row_vel_w: Array
    row_rate_b: Array
    row_acc_b: Array
    row_rotor_speed: Array
    seen: Array
    """(W, N, 19) bool: whether there is a value."""


def step_s(vehicle: Vehicle) -> float:
    """Return the length of a physics step [s]: the rate loop's period, 2 ms or longer."""
    return max(1.0 / vehicle.controller.frequency, SHORTEST_STEP_S)


def cut(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    driven_by_rotors: bool,
    stride_s: float = STRIDE_S,
) -> tuple[Windows | None, list[str]]:
    """Return the windows of `logs`, one after another, and warnings.

    Args:
        logs: flights.
        vehicle: whose steps and lag count.
        driven_by_rotors: the measured rotor speeds are the input; they are no measurement then.
        stride_s: from the start of one window to that of the next [s].

    Returns:
        None in place of windows where no flight has one.
    """
    parts: list[Windows] = []
    warnings: list[str] = []
    for number, log in enumerate(logs):
        rows = [
            _window(log, number, first, vehicle, driven_by_rotors)
            for first in _starts(log, stride_s)
        ]
        rows = [row for row in rows if row is not None]
        if not rows:
            warnings.append(
                f"{log.name}: no stretch of {LENGTH_S + WARM_S + HISTORY_S:g} s without a hole"
            )
        parts += rows
    if not parts:
        return None, warnings
    return Windows(*(np.stack(field) for field in zip(*parts, strict=True))), warnings


def take(windows: Windows, chosen: Array) -> Windows:
    """Return the windows at `chosen` (indices or bool)."""
    return Windows(*(np.asarray(field)[chosen] for field in windows))


def _starts(log: FlightLog, stride_s: float) -> list[int]:
    time, whole = log.time_s, log.whole
    next_s, found = time[0] + WARM_S + HISTORY_S, []
    while True:
        later = np.flatnonzero((time >= next_s - 1e-9) & whole)
        if not len(later) or time[later[0]] + LENGTH_S > time[-1] + 1e-6:
            return found
        first = int(later[0])
        inside = time[(time >= time[first] - 1e-9) & (time <= time[first] + LENGTH_S + 1e-9)]
        if len(inside) < 12 or np.diff(inside).max() > HOLE_S:
            next_s = time[first] + 0.1
            continue
        found.append(first)
        next_s = time[first] + stride_s


def _window(
    log: FlightLog, number: int, first: int, vehicle: Vehicle, driven_by_rotors: bool
) -> Windows | None:
    dt, time = step_s(vehicle), log.time_s
    steps, warm, before = round(LENGTH_S / dt), round(WARM_S / dt), round(HISTORY_S / dt) + 1
    begin = time[first]
    at = begin + dt * np.arange(-(before + warm), steps)
    command = np.concatenate([np.full((len(at), 1), GRAVITY), np.zeros((len(at), 3))], axis=1)
    if log.thrust_cmd is not None and log.rate_cmd_b is not None:
        given = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
        good = np.flatnonzero(np.isfinite(given).all(axis=1))
        if len(good):
            held = np.searchsorted(time[good], at + 1e-7, side="right") - 1
            command = given[good[np.maximum(held, 0)]]
    rates = _linear(at[before : before + warm], time, log.rate_b)
    speed = np.zeros((steps, 4))
    if log.rotor_speed is not None and driven_by_rotors:
        middle = begin + dt * (np.arange(steps) + 0.5)
        speed = _rotors(middle, time, log.rotor_speed, vehicle.rotors.time_constant)
    drop = np.zeros(steps)
    if log.voltage is not None and np.isfinite(log.voltage).any():
        first_volt = log.voltage[np.flatnonzero(np.isfinite(log.voltage))[0]]
        drop = first_volt - _linear(at[-steps:], time, log.voltage[:, None])[:, 0]
    rot_w = log.rot_w
    rows = np.flatnonzero((time >= begin - 1e-9) & (time <= begin + LENGTH_S + 1e-9))
    rows = rows[:: -(-len(rows) // ROWS)]
    blank = np.full((len(time), 4), np.nan)
    acc = blank[:, :3] if log.acc_b is None else log.acc_b
    rotors = blank if log.rotor_speed is None else log.rotor_speed
    vel = np.full_like(log.vel_w, np.nan) if log.velocity_derived else log.vel_w
    rot_rows = rot_w[rows]
    measured = [log.pos_w[rows], rot_rows, vel[rows], log.rate_b[rows], acc[rows], rotors[rows]]
    turned = np.isfinite(rot_rows.reshape(len(rows), 9).sum(axis=1, keepdims=True))
    attitude_seen = np.repeat(turned, 3, axis=1)
    seen = [attitude_seen if m.ndim == 3 else np.isfinite(m) for m in measured]
    if driven_by_rotors:
        seen[5] = np.zeros_like(seen[5])  # an input is no measurement
    seen[4][0] = False  # the force before the window is not simulated
    missing = ROWS - len(rows)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.concatenate([np.nan_to_num(values), np.zeros((missing, *values.shape[1:]))])

    mask = np.concatenate([np.concatenate(seen, axis=1), np.zeros((missing, CHANNELS), bool)])
    return Windows(
        np.asarray(number),
        np.asarray(begin - time[0]),
        command,
        rates,
        speed,
        drop,
        log.pos_w[first],
        rot_w[first],
        log.vel_w[first],
        log.rate_b[first],
        padded(time[rows] - begin),
        *(padded(values) for values in measured),
        seen=mask,
    )


def _linear(at: np.ndarray, time: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return `series` (T, K) at `at`, linear between its values that are there."""
    columns = []
    for column in series.T:
        good = np.isfinite(column)
        columns.append(np.interp(at, time[good], column[good]) if good.any() else 0.0 * at)
    return np.stack(columns, axis=-1)


def _rotors(
    at: np.ndarray, time: np.ndarray, speed: np.ndarray, time_constant: float
) -> np.ndarray:
    """Return rotor speeds at `at`: between rows along the first-order response to one command."""
    good = np.flatnonzero(np.isfinite(speed).all(axis=1))
    row = np.clip(np.searchsorted(time[good], at, side="right") - 1, 0, len(good) - 2)
    before, after = good[row], good[row + 1]
    span, passed = time[after] - time[before], at - time[before]
    lag = max(time_constant, 1e-4)
    share = (1.0 - np.exp(-passed / lag)) / (1.0 - np.exp(-span / lag))
    return speed[before] + share[:, None] * (speed[after] - speed[before])
