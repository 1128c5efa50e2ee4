"""Effects of the air on the rotors, and of the rotors' angular momentum on the body.

In all equations v_b is the velocity relative to the air in body axes, Omega_i the speed of a rotor,
and e3 the unit vector along body z.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, along_z, cross_e3, per_axis


class Inflow(NamedTuple):
    """Values of `inflow`."""

    coefficient: Array
    """(...,) k: thrust that a rotor loses, per climb speed and rotor speed [N s^2/(m rad)]."""


INFLOW = Effect(
    name="inflow",
    summary="Thrust decreases in a climb and increases in a descent",
    equation="rotor thrust += -k Omega_i v_b.e3",
    source="blade element theory; Svacha, Mohta and Kumar 2017",
    values=Inflow,
    parameters=(
        Parameter(
            "coefficient", "N s^2/(m rad)", neutral=0.0, low=0.0, high=1e-3, typical=(3e-5, 1.2e-4)
        ),
    ),
    thrust=lambda values, flow, thrust: (
        thrust - per_axis(values.coefficient * flow.air_vel_b[..., 2]) * flow.rotor_speed
    ),
)


class TranslationalLift(NamedTuple):
    """Values of `translational_lift`."""

    coefficient: Array
    """(...,) k: lift per mass and squared horizontal airspeed [1/m]."""


def translational_lift_force(values: TranslationalLift, flow: Flow) -> Array:
    """Return m k (v_bx^2 + v_by^2) e3 (..., 3) [N], with the true mass."""
    horizontal_squared = flow.air_vel_b[..., 0] ** 2 + flow.air_vel_b[..., 1] ** 2
    return along_z(flow.constants.mass * values.coefficient * horizontal_squared)


TRANSLATIONAL_LIFT = Effect(
    name="translational_lift",
    summary="Thrust increases in forward flight",
    equation="F_b += m k (v_bx^2 + v_by^2) e3",
    source="Svacha, Mohta and Kumar 2017",
    values=TranslationalLift,
    parameters=(
        Parameter("coefficient", "1/m", neutral=0.0, low=0.0, high=0.3, typical=(0.005, 0.03)),
    ),
    force=translational_lift_force,
)


class BladeFlapping(NamedTuple):
    """Values of `blade_flapping`."""

    coefficient: Array
    """(...,) k: torque per airspeed and sum of the rotor speeds [N s^2/rad]."""


BLADE_FLAPPING = Effect(
    name="blade_flapping",
    summary="The rotors tilt away from the airflow and pitch the body up",
    equation="tau_b += k (sum Omega_i) (v_b x e3)",
    source="Mahony, Kumar and Corke 2012",
    values=BladeFlapping,
    parameters=(
        Parameter(
            "coefficient", "N s^2/rad", neutral=0.0, low=-1e-5, high=1e-5, typical=(1e-7, 1e-6)
        ),
    ),
    torque=lambda values, flow: (
        per_axis(values.coefficient * flow.rotor_speed.sum(axis=-1)) * cross_e3(flow.air_vel_b)
    ),
)


SHARE_MOST = 1.0 / 3.0
"""Largest value of g (r / 4 z)^2 that is used; it gives a factor of 1.5 on the thrust."""
HEIGHT_LEAST_M = 1e-3
"""Least height of a rotor above the ground that is used [m]."""


class GroundEffect(NamedTuple):
    """Values of `ground_effect`."""

    strength: Array
    """(...,) g: strength of the effect; 1 is the rotor of Cheeseman and Bennett 1955."""
    rotor_radius: Array
    """(...,) r: radius of a rotor [m]."""


def ground_effect_thrust(values: GroundEffect, flow: Flow, thrust: Array) -> Array:
    """Return the thrusts (..., 4) [N] times 1 / (1 - g (r / 4 z_i)^2), which is at most 1.5.

    z_i is the height of each rotor's hub above z = 0.
    """
    xp = thrust.__array_namespace__()
    hub_above_com = (flow.rot_w[..., None, 2, :] * flow.constants.rotor_position_b).sum(axis=-1)
    height = xp.maximum(flow.pos_w[..., 2, None] + hub_above_com, HEIGHT_LEAST_M)
    share = per_axis(values.strength) * (per_axis(values.rotor_radius) / (4.0 * height)) ** 2
    return thrust / (1.0 - xp.minimum(share, SHARE_MOST))


GROUND_EFFECT = Effect(
    name="ground_effect",
    summary="More thrust close above the ground",
    equation="rotor thrust x 1 / (1 - g (r / 4 z_i)^2), at most 1.5",
    source="Cheeseman and Bennett 1955, ARC R&M 3021",
    values=GroundEffect,
    parameters=(
        Parameter("strength", "1", neutral=0.0, low=0.0, high=20.0, typical=(1.0, 8.0)),
        Parameter(
            "rotor_radius",
            "m",
            neutral=0.0635,
            low=0.005,
            high=1.0,
            typical=(0.03, 0.1),
            required=False,
            fitted=False,
            whole=True,
        ),
    ),
    thrust=ground_effect_thrust,
)


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
