"""A scene as plain arrays: the gates in flight order, and all solids; the ground is z = 0.

The classes are named tuples: immutable, and accepted by JAX as pytrees without importing it. All
positions are in the world frame (z up) in metres; rotation matrices map local to world. Solids are
padded by parked ones, far below the ground, so that scenes of different size can be stacked.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Array = Any  # numpy.ndarray or jax.Array: the geometry functions take both

PARKED_Z = -1000.0
"""Height of padding solids [m], so far below the ground that they never matter."""
_PARKED = {
    "center_w": [0.0, 0.0, PARKED_Z], "rot_w": np.eye(3), "axis_w": [0.0, 0.0, 1.0],
    "half_size": [1e-3] * 3, "radius": 1e-3, "half_length": 1e-3,
}  # fmt: skip
"""Field of a kind of solid -> its value for a padding solid."""
_PARKED_TRIANGLE = [[0.0, 0.0, PARKED_Z], [1e-3, 0.0, PARKED_Z], [0.0, 1e-3, PARKED_Z]]
"""Corners of a padding triangle [m]."""


class Gates(NamedTuple):
    """Gates in flight order.

    A gate's frame has its origin at the opening's centre, x through the gate in flight
    direction, and the opening in its y-z plane.
    """

    center_w: Array
    """(G, 3) opening centres [m]."""
    rot_w: Array
    """(G, 3, 3) rotation, gate to world; column 0 is the flight direction."""
    opening_g: Array
    """(G, V, 2) corners (y, z) of the convex opening [m], counter-clockwise in the y-z plane
    (from y to z), so that the attractive field passes through the opening along +x. Openings with
    fewer corners than others repeat their last corner."""
    frame_width: Array
    """(G,) width of the frame's bars around the opening [m]."""
    frame_depth: Array
    """(G,) extent of the frame along the flight direction [m]."""


class Boxes(NamedTuple):
    """Boxes at any orientation."""

    center_w: Array
    """(N, 3) centres [m]."""
    rot_w: Array
    """(N, 3, 3) rotations, box to world."""
    half_size: Array
    """(N, 3) half edge lengths [m]."""


class Rods(NamedTuple):
    """Cylinders (flat ends) or capsules (round ends), depending on the field of `Scene`."""

    center_w: Array
    """(N, 3) centres [m]."""
    axis_w: Array
    """(N, 3) unit vectors along the axes."""
    radius: Array
    """(N,) radii [m]."""
    half_length: Array
    """(N,) half lengths of the straight part, without a capsule's caps [m]."""


class Spheres(NamedTuple):
    """Spheres."""

    center_w: Array
    """(N, 3) centres [m]."""
    radius: Array
    """(N,) radii [m]."""


class Scene(NamedTuple):
    """All gates and solids; the ground plane z = 0 is implied."""

    gates: Gates
    boxes: Boxes
    """The bars of the gates' frames (V for each gate, gate by gate), then the obstacles."""
    cylinders: Rods
    capsules: Rods
    spheres: Spheres
    triangles: Array
    """(M, 3, 3) corners of mesh triangles [m]; M = 0 on all generated tracks."""


class Counts(NamedTuple):
    """Numbers of solids of each kind in a padded scene."""

    boxes: int
    cylinders: int
    capsules: int
    spheres: int
    triangles: int = 0


def counts(scene: Scene) -> Counts:
    """Return the numbers of solids of each kind in `scene` (not batched)."""
    solids = (part[0] for part in scene[1:5])
    return Counts(*map(len, (*solids, scene.triangles)))


def pad(scene: Scene, to: Counts) -> Scene:
    """Return `scene` padded with parked solids to the numbers `to`.

    Raises:
        ValueError: where the scene has more solids of a kind than `to`, naming both numbers.
    """
    present = counts(scene)
    for kind, n, limit in zip(Counts._fields, present, to, strict=True):
        if n > limit:
            raise ValueError(
                f"scene has {n} {kind}, more than the {limit} it is padded to; pad to more"
            )
    padded = {}
    for kind, n, limit in zip(Counts._fields[:4], present, to, strict=False):
        solids = getattr(scene, kind)
        fields = []
        for name, array in solids._asdict().items():
            parked = np.tile(_PARKED[name], (limit - n, *[1] * (array.ndim - 1)))
            fields.append(np.concatenate([array, parked]))
        padded[kind] = type(solids)(*fields)
    triangles = np.tile(_PARKED_TRIANGLE, (to.triangles - present.triangles, 1, 1))
    return scene._replace(**padded, triangles=np.concatenate([scene.triangles, triangles]))


def stack(scenes: list[Scene], to: Counts, dtype: Any = np.float32) -> Scene:
    """Pad `scenes` to `to` and stack them: every array gains a leading axis (len(scenes), ...).

    All scenes must have the same number of gates and of corners of an opening.
    """
    padded = [pad(scene, to) for scene in scenes]

    def merge(parts: list[Any]) -> Any:
        if isinstance(parts[0], tuple):
            fields = (merge(list(column)) for column in zip(*parts, strict=True))
            return type(parts[0])(*fields)
        return np.stack(parts).astype(dtype)

    return merge(padded)
