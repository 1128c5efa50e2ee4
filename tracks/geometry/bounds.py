"""Bounding spheres of the solids of a scene, from numpy or JAX arrays."""

from __future__ import annotations

from typing import NamedTuple

from tracks.geometry.scene import Array, Scene


class Bounds(NamedTuple):
    """Bounding spheres of one kind of solid."""

    center_w: Array
    """(..., N, 3) centres [m]."""
    radius: Array
    """(..., N) radii [m]."""


def bounds(scene: Scene) -> dict[str, Bounds]:
    """Return the bounding spheres of every kind, under its field's name in `Scene`.

    Takes numpy and JAX arrays, with any leading batch shape.
    """
    boxes, cylinders, capsules, spheres = scene[1:5]
    half = boxes.half_size
    xp = half.__array_namespace__()
    return {
        "boxes": Bounds(boxes.center_w, xp.sqrt((half * half).sum(-1))),
        "cylinders": Bounds(cylinders.center_w, xp.hypot(cylinders.radius, cylinders.half_length)),
        "capsules": Bounds(capsules.center_w, capsules.radius + capsules.half_length),
        "spheres": Bounds(spheres.center_w, spheres.radius),
    }
