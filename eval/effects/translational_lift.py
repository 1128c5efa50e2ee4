"""Lift won in forward flight, where the rotors meet undisturbed air."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, along_z


class TranslationalLift(NamedTuple):
    """Values of `translational_lift`."""

    coefficient: Array
    """(...,) k [1/m]."""


def force_of(values: TranslationalLift, flow: Flow) -> Array:
    """Return m k (v_bx^2 + v_by^2) e3 (..., 3) [N], with the true mass."""
    sideways = flow.air_vel_b[..., 0] ** 2 + flow.air_vel_b[..., 1] ** 2
    return along_z(flow.constants.mass * values.coefficient * sideways)


EFFECT = Effect(
    name="translational_lift",
    summary="Lift won in forward flight",
    equation="F_b += m k (v_bx^2 + v_by^2) e3",
    source="Svacha, Mohta and Kumar 2017",
    values=TranslationalLift,
    parameters=(
        Parameter(
            name="coefficient",
            unit="1/m",
            neutral=0.0,
            low=0.0,
            high=0.3,
            typical=(0.005, 0.03),
        ),
    ),
    force=force_of,
)
