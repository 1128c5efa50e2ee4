"""Windows: stretches of 1 s of flight logs, on time steps of the model between the logs' rows.

A window starts at a row of the log. Commands act from the times of their rows on; measured rotor
speeds are interpolated by the rotors' lag. Measurements are compared at their own times.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from eval.quadrotor.loops import NOMINAL
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.sampling import (
    LONGEST_S,
    StepGrid,
    integral_of_held,
    interpolate,
    longest_gap_s,
    on_every_row,
    own_spacing_s,
    padded_grid,
    rotors_at,
    start_rotor_error,
    step_grid,
    thinned,
    with_hidden_torque,
    with_lost_rows,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.rotation import quat_to_rot
from tracks.geometry.scene import Array

LENGTH_S = 1.0
"""A window's length [s]."""
HISTORY_S = 0.1
"""Commands before a window that a delay may reach [s]."""
BURN_IN_S = 0.2
"""Before a window: the rotors follow the commands at the measured rates [s]."""
STEPS = (512, 704)
"""Numbers of steps of a window: 1 s of 2 ms steps, and more where rows need shorter ones. Windows
are padded to one of them, so that few array shapes are compiled."""
BURN_IN_STEPS = (144,)
"""The same of the burn-in."""
COMMANDS = (192, 1536)
"""The same of its commands: rows of 100 Hz, and of 1,000 Hz."""
ROWS = 101
"""Measured rows in a window; a log that has more of them is thinned."""
STATE = 12
"""Numbers of the state in which a window starts: pos_w, rotation vector, vel_w, rate_b."""
KNOTS = 11
"""Number of knots of a window: what is free along it is linear between knots."""
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
    """W windows of S steps, after Q of burn-in, with N measured rows each.

    All times are since a window's start, but for `start_s`.
    """

    flight: Array
    """(W,) number of the flight."""
    start_s: Array
    """(W,) since the first row of the flight [s]."""
    edge_s: Array
    """(W, Q + S + 1) ends of steps; edge Q is the window's start [s]."""
    sample_s: Array
    """(W, Q + S) and `lead_s`, as `StepGrid` has them [s]."""
    lead_s: Array
    command_s: Array
    """(W, K) times from which commands act, before any delay [s]."""
    command: Array
    """(W, K, 4) thrust and rates."""
    command_sum: Array
    """(W, K, 4) their integral from the first one's time to each one's."""
    burn_in_rate_b: Array
    """(W, Q, 3) measured, where the loop samples [rad/s]."""
    rotor_speed: Array
    """(W, S, 4) measured, in the middle of each step [rad/s]; zeros where there is none."""
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
    """(W, N, 19) bool: whether there is a value that is compared."""
    rotor_seen: Array
    """(W, N, 4) bool: whether there is a rotor speed, compared or an input."""
    start_rotor_error: Array
    """(W,) error of the rotor speeds after the burn-in [rad/s]; 0 where they are the input."""


def step_s(vehicle: Vehicle) -> float:
    """Return about the length of a step [s]: the rate loop's period, at least 2 ms."""
    return max(1.0 / vehicle.controller.frequency, LONGEST_S)


def remembers(vehicle: Vehicle) -> bool:
    """Return whether the rate loop is a firmware's, with integrators and filters.

    No log contains their state at the start of a window.
    """
    return vehicle.controller.kind != NOMINAL


def cut(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    rotor_input: bool,
    stride_s: float = LENGTH_S,
    limits: Thresholds = THRESHOLDS,
    integrator: str = "continuous",
    coarser: FlightWindows | None = None,
    only: Collection[int] | None = None,
) -> tuple[FlightWindows | None, list[str]]:
    """Return the windows of `logs` and warnings; None where no flight has one.

    Above the limits' number an even selection of windows is kept.

    Args:
        logs: flights, known by their place.
        vehicle: whose rate loop's frequency and motor lag are used.
        rotor_input: measured rotor speeds are the input, and no measurement.
        stride_s: from the start of a window to the next's [s]; by default no row counts twice.
        limits: the longest hole in a window.
        integrator: whose steps they are; those of "euler" are the rate loop's periods.
        coarser: the same windows, for steps twice as long, every second rotor speed, and what
            `with_hidden_torque` adds.
        only: places of the flights that count; all if not given.
    """
    places, warnings = list[tuple[int, int]](), list[str]()
    shortest_s = LENGTH_S + BURN_IN_S + HISTORY_S
    states = [on_every_row(log, limits) for log in logs]
    for number, (log, state) in enumerate(zip(logs, states, strict=True)):
        if number not in (range(len(logs)) if only is None else only):
            continue
        starts = _starts(log, state.whole, rotor_input, stride_s, limits.longest_hole_s)
        if not starts:
            warnings.append(f"{log.name}: no stretch of {shortest_s:g} s without a hole")
        places += [(number, first) for first in starts]
    if not places:
        return None, warnings
    most = min(limits.most_windows, limits.most_rotor_windows if rotor_input else len(places))
    if len(places) > most:
        warnings.append(f"{most} stretches of 1 s, evenly spread, are used of {len(places)}")
        kept = np.linspace(0, len(places) - 1, most).astype(int)
        places = [places[k] for k in kept]
    longest_s = 1.0 / vehicle.controller.frequency if integrator == "euler" else LONGEST_S
    if coarser is not None and integrator != "euler":
        longest_s *= 2.0
    drives = [_drive(logs[number], first, vehicle, longest_s) for number, first in places]
    every = 1 if coarser is None else 2
    parts = [
        _window(logs[number], states[number], number, first, vehicle, rotor_input, drive, every)
        for (number, first), drive in zip(places, _of_one_shape(drives, coarser), strict=True)
    ]
    return FlightWindows(*(np.stack(field) for field in zip(*parts, strict=True))), warnings


def take(windows: FlightWindows, chosen: Array) -> FlightWindows:
    """Return the windows at `chosen` (indices or bool)."""
    return FlightWindows(*(np.asarray(field)[chosen] for field in windows))


def trusted(
    windows: FlightWindows, residual: np.ndarray, limits: Thresholds = THRESHOLDS
) -> FlightWindows:
    """Return `windows`, each shortened to where the model is still near the flight.

    Further away the linearisation does not hold: the model may have tipped over or be below the
    ground. With the named effects it stays near for longer, and the next evaluation is longer.
    `residual` is (W, N, 19).
    """
    error = np.abs(residual)
    height = np.maximum(np.asarray(windows.row_pos_w)[..., 2], 0.0)
    lost = (error[..., SLICES["position"]].max(axis=-1) > limits.trusted_m) | (
        error[..., SLICES["attitude"]].max(axis=-1) > limits.trusted_rad
    )
    lost |= (error[..., 2] > limits.trusted_height_share * height) & (height > 0.0)
    row_s = np.asarray(windows.row_s)
    until_s = np.full(len(row_s), limits.trusted_horizons_s[-1])
    for horizon in reversed(limits.trusted_horizons_s):
        there = ~(lost & (row_s <= horizon)).any(axis=1)
        until_s = np.where(there, horizon, until_s)
    seen = np.asarray(windows.seen) & (row_s <= until_s[:, None] + 1e-9)[..., None]
    return windows._replace(seen=seen)


def _starts(
    log: FlightLog, whole: np.ndarray, rotor_input: bool, stride_s: float, hole_s: float
) -> list[int]:
    """Return rows at which windows start, of those (T,) where the `whole` state is known."""
    time = log.time_s
    driven = [time[rows] for rows in _driven(log, rotor_input)]
    next_s, found = time[0] + BURN_IN_S + HISTORY_S, []
    while True:
        later = np.flatnonzero((time >= next_s - 1e-9) & whole)
        if not len(later) or time[later[0]] + LENGTH_S > time[-1] + 1e-6:
            return found
        first = int(later[0])
        begin_s, end_s = time[first], time[first] + LENGTH_S
        inside = time[(time >= begin_s - 1e-9) & (time <= end_s + 1e-9)]
        # What drives reaches back: the rotors follow it before the start, and it acts late.
        back_s = begin_s - BURN_IN_S - HISTORY_S
        hole = max(
            longest_gap_s(inside, begin_s, end_s),
            *(longest_gap_s(rows_s, back_s, end_s) for rows_s in driven),
        )
        if len(inside) < 12 or hole > hole_s:
            next_s = begin_s + 0.1
        else:
            found.append(first)
            next_s = begin_s + stride_s


def _driven(log: FlightLog, rotor_input: bool) -> list[np.ndarray]:
    """Return (T,) bool each: rows of what drives, and of the rates that the loop samples."""
    if rotor_input:
        assert log.rotor_speed is not None
        return [np.isfinite(column) for column in log.rotor_speed.T]
    assert log.thrust_cmd is not None and log.rate_cmd_b is not None
    command = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
    return [np.asarray(np.isfinite(part).all(axis=1)) for part in (command, log.rate_b)]


class _Drive(NamedTuple):
    """What drives one window, as in `FlightWindows`."""

    burn_in: StepGrid
    window: StepGrid
    command_s: np.ndarray
    command: np.ndarray


def _drive(log: FlightLog, first: int, vehicle: Vehicle, longest_s: float) -> _Drive:
    begin, period = log.time_s[first], 1.0 / vehicle.controller.frequency
    end = log.time_s[_rows(log, begin)[-1]] - begin
    time, given = log.time_s, np.tile([GRAVITY, 0.0, 0.0, 0.0], (len(log.time_s), 1))
    if log.thrust_cmd is not None and log.rate_cmd_b is not None:
        command = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
        good = np.isfinite(command).all(axis=1)
        if good.any():
            time, given = time[good], command[good]
    near = slice(
        max(np.searchsorted(time, begin - BURN_IN_S - HISTORY_S - 1e-9) - 1, 0),
        np.searchsorted(time, begin + end + 1e-9) + 1,
    )
    time, given = with_lost_rows(time[near] - begin, given[near])

    def grid(since: float, until: float) -> StepGrid:
        inside = time[(time > since + 1e-6) & (time < until - 1e-6)]
        return step_grid(np.array([since, *inside, until]), period, longest_s)

    return _Drive(grid(-BURN_IN_S, 0.0), grid(0.0, end), time, given)


def _of_one_shape(drives: Sequence[_Drive], like: FlightWindows | None) -> list[_Drive]:
    """Return `drives` with as many steps and commands each, so that few shapes are compiled.

    They are those of `like` where it is given.
    """

    def most(counts: Iterable[int], sizes: Sequence[int]) -> int:
        count = max(counts)
        fitting = [size for size in sizes if size >= count]
        return fitting[0] if fitting else -(-count // sizes[0]) * sizes[0]

    burn_in = most((len(d.burn_in.sample_s) for d in drives), BURN_IN_STEPS)
    steps = most((len(d.window.sample_s) for d in drives), STEPS)
    commands = most((len(d.command_s) for d in drives), COMMANDS)
    if like is not None:
        burn_in, steps = like.burn_in_rate_b.shape[1], like.rotor_speed.shape[1]
        commands = like.command_s.shape[1]
    return [
        _Drive(
            padded_grid(d.burn_in, burn_in, at_front=True),
            padded_grid(d.window, steps),
            np.pad(d.command_s, (0, commands - len(d.command_s)), constant_values=np.inf),
            np.pad(d.command, ((0, commands - len(d.command)), (0, 0))),
        )
        for d in drives
    ]


def _rows(log: FlightLog, begin: float) -> np.ndarray:
    """Return the rows of the window from `begin` [s] on, thinned to `ROWS` at most."""
    time = log.time_s
    rows = np.flatnonzero((time >= begin - 1e-9) & (time <= begin + LENGTH_S + 1e-9))
    blank = np.full((len(time), 1), np.nan)
    signals = (log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b, log.acc_b, log.rotor_speed)
    there = [(blank if values is None else values)[rows] for values in signals]
    seen = np.stack([np.isfinite(values).all(axis=1) for values in there], axis=1)
    return rows[thinned(seen, time[rows], ROWS)]


def _window(
    log: FlightLog,
    state: FlightLog,
    number: int,
    first: int,
    vehicle: Vehicle,
    rotor_input: bool,
    drive: _Drive,
    every: int,
) -> FlightWindows:
    time, begin = log.time_s, log.time_s[first]
    before, window = drive.burn_in, drive.window
    rates = interpolate(begin + before.edge_s[:-1] + before.lead_s, time, log.rate_b)
    middle = begin + 0.5 * (window.edge_s[:-1] + window.edge_s[1:])
    speed = np.zeros((len(middle), 4))
    if log.rotor_speed is not None and rotor_input:
        smooth = remembers(vehicle)
        speed = rotors_at(middle, time, log.rotor_speed, vehicle, smooth, every)
        if every > 1:
            speed = with_hidden_torque(speed, vehicle, own_spacing_s(time, log.rotor_speed))
    drop = np.zeros(len(middle))
    if log.voltage is not None and np.isfinite(log.voltage).any():
        first_volt = log.voltage[np.flatnonzero(np.isfinite(log.voltage))[0]]
        drop = first_volt - interpolate(middle, time, log.voltage[:, None])[:, 0]
    rows = _rows(log, begin)
    blank = np.full((len(time), 4), np.nan)
    acc = blank[:, :3] if log.acc_b is None else log.acc_b
    rotors = blank if log.rotor_speed is None else log.rotor_speed
    vel = np.full_like(log.vel_w, np.nan) if log.velocity_derived else log.vel_w
    rot_rows = quat_to_rot(log.quat_wxyz[rows])
    measured = [log.pos_w[rows], rot_rows, vel[rows], log.rate_b[rows], acc[rows], rotors[rows]]
    turned = np.isfinite(rot_rows.reshape(len(rows), 9).sum(axis=1, keepdims=True))
    attitude_seen = np.repeat(turned, 3, axis=1)
    seen = [attitude_seen if m.ndim == 3 else np.isfinite(m) for m in measured]
    turning = seen[5]
    if rotor_input:
        seen[5] = np.zeros_like(turning)  # an input is no measurement
    seen[4][0] = False  # the force before the window is not simulated
    missing = ROWS - len(rows)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.concatenate([np.nan_to_num(values), np.zeros((missing, *values.shape[1:]))])

    mask = np.concatenate([np.concatenate(seen, axis=1), np.zeros((missing, CHANNELS), bool)])
    turning = np.concatenate([turning, np.zeros((missing, 4), bool)])
    return FlightWindows(
        np.asarray(number),
        np.asarray(begin - time[0]),
        np.concatenate([before.edge_s[:-1], window.edge_s]),
        np.concatenate([before.sample_s, window.sample_s]),
        np.concatenate([before.lead_s, window.lead_s]),
        drive.command_s,
        drive.command,
        integral_of_held(drive.command_s, drive.command),
        rates,
        speed,
        drop,
        state.pos_w[first],
        quat_to_rot(state.quat_wxyz[first]),
        state.vel_w[first],
        state.rate_b[first],
        padded(time[rows] - begin),
        *(padded(values) for values in measured),
        seen=mask,
        rotor_seen=turning,
        start_rotor_error=np.asarray(0.0 if rotor_input else _start_error(state, begin, vehicle)),
    )


def _start_error(log: FlightLog, begin: float, vehicle: Vehicle) -> float:
    """Return how far off the burn-in to `begin` [s] leaves the rotor speeds [rad/s]."""
    near = (log.time_s > begin - BURN_IN_S - 1e-9) & (log.time_s <= begin + 1e-9)
    return start_rotor_error(log.time_s[near], log.rate_b[near], vehicle)
