"""Collisions by distance (JAX): does the body's box touch a solid?

All computations are in the box's axes. Boxes and triangles use separating axes (Gottschalk, Lin and
Manocha 1996; Akenine-Moeller 2001). The distance to a capsule is convex along its axis and found by
bisection; that to a sphere is the distance of its centre. For a cylinder, a point is projected to
the cylinder and back to the box in turn, with momentum (alternating projections, Cheney and
Goldstein 1959; Beck and Teboulle 2009), until it converges to the nearest pair of points.
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
"""Number of tested solids of each kind, the nearest ones; updated every `NEAR_STEPS`."""
NEAR_STEPS = 40
"""Physics steps: 0.4 m at 5 m/s and 500 Hz."""
HALVINGS = 20
"""Number of halvings of a capsule's length, to a millionth of it."""
ROUNDS = 12
"""Number of projections to a cylinder and back."""
REACH = 1.5
"""Length of a projection over the way to the surface: beyond 1 the rounds converge faster, from 2
on they may not."""
CONTACT_M = 1e-3
"""A cylinder nearer than this is met: as near as the rounds come, and half a step's way at 1 m/s
[m]."""
_CULLED = ("boxes", "cylinders", "capsules", "spheres")
PARALLEL = 1e-3
"""Directions within this angle of parallel [rad] need no common normal: other axes cover them."""
_OWN = tuple(np.eye(3, dtype=np.float32))
_CORNERS = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(8, 3)


def near_solids(scene: Scene, pos_w: Array) -> Scene:
    """Keep the `NEAR` solids of each kind whose surfaces are nearest to pos_w (N, 3).

    Surfaces, as long walls would leave no place to what is near by their bounding spheres. Meshes
    are kept whole.
    """
    solids = scene._replace(triangles=scene.triangles[:, :0])
    distance, first, scores = distances(solids, pos_w)[0], 0, {}
    for kind in _CULLED:
        count = getattr(scene, kind)[0].shape[1]
        scores[kind] = distance[:, first : first + count]
        first += count
    return keep_best(scene, scores, NEAR)


def box_distances(
    scene: Scene, pos_w: Array, rot_w: Array, half_size: Array, middle_b: Array
) -> Array:
    """Return lower bounds of the distances (N, S + 1) [m] of box and solids; 0 or less: contact.

    Args:
        scene: batched, (N, ...), S solids in all.
        pos_w: (N, 3) bodies [m].
        rot_w: (N, 3, 3) body to world.
        half_size: (3,) of the body's box [m].
        middle_b: (3,) the box's middle in body axes [m].

    Returns:
        In the order boxes, cylinders, capsules, spheres, triangles, ground. How deep bodies are in
        one another is not measured.
    """
    middle_w, frame = pos_w + to_world(rot_w, middle_b), rot_w[:, None]

    def turned(vectors_w: Array) -> Array:
        return to_local(frame, vectors_w)

    def placed(points_w: Array) -> Array:
        return to_local(frame, points_w - middle_w[:, None])

    def placed_rods(rods: Rods) -> Rods:
        return rods._replace(center_w=placed(rods.center_w), axis_w=turned(rods.axis_w))

    boxes, corners = scene.boxes, [placed(scene.triangles[..., k, :]) for k in range(3)]
    sides = [turned(boxes.rot_w[..., k]) for k in range(3)]
    ground = middle_w[:, 2] - (jnp.abs(rot_w[:, 2]) * half_size).sum(-1)
    found = [
        _from_boxes(placed(boxes.center_w), sides, boxes.half_size, half_size),
        _from_cylinders(placed_rods(scene.cylinders), half_size),
        _from_capsules(placed_rods(scene.capsules), half_size),
        _beyond(placed(scene.spheres.center_w), half_size) - scene.spheres.radius,
        _from_triangles(corners, half_size),
        ground[:, None],
    ]
    return jnp.concatenate(found, axis=-1)


def _out(point: Array, half_size: Array) -> Array:
    """Return the vector from the nearest point of the box to points (..., 3), 0 inside."""
    return point - jnp.clip(point, -half_size, half_size)


def _beyond(point: Array, half_size: Array) -> Array:
    """Return the distances (...) of points (..., 3) from the box, 0 inside."""
    out = _out(point, half_size)
    return jnp.sqrt((out * out).sum(-1))


def _parted(
    axes: list[Array], low_high: Callable[[Array], tuple[Array, Array]], half_size: Array
) -> Array:
    """Return the largest separation of the box and a convex solid over a set of axes.

    Args:
        axes: (..., 3) each, of any length; those of none part nothing.
        low_high: from where to where the solid reaches along such an axis.
        half_size: (3,) of the box.
    """
    gaps = []
    for axis in axes:
        size = jnp.sqrt((axis * axis).sum(-1))
        low, high = low_high(axis)
        gap = jnp.maximum(low, -high) - (jnp.abs(axis) * half_size).sum(-1)
        gaps.append(jnp.where(size > PARALLEL, gap / jnp.maximum(size, PARALLEL), -jnp.inf))
    return functools.reduce(jnp.maximum, gaps)


def _from_boxes(center: Array, sides: list[Array], reach: Array, half_size: Array) -> Array:
    """Return the separation of boxes: centres (N, K, 3), unit vectors of sides, half sizes."""

    def low_high(axis: Array) -> tuple[Array, Array]:
        middle = (axis * center).sum(-1)
        half = sum(jnp.abs((axis * side).sum(-1)) * reach[..., k] for k, side in enumerate(sides))
        return middle - half, middle + half

    return _parted([*_OWN, *sides, *_across(sides)], low_high, half_size)


def _from_triangles(corners: list[Array], half_size: Array) -> Array:
    """Return the separation of triangles: (N, K, 3) for each corner."""

    def low_high(axis: Array) -> tuple[Array, Array]:
        along = [(axis * corner).sum(-1) for corner in corners]
        return functools.reduce(jnp.minimum, along), functools.reduce(jnp.maximum, along)

    a, b, c = corners
    edges = [_unit(b - a), _unit(c - b), _unit(a - c)]
    normal = cross(edges[0], edges[1])
    return _parted([*_OWN, normal, *_across(edges)], low_high, half_size)


def _across(directions: list[Array]) -> list[Array]:
    """Return the common normals of the box's sides and each of `directions`."""
    return [
        cross(jnp.broadcast_to(own, direction.shape), direction)
        for own in _OWN
        for direction in directions
    ]


def _unit(vector: Array) -> Array:
    size = jnp.sqrt((vector * vector).sum(-1, keepdims=True))
    return vector / jnp.maximum(size, 1e-9)


def _from_capsules(rods: Rods, half_size: Array) -> Array:
    """Return the separation of capsules, by bisection of each axis."""

    def halved(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        point = rods.center_w + middle[..., None] * rods.axis_w
        grows = (_out(point, half_size) * rods.axis_w).sum(-1) > 0.0
        return jnp.where(grows, low, middle), jnp.where(grows, middle, high)

    ends = (-rods.half_length, rods.half_length)
    low, high = jax.lax.fori_loop(0, HALVINGS, halved, ends)
    point = rods.center_w + (0.5 * (low + high))[..., None] * rods.axis_w
    return _beyond(point, half_size) - rods.radius


def _from_cylinders(rods: Rods, half_size: Array) -> Array:
    """Return the separation of cylinders less `CONTACT_M`, from two points of the box."""
    alone = jax.tree.map(lambda array: array[:, :, None], rods)

    def from_point(point: Array) -> tuple[Array, Array]:
        distance, away = to_cylinders(alone, point)
        return distance[..., 0], away[..., 0, :]

    def into_box(point: Array) -> Array:
        return jnp.clip(point, -half_size, half_size)

    shape = rods.center_w.shape
    corners = jnp.broadcast_to((_CORNERS * half_size)[:, None, None], (8, *shape))
    nearest = from_point(corners)[0].argmin(0)
    corner = jnp.take_along_axis(corners, nearest[None, ..., None], axis=0)[0]
    start = jnp.stack([into_box(rods.center_w), corner])

    def there_and_back(
        number: Array, carry: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        point, before, least = carry
        ahead = into_box(point + number / (number + 3.0) * (point - before))
        distance, away = from_point(ahead)
        least = jnp.minimum(least, distance)
        return into_box(ahead - REACH * distance[..., None] * away), point, least

    least = jnp.full(start.shape[:-1], jnp.inf, start.dtype)
    return jax.lax.fori_loop(0, ROUNDS, there_and_back, (start, start, least))[2].min(0) - CONTACT_M
