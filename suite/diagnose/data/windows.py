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
from suite.diagnose.data.resample import hold, interpolate
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.scene import Array

LENGTH_S = 1.0
"""A window's length [s]."""
HISTORY_S = 0.1
"""Commands before a window that a delay may reach [s]."""
BURN_IN_S = 0.2
"""Before a window: the rotors follow the commands at the measured rates [s]."""
SHORTEST_STEP_S = 0.002
"""The model's step is the rate loop's period, or this where that is shorter [s]."""
ROWS = 101
"""Measured rows in a window; a log that has more of them is thinned."""
CHANNELS = 19
"""pos_w 3, attitude 3, vel_w 3, rate_b 3, acc_b 3, rotor speeds 4."""
STATE_GROUPS = ("position", "attitude", "velocity", "rates")
"""What a state is made of, three channels each, in their order."""
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


class FlightWindows(NamedTuple):
    """W windows of S steps with N measured rows each."""

    flight: Array
    """(W,) number of the flight."""
    start_s: Array
    """(W,) since the first row of the flight [s]."""
    command: Array
    """(W, H + S, 4) thrust and rates held during each step, H of them before the window."""
    burn_in_rate_b: Array
    """(W, steps of `BURN_IN_S`, 3) measured [rad/s]."""
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


def steps_before(dt: float) -> tuple[int, int]:
    """Return how many steps of `dt` [s] of history, and then of burn-in, precede a window."""
    return round(HISTORY_S / dt) + 1, round(BURN_IN_S / dt)


def cut(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    rotor_input: bool,
    stride_s: float = LENGTH_S,
    limits: Thresholds = THRESHOLDS,
) -> tuple[FlightWindows | None, list[str]]:
    """Return the windows of `logs` and warnings; None where no flight has one.

    Args:
        logs: flights, known by their place.
        vehicle: whose physics step and motor lag are used.
        rotor_input: the measured rotor speeds are the input; they are no measurement then.
        stride_s: from the start of one window to that of the next [s]; by default no row counts
            twice.
        limits: the longest hole in a window.
    """
    parts: list[FlightWindows] = []
    warnings: list[str] = []
    shortest_s = LENGTH_S + BURN_IN_S + HISTORY_S
    for number, log in enumerate(logs):
        starts = _starts(log, stride_s, limits.longest_hole_s)
        if not starts:
            warnings.append(f"{log.name}: no stretch of {shortest_s:g} s without a hole")
        parts += [_window(log, number, first, vehicle, rotor_input) for first in starts]
    if not parts:
        return None, warnings
    return FlightWindows(*(np.stack(field) for field in zip(*parts, strict=True))), warnings


def take(windows: FlightWindows, chosen: Array) -> FlightWindows:
    """Return the windows at `chosen` (indices or bool)."""
    return FlightWindows(*(np.asarray(field)[chosen] for field in windows))


def _starts(log: FlightLog, stride_s: float, hole_s: float) -> list[int]:
    time, whole = log.time_s, log.whole
    next_s, found = time[0] + BURN_IN_S + HISTORY_S, []
    while True:
        later = np.flatnonzero((time >= next_s - 1e-9) & whole)
        if not len(later) or time[later[0]] + LENGTH_S > time[-1] + 1e-6:
            return found
        first = int(later[0])
        inside = time[(time >= time[first] - 1e-9) & (time <= time[first] + LENGTH_S + 1e-9)]
        if len(inside) < 12 or np.diff(inside).max() > hole_s:
            next_s = time[first] + 0.1
            continue
        found.append(first)
        next_s = time[first] + stride_s


def _window(
    log: FlightLog, number: int, first: int, vehicle: Vehicle, rotor_input: bool
) -> FlightWindows:
    dt, time = step_s(vehicle), log.time_s
    before, burn_in = steps_before(dt)
    steps = round(LENGTH_S / dt)
    begin = time[first]
    at = begin + dt * np.arange(-(before + burn_in), steps)
    command = np.concatenate([np.full((len(at), 1), GRAVITY), np.zeros((len(at), 3))], axis=1)
    if log.thrust_cmd is not None and log.rate_cmd_b is not None:
        given = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
        if np.isfinite(given).all(axis=1).any():
            command = hold(at, time, given)
    rates = interpolate(at[before : before + burn_in], time, log.rate_b)
    speed = np.zeros((steps, 4))
    if log.rotor_speed is not None and rotor_input:
        middle = begin + dt * (np.arange(steps) + 0.5)
        speed = _rotors(middle, time, log.rotor_speed, vehicle.rotors.time_constant)
    drop = np.zeros(steps)
    if log.voltage is not None and np.isfinite(log.voltage).any():
        first_volt = log.voltage[np.flatnonzero(np.isfinite(log.voltage))[0]]
        drop = first_volt - interpolate(at[-steps:], time, log.voltage[:, None])[:, 0]
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
    if rotor_input:
        seen[5] = np.zeros_like(seen[5])  # an input is no measurement
    seen[4][0] = False  # the force before the window is not simulated
    missing = ROWS - len(rows)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.concatenate([np.nan_to_num(values), np.zeros((missing, *values.shape[1:]))])

    mask = np.concatenate([np.concatenate(seen, axis=1), np.zeros((missing, CHANNELS), bool)])
    return FlightWindows(
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
