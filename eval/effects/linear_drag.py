"""Drag proportional to the airspeed, body axes; mostly of the rotors, averaged at hover speed."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis


class LinearDrag(NamedTuple):
    """Values of `linear_drag`."""

    coefficient: Array
    """(..., 3) D along body x, y, z [1/s]."""


def force_of(values: LinearDrag, flow: Flow) -> Array:
    """Return -m D v_b (..., 3) [N], with the true mass."""
    return -per_axis(flow.constants.mass) * values.coefficient * flow.air_vel_b


EFFECT = Effect(
    name="linear_drag",
    summary="Drag proportional to the airspeed",
    equation="F_b += -m D v_b",
    source="Faessler, Franchi and Scaramuzza 2018",
    values=LinearDrag,
    parameters=(
        Parameter(
            name="coefficient",
            unit="1/s",
            neutral=0.0,
            low=0.0,
            high=5.0,
            typical=(0.2, 0.5),
            size=3,
        ),
    ),
    force=force_of,
)
