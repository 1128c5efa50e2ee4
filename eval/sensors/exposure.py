"""Exposure gaps: the camera is blinded or in the dark for a while and finds no depth at all."""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.interface import (
    Array,
    Moment,
    Needs,
    Parameter,
    Sensor,
    View,
    absent,
    over_image,
    sticky,
)


class Exposure(NamedTuple):
    """Values of `exposure`."""

    share: Array
    length: Array


def sense(values: Exposure, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with an image without depths where the camera is blind."""
    xp, chance = seen.depth_m.__array_namespace__(), moment.draws.uniform[..., 0]
    blind = sticky(memory, chance, values.share, values.length, moment.dt_s)
    depth_m = xp.where(over_image(blind), moment.camera.range_m, seen.depth_m)
    return seen._replace(depth_m=depth_m), blind


SENSOR = Sensor(
    name="exposure",
    stage="depth",
    summary="The camera is blind for a while; its image reads as the range everywhere",
    equation="Markov chain: blind for `share` of the images, `length` at a time; z = range",
    source="our estimate",
    values=Exposure,
    parameters=(
        Parameter("share", "1", 0.0, 0.0, 0.95, (0.005, 0.05)),
        Parameter("length", "s", 0.0, 0.0, 10.0, (0.05, 0.3)),
    ),
    grows=("share",),
    trial=Needs(uniform=1),
    observation=Needs(uniform=1),
    start=absent,
    sense=sense,
)
