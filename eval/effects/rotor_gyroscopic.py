"""The spinning rotors' angular momentum turns with the body."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, cross_e3, per_axis


class RotorGyroscopic(NamedTuple):
    """Values of `rotor_gyroscopic`."""

    rotor_inertia: Array
    """(...,) J_r of one rotor about its axis [kg m^2]."""


def torque_of(values: RotorGyroscopic, flow: Flow) -> Array:
    """Return -J_r (sum s_i Omega_i) (w x e3) (..., 3) [N m]; the spin-up part is left out."""
    net_spin = (flow.spin * flow.rotor_speed).sum(axis=-1)
    return -per_axis(values.rotor_inertia * net_spin) * cross_e3(flow.rate_b)


EFFECT = Effect(
    name="rotor_gyroscopic",
    summary="The rotors' angular momentum turns with the body",
    equation="tau_b += -J_r (sum s_i Omega_i) (w x e3)",
    source="Mahony, Kumar and Corke 2012",
    values=RotorGyroscopic,
    parameters=(
        Parameter(
            name="rotor_inertia",
            unit="kg m^2",
            neutral=0.0,
            low=0.0,
            high=1e-3,
            typical=(5e-6, 5e-5),
        ),
    ),
    torque=torque_of,
)
