"""The continuous-time engine: it integrates rigid body, rotors and air by Runge-Kutta of order 4.

Events are rows of the log, ticks of the rate loop (the times at which it computes), and delayed
commands that begin to act. Between two events the commanded rotor speeds are constant, so the lag
of the rotors is solved exactly. The rigid body is integrated in steps, one of which ends at each
event. N flights are computed together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from suite.blind.continuous.air import Wind
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery, Body, rotation
from suite.blind.continuous.quadrotor import GRAVITY, Quadrotor, commanded_speeds
from suite.blind.continuous.timing import Schedule


class Rows(NamedTuple):
    """The states of N flights at one row of the log."""

    number: int
    time_s: np.ndarray
    """(N,) time [s]."""
    pos_w: np.ndarray
    """(N, 3) position [m]."""
    rot_w: np.ndarray
    """(N, 3, 3) attitude, body to world."""
    vel_w: np.ndarray
    """(N, 3) velocity [m/s]."""
    rate_b: np.ndarray
    """(N, 3) body rates [rad/s]."""


class Flown(NamedTuple):
    """N flights: their states at the S + 1 ends of S steps, and what is logged at R rows."""

    schedule: Schedule
    """The times of rows and steps."""
    time_s: np.ndarray
    """(S + 1, N) times of the ends of the steps [s]."""
    state: np.ndarray
    """(S + 1, N, 13) states; `suite.blind.continuous.body` has the order."""
    speed: np.ndarray
    """(S + 1, N, 4) rotor speeds [rad/s]."""
    push_b: np.ndarray
    """(S, N, 3) additional force in each step, body axes [N]."""
    command: np.ndarray
    """(R, N, 4) logged commands: thrust [m/s^2], body rates [rad/s]."""
    acting: np.ndarray
    """(R, N, 4) commands that act after their delay; additional physics may have changed them."""
    acc_b: np.ndarray
    """(R, N, 3) specific force, what an accelerometer measures [m/s^2]."""
    voltage: np.ndarray
    """(R, N) voltage of the battery [V]."""


Pilot = Callable[[Rows], tuple[np.ndarray, np.ndarray]]
"""Function (states at a row) -> logged commands (N, 4), commands that act (N, 4)."""
Push = Callable[[Rows, np.ndarray, np.ndarray], np.ndarray]
"""Additional physics: function (states at the start of a step, force (N, 3) [N], length of the step
(N, 1) [s]) -> force (N, 3) that is added during the step [N]. Forces are in body axes."""


def fly(
    quadrotor: Quadrotor,
    plan: Schedule,
    start: np.ndarray,
    pilot: Pilot,
    rng: np.random.Generator,
    battery: Battery,
    push: Push | None = None,
) -> Flown:
    """Fly N flights, which start with the rotors at their speeds in hover.

    Args:
        quadrotor: constants of the true vehicle.
        plan: times of rows and steps.
        start: (N, 13) states at the first row.
        pilot: function that returns the commands at each row.
        rng: random generator of gusts.
        battery: constants of the battery.
        push: additional physics; None: none.
    """
    count, steps, rows = len(start), len(plan.start_s), len(plan.stamp_s) - 1
    nominal = quadrotor.nominal
    hover_command = np.tile([GRAVITY, 0.0, 0.0, 0.0], (count, 1))
    state, rate_b = start.copy(), start[:, RATE].copy()
    speed_cmd = commanded_speeds(nominal, hover_command, rate_b)
    speed, hover_power = speed_cmd, (speed_cmd**2).sum(axis=1, keepdims=True)
    body = Body(quadrotor, Wind(quadrotor.effects, count, rng), battery, hover_power)
    states, speeds = np.empty((steps + 1, count, 13)), np.empty((steps + 1, count, 4))
    pushes = np.zeros((steps, count, 3))
    commands, actings = np.empty((rows, count, 4)), np.empty((rows, count, 4))
    accs, volts = np.empty((rows, count, 3)), np.empty((rows, count))
    # The commanded rotor speeds change with a tick of the rate loop or a new command.
    is_new = np.any(plan.is_tick, axis=1)
    is_new[1:] |= np.any(plan.acting[1:] != plan.acting[:-1], axis=1)
    # In all arrays below, the first axis is the row or the step.
    flight = np.arange(count)
    for row in range(rows):
        time_s = plan.stamp_s[row][:, None]
        # Sensors measure before the row's command acts.
        body.begin_row(time_s, speed)
        force_b = body.forces(state, speed, time_s, body.wind.end_w)[0]
        last_push_b = pushes[plan.block[row] - 1] if row else np.zeros((count, 3))
        accs[row] = (force_b + last_push_b) / quadrotor.mass
        volts[row] = battery.full_v - body.drop(time_s, speed)[:, 0]
        commands[row], actings[row] = pilot(_rows(row, time_s[:, 0], state))
        for step in range(plan.block[row], plan.block[row + 1]):
            begin, length = plan.start_s[step][:, None], plan.length_s[step][:, None]
            states[step], speeds[step] = state, speed
            # -1 in `acting`: no command has begun to act yet, so the vehicle hovers.
            if is_new[step]:
                rate_b = np.where(plan.is_tick[step][:, None], state[:, RATE], rate_b)
                command_row = plan.acting[step]
                command = np.where(
                    command_row[:, None] >= 0, actings[command_row, flight], hover_command
                )
                speed_cmd = commanded_speeds(nominal, command, rate_b)
            body.wind.step(state[:, VEL], length)
            if push is not None:
                force_b = body.forces(state, speed, begin, body.wind.start_w)[0]
                pushes[step] = push(_rows(row, begin[:, 0], state), force_b, length)
            state, speed = _step(body, state, speed, speed_cmd, begin, length, pushes[step])
    states[steps], speeds[steps] = state, speed
    time_s = np.concatenate([plan.start_s, plan.stamp_s[-1:]])
    return Flown(plan, time_s, states, speeds, pushes, commands, actings, accs, volts)


def _step(
    body: Body, state: np.ndarray, speed: np.ndarray, speed_cmd: np.ndarray, begin: np.ndarray,
    length: np.ndarray, push_b: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return state and rotor speeds after a step of `length` (N, 1) [s] from `begin` (N, 1) [s]."""
    lag, half = body.quadrotor.time_constant, 0.5 * length
    # Rotor speeds and their derivatives at the start, the middle and the end of the step, exactly.
    if lag > 0.0:
        error = speed - speed_cmd
        speeds = [speed, *(speed_cmd + error * np.exp(-passed / lag) for passed in (half, length))]
        spin_ups = [(speed_cmd - each) / lag for each in speeds]
    else:
        # Rotors without lag reach the command within the step, at a constant rate.
        spin_ups = [(speed_cmd - speed) / np.maximum(length, 1e-9)] * 3
        speeds = [speed_cmd] * 3
    start, middle, end = zip(speeds, spin_ups, strict=True)
    # Runge-Kutta of order 4 for the rigid body.
    k1 = body.derivative(state, *start, begin, 0.0, push_b)
    k2 = body.derivative(state + half * k1, *middle, begin + half, 0.5, push_b)
    k3 = body.derivative(state + half * k2, *middle, begin + half, 0.5, push_b)
    k4 = body.derivative(state + length * k3, *end, begin + length, 1.0, push_b)
    state = state + length / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    quat = state[:, QUAT]
    state[:, QUAT] = quat / np.sqrt((quat * quat).sum(axis=1, keepdims=True))
    return state, speeds[-1]


def _rows(number: int, time_s: np.ndarray, state: np.ndarray) -> Rows:
    """Return the states (N, 13) as `Rows`."""
    rot_w = rotation(state[:, QUAT])
    return Rows(number, time_s, state[:, POS], rot_w, state[:, VEL], state[:, RATE])
