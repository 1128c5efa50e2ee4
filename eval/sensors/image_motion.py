"""Sensor model `image_motion`: blur over the exposure time, and rolling shutter.

At the policy's low resolution, a rotation of the camera shifts all pixels of an image equally. The
shift is the body rate times the time, divided by a pixel's angle. The rate is the mean rate since
the previous observation. Where state and image have different ages, it is that of the state.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from eval.sensors.interface import (
    Array,
    Moment,
    Parameter,
    Sensor,
    View,
    over_image,
    rotation_since,
)


class ImageMotion(NamedTuple):
    """Parameters of `image_motion`; units in `SENSOR`."""

    exposure: Array
    """Exposure time of a row."""
    readout: Array
    """Time between the first and the last row."""


def start(values: ImageMotion, moment: Moment) -> Array:
    """Return the body's attitude (..., 3, 3) at the first observation."""
    return moment.truth.rot_w


def sense(values: ImageMotion, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with a blurred and sheared image, and the attitude of this observation."""
    camera, depth_m = moment.camera, seen.depth_m
    xp = depth_m.__array_namespace__()
    rate_b = rotation_since(moment.truth.rot_w, memory) / moment.dt_s
    tangents_wide, tangents_high = (
        2.0 * math.tan(math.radians(angle) / 2) for angle in camera.fov_deg
    )
    # A yaw to the left moves the image to the right, a pitch down (about y) moves it up.
    right_px_per_s = over_image(rate_b[..., 2]) * camera.width / tangents_wide
    down_px_per_s = -over_image(rate_b[..., 1]) * camera.height / tangents_high
    row_s = over_image(values.readout) * (np.arange(camera.height)[:, None] / camera.height - 0.5)
    # Blur: the mean of the inverse depths at the start and the end of the exposure.
    inverse: Any = 0.0
    for fraction in (-0.5, 0.5):
        time_s = row_s + fraction * over_image(values.exposure)
        image = shift(1.0 / xp.maximum(depth_m, 1e-3), right_px_per_s * time_s, -1)
        inverse = inverse + 0.5 * shift(image, down_px_per_s * time_s, -2)
    return seen._replace(depth_m=1.0 / inverse), moment.truth.rot_w


def shift(image: Array, pixels: Array, axis: int) -> Array:
    """Return images (..., H, W) shifted by `pixels` (..., H, 1) along `axis`, -1 or -2.

    Values between pixels are interpolated linearly; beyond the border the last pixel is repeated.
    """
    xp, count = image.__array_namespace__(), image.shape[axis]
    index = np.arange(count) if axis == -1 else np.arange(count)[:, None]
    source = (index - pixels).clip(0.0, count - 1.0) + 0.0 * image
    pixel = xp.floor(source)
    fraction, first = source - pixel, pixel.astype(int)
    second = (first + 1).clip(0, count - 1)
    low_value, high_value = (xp.take_along_axis(image, k, axis=axis) for k in (first, second))
    return (1.0 - fraction) * low_value + fraction * high_value


SENSOR = Sensor(
    name="image_motion",
    stage="depth",
    summary="Rotation blurs the image over the exposure and shears it over the readout",
    equation="1/z at (u - w t): mean of t = row time -+ exposure / 2; w: pixels per second",
    source="geometry of a pinhole; usual times are those of data sheets of such cameras",
    values=ImageMotion,
    parameters=(
        Parameter("exposure", "s", 0.0, 0.0, 0.5, (0.001, 0.02)),
        Parameter("readout", "s", 0.0, 0.0, 0.5, (0.005, 0.03)),
    ),
    grows=("exposure", "readout"),
    start=start,
    sense=sense,
)
