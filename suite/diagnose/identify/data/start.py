"""The vehicle that a fit starts from: effects that are another word for its numbers are in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import Vehicle
from eval.vehicles.vehicle_check import check_vehicle

OWN = ("motor_lag", "inertia_scale", "rate_gain")
"""Effects that scale or replace a number which is fitted."""
FITTED = ("linear_drag", "blade_flapping", "command_delay", "thrust_scale")
"""Effects that are entries of what is found, and start from where the file has them."""


def with_own_numbers(vehicle: Vehicle, known_motors: bool) -> Vehicle:
    """Return `vehicle` with the numbers that its effects scale or replace, without these.

    It flies as before. Left beside the number that flights tell they would count twice.

    Args:
        vehicle: as it was given.
        known_motors: the motors' own thrust is fitted, and no scale of what was commanded, so that
            the effect of that name is one of these as well.

    Raises:
        ValueError: where no file may hold such numbers, as of rotors that are too weak to hover.
    """
    names = (*OWN, "thrust_scale") if known_motors else OWN
    own = {name: values for name, values in vehicle.effects.items() if name in names}
    if not own:
        return vehicle
    rotors, motors = vehicle.rotors, vehicle.motors
    true = make_plant(vehicle, 1.0 / vehicle.controller.frequency, own).constants
    push = float(true.thrust_coefficient[0])
    if motors is not None:
        first, second = np.asarray(motors.thrust) * (push / rotors.thrust_coefficient)
        motors = replace(motors, thrust=(float(first), float(second)))
    rotors = replace(rotors, thrust_coefficient=push, time_constant=float(true.time_constant))
    found = replace(
        vehicle,
        rotors=rotors,
        motors=motors,
        controller=replace(vehicle.controller, rate_gain=_three(true.rate_gain)),
        effects=MappingProxyType({n: v for n, v in vehicle.effects.items() if n not in own}),
    )
    try:
        # The scale of the inertia may be more than a body can have; the fit makes it possible.
        check_vehicle(found)
    except ValueError as error:
        raise ValueError(f"{vehicle.name} with its {', '.join(own)}: {error}") from error
    return replace(found, inertia=_three(true.inertia))


def unknown_to_the_fits(vehicle: Vehicle) -> Sequence[str]:
    """Return the effects of a start that no fit takes into account, and that stay in its file."""
    return [name for name in vehicle.effects if name not in (*OWN, *FITTED)]


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)
