"""The nominal flight controller: torque from body rates, rotor thrusts from torque."""

from __future__ import annotations

from functools import reduce

import numpy as np

from tracks.common.masks import nowhere
from tracks.geometry.rotation import cross
from tracks.geometry.scene import Array

NEGLIGIBLE = 1e-9
"""Thrusts below this are rounding errors [N]."""


def largest(values: Array) -> Array:
    """Return the largest value along the last axis, by pairwise `maximum`.

    The gradient of `max` divides by the number of values that equal it. That number is zero where a
    compiler evaluates them twice with different rounding. `maximum` does not divide.
    """
    xp = values.__array_namespace__()
    return reduce(xp.maximum, [values[..., k] for k in range(values.shape[-1])])


def least(values: Array) -> Array:
    """Return the least value along the last axis, as `largest` does."""
    xp = values.__array_namespace__()
    return reduce(xp.minimum, [values[..., k] for k in range(values.shape[-1])])


def rate_torque(rate_cmd_b: Array, rate_b: Array, gain: Array, inertia: Array) -> Array:
    """Return the wanted torque J (K (rate_cmd - rate)) + rate x (J rate), (..., 3) [N m].

    Args:
        rate_cmd_b: (..., 3) [rad/s].
        rate_b: (..., 3) [rad/s].
        gain: (..., 3) diagonal of K [1/s].
        inertia: (..., 3) diagonal of the nominal J [kg m^2].
    """
    return inertia * gain * (rate_cmd_b - rate_b) + cross(rate_b, inertia * rate_b)


def mixer_matrix(position_b: Array, spin: Array, torque_per_thrust: float) -> np.ndarray:
    """Return the matrix (4, 4) from rotor thrusts [N] to (force along z, torque about x, y, z).

    Args:
        position_b: (4, 3) hubs [m].
        spin: (4,) +1 counter-clockwise seen from above.
        torque_per_thrust: k_Q / k_T [m].
    """
    x, y, _ = np.asarray(position_b, dtype=float).T
    return np.stack([np.ones(4), y, -x, -np.asarray(spin, dtype=float) * torque_per_thrust])


def mix(unmixer: Array, thrust_max: Array, force_z: Array, torque_b: Array) -> Array:
    """Return the rotor thrusts (..., 4) [N], each in [0, thrust_max].

    Where the exact solution is out of range, roll and pitch are scaled down together until their
    spread fits, the collective is clamped to the feasible range, and yaw gets the remaining room.
    The direction of thrust has priority over its size, and its size over the heading.

    Args:
        unmixer: (4, 4) inverse of `mixer_matrix`.
        thrust_max: largest thrust of one rotor [N].
        force_z: (...,) wanted collective [N].
        torque_b: (..., 3) wanted torque [N m].
    """
    xp = torque_b.__array_namespace__()
    per_force, per_yaw = unmixer[:, 0], unmixer[:, 3]
    # Written out: a matrix product may round a row differently at another batch size.
    level = torque_b[..., 0, None] * unmixer[:, 1] + torque_b[..., 1, None] * unmixer[:, 2]
    yaw = torque_b[..., 2, None] * per_yaw
    exact = force_z[..., None] * per_force + level + yaw
    outside = xp.any((exact < 0.0) | (exact > thrust_max), axis=-1, keepdims=True)
    if nowhere(outside):
        return exact

    spread = largest(level) - least(level)
    level = level * (thrust_max / xp.maximum(spread, thrust_max))[..., None]
    lowest = largest(-level / per_force)
    highest = least((thrust_max - level) / per_force)
    force = xp.minimum(xp.maximum(force_z, lowest), highest)
    without_yaw = xp.clip(force[..., None] * per_force + level, 0.0, thrust_max)
    room = xp.where(yaw > 0.0, thrust_max - without_yaw, without_yaw)
    size = xp.abs(yaw)
    # The clip removes what exceeds the room by rounding alone.
    beyond = size > xp.maximum(room, NEGLIGIBLE)
    share = xp.where(beyond, room / xp.where(beyond, size, 1.0), 1.0)
    limited = without_yaw + least(share)[..., None] * yaw
    return xp.where(outside, xp.clip(limited, 0.0, thrust_max), exact)
