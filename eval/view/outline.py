"""What solids look like from above or from the side: convex outlines of their projections."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from tracks.scene import PARKED_Z, Scene

ROUND_POINTS = 24
"""Points around a circle."""


def solid_points(scene: Scene) -> Iterator[np.ndarray]:
    """Yield for each solid points (n, 3) whose convex hull it is (round ones nearly) [m].

    Boxes, cylinders, capsules, spheres and triangles, in that order; parked padding is left out.
    """
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    for center, rot, half in zip(*scene.boxes, strict=True):
        yield from _unless_parked(center + (signs * half) @ rot.T)
    ball = _ball()
    for rods, caps in ((scene.cylinders, False), (scene.capsules, True)):
        for center, axis, radius, half in zip(*rods, strict=True):
            end = ball * radius if caps else _disc(axis) * radius
            both = np.concatenate([end - half * axis, end + half * axis])
            yield from _unless_parked(center + both)
    for center, radius in zip(*scene.spheres, strict=True):
        yield from _unless_parked(center + ball * radius)
    for corners in scene.triangles:
        yield from _unless_parked(corners)


def outline(points: np.ndarray) -> np.ndarray:
    """Return the corners (k, 2) of the convex hull of `points` (n, 2), counter-clockwise.

    Andrew's monotone chain (1979), which takes points on one line, too.
    """
    ordered = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    if len(ordered) < 3:
        return ordered
    return np.array(_half_hull(ordered)[:-1] + _half_hull(ordered[::-1])[:-1])


def _half_hull(ordered: np.ndarray) -> list[np.ndarray]:
    hull: list[np.ndarray] = []
    for point in ordered:
        while len(hull) >= 2:
            one, two = hull[-1] - hull[-2], point - hull[-2]
            if one[0] * two[1] - one[1] * two[0] > 0:
                break
            hull.pop()
        hull.append(point)
    return hull


def _unless_parked(points: np.ndarray) -> Iterator[np.ndarray]:
    if points[0, 2] > PARKED_Z / 2:
        yield points


def _ball() -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, ROUND_POINTS, endpoint=False)
    height = np.linspace(-1, 1, 13)
    ring = np.sqrt(1 - height**2)
    x, y = np.outer(ring, np.cos(angle)), np.outer(ring, np.sin(angle))
    return np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1).reshape(-1, 3)


def _disc(axis: np.ndarray) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, ROUND_POINTS, endpoint=False)[:, None]
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    return np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)
