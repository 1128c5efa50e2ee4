"""Body rates to torque: what the flight controller does at every physics step."""

from __future__ import annotations

from tracks.geometry.rotation import cross
from tracks.geometry.scene import Array


def rate_torque(rate_cmd_b: Array, rate_b: Array, gain: Array, inertia: Array) -> Array:
    """Return the torque wanted, J (K (rate_cmd - rate)) + rate x (J rate), (..., 3) [N m].

    Args:
        rate_cmd_b: (..., 3) [rad/s].
        rate_b: (..., 3) [rad/s].
        gain: (..., 3) diagonal of K [1/s].
        inertia: (..., 3) diagonal of J as the controller believes it [kg m^2].
    """
    return inertia * gain * (rate_cmd_b - rate_b) + cross(rate_b, inertia * rate_b)
