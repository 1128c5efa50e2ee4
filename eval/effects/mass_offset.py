"""A heavier or lighter quadrotor than its controller believes."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter


class MassOffset(NamedTuple):
    """Values of `mass_offset`."""

    offset: Array
    """(...,) true mass minus nominal mass [kg]."""


def constants_of(values: MassOffset, constants: Constants) -> Constants:
    """Return the constants with the mass added; the inertia stays."""
    return constants._replace(mass=constants.mass + values.offset)


EFFECT = Effect(
    name="mass_offset",
    summary="Heavier or lighter than nominal",
    equation="m = nominal + offset",
    source="payload, another battery",
    values=MassOffset,
    parameters=(
        Parameter(
            name="offset",
            unit="kg",
            neutral=0.0,
            low=lambda vehicle: -0.5 * vehicle.mass,
            high=lambda vehicle: vehicle.mass,
            typical=(0.04, 0.2),
            signs=(1, -1),
        ),
    ),
    constants=constants_of,
)
