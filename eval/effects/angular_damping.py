"""The air resists turning."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter


class AngularDamping(NamedTuple):
    """Values of `angular_damping`."""

    coefficient: Array
    """(..., 3) d about body x, y, z [1/s]."""


def torque_of(values: AngularDamping, flow: Flow) -> Array:
    """Return -J d w (..., 3) [N m], with the true inertia."""
    return -flow.constants.inertia * values.coefficient * flow.rate_b


EFFECT = Effect(
    name="angular_damping",
    summary="The air resists turning",
    equation="tau_b += -J d w",
    source="Faessler, Franchi and Scaramuzza 2018",
    values=AngularDamping,
    parameters=(
        Parameter(
            name="coefficient",
            unit="1/s",
            neutral=0.0,
            low=0.0,
            high=30.0,
            typical=(0.2, 3.0),
            size=3,
        ),
    ),
    torque=torque_of,
)
