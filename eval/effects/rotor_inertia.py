"""Effects of the rotors' angular momentum: gyroscopic torque, and torque of spinning up."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, along_z, cross_e3, per_axis


class RotorGyroscopic(NamedTuple):
    """Values of `rotor_gyroscopic`."""

    rotor_inertia: Array
    """(...,) J_r: inertia of one rotor about its axis [kg m^2]."""


def rotor_gyroscopic_torque(values: RotorGyroscopic, flow: Flow) -> Array:
    """Return -J_r (sum s_i Omega_i) (w x e3) (..., 3) [N m], without the torque of spinning up."""
    net_spin = (flow.spin * flow.rotor_speed).sum(axis=-1)
    return -per_axis(values.rotor_inertia * net_spin) * cross_e3(flow.rate_b)


ROTOR_GYROSCOPIC = Effect(
    name="rotor_gyroscopic",
    summary="The rotors' angular momentum turns with the body",
    equation="tau_b += -J_r (sum s_i Omega_i) (w x e3)",
    source="Mahony, Kumar and Corke 2012",
    values=RotorGyroscopic,
    parameters=(
        Parameter("rotor_inertia", "kg m^2", neutral=0.0, low=0.0, high=1e-3, typical=(5e-6, 5e-5)),
    ),
    torque=rotor_gyroscopic_torque,
)


class RotorSpinUp(NamedTuple):
    """Values of `rotor_spin_up`."""

    rotor_inertia: Array
    """(...,) J_r: inertia of one rotor with its motor's bell, about its axis [kg m^2]."""


def rotor_spin_up_torque(values: RotorSpinUp, flow: Flow) -> Array:
    """Return -J_r (sum s_i dOmega_i/dt) e3 (..., 3) [N m]; 0 where dOmega_i/dt is unknown."""
    if flow.rotor_acc is None:
        return 0.0 * flow.rate_b
    net = (flow.spin * flow.rotor_acc).sum(axis=-1)
    return along_z(-values.rotor_inertia * net)


ROTOR_SPIN_UP = Effect(
    name="rotor_spin_up",
    summary="The body is turned by rotors that spin up or down",
    equation="tau_b += -J_r (sum s_i dOmega_i/dt) e3",
    source="Mahony, Kumar and Corke 2012",
    values=RotorSpinUp,
    parameters=(
        Parameter("rotor_inertia", "kg m^2", neutral=0.0, low=0.0, high=1e-3, typical=(2e-6, 2e-5)),
    ),
    torque=rotor_spin_up_torque,
    rotor_acc=True,
)
