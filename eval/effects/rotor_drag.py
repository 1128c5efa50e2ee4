"""Drag in the rotors' plane, proportional to airspeed and to rotor speed."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, along_z, per_axis


class RotorDrag(NamedTuple):
    """Values of `rotor_drag`."""

    coefficient: Array
    """(...,) k [kg/rad]."""


def force_of(values: RotorDrag, flow: Flow) -> Array:
    """Return -k (sum Omega_i) (v_b - (v_b . e3) e3) (..., 3) [N]."""
    in_plane = flow.air_vel_b - along_z(flow.air_vel_b[..., 2])
    return -per_axis(values.coefficient * flow.rotor_speed.sum(axis=-1)) * in_plane


EFFECT = Effect(
    name="rotor_drag",
    summary="Drag in the rotor plane, proportional to airspeed and rotor speed",
    equation="F_b += -k (sum Omega_i) (v_b - (v_b.e3) e3)",
    source="Svacha, Mohta and Kumar 2017",
    values=RotorDrag,
    parameters=(
        Parameter(
            name="coefficient",
            unit="kg/rad",
            neutral=0.0,
            low=0.0,
            high=1e-3,
            typical=(1e-5, 1e-4),
        ),
    ),
    force=force_of,
)
