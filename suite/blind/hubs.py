"""What RotorPy's rotors bring along: a hub moves as the body turns, and what acts on it resists.

RotorPy's rotor drag and inflow go by each hub's own airspeed `v + w x r`, those of our catalogue by
the body's. At rotor speed `Omega` the difference is an angular damping: a drag `k Omega` in the
rotor plane turns against `w_z` by `k Omega (x^2 + y^2)` a rotor, an inflow along body z against
`w_x` by `k Omega y^2` and against `w_y` by `k Omega x^2`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.vehicles.vehicle import Vehicle

NAME = "angular_damping"
WITHIN = 1.5
"""By this factor what is named may be off what hubs bring at hover: flights are no hover."""


def damping_of_hubs(effects: Sequence[Mapping[str, Any]], vehicle: Vehicle) -> np.ndarray:
    """Return the damping (3,) [1/s] that an answer's `effects` bring along at hover."""
    place = np.asarray(vehicle.rotors.position)
    inertia = np.asarray(vehicle.inertia)
    thrust = vehicle.mass * GRAVITY / len(place)
    speed = np.sqrt(thrust / vehicle.rotors.thrust_coefficient)
    x_sum, y_sum = (place[:, :2] ** 2).sum(axis=0) * speed
    found = np.zeros(3)
    for effect in effects:
        if effect["name"] == "rotor_drag":
            found[2] += effect["parameters"]["coefficient"] * (x_sum + y_sum)
        if effect["name"] == "inflow":
            found[:2] += effect["parameters"]["coefficient"] * np.array([y_sum, x_sum])
    return found / inertia


def is_of_hubs(effect: Mapping[str, Any], damping: np.ndarray) -> bool:
    """Return whether a diagnosis' `effect` is the damping (3,) that hubs bring."""
    if effect["name"] != NAME or effect.get("alternatives") or not damping.any():
        return False
    value = np.asarray(effect["parameters"]["coefficient"]["value"], float)
    most = int(damping.argmax())
    ratio = value[most] / damping[most]
    return bool(1.0 / WITHIN <= ratio <= WITHIN) and int(value.argmax()) in np.flatnonzero(damping)
