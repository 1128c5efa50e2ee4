"""Effects on thrust, force and torque in the continuous-time engine, and the wind.

Each effect follows its equation in the catalogue of effects, but shares no code with it. A `Moment`
has the inputs of the equations, for N flights. The effects in `THRUSTS` change the thrusts of the
rotors in this order: first additions to a thrust, then factors. The wind is steady, with gusts that
are first-order coloured noise. In the equations, e3 is the body axis z, and x a cross product.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Moment(NamedTuple):
    """The states of N flights at one time, and their true constants."""

    mass: float
    """True mass [kg]."""
    inertia: np.ndarray
    """(3,) true inertia [kg m^2]."""
    arm: np.ndarray
    """(4, 3) positions of the rotors from the true centre of mass, body axes [m]."""
    spin: np.ndarray
    """(4,) directions of rotation s_i, 1 or -1."""
    pos_w: np.ndarray
    """(N, 3) position [m]."""
    rot_w: np.ndarray
    """(N, 3, 3) attitude, body to world."""
    air_b: np.ndarray
    """(N, 3) velocity relative to the air, v_b in the equations, body axes [m/s]."""
    rate_b: np.ndarray
    """(N, 3) body rates w [rad/s]."""
    speed: np.ndarray
    """(N, 4) rotor speeds Omega_i [rad/s]."""
    time_s: np.ndarray
    """(N, 1) time since the first row [s]."""
    fallen_v: np.ndarray
    """(N, 1) voltage of the first row minus the present one [V]."""
    spin_up: np.ndarray | float = 0.0
    """(N, 4) derivative of the rotor speeds [rad/s^2]."""


Force = Callable[[Any, Moment], np.ndarray]
"""Function (values of an effect, moment) -> force [N] or torque [N m], (N, 3) in body axes."""
Thrust = Callable[[Any, Moment, np.ndarray], np.ndarray]
"""Function (values of an effect, moment, thrusts (N, 4) [N]) -> changed thrusts."""

GROUND_CAP = 1.5
"""Largest factor by which the ground effect increases a thrust."""
GROUND_HEIGHT = 1e-3
"""Least height of a rotor in the equation of the ground effect [m]."""


def _inflow(effect: Any, at: Moment, thrust: np.ndarray) -> np.ndarray:
    """Rotor thrust += -k Omega_i v_b.e3."""
    return thrust - effect.coefficient * at.speed * at.air_b[:, 2:]


def _ground_effect(effect: Any, at: Moment, thrust: np.ndarray) -> np.ndarray:
    """Rotor thrust times 1 / (1 - g (r / 4 z_i)^2), at most 1.5; z_i is the rotor's height."""
    height = at.pos_w[:, 2:] + at.rot_w[:, 2] @ at.arm.T
    ratio = effect.rotor_radius / (4.0 * np.maximum(height, GROUND_HEIGHT))
    share = effect.strength * ratio**2
    # From a share of 1 on the formula is not valid; the cap acts below it.
    return thrust / (1.0 - np.minimum(share, 1.0 - 1.0 / GROUND_CAP))


def _battery_sag(effect: Any, at: Moment, thrust: np.ndarray) -> np.ndarray:
    """Thrust scale 1 - rate t, or 1 - a (V0 - V); a case has one of the two."""
    lost = effect.rate * np.maximum(at.time_s, 0.0) + effect.per_volt * at.fallen_v
    return thrust * np.maximum(1.0 - lost, 0.0)


def _linear_drag(effect: Any, at: Moment) -> np.ndarray:
    """F_b += -m D v_b."""
    return -at.mass * np.multiply(effect.coefficient, at.air_b)


def _quadratic_drag(effect: Any, at: Moment) -> np.ndarray:
    """F_b += -m C |v_b| v_b."""
    airspeed = np.sqrt((at.air_b * at.air_b).sum(axis=1, keepdims=True))
    return -at.mass * np.multiply(effect.coefficient, airspeed * at.air_b)


def _rotor_drag(effect: Any, at: Moment) -> np.ndarray:
    """F_b += -k (sum Omega_i) (v_b - (v_b.e3) e3)."""
    speed_sum = at.speed.sum(axis=1, keepdims=True)
    return -effect.coefficient * speed_sum * at.air_b * [1.0, 1.0, 0.0]


def _translational_lift(effect: Any, at: Moment) -> np.ndarray:
    """F_b += m k (v_bx^2 + v_by^2) e3."""
    squared_airspeed = at.air_b[:, :1] ** 2 + at.air_b[:, 1:2] ** 2
    return at.mass * effect.coefficient * squared_airspeed * [0.0, 0.0, 1.0]


def _blade_flapping(effect: Any, at: Moment) -> np.ndarray:
    """tau_b += k (sum Omega_i) (v_b x e3)."""
    speed_sum = at.speed.sum(axis=1, keepdims=True)
    return effect.coefficient * speed_sum * _cross_e3(at.air_b)


def _torque_trim(effect: Any, at: Moment) -> np.ndarray:
    """tau_b += a constant torque."""
    return np.broadcast_to(np.asarray(effect.torque, dtype=float), at.rate_b.shape)


def _rotor_gyroscopic(effect: Any, at: Moment) -> np.ndarray:
    """tau_b += -J_r (sum s_i Omega_i) (w x e3)."""
    net = (at.speed * at.spin).sum(axis=1, keepdims=True)
    return -effect.rotor_inertia * net * _cross_e3(at.rate_b)


def _rotor_spin_up(effect: Any, at: Moment) -> np.ndarray:
    """tau_b += -J_r (sum s_i dOmega_i/dt) e3."""
    net = (at.spin_up * at.spin * np.ones_like(at.speed)).sum(axis=1, keepdims=True)
    return -effect.rotor_inertia * net * [0.0, 0.0, 1.0]


def _angular_damping(effect: Any, at: Moment) -> np.ndarray:
    """tau_b += -J d w."""
    return -at.inertia * np.multiply(effect.coefficient, at.rate_b)


def _cross_e3(vector: np.ndarray) -> np.ndarray:
    """Return vector x e3 (N, 3)."""
    return vector[:, [1, 0, 2]] * [1.0, -1.0, 0.0]


THRUSTS: dict[str, Thrust] = {
    "inflow": _inflow,
    "ground_effect": _ground_effect,
    "battery_sag": _battery_sag,
}
"""Effect -> function that changes the thrusts (N, 4) [N]."""
FORCES: dict[str, Force] = {
    "linear_drag": _linear_drag,
    "quadratic_drag": _quadratic_drag,
    "rotor_drag": _rotor_drag,
    "translational_lift": _translational_lift,
}
"""Effect -> function that returns the force on the centre of mass (N, 3), body axes [N]."""
TORQUES: dict[str, Force] = {
    "blade_flapping": _blade_flapping,
    "torque_trim": _torque_trim,
    "rotor_gyroscopic": _rotor_gyroscopic,
    "rotor_spin_up": _rotor_spin_up,
    "angular_damping": _angular_damping,
}
"""Effect -> function that returns the torque (N, 3), body axes [N m]."""
WINDS = ("constant_wind", "gusts")
"""Effects that move the air."""
VERTICAL_SHARE = 0.5
"""Intensity of vertical gusts divided by that of horizontal ones."""
MIN_AIRSPEED = 1.0
"""Least airspeed in the formula for the correlation time of gusts [m/s]."""


class Wind:
    """Wind on N flights, computed at both ends of each step and linear between them."""

    def __init__(self, effects: dict[str, Any], count: int, rng: np.random.Generator) -> None:
        """Prepare for `count` flights; gusts start from their stationary distribution."""
        steady = effects["constant_wind"].velocity if "constant_wind" in effects else (0.0,) * 3
        self._steady_w = np.asarray(steady, dtype=float)
        self._gusts, self._rng = effects.get("gusts"), rng
        self._gust_w = np.zeros((count, 3))
        if self._gusts is not None:
            # Standard deviations along the world axes [m/s].
            self._intensity = float(self._gusts.intensity) * np.array([1.0, 1.0, VERTICAL_SHARE])
            self._gust_w = self._intensity * rng.standard_normal((count, 3))
        self.start_w = self.end_w = self._steady_w + self._gust_w
        """(N, 3) wind at the start and at the end of the present step [m/s]."""

    def step(self, vel_w: np.ndarray, length_s: np.ndarray) -> None:
        """Advance the wind by a step.

        Gusts follow dw/dt = -w / tau + noise with tau = length / max(airspeed, 1), solved exactly
        for a tau that is constant in the step.

        Args:
            vel_w: (N, 3) velocities of the vehicles [m/s].
            length_s: (N, 1) length of the step [s].
        """
        if self._gusts is not None:
            air_w = vel_w - self._steady_w
            airspeed = np.sqrt((air_w * air_w).sum(axis=1, keepdims=True))
            rate = np.maximum(airspeed, MIN_AIRSPEED) / float(self._gusts.length)
            decay = np.exp(-length_s * rate)
            noise = self._intensity * self._rng.standard_normal(self._gust_w.shape)
            self._gust_w = decay * self._gust_w + np.sqrt(1.0 - decay**2) * noise
        self.start_w, self.end_w = self.end_w, self._steady_w + self._gust_w
