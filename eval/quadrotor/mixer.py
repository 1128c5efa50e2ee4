"""The nominal rate loop (body rates to torque) and mixer (torque to rotor thrusts)."""

from __future__ import annotations

from functools import reduce

import numpy as np

from tracks.common.masks import nowhere
from tracks.geometry.rotation import cross
from tracks.geometry.scene import Array

NEGLIGIBLE = 1e-9
"""Thrusts below this count as rounding errors [N]."""
SAME_SHARE = 1e-9
"""Differences of the rotors' shares of a collective thrust that count as rounding errors."""


def largest(values: Array) -> Array:
    """Return the largest value along the last axis, by pairwise `maximum`.

    The gradient of `max` divides by the number of values that equal the maximum. That number is
    zero if a compiler evaluates the values twice with different rounding. The gradient of `maximum`
    does not divide.
    """
    xp = values.__array_namespace__()
    return reduce(xp.maximum, [values[..., k] for k in range(values.shape[-1])])


def least(values: Array) -> Array:
    """Return the least value along the last axis, by pairwise `minimum` (see `largest`)."""
    xp = values.__array_namespace__()
    return reduce(xp.minimum, [values[..., k] for k in range(values.shape[-1])])


def rate_torque(rate_cmd_b: Array, rate_b: Array, gain: Array, inertia: Array) -> Array:
    """Return the wanted torque J (K (rate_cmd - rate)) + rate x (J rate), (..., 3) [N m].

    Args:
        rate_cmd_b: (..., 3) commanded body rates [rad/s].
        rate_b: (..., 3) body rates [rad/s].
        gain: (..., 3) diagonal of K [1/s].
        inertia: (..., 3) diagonal of the nominal J [kg m^2].
    """
    return inertia * gain * (rate_cmd_b - rate_b) + cross(rate_b, inertia * rate_b)


def mixer_matrix(position_b: Array, spin: Array, torque_per_thrust: float) -> np.ndarray:
    """Return the matrix (4, 4) from rotor thrusts [N] to (force along z, torque about x, y, z).

    Args:
        position_b: (4, 3) positions of the hubs [m].
        spin: (4,) +1 for a rotor turning counter-clockwise seen from above, -1 clockwise.
        torque_per_thrust: k_Q / k_T [m].
    """
    x, y, _ = np.asarray(position_b, dtype=float).T
    return np.stack([np.ones(4), y, -x, -np.asarray(spin, dtype=float) * torque_per_thrust])


def unequal_arms(unmixer: np.ndarray) -> np.ndarray | None:
    """Return the rotors' shares (4,) of a collective thrust; None if they are equal."""
    share = unmixer[:, 0]
    return None if np.ptp(share) < SAME_SHARE else share


def mix(
    unmixer: Array,
    thrust_max: Array,
    force_z: Array,
    torque_b: Array,
    unequal: Array | None = None,
) -> Array:
    """Return the rotor thrusts (..., 4) [N], each in [0, thrust_max].

    If the exact solution is out of range, three steps reduce it. Roll and pitch are scaled down
    together until their spread fits, and with unequal arms until a collective thrust is feasible.
    The collective thrust is clamped to the feasible range. Yaw is scaled down to the remaining
    range. So the direction of thrust has priority over its magnitude, and the magnitude over the
    heading.

    Args:
        unmixer: (4, 4) inverse of `mixer_matrix`.
        thrust_max: largest thrust of one rotor [N].
        force_z: (...,) wanted collective thrust [N].
        torque_b: (..., 3) wanted torque [N m].
        unequal: (4,) from `unequal_arms`.
    """
    xp = torque_b.__array_namespace__()
    per_force, per_yaw = unmixer[:, 0], unmixer[:, 3]
    # Written out, since a matrix product may round a row differently at another batch size.
    roll_pitch = torque_b[..., 0, None] * unmixer[:, 1] + torque_b[..., 1, None] * unmixer[:, 2]
    yaw = torque_b[..., 2, None] * per_yaw
    exact = force_z[..., None] * per_force + roll_pitch + yaw
    beyond = (exact < 0.0) | (exact > thrust_max)
    if nowhere(beyond):
        return exact

    spread = largest(roll_pitch) - least(roll_pitch)
    scale = thrust_max / xp.maximum(spread, thrust_max)
    if unequal is not None:
        # Collective thrust that each rotor needs at least, and from there the range of a rotor.
        need, room = -roll_pitch / unequal, thrust_max / unequal
        span = largest(need)[..., None] - need
        scale = xp.minimum(scale, least(room / xp.maximum(span, room)))
    roll_pitch = roll_pitch * scale[..., None]
    lowest = largest(-roll_pitch / per_force)
    highest = least((thrust_max - roll_pitch) / per_force)
    force = xp.minimum(xp.maximum(force_z, lowest), highest)
    without_yaw = xp.clip(force[..., None] * per_force + roll_pitch, 0.0, thrust_max)
    margin = xp.where(yaw > 0.0, thrust_max - without_yaw, without_yaw)
    yaw_size = xp.abs(yaw)
    # An excess over the margin by rounding is left to the clip below.
    exceeds = yaw_size > xp.maximum(margin, NEGLIGIBLE)
    feasible_share = xp.where(exceeds, margin / xp.where(exceeds, yaw_size, 1.0), 1.0)
    limited = without_yaw + least(feasible_share)[..., None] * yaw
    outside = xp.any(beyond, axis=-1, keepdims=True)
    return xp.where(outside, xp.clip(limited, 0.0, thrust_max), exact)
