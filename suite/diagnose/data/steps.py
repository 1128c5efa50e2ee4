"""Places the model's time steps between the rows of a log, and computes its inputs on them.

A command acts from the time of its row on, and the vehicle's rate loop starts its period at this
time. So every step of the model lies between two rows. A sample of the loop is an evaluation with
new rates. The model's loop samples about as often as that of the vehicle, but not more often than
every `LONGEST_S`; it predicts the rates over the difference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from eval.effects.interface import GRAVITY
from eval.quadrotor.loops import NOMINAL
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle

LONGEST_S = 0.002
"""Length of the longest step [s]: the integrator's error over 1 s is far below the noise."""
LOST = 1.75
"""Between rows that are further apart than this multiple of the usual spacing, rows were lost."""

LEAST_START_ERROR = 1e-3
"""Lower limit of the error of rotor speeds at a window's start [rad/s]."""


def step_s(vehicle: Vehicle) -> float:
    """Return the approximate length of a step [s]: the rate loop's period, but at least 2 ms."""
    return max(1.0 / vehicle.controller.frequency, LONGEST_S)


def has_firmware_loop(vehicle: Vehicle) -> bool:
    """Return whether the rate loop has integrators and filters, whose state no log contains."""
    return vehicle.controller.kind != NOMINAL


class StepGrid(NamedTuple):
    """T consecutive time steps of the model."""

    edge_s: np.ndarray
    """(T + 1,) ends of steps [s]."""
    sample_s: np.ndarray
    """(T,) time until the rate loop's next sample [s]; 0 if the step starts without a sample."""
    lead_s: np.ndarray
    """(T,) mean time by which the vehicle's samples are later than those of the model [s]."""


def step_grid(row_s: np.ndarray, period_s: float, longest_s: float = LONGEST_S) -> StepGrid:
    """Return steps from the first to the last of `row_s` (R,), R >= 2, when commands may change.

    The vehicle's rate loop restarts its `period_s` at each row. Steps last about `longest_s` [s].
    """
    row_s = np.asarray(row_s, dtype=float)
    spacing = np.diff(row_s)
    edges = _step_rows(row_s, 0.75 * longest_s)
    # The age of the rates that the vehicle's loop uses grows from 0 over each period. Here it is
    # integrated over the time between two edges.
    periods = np.floor(spacing / period_s + 1e-6)
    remainder = np.maximum(spacing - periods * period_s, 0.0)
    age = np.add.reduceat(0.5 * (periods * period_s**2 + remainder**2), edges[:-1])
    # Between two edges there are some samples of the model's loop, and some steps for each sample.
    length = np.diff(row_s[edges])
    samples = np.maximum(np.rint(length / max(period_s, longest_s)), 1).astype(int)
    hold_s = length / samples
    substeps = np.maximum(np.rint(hold_s / longest_s), 1).astype(int)
    count = samples * substeps
    interval = np.repeat(np.arange(len(count)), count)
    step_number = np.arange(len(interval)) - np.repeat(np.cumsum(count) - count, count)
    edge_s = row_s[edges][interval] + step_number * (length / count)[interval]
    lead_s = 0.5 * hold_s - age / length
    return StepGrid(
        np.append(edge_s, row_s[-1]),
        np.where(step_number % substeps[interval] == 0, hold_s[interval], 0.0),
        lead_s[interval],
    )


def with_lost_rows(time_s: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `time_s` (R,) and `command` (R, K) with the lost rows, interpolated linearly.

    The vehicle received commands there, too: holding the last logged one would be too late.
    """
    spacing = np.diff(time_s)
    if not len(spacing):
        return time_s, command
    usual_spacing = float(np.median(spacing))
    has_lost = spacing > LOST * usual_spacing
    if not has_lost.any():
        return time_s, command
    count = np.where(has_lost, np.rint(spacing / usual_spacing), 1.0).astype(int)
    share = np.concatenate([np.arange(n) / n for n in count] + [[0.0]])
    before = np.append(np.repeat(np.arange(len(spacing)), count), len(spacing))
    after = np.minimum(before + 1, len(spacing))
    filled_s = time_s[before] + share * (time_s[after] - time_s[before])
    return filled_s, command[before] + share[:, None] * (command[after] - command[before])


def padded_grid(grid: StepGrid, count: int, at_front: bool = False) -> StepGrid:
    """Return `grid` with `count` steps; the added ones have zero length, and so no effect."""
    missing = count - len(grid.sample_s)
    ends = (missing, 0) if at_front else (0, missing)
    edge_s = np.pad(grid.edge_s, ends, mode="edge")
    return StepGrid(edge_s, np.pad(grid.sample_s, ends), np.pad(grid.lead_s, ends))


def _step_rows(row_s: np.ndarray, shortest_s: float) -> np.ndarray:
    """Return the indices of rows at least `shortest_s` apart, with the first and the last row."""
    if len(row_s) < 3 or np.diff(row_s).min() >= shortest_s:
        return np.arange(len(row_s))
    chosen = [0]
    for place in range(1, len(row_s) - 1):
        if row_s[place] - row_s[chosen[-1]] >= shortest_s:
            chosen.append(place)
    if len(chosen) > 1 and row_s[-1] - row_s[chosen[-1]] < shortest_s:
        chosen.pop()
    return np.array([*chosen, len(row_s) - 1])


def rotors_at(
    at_s: np.ndarray,
    time_s: np.ndarray,
    speed: np.ndarray,
    vehicle: Vehicle,
    spacing_s: float,
    stride: int = 1,
) -> np.ndarray:
    """Return rotor speeds (S, 4) at `at_s` (S,), measured as `speed` (T, 4) at `time_s` (T,).

    The measured rows are `spacing_s` [s] apart, as by `own_spacing_s`.

    Of each rotor every `stride`-th measured row is used. Between two rows the speeds follow the
    first-order response to a constant command, and the torque that the rows do not show is added.
    Rows further apart than the lag determine this torque only to a factor of two. Then it is added
    only with a stride above 1, whose difference from other results shows this error.

    A firmware's rate loop changes its commands all the time, by filtered derivatives of rates.
    There a spline is more accurate.
    """
    columns, is_firmware = [], has_firmware_loop(vehicle)
    lag_s = max(vehicle.rotors.time_constant, 1e-4)
    for column in speed.T:
        own_rows = np.flatnonzero(np.isfinite(column))[::stride]
        own_s = time_s[own_rows]
        if is_firmware:
            columns.append(CubicSpline(own_s, column[own_rows])(at_s))
            continue
        row = np.clip(np.searchsorted(own_s, at_s, side="right") - 1, 0, len(own_rows) - 2)
        before, after = own_rows[row], own_rows[row + 1]
        span_s, since_s = time_s[after] - time_s[before], at_s - time_s[before]
        share = (1.0 - np.exp(-since_s / lag_s)) / (1.0 - np.exp(-span_s / lag_s))
        columns.append(column[before] + share * (column[after] - column[before]))
    speed_at = np.stack(columns, axis=1)
    if is_firmware:
        return speed_at
    if rows_show_torque(vehicle, spacing_s):
        return with_hidden_torque(speed_at, vehicle, stride * spacing_s)
    return with_hidden_torque(speed_at, vehicle, spacing_s) if stride > 1 else speed_at


def torque_between_rows(vehicle: Vehicle, step_s: float) -> np.ndarray:
    """Return the share (3,) of the rotors' torque that rows `step_s` [s] apart do not show.

    A rate loop may sample more often than the log has rows. As the body turns, it commands less
    torque: from one row to the next, the slope of an angular acceleration `a` falls by
    `gain * step * a / lag`. An integral by the trapezoidal rule misses `step / 12` of that fall
    (Euler and Maclaurin). If rows are further apart than the lag, the rotors settle between them;
    without any lag half of the fall is missed. The settings of a firmware's loop are not gains in
    1/s, so such a loop is assumed to be as fast as the rotors.
    """
    lag, loop = vehicle.rotors.time_constant, vehicle.controller
    if step_s <= 1.0 / loop.frequency:
        return np.zeros(3)
    gain = np.array(loop.rate_gain) if loop.kind == "p" else np.full(3, 1.0 / max(lag, step_s))
    settled = 2.0 * step_s if step_s >= lag else 0.0
    return gain * step_s**2 / (12.0 * lag + settled)


def rows_show_torque(vehicle: Vehicle, step_s: float) -> bool:
    """Return whether rows `step_s` [s] apart show the torque, as a firmware's loop always does."""
    return has_firmware_loop(vehicle) or step_s <= vehicle.rotors.time_constant


def with_hidden_torque(speed: np.ndarray, vehicle: Vehicle, step_s: float) -> np.ndarray:
    """Return rotor speeds (S, 4) with the torque that rows `step_s` [s] apart do not show."""
    mixer, share = rotor_mixer(vehicle), torque_between_rows(vehicle, step_s)
    added = np.linalg.inv(mixer) @ (np.append(0.0, share)[:, None] * mixer)
    return speed + (speed - speed.mean(axis=0)) @ added.T


def rotor_mixer(vehicle: Vehicle) -> np.ndarray:
    """Return the matrix (4, 4) from rotor thrusts [N] to collective thrust and body torques."""
    rotors = vehicle.rotors
    ratio = rotors.torque_coefficient / rotors.thrust_coefficient
    return mixer_matrix(np.array(rotors.position), np.array(rotors.spin), ratio)


def start_rotor_error(time_s: np.ndarray, rate_b: np.ndarray, vehicle: Vehicle) -> float:
    """Return the RMS error [rad/s] of the rotor speeds that the rate loop gives at measured rates.

    The rates `rate_b` (N, 3) are interpolated between rows. Each row is compared with the
    interpolation between its neighbours. Between neighbouring rows the error is a quarter of that
    if rates are smooth, about all of it if they are noise; half is used.
    """
    if len(time_s) < 3:
        return LEAST_START_ERROR
    share = ((time_s[1:-1] - time_s[:-2]) / (time_s[2:] - time_s[:-2]))[:, None]
    rate_error = rate_b[1:-1] - (rate_b[:-2] + share * (rate_b[2:] - rate_b[:-2]))
    # From rates to commanded rotor speeds, by finite differences at hover.
    plant = make_plant(vehicle, LONGEST_S)
    hover = Command(np.full(4, GRAVITY), np.zeros((4, 3)))
    rates = np.concatenate([np.zeros((1, 3)), 0.1 * np.eye(3)])
    commanded = np.asarray(wanted_speed(plant, hover, rates))
    error = 0.5 * rate_error @ ((commanded[1:] - commanded[0]) / 0.1)
    return max(float(np.sqrt((error**2).mean())), LEAST_START_ERROR)


def wrench_difference(
    measured: np.ndarray, commanded: np.ndarray, vehicle: Vehicle
) -> tuple[np.ndarray, np.ndarray]:
    """Return the accelerations by `measured` less those by `commanded` rotor speeds (N, 4) [rad/s].

    They are thrust over mass (N,) [m/s^2], and angular in body axes (N, 3) [rad/s^2].
    """
    thrust = vehicle.rotors.thrust_coefficient * (measured**2 - commanded**2)
    wrench = thrust @ rotor_mixer(vehicle).T
    return wrench[:, 0] / vehicle.mass, wrench[:, 1:] / np.array(vehicle.inertia)
