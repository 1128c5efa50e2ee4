"""Signed distances from points to the solids of a scene and the ground, and directions away (JAX).

Inside a solid the distance is negative and the direction points to the nearest surface, so that a
repulsive gradient always points to free space. The training's collision loss uses it.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from tracks.geometry.cull import nearest_solids
from tracks.geometry.scene import Array, Boxes, Counts, Rods, Scene, Spheres

_TINY = 1e-9
"""Shortest length of a vector that has a direction [m]."""


def _norm(vector: Array) -> Array:
    return jnp.sqrt((vector * vector).sum(-1))


def _direction(vector: Array, length: Array) -> Array:
    """Return vector / length, and world z where the length is zero."""
    up = jnp.asarray([0.0, 0.0, 1.0])
    return jnp.where(length[..., None] > _TINY, vector / jnp.maximum(length, _TINY)[..., None], up)


def _box(boxes: Boxes, point_w: Array) -> tuple[Array, Array]:
    """Return signed distances to boxes, and directions away (see `distances`)."""
    local = (point_w[..., None, :] - boxes.center_w)[..., None, :] @ boxes.rot_w
    local = local[..., 0, :]
    # Signed distance to the faces of each axis, negative inside; the largest is that of the box.
    face_distance = jnp.abs(local) - boxes.half_size
    outside = jnp.maximum(face_distance, 0.0)
    inside_distance = face_distance.max(-1)
    is_inside = inside_distance < 0
    nearest_face = jnp.where(face_distance >= inside_distance[..., None], 1.0, 0.0)
    length = _norm(outside)
    away = jnp.where(is_inside[..., None], nearest_face, _direction(outside, length))
    away = away * jnp.where(local < 0, -1.0, 1.0)
    normal = (boxes.rot_w @ away[..., None])[..., 0]
    return jnp.where(is_inside, inside_distance, length), _direction(normal, _norm(normal))


def _sphere(spheres: Spheres, point_w: Array) -> tuple[Array, Array]:
    """Return signed distances to spheres, and directions away (see `distances`)."""
    away = point_w[..., None, :] - spheres.center_w
    length = _norm(away)
    return length - spheres.radius, _direction(away, length)


def _capsule(rods: Rods, point_w: Array) -> tuple[Array, Array]:
    """Return distances to rods with round ends, and directions away (see `distances`)."""
    away = point_w[..., None, :] - rods.center_w
    along = jnp.clip((away * rods.axis_w).sum(-1), -rods.half_length, rods.half_length)
    away = away - along[..., None] * rods.axis_w
    length = _norm(away)
    return length - rods.radius, _direction(away, length)


def to_cylinders(rods: Rods, point_w: Array) -> tuple[Array, Array]:
    """Return signed distances to rods with flat ends, and directions away (see `distances`)."""
    away = point_w[..., None, :] - rods.center_w
    along = (away * rods.axis_w).sum(-1)
    radial = away - along[..., None] * rods.axis_w
    radius = _norm(radial)
    # Signed distances to the curved side and to the plane of the nearer end, negative inside.
    side, end = radius - rods.radius, jnp.abs(along) - rods.half_length
    outward = _direction(radial, radius)
    endward = rods.axis_w * jnp.where(along < 0, -1.0, 1.0)[..., None]
    beyond_side, beyond_end = jnp.maximum(side, 0.0), jnp.maximum(end, 0.0)
    length = jnp.hypot(beyond_side, beyond_end)
    corner = beyond_side[..., None] * outward + beyond_end[..., None] * endward
    inside = jnp.where((side > end)[..., None], outward, endward)
    is_inside = (side < 0) & (end < 0)
    normal = jnp.where(is_inside[..., None], inside, _direction(corner, length))
    return jnp.where(is_inside, jnp.maximum(side, end), length), normal


def _triangle(corners: Array, point_w: Array) -> tuple[Array, Array]:
    """Return unsigned distances to triangles (..., 3, 3), and directions away from them.

    Source: Ericson 2005, Real-Time Collision Detection, 5.1.5.
    """
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    p = point_w[..., None, :]
    normal = jnp.cross(b - a, c - a)
    normal = normal / jnp.maximum(_norm(normal), _TINY)[..., None]
    plane = p - ((p - a) * normal).sum(-1)[..., None] * normal

    def on_left(start: Array, end: Array) -> Array:
        return (jnp.cross(end - start, plane - start) * normal).sum(-1) >= 0

    def on_edge(start: Array, end: Array) -> Array:
        edge = end - start
        square = jnp.maximum((edge * edge).sum(-1), _TINY)
        share = jnp.clip(((p - start) * edge).sum(-1) / square, 0, 1)
        return start + share[..., None] * edge

    edge_points = jnp.stack([on_edge(a, b), on_edge(b, c), on_edge(c, a)])
    index = _norm(p - edge_points).argmin(0)[None, ..., None]
    nearest = jnp.take_along_axis(edge_points, index, axis=0)[0]
    projects_inside = on_left(a, b) & on_left(b, c) & on_left(c, a)
    away = p - jnp.where(projects_inside[..., None], plane, nearest)
    length = _norm(away)
    return length, _direction(away, length)


def distances(scene: Scene, point_w: Array) -> tuple[Array, Array]:
    """Return signed distances to every solid and the ground, and the directions away from them.

    Args:
        scene: arrays (..., N, ...) whose leading shape broadcasts with that of point_w.
        point_w: (..., 3) the points [m].

    Returns:
        distance (..., N + 1) [m] in the order boxes, cylinders, capsules, spheres, triangles,
        ground; away (..., N + 1, 3) unit vectors along which the distance grows.
    """
    kinds: list[tuple[Any, Any, Array]] = [
        (_box, scene.boxes, scene.boxes.center_w),
        (to_cylinders, scene.cylinders, scene.cylinders.center_w),
        (_capsule, scene.capsules, scene.capsules.center_w),
        (_sphere, scene.spheres, scene.spheres.center_w),
        (_triangle, scene.triangles, scene.triangles[..., 0]),
    ]
    by_kind = [f(solids, point_w) for f, solids, rows in kinds if rows.shape[-2] > 0]
    ground = point_w[..., None, 2]
    up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), (*ground.shape, 3))
    distance = jnp.concatenate([d for d, _ in by_kind] + [ground], axis=-1)
    return distance, jnp.concatenate([n for _, n in by_kind] + [up], axis=-2)


def nearest_obstacle(
    scene: Scene, point_w: Array, limits: Counts | None = None
) -> tuple[Array, Array]:
    """Return the signed distance to the nearest solid or the ground, and the direction away.

    Args:
        scene: batched, (B, ...).
        point_w: (B, S, 3) points on a short piece of path in each scene [m].
        limits: use only this many solids of each kind, those whose bounding spheres are nearest
            to the middle point; None uses all, which is exact.

    Returns:
        distance (B, S) [m]; away (B, S, 3), the unit vectors along which it grows. The nearest
        surface point is point - distance * away.
    """
    if limits is not None:
        scene = nearest_solids(scene, point_w[:, point_w.shape[1] // 2], limits)
    spread = jax.tree.map(lambda array: array[:, None], scene)  # an axis for the points
    distance, away = distances(spread, point_w)
    nearest_index = distance.argmin(-1)[..., None]
    nearest = jnp.take_along_axis(distance, nearest_index, axis=-1)[..., 0]
    return nearest, jnp.take_along_axis(away, nearest_index[..., None], axis=-2)[..., 0, :]
