"""Rotors that push more or less than their nominal thrust curve; the controller does not know."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter, per_axis


class ThrustScale(NamedTuple):
    """Values of `thrust_scale`."""

    scale: Array
    """(...,) true k_T over nominal k_T [1]."""


def constants_of(values: ThrustScale, constants: Constants) -> Constants:
    """Return the constants with k_T scaled; k_Q stays."""
    return constants._replace(
        thrust_coefficient=constants.thrust_coefficient * per_axis(values.scale)
    )


EFFECT = Effect(
    name="thrust_scale",
    summary="Thrust stronger or weaker than nominal",
    equation="k_T = scale x nominal, k_Q unchanged",
    source="thrust curve off by a factor",
    values=ThrustScale,
    parameters=(
        Parameter(
            name="scale",
            unit="1",
            neutral=1.0,
            low=0.3,
            high=2.0,
            typical=(0.05, 0.15),
            signs=(-1, 1),
        ),
    ),
    constants=constants_of,
)
