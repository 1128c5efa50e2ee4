"""Distances between the drone's collision box and the solids of a scene, for collisions in JAX.

All computations are in the box's axes. Boxes and triangles use separating axes (Gottschalk, Lin and
Manocha 1996; Akenine-Moeller 2001). The distance to a capsule is convex along its axis, so its
minimum is found by bisection; a sphere's distance is that of its centre minus its radius. For a
cylinder, a point is projected to the cylinder and back to the box, again and again and with
momentum, and converges to the nearest pair of points (alternating projections, Cheney and Goldstein
1959; Beck and Teboulle 2009).
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from tracks.geometry.clearance import distances, to_cylinders
from tracks.geometry.cull import keep_best
from tracks.geometry.rotation import cross, to_local, to_world
from tracks.geometry.scene import Array, Counts, Rods, Scene

NEAR = Counts(boxes=12, cylinders=4, capsules=4, spheres=4)
"""Number of solids of each kind that are tested: the nearest ones, updated every `NEAR_STEPS`."""
NEAR_STEPS = 40
"""Number of physics steps between updates of the nearest solids. Meanwhile a drone flies 0.4 m, at
5 m/s and 500 Hz."""
HALVINGS = 20
"""Number of bisections along a capsule's axis; they find the nearest point to a millionth of the
length."""
ROUNDS = 12
"""Number of projections from the box to a cylinder and back."""
OVER_RELAXATION = 1.5
"""Factor of the step towards a cylinder's surface: above 1 the rounds converge faster, from 2 on
they may diverge."""
CONTACT_M = 1e-3
"""A cylinder nearer than this counts as touched [m]. It is the accuracy of the projections, and
half the distance flown in a step at 1 m/s."""
PARALLEL = 1e-3
"""Directions within this angle of parallel [rad] need no common normal: other axes cover them."""
_CULLED = ("boxes", "cylinders", "capsules", "spheres")
"""Kinds of solids of which only the nearest are tested."""
_BOX_AXES = tuple(np.eye(3, dtype=np.float32))
"""Axes of the box, in the box's axes."""
_CORNERS = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(8, 3)
"""(8, 3) corners of the box, relative to its half extents."""


def near_solids(scene: Scene, pos_w: Array) -> Scene:
    """Return the scene with the `NEAR` solids of each kind nearest to pos_w (N, 3), and all meshes.

    Distances are to the surfaces. With distances to bounding spheres, a long wall would seem nearer
    than solids that are in fact nearer.
    """
    solids = scene._replace(triangles=scene.triangles[:, :0])
    distance, first_column, scores = distances(solids, pos_w)[0], 0, {}
    for kind in _CULLED:
        count = getattr(scene, kind)[0].shape[1]
        scores[kind] = distance[:, first_column : first_column + count]
        first_column += count
    return keep_best(scene, scores, NEAR)


def box_distances(
    scene: Scene, pos_w: Array, rot_w: Array, half_size: Array, middle_b: Array
) -> Array:
    """Return lower bounds of the distances of box and solids (N, S + 1) [m]; 0 or less: contact.

    Args:
        scene: batched scene (N, ...) with S solids.
        pos_w: (N, 3) positions of the bodies [m].
        rot_w: (N, 3, 3) attitudes, body to world.
        half_size: (3,) half extents of the body's box [m].
        middle_b: (3,) the box's centre in body axes [m].

    Returns:
        The distances in the order boxes, cylinders, capsules, spheres, triangles, ground. A
        distance of 0 or less is not the depth of penetration.
    """
    middle_w, frame = pos_w + to_world(rot_w, middle_b), rot_w[:, None]

    def to_box_axes(vectors_w: Array) -> Array:
        return to_local(frame, vectors_w)

    def to_box(points_w: Array) -> Array:
        return to_local(frame, points_w - middle_w[:, None])

    def rods_to_box(rods: Rods) -> Rods:
        return rods._replace(center_w=to_box(rods.center_w), axis_w=to_box_axes(rods.axis_w))

    boxes, corners = scene.boxes, [to_box(scene.triangles[..., k, :]) for k in range(3)]
    sides = [to_box_axes(boxes.rot_w[..., k]) for k in range(3)]
    ground = middle_w[:, 2] - (jnp.abs(rot_w[:, 2]) * half_size).sum(-1)
    distances_m = [
        _from_boxes(to_box(boxes.center_w), sides, boxes.half_size, half_size),
        _from_cylinders(rods_to_box(scene.cylinders), half_size),
        _from_capsules(rods_to_box(scene.capsules), half_size),
        _from_points(to_box(scene.spheres.center_w), half_size) - scene.spheres.radius,
        _from_triangles(corners, half_size),
        ground[:, None],
    ]
    return jnp.concatenate(distances_m, axis=-1)


def _outwards(point: Array, half_size: Array) -> Array:
    """Return the vectors from the nearest point of the box to points (..., 3), 0 inside."""
    return point - jnp.clip(point, -half_size, half_size)


def _from_points(point: Array, half_size: Array) -> Array:
    """Return the distances (...,) of points (..., 3) from the box, 0 inside."""
    outwards = _outwards(point, half_size)
    return jnp.sqrt((outwards * outwards).sum(-1))


def _separation(
    axes: list[Array], low_high: Callable[[Array], tuple[Array, Array]], half_size: Array
) -> Array:
    """Return the largest separation of the box and a convex solid over a set of axes.

    Directions are (..., 3) of any length; those of length zero are ignored. `low_high` returns the
    two ends of the solid's extent along an axis. The box has half extents `half_size` (3,).
    """
    gaps = []
    for axis in axes:
        size = jnp.sqrt((axis * axis).sum(-1))
        low, high = low_high(axis)
        gap = jnp.maximum(low, -high) - (jnp.abs(axis) * half_size).sum(-1)
        gaps.append(jnp.where(size > PARALLEL, gap / jnp.maximum(size, PARALLEL), -jnp.inf))
    return functools.reduce(jnp.maximum, gaps)


def _from_boxes(center: Array, sides: list[Array], extent: Array, half_size: Array) -> Array:
    """Return the separation (N, K) of boxes.

    Args:
        center: (N, K, 3) centres of the boxes.
        sides: (N, K, 3) each, unit vectors of their sides.
        extent: (N, K, 3) their half extents.
        half_size: (3,) half extents of the body's box.
    """

    def low_high(axis: Array) -> tuple[Array, Array]:
        center_along = (axis * center).sum(-1)
        half_along = sum(
            jnp.abs((axis * side).sum(-1)) * extent[..., k] for k, side in enumerate(sides)
        )
        return center_along - half_along, center_along + half_along

    return _separation([*_BOX_AXES, *sides, *_normals(sides)], low_high, half_size)


def _from_triangles(corners: list[Array], half_size: Array) -> Array:
    """Return the separation (N, K) of triangles, given by three corners (N, K, 3)."""

    def low_high(axis: Array) -> tuple[Array, Array]:
        along = [(axis * corner).sum(-1) for corner in corners]
        return functools.reduce(jnp.minimum, along), functools.reduce(jnp.maximum, along)

    a, b, c = corners
    edges = [_unit(b - a), _unit(c - b), _unit(a - c)]
    normal = cross(edges[0], edges[1])
    return _separation([*_BOX_AXES, normal, *_normals(edges)], low_high, half_size)


def _normals(directions: list[Array]) -> list[Array]:
    """Return the common normals of the box's sides and each of `directions`."""
    return [
        cross(jnp.broadcast_to(box_axis, direction.shape), direction)
        for box_axis in _BOX_AXES
        for direction in directions
    ]


def _unit(vector: Array) -> Array:
    size = jnp.sqrt((vector * vector).sum(-1, keepdims=True))
    return vector / jnp.maximum(size, 1e-9)


def _from_capsules(rods: Rods, half_size: Array) -> Array:
    """Return the distances (N, K) of capsules, by bisection along each axis."""

    def bisect(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle_of_ends = 0.5 * (low + high)
        point = rods.center_w + middle_of_ends[..., None] * rods.axis_w
        grows = (_outwards(point, half_size) * rods.axis_w).sum(-1) > 0.0
        return jnp.where(grows, low, middle_of_ends), jnp.where(grows, middle_of_ends, high)

    ends = (-rods.half_length, rods.half_length)
    low, high = jax.lax.fori_loop(0, HALVINGS, bisect, ends)
    point = rods.center_w + (0.5 * (low + high))[..., None] * rods.axis_w
    return _from_points(point, half_size) - rods.radius


def _from_cylinders(rods: Rods, half_size: Array) -> Array:
    """Return the distances (N, K) of cylinders minus `CONTACT_M`.

    The projections start from two points of the box: the point nearest to the cylinder's centre,
    and the corner nearest to the cylinder. The smaller of the two distances counts.
    """
    single = jax.tree.map(lambda array: array[:, :, None], rods)

    def from_point(point: Array) -> tuple[Array, Array]:
        distance, away = to_cylinders(single, point)
        return distance[..., 0], away[..., 0, :]

    def into_box(point: Array) -> Array:
        return jnp.clip(point, -half_size, half_size)

    shape = rods.center_w.shape
    corners = jnp.broadcast_to((_CORNERS * half_size)[:, None, None], (8, *shape))
    nearest = from_point(corners)[0].argmin(0)
    corner = jnp.take_along_axis(corners, nearest[None, ..., None], axis=0)[0]
    start = jnp.stack([into_box(rods.center_w), corner])

    def project(number: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        point, before, least = carry
        ahead = into_box(point + number / (number + 3.0) * (point - before))  # with momentum
        distance, away = from_point(ahead)
        least = jnp.minimum(least, distance)
        return into_box(ahead - OVER_RELAXATION * distance[..., None] * away), point, least

    least = jnp.full(start.shape[:-1], jnp.inf, start.dtype)
    return jax.lax.fori_loop(0, ROUNDS, project, (start, start, least))[2].min(0) - CONTACT_M
