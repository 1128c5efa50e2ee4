"""The vehicle that a fit starts from: effects that are another word for its numbers are in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from eval.vehicles.vehicle import Vehicle

FITTED = ("linear_drag", "blade_flapping", "command_delay", "thrust_scale")
"""Effects that are entries of what is found, and start from where the file has them."""


def with_own_numbers(vehicle: Vehicle, known_motors: bool) -> Vehicle:
    """Return `vehicle` without the effects that scale or replace a number which is fitted.

    It flies as before. Left beside the number that flights tell they would count twice.

    Args:
        vehicle: as it was given.
        known_motors: the motors' own thrust is fitted, and no scale of what was commanded.
    """
    effects = dict(vehicle.effects)
    rotors, motors, inertia = vehicle.rotors, vehicle.motors, np.asarray(vehicle.inertia)
    controller = vehicle.controller
    if lag := effects.pop("motor_lag", None):
        rotors = replace(rotors, time_constant=float(lag.time_constant))
    if scaled := effects.pop("inertia_scale", None):
        inertia = inertia * np.asarray(scaled.scale)
    if gain := effects.pop("rate_gain", None):
        scale = np.asarray(gain.scale) * np.asarray(controller.rate_gain)
        controller = replace(controller, rate_gain=_three(scale))
    if known_motors and (thrust := effects.pop("thrust_scale", None)):
        scale = float(thrust.scale)
        rotors = replace(
            rotors,
            thrust_coefficient=scale * rotors.thrust_coefficient,
        )
        if motors is not None:
            first, second = motors.thrust
            motors = replace(motors, thrust=(scale * first, scale * second))
    return replace(
        vehicle,
        inertia=_three(inertia),
        rotors=rotors,
        motors=motors,
        controller=controller,
        effects=MappingProxyType(effects),
    )


def unknown_to_the_fits(vehicle: Vehicle) -> Sequence[str]:
    """Return the effects of a start that no fit takes into account, and that stay in its file."""
    return [name for name in vehicle.effects if name not in FITTED]


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = np.broadcast_to(values, 3)
    return float(x), float(y), float(z)
