"""Moments of inertia that are not what the controller believes."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter


class InertiaScale(NamedTuple):
    """Values of `inertia_scale`."""

    scale: Array
    """(..., 3) true inertia over nominal inertia, body axes [1]."""


def constants_of(values: InertiaScale, constants: Constants) -> Constants:
    """Return the constants with the inertia scaled per axis."""
    return constants._replace(inertia=constants.inertia * values.scale)


EFFECT = Effect(
    name="inertia_scale",
    summary="True inertia over nominal",
    equation="J = scale x nominal, per axis",
    source="inertia measured or guessed badly",
    values=InertiaScale,
    parameters=(
        Parameter(
            name="scale",
            unit="1",
            neutral=1.0,
            low=0.2,
            high=5.0,
            typical=(0.05, 0.25),
            size=3,
            signs=(1, -1),
        ),
    ),
    constants=constants_of,
)
