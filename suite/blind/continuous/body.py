"""Forces and torques on a flying body, and the derivative of its state.

This is a part of the continuous-time engine, which shares no code with the model of the diagnosis.
In the shapes, N is the number of flights, which are computed together.
"""

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
    """N flying bodies with their rotors, air and battery, during one step."""

    def __init__(
        self, quadrotor: Quadrotor, wind: Wind, battery: Battery, hover_power: np.ndarray
    ) -> None:
        """Prepare for N flights.

        Args:
            quadrotor: constants of the vehicle that flies.
            wind: the moving air.
            battery: constants of the battery.
            hover_power: (N, 1) sum of the squared rotor speeds in hover [rad^2/s^2].
        """
        self.quadrotor, self._wind, self._battery = quadrotor, wind, battery
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
        self._wind_at_ends_w = wind.now_w, wind.now_w
        self._first_drop: np.ndarray | None = None
        self._speed_cmd: np.ndarray | None = None
        self._spin_up: np.ndarray | float = 0.0

    @property
    def wind_at_start_w(self) -> np.ndarray:
        """(N, 3) wind at the start of the present step [m/s]."""
        return self._wind_at_ends_w[0]

    def begin_row(self, time_s: np.ndarray, speed: np.ndarray) -> None:
        """Set the wind at a row of the log, and store the voltage drop of the first row.

        The first row is the first one at a time of 0 or later.

        Args:
            time_s: (N, 1) time of the row [s].
            speed: (N, 4) rotor speeds [rad/s].
        """
        self._wind_at_ends_w = self._wind.now_w, self._wind.now_w
        if self._first_drop is None and (time_s >= 0.0).all():
            self._first_drop = self.drop(time_s, speed)

    def advance_wind(self, state: np.ndarray, length_s: np.ndarray) -> None:
        """Advance the wind by a step of `length_s` (N, 1) [s] from `state` (N, 13)."""
        if not self._wind.still:
            self._wind_at_ends_w = self._wind.step(state[:, VEL], length_s)

    def set_command(self, speed: np.ndarray, speed_cmd: np.ndarray, length_s: np.ndarray) -> None:
        """Set the commanded rotor speeds of a step.

        Args:
            speed: (N, 4) rotor speeds at the start of the step [rad/s].
            speed_cmd: (N, 4) commanded rotor speeds [rad/s].
            length_s: (N, 1) length of the step [s].
        """
        if self.quadrotor.time_constant > 0.0:
            self._speed_cmd = speed_cmd
        else:
            # Rotors without lag reach the command within the step, at a constant rate.
            self._spin_up = (speed_cmd - speed) / np.maximum(length_s, 1e-9)

    def spin_up(self, speed: np.ndarray) -> np.ndarray | float:
        """Return the derivative of the rotor speeds (N, 4) at `speed` (N, 4) [rad/s^2]."""
        if self._speed_cmd is None:
            return self._spin_up
        return (self._speed_cmd - speed) / self.quadrotor.time_constant

    def wind_w(self, share: float) -> np.ndarray:
        """Return the wind (N, 3) at a fraction `share` (0 to 1) of the present step [m/s]."""
        before, after = self._wind_at_ends_w
        return before + share * (after - before)

    def drop(self, time_s: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return how far the voltage is below that of a full battery in hover (N, 1) [V].

        Args:
            time_s: (N, 1) time since the first row [s].
            speed: (N, 4) rotor speeds [rad/s].
        """
        power = (speed * speed).sum(axis=1, keepdims=True) / self._hover_power
        discharge = self._battery.fall_v_per_s * np.maximum(time_s, 0.0)
        return discharge + self._battery.sag_v * (power - 1.0)

    def forces(
        self, state: np.ndarray, speed: np.ndarray, time_s: np.ndarray, wind_w: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the forces and torques on the bodies.

        Args:
            state: (N, 13) states.
            speed: (N, 4) rotor speeds [rad/s].
            time_s: (N, 1) time since the first row [s].
            wind_w: (N, 3) wind [m/s].

        Returns:
            Force (N, 3) [N] and torque (N, 3) [N m] in body axes, and the rotation matrix
            (N, 3, 3) body to world.
        """
        q = self.quadrotor
        rot_w = rotation(state[:, QUAT])
        air_b = ((state[:, VEL] - wind_w)[:, None] @ rot_w)[:, 0]
        if self._first_drop is None:
            drop_since_start = np.zeros_like(time_s)
        else:
            drop_since_start = self.drop(time_s, speed) - self._first_drop
        # Everything that the equations of the effects need.
        moment = Moment(
            q.mass, q.inertia, q.arm, q.spin, state[:, POS], rot_w, air_b,
            state[:, RATE], speed, time_s, drop_since_start, self.spin_up(speed),
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
        self, state: np.ndarray, speed: np.ndarray, time_s: np.ndarray, share: float,
        push_b: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return the derivative of the state (N, 13) at a fraction `share` of the present step.

        `push_b` (N, 3) is an additional force in body axes [N]. The other arguments are those of
        `forces`.
        """
        q = self.quadrotor
        force_b, torque_b, rot_w = self.forces(state, speed, time_s, self.wind_w(share))
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
