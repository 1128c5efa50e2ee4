"""Effects of drag on airframe and rotors: forces against the airspeed, a torque against rotation.

In all equations v_b is the velocity relative to the air in body axes, Omega_i the speed of a rotor,
and e3 the unit vector along body z.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, along_z, per_axis
from tracks.geometry.rotation import cross


class LinearDrag(NamedTuple):
    """Values of `linear_drag`."""

    coefficient: Array
    """(..., 3) D: drag along body x, y, z per mass and airspeed [1/s]."""


LINEAR_DRAG = Effect(
    name="linear_drag",
    summary="Drag proportional to the airspeed",
    equation="F_b += -m D v_b",
    source="Faessler, Franchi and Scaramuzza 2018",
    values=LinearDrag,
    parameters=(
        Parameter("coefficient", "1/s", neutral=0.0, low=0.0, high=5.0, typical=(0.2, 0.5), size=3),
    ),
    force=lambda values, flow: -per_axis(flow.constants.mass) * values.coefficient * flow.air_vel_b,
)


class QuadraticDrag(NamedTuple):
    """Values of `quadratic_drag`."""

    coefficient: Array
    """(..., 3) C: drag along body x, y, z per mass and squared airspeed [1/m]."""


def quadratic_drag_force(values: QuadraticDrag, flow: Flow) -> Array:
    """Return -m C |v_b| v_b (..., 3) [N], with the true mass."""
    xp = flow.air_vel_b.__array_namespace__()
    squared = xp.sum(flow.air_vel_b**2, axis=-1, keepdims=True)
    # At rest the root has an infinite slope, although the force and its slope are zero.
    moving = squared > 0.0
    speed = xp.where(moving, xp.sqrt(xp.where(moving, squared, 1.0)), 0.0)
    return -per_axis(flow.constants.mass) * values.coefficient * speed * flow.air_vel_b


QUADRATIC_DRAG = Effect(
    name="quadratic_drag",
    summary="Drag proportional to the square of the airspeed",
    equation="F_b += -m C |v_b| v_b",
    source="parasitic drag; Hattenberger, Bronz and Condomines 2023",
    values=QuadraticDrag,
    parameters=(
        Parameter(
            "coefficient", "1/m", neutral=0.0, low=0.0, high=1.0, typical=(0.005, 0.04), size=3
        ),
    ),
    force=quadratic_drag_force,
)


class RotorDrag(NamedTuple):
    """Values of `rotor_drag`."""

    coefficient: Array
    """(...,) k: drag per airspeed and sum of the rotor speeds [kg/rad]."""


def rotor_drag_force(values: RotorDrag, flow: Flow) -> Array:
    """Return -k (sum Omega_i) (v_b - (v_b . e3) e3) (..., 3) [N]."""
    in_plane = flow.air_vel_b - along_z(flow.air_vel_b[..., 2])
    return -per_axis(values.coefficient * flow.rotor_speed.sum(axis=-1)) * in_plane


ROTOR_DRAG = Effect(
    name="rotor_drag",
    summary="Drag in the rotor plane, proportional to airspeed and rotor speed",
    equation="F_b += -k (sum Omega_i) (v_b - (v_b.e3) e3)",
    source="Svacha, Mohta and Kumar 2017",
    values=RotorDrag,
    parameters=(
        Parameter("coefficient", "kg/rad", neutral=0.0, low=0.0, high=1e-3, typical=(1e-5, 1e-4)),
    ),
    force=rotor_drag_force,
)


class HubDrag(NamedTuple):
    """Values of `hub_drag`."""

    in_plane: Array
    """(...,) k: drag in the rotor plane, per speed of the hub and rotor speed [kg/rad]."""
    axial: Array
    """(...,) c: drag along body z, per speed of the hub and rotor speed [kg/rad]."""


def _hub_drags(values: HubDrag, flow: Flow) -> Array:
    """Return the drag of each rotor, -Omega_i diag(k, k, c) (v_b + w x r_i) (..., 4, 3) [N]."""
    turning_b = cross(flow.rate_b[..., None, :], flow.constants.rotor_position_b)
    hub_vel_b = flow.air_vel_b[..., None, :] + turning_b
    axial_b = along_z(hub_vel_b[..., 2])
    in_plane, axial = (per_axis(per_axis(value)) for value in values)
    return -flow.rotor_speed[..., None] * (in_plane * (hub_vel_b - axial_b) + axial * axial_b)


HUB_DRAG = Effect(
    name="hub_drag",
    summary="Drag of each rotor at its hub; the drag of the simulator RotorPy",
    equation="F_b += sum F_i, tau_b += sum r_i x F_i; F_i = -Omega_i diag(k, k, c) (v_b + w x r_i)",
    source="Svacha, Mohta and Kumar 2017; Folk, Paulos and Kumar 2023",
    values=HubDrag,
    # Not fitted: the forces are nearly those of rotor_drag and inflow, which a diagnosis names.
    parameters=(
        Parameter(
            "in_plane",
            "kg/rad",
            neutral=0.0,
            low=0.0,
            high=1e-3,
            typical=(1e-5, 1e-4),
            fitted=False,
        ),
        Parameter(
            "axial",
            "kg/rad",
            neutral=0.0,
            low=0.0,
            high=1e-3,
            typical=(3e-5, 1.2e-4),
            required=False,
            fitted=False,
        ),
    ),
    force=lambda values, flow: _hub_drags(values, flow).sum(axis=-2),
    torque=lambda values, flow: cross(
        flow.constants.rotor_position_b, _hub_drags(values, flow)
    ).sum(axis=-2),
)


class AngularDamping(NamedTuple):
    """Values of `angular_damping`."""

    coefficient: Array
    """(..., 3) d: damping about body x, y, z per inertia [1/s]."""


ANGULAR_DAMPING = Effect(
    name="angular_damping",
    summary="The air resists rotation",
    equation="tau_b += -J d w",
    source="Faessler, Franchi and Scaramuzza 2018",
    values=AngularDamping,
    parameters=(
        Parameter(
            "coefficient", "1/s", neutral=0.0, low=0.0, high=30.0, typical=(0.2, 3.0), size=3
        ),
    ),
    torque=lambda values, flow: -flow.constants.inertia * values.coefficient * flow.rate_b,
)
