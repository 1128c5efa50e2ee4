"""The rotors lean back from the wind and pitch the body up."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, cross_e3, per_axis


class BladeFlapping(NamedTuple):
    """Values of `blade_flapping`."""

    coefficient: Array
    """(...,) k [N s^2/rad]."""


def torque_of(values: BladeFlapping, flow: Flow) -> Array:
    """Return k (sum Omega_i) (v_b x e3) (..., 3) [N m]."""
    return per_axis(values.coefficient * flow.rotor_speed.sum(axis=-1)) * cross_e3(flow.air_vel_b)


EFFECT = Effect(
    name="blade_flapping",
    summary="The rotors lean back from the wind and pitch the body up",
    equation="tau_b += k (sum Omega_i) (v_b x e3)",
    source="Mahony, Kumar and Corke 2012",
    values=BladeFlapping,
    parameters=(
        Parameter(
            name="coefficient",
            unit="N s^2/rad",
            neutral=0.0,
            low=-1e-5,
            high=1e-5,
            typical=(1e-7, 1e-6),
        ),
    ),
    torque=torque_of,
)
