"""What acts on a body in flight, and how its state changes with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, Moment, Wind
from suite.blind.continuous.quadrotor import Quadrotor

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


class Body:
    """N flying bodies with the air around them and the battery within, in the present step."""

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
        self._asked: np.ndarray | None = None
        self._jump: np.ndarray | float = 0.0

    @property
    def blowing(self) -> np.ndarray:
        """(N, 3) wind at the start of the present step [m/s]."""
        return self._ends[0]

    def begin_row(self, time_s: np.ndarray, speed: np.ndarray) -> None:
        """Set the wind at the start of a step, and the voltage of the first row."""
        self._ends = self._wind.now_w, self._wind.now_w
        if self._first_drop is None and (time_s >= 0.0).all():
            self._first_drop = self.drop(time_s, speed)

    def blow(self, state: np.ndarray, length_s: np.ndarray) -> None:
        """Advance the wind by a step."""
        if not self._wind.still:
            self._ends = self._wind.step(state[:, VEL], length_s)

    def ask(self, speed: np.ndarray, wanted: np.ndarray, length_s: np.ndarray) -> None:
        """Set the commanded rotor speeds for a step of `length_s` (N, 1) from `speed` (N, 4)."""
        if self.quadrotor.time_constant > 0.0:
            self._asked = wanted
        else:
            # Rotors without lag reach the command within the step.
            self._jump = (wanted - speed) / np.maximum(length_s, 1e-9)

    def spin_up(self, speed: np.ndarray) -> np.ndarray | float:
        """Return the change of the rotor speeds (N, 4) at `speed` (N, 4) [rad/s^2]."""
        if self._asked is None:
            return self._jump
        return (self._asked - speed) / self.quadrotor.time_constant

    def wind_w(self, share: float) -> np.ndarray:
        """Return the wind (N, 3) at a fraction `share` of the present step [m/s]."""
        before, after = self._ends
        return before + share * (after - before)

    def drop(self, time_s: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the voltage drop below a full battery in hover (N, 1) [V]."""
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
                    state[:, RATE], speed, time_s, fallen, self.spin_up(speed))  # fmt: skip
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
        """Return d state / dt (N, 13) at a fraction `share` of the present step."""
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


def rotation(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return body to world (N, 3, 3) of unit quaternions (N, 4)."""
    pairs = (quat_wxyz[:, :, None] * quat_wxyz[:, None]).reshape(-1, 16)
    return (pairs @ _ROTATION).reshape(-1, 3, 3)


def _quadratic(terms: str) -> np.ndarray:
    """Return (16,) what to make of the products of a quaternion's parts, such as "+2xy -2wz"."""
    made = np.zeros((4, 4))
    for sign, factor, first, second in terms.split():
        made["wxyz".index(first), "wxyz".index(second)] += float(sign + factor)
    return made.ravel()


_ROTATION = np.stack(
    [
        *map(_quadratic, ("+1ww +1xx -1yy -1zz", "+2xy -2wz", "+2xz +2wy")),
        *map(_quadratic, ("+2xy +2wz", "+1ww -1xx +1yy -1zz", "+2yz -2wx")),
        *map(_quadratic, ("+2xz -2wy", "+2yz +2wx", "+1ww -1xx -1yy +1zz")),
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
