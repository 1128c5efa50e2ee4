"""The drone's depth camera: a pinhole model with 32 x 24 pixels, pitched up, and its rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from tracks.geometry.scene import Array
from tracks.input.ranges import Range


@dataclass(frozen=True)
class Camera:
    """A forward-looking depth camera at the body's origin."""

    pitch_deg: Annotated[float, Range(-90.0, 90.0)] = 15.0
    """Pitch of the optical axis above body x [deg]."""
    fov_deg: Annotated[tuple[float, float], Range(1.0, 179.0)] = (78.4, 63.8)
    """Horizontal and vertical field of view, edge to edge [deg]."""
    range_m: Annotated[float, Range(0.1, 1000.0)] = 10.0
    """Largest depth [m]; larger depths are set to it."""
    width: Annotated[int, Range(1, 1024)] = 32
    """Number of columns of the image [pixels]."""
    height: Annotated[int, Range(1, 1024)] = 24
    """Number of rows of the image [pixels]."""
    rays: Annotated[int, Range(1, 8)] = 1
    """n: a pixel is the smallest depth of its n x n rays. More rays find thinner objects."""


def pixel_rays_b(camera: Camera) -> np.ndarray:
    """Return the rays through the pixel centres in body axes, (height * width, 3).

    The order is that of the image: row by row from the top left. Each ray's component along the
    optical axis is 1, so the ray parameter at a hit is the planar depth itself.
    """
    half_u, half_v = np.tan(np.deg2rad(np.asarray(camera.fov_deg)) / 2)
    left = half_u * (1 - (2 * np.arange(camera.width) + 1) / camera.width)
    up = half_v * (1 - (2 * np.arange(camera.height) + 1) / camera.height)
    up, left = np.meshgrid(up, left, indexing="ij")
    pitch = np.deg2rad(camera.pitch_deg)
    rays = np.stack(
        [np.cos(pitch) - up * np.sin(pitch), left, np.sin(pitch) + up * np.cos(pitch)], axis=-1
    )
    return rays.reshape(-1, 3)


def cast_rays_b(camera: Camera) -> np.ndarray:
    """Return all rays of an image in body axes, (rays^2 * height * width, 3), for `nearest`.

    Each pixel is split evenly into rays x rays parts, and a ray goes through the centre of each
    part. The first parts of all pixels come first, so that `nearest` takes the minimum over a
    leading axis.
    """
    n, height, width = camera.rays, camera.height, camera.width
    supersampled = replace(camera, width=n * width, height=n * height)
    rays = pixel_rays_b(supersampled).reshape(height, n, width, n, 3)
    return rays.transpose(1, 3, 0, 2, 4).reshape(-1, 3)


def nearest(camera: Camera, depth_m: Array) -> Array:
    """Return the image (..., height, width) from the depths (..., R) along `cast_rays_b` [m]."""
    parts = depth_m.reshape(*depth_m.shape[:-1], camera.rays**2, camera.height, camera.width)
    return parts.min(-3)


def optical_axis_b(camera: Camera) -> np.ndarray:
    """Return the unit optical axis in body axes, (3,)."""
    pitch = np.deg2rad(camera.pitch_deg)
    return np.array([np.cos(pitch), 0.0, np.sin(pitch)])
