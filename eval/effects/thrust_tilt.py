"""Rotors whose common thrust does not push along body z."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter, tilted_e3


class ThrustTilt(NamedTuple):
    """Values of `thrust_tilt`."""

    angle: Array
    """(..., 2) of the thrust about body x, then y [rad]."""


def constants_of(values: ThrustTilt, constants: Constants) -> Constants:
    """Return the constants with the thrust's axis tilted; the torques stay."""
    return constants._replace(thrust_axis_b=tilted_e3(values.angle))


EFFECT = Effect(
    name="thrust_tilt",
    summary="The total thrust is tilted; torques unchanged",
    equation="F_thrust = (sum f_i) Rot(a_x, a_y, 0) e3",
    source="body frame misaligned with the rotors",
    values=ThrustTilt,
    parameters=(
        Parameter(
            name="angle",
            unit="rad",
            neutral=0.0,
            low=-0.35,
            high=0.35,
            typical=(0.0035, 0.035),
            size=2,
            direction=(0.6, 0.8),
        ),
    ),
    constants=constants_of,
)
