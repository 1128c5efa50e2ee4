"""Forces and torques on the N flying bodies of the continuous-time engine, and their motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, Moment, Wind
from suite.blind.continuous.quadrotor import Quadrotor

POS, VEL, QUAT, RATE = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
"""Columns of a state (N, 13): position and velocity in world axes, attitude (quaternion wxyz, body
to world), body rates."""


class Battery(NamedTuple):
    """A battery whose voltage is full - fall t - sag (power / power in hover - 1)."""

    full_v: float
    """Voltage of the full battery in hover [V]."""
    fall_v_per_s: float
    """Decrease of the voltage per second [V/s]."""
    sag_v: float
    """Decrease of the voltage at twice the power of a hover [V]."""


class Body:
    """N flying bodies with their rotors, air and battery."""

    def __init__(
        self, quadrotor: Quadrotor, wind: Wind, battery: Battery, hover_power: np.ndarray
    ) -> None:
        """Prepare for N flights of the vehicle `quadrotor`.

        `hover_power` is the sum of the squared rotor speeds in hover, (N, 1) [rad^2/s^2].
        """
        self.quadrotor, self.wind, self._battery = quadrotor, wind, battery
        self._hover_power = hover_power
        effects = quadrotor.effects
        self._thrusts = [(change, effects[n]) for n, change in THRUSTS.items() if n in effects]
        self._forces = [(force, effects[n]) for n, force in FORCES.items() if n in effects]
        self._torques = [(torque, effects[n]) for n, torque in TORQUES.items() if n in effects]
        self._torque_by_thrust = quadrotor.arm[:, [1, 0, 2]] * [1.0, -1.0, 0.0]
        yaw_coefficient = -quadrotor.spin * quadrotor.torque_coefficient
        self._torque_by_squared_speed = np.outer(yaw_coefficient, [0.0, 0.0, 1.0])
        x, y, z = quadrotor.inertia
        self._gyroscopic = np.array([z - y, x - z, y - x])
        self._first_drop: np.ndarray | None = None

    def begin_row(self, time_s: np.ndarray, speed: np.ndarray) -> None:
        """Store the voltage drop at the first row, which is the first one at time 0 or later.

        The arguments are those of `drop`.
        """
        if self._first_drop is None and (time_s >= 0.0).all():
            self._first_drop = self.drop(time_s, speed)

    def drop(self, time_s: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return how far the voltage is below a full battery's in hover (N, 1) [V].

        `time_s` (N, 1) is since the first row [s], `speed` (N, 4) are rotor speeds [rad/s].
        """
        power = (speed * speed).sum(axis=1, keepdims=True) / self._hover_power
        discharge = self._battery.fall_v_per_s * np.maximum(time_s, 0.0)
        return discharge + self._battery.sag_v * (power - 1.0)

    def forces(
        self, state: np.ndarray, speed: np.ndarray, time_s: np.ndarray, wind_w: np.ndarray,
        spin_up: np.ndarray | float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Return the forces and torques on the bodies.

        Args:
            state: (N, 13) states.
            speed: (N, 4) rotor speeds [rad/s].
            time_s: (N, 1) time since the first row [s].
            wind_w: (N, 3) wind [m/s].
            spin_up: (N, 4) derivative of the rotor speeds [rad/s^2]; only a torque depends on it.

        Returns:
            Force (N, 3) [N] and torque (N, 3) [N m] in body axes, and the rotation matrix
            (N, 3, 3) body to world.
        """
        q = self.quadrotor
        rot_w = rotation(state[:, QUAT])
        air_b = ((state[:, VEL] - wind_w)[:, None] @ rot_w)[:, 0]
        first_drop = self._first_drop
        fallen_v = 0.0 * time_s if first_drop is None else self.drop(time_s, speed) - first_drop
        # Everything that the equations of the effects need.
        moment = Moment(
            q.mass, q.inertia, q.arm, q.spin, state[:, POS], rot_w, air_b,
            state[:, RATE], speed, time_s, fallen_v, spin_up,
        )  # fmt: skip
        squared_speed = speed * speed
        thrust = q.thrust_coefficient * squared_speed
        for change, effect in self._thrusts:
            thrust = change(effect, moment, thrust)
        force_b = thrust.sum(axis=1, keepdims=True) * q.thrust_axis
        torque_b = thrust @ self._torque_by_thrust + squared_speed @ self._torque_by_squared_speed
        for force, effect in self._forces:
            force_b = force_b + force(effect, moment)
        for torque, effect in self._torques:
            torque_b = torque_b + torque(effect, moment)
        return force_b, torque_b, rot_w

    def derivative(
        self, state: np.ndarray, speed: np.ndarray, spin_up: np.ndarray, time_s: np.ndarray,
        share: float, push_b: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return the derivative of the state (N, 13) at a fraction `share` of the present step.

        `push_b` (N, 3) is an additional force in body axes [N]. The other arguments are those of
        `forces`.
        """
        q, wind = self.quadrotor, self.wind
        wind_w = wind.start_w + share * (wind.end_w - wind.start_w)
        force_b, torque_b, rot_w = self.forces(state, speed, time_s, wind_w, spin_up)
        rate_b = state[:, RATE]
        gyroscopic_b = self._gyroscopic * rate_b[:, [1, 2, 0]] * rate_b[:, [2, 0, 1]]
        change = np.empty_like(state)
        change[:, POS] = state[:, VEL]
        change[:, VEL] = (rot_w @ (force_b + push_b)[:, :, None])[:, :, 0] / q.mass + q.gravity_w
        product = (state[:, QUAT] @ _PRODUCT).reshape(-1, 4, 3)
        change[:, QUAT] = 0.5 * (product @ rate_b[:, :, None])[:, :, 0]
        change[:, RATE] = (torque_b - gyroscopic_b) / q.inertia
        return change


def rotation(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (N, 3, 3) of unit quaternions wxyz (N, 4)."""
    products = (quat_wxyz[:, :, None] * quat_wxyz[:, None]).reshape(-1, 16)
    return (products @ _ROTATION).reshape(-1, 3, 3)


def _quadratic(terms: str) -> np.ndarray:
    """Return the coefficients (16,) of the products of two parts of a quaternion.

    `terms` has them as text, such as "+2xy -2wz".
    """
    coefficients = np.zeros((4, 4))
    for sign, factor, first, second in terms.split():
        coefficients["wxyz".index(first), "wxyz".index(second)] += float(sign + factor)
    return coefficients.ravel()


_ROTATION = np.stack(
    [
        *map(_quadratic, ("+1ww +1xx -1yy -1zz", "+2xy -2wz", "+2xz +2wy")),
        *map(_quadratic, ("+2xy +2wz", "+1ww -1xx +1yy -1zz", "+2yz -2wx")),
        *map(_quadratic, ("+2xz -2wy", "+2yz +2wx", "+1ww -1xx -1yy +1zz")),
    ],
    axis=1,
)
"""(16, 9) matrix that gives a rotation matrix, row by row, from the products of two parts of a
quaternion."""
# d(w, x, y, z)/dt = q (0, rate) / 2: a matrix (4, 3) for each part of q.
_PRODUCT = np.array(
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, -1, 0], [0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ],
    dtype=float,
).reshape(4, 12)
"""(4, 12) matrix that gives, from a quaternion, the matrix (4, 3) of its product with (0, rate)."""
