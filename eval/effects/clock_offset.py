"""Poses stamped by another clock than the gyroscope's and the commands'."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter


class ClockOffset(NamedTuple):
    """Values of `clock_offset`."""

    offset: Array
    """() how much later a pose is logged than it was [s]."""


EFFECT = Effect(
    name="clock_offset",
    summary="Pose and velocity are logged late against rates and commands",
    equation="row t: pose and velocity of t - offset, everything else of t",
    source="clocks of motion capture and flight controller not aligned",
    values=ClockOffset,
    parameters=(
        Parameter(
            name="offset",
            unit="s",
            neutral=0.0,
            low=-0.2,
            high=0.2,
            typical=(0.002, 0.02),
        ),
    ),
    late=lambda values: values.offset,
    of_log=True,
)
