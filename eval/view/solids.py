"""A track's solids (the frames of its gates, and its obstacles) as triangles for drawing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tracks.formats.meshes import solid_meshes
from tracks.track import Track

DRONE_HALF_SIZE = (0.064, 0.064, 0.025)
"""Default half extents of a drawn body [m]."""
ROTOR_RADIUS_M = 0.0635
"""Radius of the drawn rotors [m]."""


class Solid(NamedTuple):
    """One convex solid as triangles in the world frame."""

    name: str
    gate: int | None
    """Number of the gate to whose frame the solid belongs; None for an obstacle."""
    vertices: np.ndarray
    """(V, 3) positions [m]."""
    faces: np.ndarray
    """(F, 3) indices of vertices, counter-clockwise seen from outside."""


def track_solids(track: Track) -> list[Solid]:
    """Return every solid of `track`: the bars of the gates' frames first, then the obstacles."""
    gates = track.scene.gates.opening_g.shape[0]
    # The bars of gates come first in a scene, and each has its gate's name.
    number = {name: k for k, name in enumerate(list(dict.fromkeys(track.names))[:gates])}
    return [
        Solid(name, number.get(name), np.asarray(mesh.vertices), np.asarray(mesh.faces))
        for name, mesh in solid_meshes(track)
    ]


def join_solids(solids: list[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) [m] and faces (F, 3) of several solids as one mesh."""
    offsets = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + offset for solid, offset in zip(solids, offsets, strict=False)]
    return np.concatenate([solid.vertices for solid in solids]), np.concatenate(faces)


def flat_normals(corners: np.ndarray) -> np.ndarray:
    """Return the unit normals (F, 3) of triangles (F, 3, 3); zero for a triangle without area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def outline(points: np.ndarray) -> np.ndarray:
    """Return the corners (k, 2) of the convex hull of `points` (n, 2), counter-clockwise.

    The method is Andrew's monotone chain (1979), which also works for collinear points.
    """
    ordered = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    if len(ordered) < 3:
        return ordered
    return np.array(_half_hull(ordered)[:-1] + _half_hull(ordered[::-1])[:-1])


def _half_hull(ordered: np.ndarray) -> list[np.ndarray]:
    """Return the lower half of the hull of points (n, 2) in increasing order.

    For points in decreasing order it is the upper half.
    """
    hull: list[np.ndarray] = []
    for point in ordered:
        while len(hull) >= 2:
            last, new = hull[-1] - hull[-2], point - hull[-2]
            if last[0] * new[1] - last[1] * new[0] > 0:  # a turn to the left
                break
            hull.pop()
        hull.append(point)
    return hull
