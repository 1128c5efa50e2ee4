"""The engine: rigid body, rotors and air in continuous time, by Runge-Kutta of order four.

Between two events the rotors' commanded speeds are constant, so their lag is solved exactly; the
rigid body is integrated over steps that end at every event.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, Moment
from suite.blind.continuous.controller import wanted_speeds
from suite.blind.continuous.quadrotor import GRAVITY, Quadrotor
from suite.blind.continuous.timing import Schedule
from suite.blind.continuous.wind import Wind

POS, VEL, QUAT, RATE = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
"""Parts of a state (N, 13): position and velocity in the world, body to world, body rates."""


class Battery(NamedTuple):
    """Voltage: full - fall t - sag (power / power in a hover - 1)."""

    full_v: float
    """[V]."""
    fall_v_per_s: float
    """[V/s]."""
    sag_v: float
    """[V]."""


class Rows(NamedTuple):
    """N flights at one row."""

    number: int
    """Of the row."""
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
    """(S, N, 3) force of physics from outside in each step, body axes [N]."""
    command: np.ndarray
    """(R, N, 4) as the pilot gave it: thrust [m/s^2], body rates [rad/s]."""
    acting: np.ndarray
    """(R, N, 4) what acted of it, before its delay."""
    acc_b: np.ndarray
    """(R, N, 3) specific force [m/s^2]."""
    voltage: np.ndarray
    """(R, N) [V]."""


Pilot = Callable[[Rows], tuple[np.ndarray, np.ndarray]]
"""Rows to the command (N, 4) that is logged and the one that acts."""
Push = Callable[[Rows, np.ndarray, np.ndarray], np.ndarray]
"""Physics from outside: (state at the start of a step, force_b (N, 3), length (N, 1)) to the force
(N, 3) that is added during the step, body axes [N]."""


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
        quadrotor: what flies.
        plan: when.
        start: states at the first row.
        pilot: gives the command of each row.
        rng: of gusts.
        battery: its voltage.
        push: physics besides.
    """
    count, steps, rows = len(start), len(plan.start_s), len(plan.stamp_s) - 1
    believed = quadrotor.believed
    hovering = np.tile([GRAVITY, 0.0, 0.0, 0.0], (count, 1))
    state, rate_b = start.copy(), start[:, RATE].copy()
    wanted = wanted_speeds(believed, hovering, rate_b)
    speed, hover_power = wanted, (wanted**2).sum(axis=1, keepdims=True)
    air = Air(quadrotor, Wind(quadrotor.effects, count, rng), battery, hover_power)
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
        # Before the row's command acts, as a sensor would have it.
        air.begin_row(now, speed)
        accs[row] = air.forces(state, speed, now, air.blowing)[0] / quadrotor.mass
        volts[row] = battery.full_v - air.drop(now, speed)[:, 0]
        commands[row], actings[row] = pilot(seen)
        for step in range(plan.block[row], plan.block[row + 1]):
            begin, length = plan.start_s[step][:, None], plan.length_s[step][:, None]
            states[step], speeds[step] = state, speed
            if refresh[step]:
                rate_b = np.where(plan.is_tick[step][:, None], state[:, RATE], rate_b)
                late = plan.acting[step]
                held = np.where(late[:, None] >= 0, actings[late, flight], hovering)
                wanted = wanted_speeds(believed, held, rate_b)
            air.blow(state, length)
            if push is not None:
                force_b = air.forces(state, speed, begin, air.blowing)[0]
                pushes[step] = push(_rows(row, begin[:, 0], state), force_b, length)
            state, speed = _step(air, state, speed, wanted, begin, length, pushes[step])
    states[steps], speeds[steps] = state, speed
    time_s = np.concatenate([plan.start_s, plan.stamp_s[-1:]])
    return Flown(plan, time_s, states, speeds, pushes, commands, actings, accs, volts)


class Air:
    """What acts on the body, with the wind of the present step."""

    def __init__(
        self, quadrotor: Quadrotor, wind: Wind, battery: Battery, hover_power: np.ndarray
    ) -> None:
        """Prepare for N flights; `hover_power` (N, 1) is the sum of squared speeds of a hover."""
        self.quadrotor, self._wind, self._battery = quadrotor, wind, battery
        self._hover_power = hover_power
        effects = quadrotor.effects
        self._thrusts = [(change, effects[n]) for n, change in THRUSTS.items() if n in effects]
        self._forces = [(force, effects[n]) for n, force in FORCES.items() if n in effects]
        self._torques = [(torque, effects[n]) for n, torque in TORQUES.items() if n in effects]
        self._lever = quadrotor.arm[:, [1, 0, 2]] * [1.0, -1.0, 0.0]
        self._about_z = np.outer(-quadrotor.spin * quadrotor.torque_coefficient, [0.0, 0.0, 1.0])
        x, y, z = quadrotor.inertia
        self._gyroscopic = np.array([z - y, x - z, y - x])
        self._ends = wind.now_w, wind.now_w
        self._first_drop: np.ndarray | None = None

    @property
    def blowing(self) -> np.ndarray:
        """(N, 3) wind at the start of the present step [m/s]."""
        return self._ends[0]

    def begin_row(self, time_s: np.ndarray, speed: np.ndarray) -> None:
        """Note how fast the air is now, and the voltage of the first row."""
        self._ends = self._wind.now_w, self._wind.now_w
        if self._first_drop is None and (time_s >= 0.0).all():
            self._first_drop = self.drop(time_s, speed)

    def blow(self, state: np.ndarray, length_s: np.ndarray) -> None:
        """Move the air on by a step."""
        if not self._wind.still:
            self._ends = self._wind.step(state[:, VEL], length_s)

    def wind_w(self, share: float) -> np.ndarray:
        """Return the wind (N, 3) at `share` of the present step [m/s]."""
        before, after = self._ends
        return before + share * (after - before)

    def drop(self, time_s: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return how far the voltage is below that of a full battery in a hover (N, 1) [V]."""
        power = (speed * speed).sum(axis=1, keepdims=True) / self._hover_power
        fallen = self._battery.fall_v_per_s * np.maximum(time_s, 0.0)
        return fallen + self._battery.sag_v * (power - 1.0)

    def forces(
        self, state: np.ndarray, speed: np.ndarray, time_s: np.ndarray, wind_w: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return force (N, 3) [N] and torque (N, 3) [N m] in body axes, and body to world."""
        q = self.quadrotor
        rot_w = rotation(state[:, QUAT])
        air_b = ((state[:, VEL] - wind_w)[:, None] @ rot_w)[:, 0]
        none = self._first_drop is None
        fallen = np.zeros_like(time_s) if none else self.drop(time_s, speed) - self._first_drop
        at = Moment(q.mass, q.inertia, q.arm, q.spin, state[:, POS], rot_w, air_b,
                    state[:, RATE], speed, time_s, fallen)  # fmt: skip
        squared = speed * speed
        thrust = q.thrust_coefficient * squared
        for change, effect in self._thrusts:
            thrust = change(effect, at, thrust)
        force_b = thrust.sum(axis=1, keepdims=True) * q.thrust_axis
        torque_b = thrust @ self._lever + squared @ self._about_z
        for push, effect in self._forces:
            force_b = force_b + push(effect, at)
        for twist, effect in self._torques:
            torque_b = torque_b + twist(effect, at)
        return force_b, torque_b, rot_w

    def derivative(
        self, state: np.ndarray, speed: np.ndarray, time_s: np.ndarray, share: float,
        push_b: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return d state / dt (N, 13); `share` is that of the present step."""
        q = self.quadrotor
        force_b, torque_b, rot_w = self.forces(state, speed, time_s, self.wind_w(share))
        rate_b = state[:, RATE]
        turning = self._gyroscopic * rate_b[:, [1, 2, 0]] * rate_b[:, [2, 0, 1]]
        change = np.empty_like(state)
        change[:, POS] = state[:, VEL]
        change[:, VEL] = (rot_w @ (force_b + push_b)[:, :, None])[:, :, 0] / q.mass + q.gravity_w
        product = (state[:, QUAT] @ _PRODUCT).reshape(-1, 4, 3)
        change[:, QUAT] = 0.5 * (product @ rate_b[:, :, None])[:, :, 0]
        change[:, RATE] = (torque_b - turning) / q.inertia
        return change


def _step(
    air: Air, state: np.ndarray, speed: np.ndarray, wanted: np.ndarray, begin: np.ndarray,
    length: np.ndarray, push_b: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return state and rotor speeds after a step of `length` (N, 1) [s] from `begin` (N, 1) [s]."""
    lag = air.quadrotor.time_constant
    half = 0.5 * length
    if lag > 0.0:
        behind = speed - wanted
        middle = wanted + behind * np.exp(-half / lag)
        last = wanted + behind * np.exp(-length / lag)
    else:
        speed = middle = last = wanted
    one = air.derivative(state, speed, begin, 0.0, push_b)
    two = air.derivative(state + half * one, middle, begin + half, 0.5, push_b)
    three = air.derivative(state + half * two, middle, begin + half, 0.5, push_b)
    four = air.derivative(state + length * three, last, begin + length, 1.0, push_b)
    state = state + length / 6.0 * (one + 2.0 * (two + three) + four)
    quat = state[:, QUAT]
    state[:, QUAT] = quat / np.sqrt((quat * quat).sum(axis=1, keepdims=True))
    return state, last


def _rows(number: int, time_s: np.ndarray, state: np.ndarray) -> Rows:
    rot_w = rotation(state[:, QUAT])
    return Rows(number, time_s, state[:, POS], rot_w, state[:, VEL], state[:, RATE])


def rotation(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return body to world (N, 3, 3) of unit quaternions (N, 4)."""
    pairs = (quat_wxyz[:, :, None] * quat_wxyz[:, None]).reshape(-1, 16)
    return (pairs @ _ROTATION).reshape(-1, 3, 3)


def _quadratic(*terms: tuple[float, str]) -> np.ndarray:
    """Return (16,) what to make of the products of a quaternion's parts, such as (2, "xy")."""
    made = np.zeros((4, 4))
    for factor, (first, second) in terms:
        made["wxyz".index(first), "wxyz".index(second)] += factor
    return made.ravel()


_ROTATION = np.stack(
    [
        _quadratic((1, "ww"), (1, "xx"), (-1, "yy"), (-1, "zz")),
        _quadratic((2, "xy"), (-2, "wz")),
        _quadratic((2, "xz"), (2, "wy")),
        _quadratic((2, "xy"), (2, "wz")),
        _quadratic((1, "ww"), (-1, "xx"), (1, "yy"), (-1, "zz")),
        _quadratic((2, "yz"), (-2, "wx")),
        _quadratic((2, "xz"), (-2, "wy")),
        _quadratic((2, "yz"), (2, "wx")),
        _quadratic((1, "ww"), (-1, "xx"), (-1, "yy"), (1, "zz")),
    ],
    axis=1,
)
"""(16, 9) from products of a quaternion's parts to the rows of its rotation matrix."""
# d(w, x, y, z)/dt = q (0, rate) / 2, by rows of (4, 3) for each part of q.
_PRODUCT = np.array(
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, -1, 0], [0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ],
    dtype=float,
).reshape(4, 12)
"""(4, 12) from a quaternion to the matrix (4, 3) of its product with (0, rate)."""
