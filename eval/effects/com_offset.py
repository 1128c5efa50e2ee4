"""A centre of mass that is not where the controller believes it."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter


class ComOffset(NamedTuple):
    """Values of `com_offset`."""

    offset: Array
    """(..., 3) true centre of mass from the nominal one, body axes [m]."""


def constants_of(values: ComOffset, constants: Constants) -> Constants:
    """Return the constants with the rotors measured from the true centre of mass.

    Positions in logs and in the world refer to the true centre of mass, and so does the inertia.
    """
    return constants._replace(
        com_offset_b=constants.com_offset_b + values.offset,
        rotor_position_b=constants.rotor_position_b - values.offset[..., None, :],
    )


EFFECT = Effect(
    name="com_offset",
    summary="The centre of mass lies off the nominal one",
    equation="rotor arms become r_i - d",
    source="battery position",
    values=ComOffset,
    parameters=(
        Parameter(
            name="offset",
            unit="m",
            neutral=0.0,
            low=-0.05,
            high=0.05,
            typical=(0.002, 0.01),
            size=3,
            unseen=(2,),
            direction=(0.6, 0.8, 0.0),
        ),
    ),
    constants=constants_of,
)
