"""Drag of the airframe: it grows with the square of the airspeed."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis


class QuadraticDrag(NamedTuple):
    """Values of `quadratic_drag`."""

    coefficient: Array
    """(..., 3) C along body x, y, z [1/m]."""


def force_of(values: QuadraticDrag, flow: Flow) -> Array:
    """Return -m C |v_b| v_b (..., 3) [N], with the true mass."""
    xp = flow.air_vel_b.__array_namespace__()
    squared = xp.sum(flow.air_vel_b**2, axis=-1, keepdims=True)
    # The root's slope is infinite at rest, where the force and its slope are zero.
    moving = squared > 0.0
    speed = xp.where(moving, xp.sqrt(xp.where(moving, squared, 1.0)), 0.0)
    return -per_axis(flow.constants.mass) * values.coefficient * speed * flow.air_vel_b


EFFECT = Effect(
    name="quadratic_drag",
    summary="Drag proportional to the square of the airspeed",
    equation="F_b += -m C |v_b| v_b",
    source="parasitic drag; Hattenberger, Bronz and Condomines 2023",
    values=QuadraticDrag,
    parameters=(
        Parameter(
            name="coefficient",
            unit="1/m",
            neutral=0.0,
            low=0.0,
            high=1.0,
            typical=(0.005, 0.04),
            size=3,
        ),
    ),
    force=force_of,
)
