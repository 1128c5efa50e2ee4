"""A constant torque: bent frame, misaligned motors, a cable."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter


class TorqueTrim(NamedTuple):
    """Values of `torque_trim`."""

    torque: Array
    """(..., 3) about body x, y, z [N m]."""


def torque_of(values: TorqueTrim, flow: Flow) -> Array:
    """Return the constant torque (..., 3) [N m]."""
    return values.torque


EFFECT = Effect(
    name="torque_trim",
    summary="A constant body torque",
    equation="tau_b += torque",
    source="definition",
    values=TorqueTrim,
    parameters=(
        Parameter(
            name="torque",
            unit="N m",
            neutral=0.0,
            low=-0.5,
            high=0.5,
            typical=(0.005, 0.05),
            size=3,
            direction=(0.6, 0.8, 0.0),
        ),
    ),
    torque=torque_of,
)
