"""Depth by time of flight: noise, pixels between two surfaces at edges, and wrapped ranges.

A pixel without a return within the camera's range has the value of the range.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.interface import Array, Moment, Needs, Parameter, Sensor, View, over_image
from eval.sensors.stereo import EDGE, NEAREST_M, neighbour

LIGHT = 299_792_458.0
"""Speed of light [m/s]."""


class TimeOfFlight(NamedTuple):
    """Values of `tof`."""

    noise: Array
    bias: Array
    mixing: Array
    wrapped: Array
    modulation: Array


def start(values: TimeOfFlight, moment: Moment) -> Array:
    """Return the trial's bias by multipath as a share of the range (...,), never negative."""
    return values.bias * abs(moment.draws.normal[..., 0])


def sense(values: TimeOfFlight, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with a time-of-flight camera's image."""
    depth_m, draws, range_m = seen.depth_m, moment.draws, moment.camera.range_m
    xp, chance = depth_m.__array_namespace__(), draws.chance
    neighbours = [neighbour(depth_m, side) for side in (-1, 1)]
    nearer = xp.minimum(*neighbours)
    mixed = (EDGE * nearer < depth_m) & (chance[..., 0, :, :] < over_image(values.mixing))
    share = chance[..., 1, :, :]
    found_m = xp.where(mixed, share * nearer + (1.0 - share) * depth_m, depth_m)
    noise = over_image(values.noise) * draws.grain[..., 0, :, :]
    found_m = found_m * (1.0 + over_image(memory) + noise)
    # Ranges are ambiguous by half a wavelength of the modulation.
    half_m = over_image(LIGHT / (2.0 * xp.maximum(values.modulation, 1.0)))
    wrong = chance[..., 2, :, :] < over_image(values.wrapped)
    found_m = xp.where(wrong, found_m - half_m * xp.floor(found_m / half_m), found_m)
    found_m = xp.where((depth_m >= range_m) & ~mixed, range_m, found_m)
    return seen._replace(depth_m=found_m.clip(NEAREST_M, range_m)), memory


SENSOR = Sensor(
    name="tof",
    stage="depth",
    summary="Depth by time of flight: noise, multipath, mixed pixels at edges, wrapped ranges",
    equation="z (1 + b + s n); at edges u z_near + (1 - u) z, u even; some z mod c / (2 f)",
    source="Hansard et al. 2012 (time-of-flight cameras); data sheets of the Flexx2 and Azure "
    "Kinect: 0.2 to 1 % noise, 1 % systematic; shares are our estimate",
    values=TimeOfFlight,
    parameters=(
        Parameter("noise", "1", 0.0, 0.0, 1.0, (0.002, 0.02)),
        Parameter("bias", "1", 0.0, 0.0, 1.0, (0.005, 0.03)),
        Parameter("mixing", "1", 0.0, 0.0, 1.0, (0.1, 0.5)),
        Parameter("wrapped", "1", 0.0, 0.0, 1.0, (0.005, 0.05)),
        Parameter("modulation", "Hz", 0.0, 0.0, 1e9, (1e7, 1e8)),
    ),
    grows=("noise", "bias", "mixing", "wrapped"),
    trial=Needs(normal=1),
    observation=Needs(grain=1, chance=3),
    start=start,
    sense=sense,
)
