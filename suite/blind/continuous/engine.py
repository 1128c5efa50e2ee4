"""The engine: rigid body, rotors and air in continuous time, by Runge-Kutta of order four.

Between two events the rotors' commanded speeds are constant, so their lag is solved exactly; the
rigid body is integrated over steps that end at every event.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from suite.blind.continuous.air import Wind
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery, Body, rotation
from suite.blind.continuous.quadrotor import GRAVITY, Quadrotor, wanted_speeds
from suite.blind.continuous.timing import Schedule


class Rows(NamedTuple):
    """N flights at one row."""

    number: int
    """Number of the row."""
    time_s: np.ndarray
    """(N,) [s]."""
    pos_w: np.ndarray
    """(N, 3) [m]."""
    rot_w: np.ndarray
    """(N, 3, 3) body to world."""
    vel_w: np.ndarray
    """(N, 3) [m/s]."""
    rate_b: np.ndarray
    """(N, 3) [rad/s]."""


class Flown(NamedTuple):
    """N flights: at S + 1 ends of steps, and at R rows before their commands act."""

    schedule: Schedule
    time_s: np.ndarray
    """(S + 1, N) [s]."""
    state: np.ndarray
    """(S + 1, N, 13)."""
    speed: np.ndarray
    """(S + 1, N, 4) of the rotors [rad/s]."""
    push_b: np.ndarray
    """(S, N, 3) additional force in each step, body axes [N]."""
    command: np.ndarray
    """(R, N, 4) logged commands: thrust [m/s^2], body rates [rad/s]."""
    acting: np.ndarray
    """(R, N, 4) commands that act, before their delay."""
    acc_b: np.ndarray
    """(R, N, 3) specific force [m/s^2]."""
    voltage: np.ndarray
    """(R, N) [V]."""


Pilot = Callable[[Rows], tuple[np.ndarray, np.ndarray]]
"""(row) -> the logged command (N, 4) and the command that acts (N, 4)."""
Push = Callable[[Rows, np.ndarray, np.ndarray], np.ndarray]
"""Additional physics: (state at the start of a step, force_b (N, 3), length (N, 1)) -> force (N, 3)
that is added during the step, body axes [N]."""


def fly(
    quadrotor: Quadrotor,
    plan: Schedule,
    start: np.ndarray,
    pilot: Pilot,
    rng: np.random.Generator,
    battery: Battery,
    push: Push | None = None,
) -> Flown:
    """Fly N flights from the states `start` (N, 13), rotors at their hovering speed.

    Args:
        quadrotor: the true vehicle.
        plan: rows and steps.
        start: states at the first row.
        pilot: returns the command of each row.
        rng: of gusts.
        battery: its voltage.
        push: additional physics.
    """
    count, steps, rows = len(start), len(plan.start_s), len(plan.stamp_s) - 1
    believed = quadrotor.believed
    hovering = np.tile([GRAVITY, 0.0, 0.0, 0.0], (count, 1))
    state, rate_b = start.copy(), start[:, RATE].copy()
    wanted = wanted_speeds(believed, hovering, rate_b)
    speed, hover_power = wanted, (wanted**2).sum(axis=1, keepdims=True)
    body = Body(quadrotor, Wind(quadrotor.effects, count, rng), battery, hover_power)
    states, speeds = np.empty((steps + 1, count, 13)), np.empty((steps + 1, count, 4))
    pushes = np.zeros((steps, count, 3))
    commands, actings = np.empty((rows, count, 4)), np.empty((rows, count, 4))
    accs, volts = np.empty((rows, count, 3)), np.empty((rows, count))
    refresh = np.any(plan.is_tick, axis=1)
    refresh[1:] |= np.any(plan.acting[1:] != plan.acting[:-1], axis=1)
    flight = np.arange(count)
    for row in range(rows):
        now = plan.stamp_s[row][:, None]
        seen = _rows(row, now[:, 0], state)
        # Before the row's command acts, like a sensor.
        body.begin_row(now, speed)
        force_b = body.forces(state, speed, now, body.blowing)[0]
        pushed_b = pushes[plan.block[row] - 1] if row else np.zeros((count, 3))
        accs[row] = (force_b + pushed_b) / quadrotor.mass
        volts[row] = battery.full_v - body.drop(now, speed)[:, 0]
        commands[row], actings[row] = pilot(seen)
        for step in range(plan.block[row], plan.block[row + 1]):
            begin, length = plan.start_s[step][:, None], plan.length_s[step][:, None]
            states[step], speeds[step] = state, speed
            if refresh[step]:
                rate_b = np.where(plan.is_tick[step][:, None], state[:, RATE], rate_b)
                late = plan.acting[step]
                held = np.where(late[:, None] >= 0, actings[late, flight], hovering)
                wanted = wanted_speeds(believed, held, rate_b)
            body.blow(state, length)
            if push is not None:
                force_b = body.forces(state, speed, begin, body.blowing)[0]
                pushes[step] = push(_rows(row, begin[:, 0], state), force_b, length)
            state, speed = _step(body, state, speed, wanted, begin, length, pushes[step])
    states[steps], speeds[steps] = state, speed
    time_s = np.concatenate([plan.start_s, plan.stamp_s[-1:]])
    return Flown(plan, time_s, states, speeds, pushes, commands, actings, accs, volts)


def _step(
    body: Body, state: np.ndarray, speed: np.ndarray, wanted: np.ndarray, begin: np.ndarray,
    length: np.ndarray, push_b: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return state and rotor speeds after a step of `length` (N, 1) [s] from `begin` (N, 1) [s]."""
    lag = body.quadrotor.time_constant
    body.ask(speed, wanted, length)
    half = 0.5 * length
    if lag > 0.0:
        behind = speed - wanted
        middle = wanted + behind * np.exp(-half / lag)
        last = wanted + behind * np.exp(-length / lag)
    else:
        speed = middle = last = wanted
    one = body.derivative(state, speed, begin, 0.0, push_b)
    two = body.derivative(state + half * one, middle, begin + half, 0.5, push_b)
    three = body.derivative(state + half * two, middle, begin + half, 0.5, push_b)
    four = body.derivative(state + length * three, last, begin + length, 1.0, push_b)
    state = state + length / 6.0 * (one + 2.0 * (two + three) + four)
    quat = state[:, QUAT]
    state[:, QUAT] = quat / np.sqrt((quat * quat).sum(axis=1, keepdims=True))
    return state, last


def _rows(number: int, time_s: np.ndarray, state: np.ndarray) -> Rows:
    rot_w = rotation(state[:, QUAT])
    return Rows(number, time_s, state[:, POS], rot_w, state[:, VEL], state[:, RATE])
