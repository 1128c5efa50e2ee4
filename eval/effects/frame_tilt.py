"""A world frame that is not level: gravity leans in it, and every pose is measured in it."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import GRAVITY, Array, Constants, Effect, Parameter, tilted_e3


class FrameTilt(NamedTuple):
    """Values of `frame_tilt`."""

    angle: Array
    """(..., 2) of gravity about world x, then y [rad]."""


def constants_of(values: FrameTilt, constants: Constants) -> Constants:
    """Return the constants with gravity along Rot(a_x, a_y, 0) (0, 0, -1)."""
    return constants._replace(gravity_w=-GRAVITY * tilted_e3(values.angle))


EFFECT = Effect(
    name="frame_tilt",
    summary="The log's frame is not level",
    equation="gravity = Rot(a_x, a_y, 0) (0, 0, -9.81)",
    source="motion capture levelled badly",
    values=FrameTilt,
    parameters=(
        Parameter(
            name="angle",
            unit="rad",
            neutral=0.0,
            low=-0.35,
            high=0.35,
            typical=(0.005, 0.035),
            size=2,
            direction=(0.6, 0.8),
        ),
    ),
    constants=constants_of,
    of_log=True,
)
