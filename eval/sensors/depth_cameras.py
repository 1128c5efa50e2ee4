"""Sensor models `stereo` and `tof`: the errors of stereo and time-of-flight depth cameras.

Stereo disparity refers to a camera of focal length `focal` [pixel], whose image is reduced to the
policy's 24 x 32 pixels. A hole, which is a pixel without a depth, gets the value of the camera's
range, and so does a pixel with nothing within the range. Drivers of real cameras do the same.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.interface import Array, Moment, Needs, Parameter, Sensor, View, over_image
from tracks.geometry.camera import Camera

NEAREST_M = 1e-3
"""Smallest depth that is inverted [m]."""
EDGE = 1.25
"""Ratio of neighbouring depths above which there is an edge."""
EMPTY = 1.0 - 1e-5
"""Share of the range from which a depth counts as nothing within the range. It is a little below 1,
because `image_motion` rounds a depth at the range."""


class Stereo(NamedTuple):
    """Parameters of `stereo`; units in `STEREO`, letters as in its `equation`."""

    noise: Array
    """n: standard deviation of the disparity (shift between the two images)."""
    offset: Array
    """o: standard deviation of a trial's constant disparity error."""
    step: Array
    """Disparity is rounded to multiples of this; 0: not rounded."""
    least: Array
    """Smaller disparities read as the camera's range."""
    near: Array
    """Nearer points read as the camera's range."""
    edge_holes: Array
    """Share of pixels at the far side of an edge that are holes."""
    thin_holes: Array
    """Share of pixels on thin objects that show the background instead."""
    smear: Array
    """Share of pixels at the far side of an edge that show the near side."""
    focal: Array
    """f: focal length of the stereo camera."""
    baseline: Array
    """b: distance between the two lenses of the stereo camera."""


def stereo_start(values: Stereo, moment: Moment) -> Array:
    """Return the trial's offset of the disparity (...,) [pixel]."""
    return values.offset * moment.draws.normal[..., 0]


def stereo_sense(values: Stereo, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with the depth image of a stereo camera, and the offset in `memory`."""
    depth_m, grain, chance = seen.depth_m, moment.draws.grain, moment.draws.chance
    xp, range_m = depth_m.__array_namespace__(), moment.camera.range_m
    left, right = neighbour(depth_m, -1), neighbour(depth_m, 1)
    nearer, further = xp.minimum(left, right), xp.maximum(left, right)
    edge = EDGE * nearer < depth_m
    thin = EDGE * depth_m < xp.minimum(left, right)
    # At edges and thin objects, stereo matching finds a neighbour's depth or nothing.
    smeared = edge & (chance[..., 0, :, :] < over_image(values.smear))
    hole = edge & (chance[..., 1, :, :] < over_image(values.edge_holes)) & ~smeared
    missed = thin & (chance[..., 2, :, :] < over_image(values.thin_holes))
    matched_m = xp.where(smeared, nearer, xp.where(missed, further, depth_m))
    measured_m = in_disparity(values, memory, matched_m, grain[..., 0, :, :], moment.camera)
    no_depth = hole | (matched_m < over_image(values.near)) | (matched_m >= EMPTY * range_m)
    measured_m = xp.where(no_depth, range_m, measured_m)
    return seen._replace(depth_m=measured_m), memory


def neighbour(depth_m: Array, side: int) -> Array:
    """Return the depth of each pixel's left (-1) or right (1) neighbour; at the border its own."""
    xp = depth_m.__array_namespace__()
    if side < 0:
        return xp.concatenate([depth_m[..., :1], depth_m[..., :-1]], axis=-1)
    return xp.concatenate([depth_m[..., 1:], depth_m[..., -1:]], axis=-1)


def in_disparity(
    values: Stereo, offset: Array, depth_m: Array, grain: Array, camera: Camera
) -> Array:
    """Return depths (..., H, W) [m] measured by a disparity with noise, an offset and steps.

    Args:
        values: parameters of the model.
        offset: (...,) the trial's offset of the disparity [pixel].
        depth_m: (..., H, W) true depths [m].
        grain: (..., H, W) standard normal draws.
        camera: the policy's camera.
    """
    xp = depth_m.__array_namespace__()
    focal_baseline = over_image(values.focal * values.baseline)
    disparity = focal_baseline / xp.maximum(depth_m, NEAREST_M)
    disparity = disparity + over_image(values.noise) * grain + over_image(offset)
    step = over_image(values.step)
    rounded = step * xp.rint(disparity / xp.where(step > 0.0, step, 1.0))
    disparity = xp.where(step > 0.0, rounded, disparity)
    least_disparity = xp.maximum(over_image(values.least), focal_baseline / camera.range_m)
    measured_m = focal_baseline / xp.maximum(disparity, least_disparity)
    return xp.where(disparity < least_disparity, camera.range_m, measured_m)


STEREO = Sensor(
    name="stereo",
    stage="depth",
    summary="Depth by stereo: noise and steps of disparity, holes, smearing, limits of the range",
    equation="d = f b / z + n + o, in steps; z = f b / d; the range where d < least or z < near, "
    "in holes, and where nothing is within it",
    source="Grunnet-Jepsen et al., tuning guide of RealSense D400: 0.08 pixel RMS, steps of 1/32, "
    "D435 at 848 x 480: f = 424, b = 0.05 m, nearest 0.17 m; shares at edges are our estimate",
    values=Stereo,
    parameters=(
        Parameter("noise", "pixel", 0.0, 0.0, 20.0, (0.05, 0.3)),
        Parameter("offset", "pixel", 0.0, 0.0, 10.0, (0.02, 0.1)),
        Parameter("step", "pixel", 0.0, 0.0, 10.0, (1 / 32, 1 / 8)),
        Parameter("least", "pixel", 0.0, 0.0, 100.0, (1.0, 3.0)),
        Parameter("near", "m", 0.0, 0.0, 5.0, (0.15, 0.3)),
        Parameter("edge_holes", "1", 0.0, 0.0, 1.0, (0.05, 0.3)),
        Parameter("thin_holes", "1", 0.0, 0.0, 1.0, (0.05, 0.3)),
        Parameter("smear", "1", 0.0, 0.0, 1.0, (0.05, 0.3)),
        Parameter("focal", "pixel", 424.0, 1.0, 1e4, (300.0, 700.0)),
        Parameter("baseline", "m", 0.05, 1e-3, 10.0, (0.03, 0.1)),
    ),
    grows=("noise", "offset", "step", "least", "near", "edge_holes", "thin_holes", "smear"),
    trial=Needs(normal=1),
    observation=Needs(grain=1, chance=3),
    start=stereo_start,
    sense=stereo_sense,
)


LIGHT = 299_792_458.0
"""Speed of light [m/s]."""


class TimeOfFlight(NamedTuple):
    """Parameters of `tof`; units in `TOF`, letters as in its `equation`."""

    noise: Array
    """s: standard deviation of the noise, as a share of the depth."""
    bias: Array
    """b: size of a trial's constant error by multipath (light that is reflected twice), as a share
    of the depth. The error is the absolute value of a normal number with this deviation."""
    mixing: Array
    """Share of pixels at an edge that mix near and far depths."""
    wrapped: Array
    """Share of pixels whose depth is known only up to multiples of c / (2 f)."""
    modulation: Array
    """f: frequency of the emitted light's modulation."""


def tof_start(values: TimeOfFlight, moment: Moment) -> Array:
    """Return the trial's bias by multipath as a share of the depth (...,), never negative."""
    return values.bias * abs(moment.draws.normal[..., 0])


def tof_sense(
    values: TimeOfFlight, memory: Array, seen: View, moment: Moment
) -> tuple[View, Array]:
    """Return the view with the depth image of a time-of-flight camera, and the bias in `memory`."""
    depth_m, draws, range_m = seen.depth_m, moment.draws, moment.camera.range_m
    xp, chance = depth_m.__array_namespace__(), draws.chance
    neighbours = [neighbour(depth_m, side) for side in (-1, 1)]
    nearer = xp.minimum(*neighbours)
    mixed = (EDGE * nearer < depth_m) & (chance[..., 0, :, :] < over_image(values.mixing))
    mix_share = chance[..., 1, :, :]
    measured_m = xp.where(mixed, mix_share * nearer + (1.0 - mix_share) * depth_m, depth_m)
    noise = over_image(values.noise) * draws.grain[..., 0, :, :]
    measured_m = measured_m * (1.0 + over_image(memory) + noise)
    # Depths are ambiguous by half a wavelength of the modulation.
    half_wave_m = over_image(LIGHT / (2.0 * xp.maximum(values.modulation, 1.0)))
    wrapped = chance[..., 2, :, :] < over_image(values.wrapped)
    wrapped_m = measured_m - half_wave_m * xp.floor(measured_m / half_wave_m)
    measured_m = xp.where(wrapped, wrapped_m, measured_m)
    measured_m = xp.where((depth_m >= EMPTY * range_m) & ~mixed, range_m, measured_m)
    return seen._replace(depth_m=measured_m.clip(NEAREST_M, range_m)), memory


TOF = Sensor(
    name="tof",
    stage="depth",
    summary="Depth by time of flight: noise, multipath, mixed pixels at edges, wrapped ranges",
    equation="z (1 + b + s n); at edges u z_near + (1 - u) z, u uniform; some z mod c / (2 f)",
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
    start=tof_start,
    sense=tof_sense,
)
