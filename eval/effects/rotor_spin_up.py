"""The body turns against rotors that spin up or down."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, along_z


class RotorSpinUp(NamedTuple):
    """Values of `rotor_spin_up`."""

    rotor_inertia: Array
    """(...,) J_r of one rotor with its motor's bell about its axis [kg m^2]."""


def torque_of(values: RotorSpinUp, flow: Flow) -> Array:
    """Return -J_r (sum s_i dOmega_i/dt) e3 (..., 3) [N m]; none where the change is not known."""
    if flow.rotor_acc is None:
        return 0.0 * flow.rate_b
    net = (flow.spin * flow.rotor_acc).sum(axis=-1)
    return along_z(-values.rotor_inertia * net)


EFFECT = Effect(
    name="rotor_spin_up",
    summary="The body turns against rotors that spin up or down",
    equation="tau_b += -J_r (sum s_i dOmega_i/dt) e3",
    source="Mahony, Kumar and Corke 2012",
    values=RotorSpinUp,
    parameters=(
        Parameter(
            name="rotor_inertia",
            unit="kg m^2",
            neutral=0.0,
            low=0.0,
            high=1e-3,
            typical=(2e-6, 2e-5),
        ),
    ),
    torque=torque_of,
    rotor_acc=True,
)
