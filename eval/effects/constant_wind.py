"""A steady wind; it acts through every effect that uses the airspeed, and alone does nothing."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Gust, Parameter


class ConstantWind(NamedTuple):
    """Values of `constant_wind`."""

    velocity: Array
    """(..., 3) of the air in the world [m/s]."""


def wind_of(values: ConstantWind, gust: Gust) -> Array:
    """Return the air's velocity in the world (..., 3) [m/s]."""
    return values.velocity


EFFECT = Effect(
    name="constant_wind",
    summary="Steady wind; acts through the effects that use the airspeed",
    equation="v_b = R^T (v_w - velocity)",
    source="definition",
    values=ConstantWind,
    parameters=(
        Parameter(
            name="velocity",
            unit="m/s",
            neutral=0.0,
            low=-30.0,
            high=30.0,
            typical=(1.0, 5.0),
            size=3,
            direction=(-0.6, 0.8, 0.0),
        ),
    ),
    wind=wind_of,
)
