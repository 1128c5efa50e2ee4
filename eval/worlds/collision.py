"""Collisions by signed distance (JAX): does the body's box meet a solid?

For every solid near by, a point of the box is moved to the solid and back into the box in turn.
Both are convex, so that the point ends where the two are nearest to one another (alternating
projections, Cheney and Goldstein 1959); they are in contact where that distance is nought.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from tracks.geometry.clearance import distances
from tracks.geometry.cull import keep_best
from tracks.geometry.rotation import to_local, to_world
from tracks.geometry.scene import Array, Counts, Scene

NEAR = Counts(boxes=12, cylinders=4, capsules=4, spheres=4)
"""Solids looked at: of each kind those with the nearest surface, found anew once a decision."""
ROUNDS = 12
"""Projections to and fro; bodies that merely graze one another may be seen a few steps later."""
REACH = 1.5
"""Length of a projection over the way to the surface: beyond 1 the rounds converge faster, from 2
on they may not."""
CONTACT_M = 1e-3
"""Nearer than this is a contact: as near as the rounds come, and half a step's way at 1 m/s [m]."""
_KINDS = ("boxes", "cylinders", "capsules", "spheres", "triangles")


def near_solids(scene: Scene, pos_w: Array) -> Scene:
    """Keep the `NEAR` solids of each kind whose surfaces are nearest to pos_w (N, 3).

    Surfaces, as long walls would leave no place to what is near by their bounding spheres. Meshes
    are kept whole.
    """
    solids = scene._replace(triangles=scene.triangles[:, :0])
    distance, first, scores = distances(solids, pos_w)[0], 0, {}
    for kind in _KINDS[:-1]:
        count = getattr(scene, kind)[0].shape[1]
        scores[kind] = distance[:, first : first + count]
        first += count
    return keep_best(scene, scores, NEAR)


def box_distances(
    scene: Scene, pos_w: Array, rot_w: Array, half_size: Array, middle_b: Array
) -> Array:
    """Return the distances (N, S + 1) [m] between boxes and solids; 0 or less where they meet.

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
    middle_w = pos_w + to_world(rot_w, middle_b)
    found = [_distance(_only(scene, kind), kind, middle_w, rot_w, half_size) for kind in _KINDS]
    reach = (jnp.abs(rot_w[:, 2]) * half_size).sum(-1)
    ground = (middle_w[:, 2] - reach)[:, None]
    return jnp.concatenate([*(each for each in found if each is not None), ground], axis=-1)


def _only(scene: Scene, kind: str) -> Scene:
    """Return the scene with one kind of solid, each alone in a scene of its own: (N, K, 1, ...)."""

    def each(array: Array) -> Array:
        return array[:, :, None]

    def none(array: Array) -> Array:
        return array[:, :1, None][:, :, :0]

    parts = {
        name: jax.tree.map(each if name == kind else none, getattr(scene, name)) for name in _KINDS
    }
    return scene._replace(**parts)


def _distance(
    alone: Scene, kind: str, middle_w: Array, rot_w: Array, half_size: Array
) -> Array | None:
    solids = getattr(alone, kind)
    places = solids if kind == "triangles" else solids[0]
    if places.shape[1] == 0:
        return None
    rot = rot_w[:, None]
    middle = middle_w[:, None]

    def into_box(point_w: Array) -> Array:
        local = to_local(rot, point_w - middle)
        local = jnp.clip(local, -half_size, half_size)
        return middle + to_world(rot, local)

    start = into_box(places.mean(-2)[:, :, 0] if kind == "triangles" else places[:, :, 0])

    def there_and_back(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        point, nearest = carry
        distance, away = distances(alone, point)
        nearest = jnp.minimum(nearest, distance[..., 0])
        return into_box(point - REACH * distance[..., :1] * away[..., 0, :]), nearest

    nearest = jnp.full(start.shape[:-1], jnp.inf, start.dtype)
    return jax.lax.fori_loop(0, ROUNDS, there_and_back, (start, nearest))[1]
