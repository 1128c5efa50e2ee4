"""Detect gate crossings: the gate's plane is crossed inside the opening, in flight direction.

The functions take numpy and JAX arrays.
"""

from __future__ import annotations

from tracks.common.masks import nowhere
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Array

NEAR_RADIUS_M = 0.35
"""Distance from a gate's centre [m] within which Yu et al. 2025 count the gate as passed."""


def is_inside(opening_g: Array, point_g: Array) -> Array:
    """Return whether (y, z) points (..., 2) lie in the convex opening (..., V, 2)."""
    _, turn = sides(opening_g, point_g)
    return (turn >= 0).all(-1)


def sides(opening_g: Array, point_g: Array) -> tuple[Array, Array]:
    """Return the sides of an opening, and on which side of each a point lies.

    Args:
        opening_g: (..., V, 2) corners (y, z), counter-clockwise [m].
        point_g: (..., 2) the point (y, z) [m].

    Returns:
        edge (..., V, 2) from corner to corner [m]; turn (..., V), the signed distance of the point
        from an edge, positive inside, times the edge's length [m^2].
    """
    xp = point_g.__array_namespace__()
    edge = xp.roll(opening_g, -1, axis=-2) - opening_g
    away = point_g[..., None, :] - opening_g
    return edge, edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0]


def crossing(
    center_w: Array, rot_w: Array, opening_g: Array, before_w: Array, after_w: Array
) -> tuple[Array, Array]:
    """Return whether a straight step passes or misses a gate, each (...) bool.

    Args:
        center_w: (..., 3) opening's centre [m].
        rot_w: (..., 3, 3) gate to world.
        opening_g: (..., V, 2) corners (y, z), counter-clockwise [m].
        before_w: (..., 3) start of the step [m].
        after_w: (..., 3) end of the step [m].

    Returns:
        passed: the step crosses the gate's plane in flight direction, inside the opening; missed:
        it crosses the plane in flight direction, outside the opening.
    """
    xp = before_w.__array_namespace__()
    before, after = to_local(rot_w, before_w - center_w), to_local(rot_w, after_w - center_w)
    crosses = (before[..., 0] < 0) & (after[..., 0] >= 0)
    if nowhere(crosses):
        return crosses, crosses  # the usual case, in which nothing more is to compute
    travel = after[..., 0] - before[..., 0]
    fraction = -before[..., 0] / xp.where(crosses, travel, 1.0)
    point = before[..., 1:] + fraction[..., None] * (after - before)[..., 1:]
    inside = is_inside(opening_g, point)
    return crosses & inside, crosses & ~inside


def is_near(center_w: Array, point_w: Array) -> Array:
    """Return whether point_w (..., 3) is within `NEAR_RADIUS_M` of a gate's centre (..., 3)."""
    away = point_w - center_w
    return (away * away).sum(-1) <= NEAR_RADIUS_M**2
