"""Thrust lost to the air that comes through the rotors in a climb, won in a descent."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis


class Inflow(NamedTuple):
    """Values of `inflow`."""

    coefficient: Array
    """(...,) k [N s^2/(m rad)]."""


def thrust_of(values: Inflow, flow: Flow, thrust: Array) -> Array:
    """Return the thrusts (..., 4) [N] less k Omega_i v_b . e3 each."""
    climb = flow.air_vel_b[..., 2]
    return thrust - per_axis(values.coefficient * climb) * flow.rotor_speed


EFFECT = Effect(
    name="inflow",
    summary="Thrust lost in a climb, won in a descent",
    equation="rotor thrust += -k Omega_i v_b.e3",
    source="blade element theory; Svacha, Mohta and Kumar 2017",
    values=Inflow,
    parameters=(
        Parameter(
            name="coefficient",
            unit="N s^2/(m rad)",
            neutral=0.0,
            low=0.0,
            high=1e-3,
            typical=(3e-5, 1.2e-4),
        ),
    ),
    thrust=thrust_of,
)
