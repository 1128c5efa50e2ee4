"""Select the relevant solids of a scene: the nearest, or those in the camera's view (JAX).

Scenes are batched, (B, ...), and array shapes must not depend on values. So the K best solids of
each kind are gathered, where K is set by the caller's `Counts`. A kind with at most K solids is
returned unchanged.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from tracks.geometry.bounds import bounds
from tracks.geometry.scene import Array, Counts, Scene

_INVISIBLE = 1e6
"""Number that is added to the score of a solid out of view, which so comes last [m]."""


def _gather(solids: Any, index: Array) -> Any:
    gather = jax.vmap(lambda rows, i: rows[i])
    return jax.tree.map(lambda array: gather(array, index), solids)


def keep_best(scene: Scene, scores: dict[str, Array], limits: Counts) -> Scene:
    """Return the scene with the solids of the least scores (B, N), at most `limits` a kind."""
    kept = {}
    for name, score in scores.items():
        limit = getattr(limits, name)
        if score.shape[-1] > limit:
            kept[name] = _gather(getattr(scene, name), jax.lax.top_k(-score, limit)[1])
    return scene._replace(**kept)


def nearest_solids(scene: Scene, pos_w: Array, limits: Counts) -> Scene:
    """Return the scene with the solids whose bounding spheres are nearest to pos_w (B, 3) [m]."""
    scores = {}
    for name, ball in bounds(scene).items():
        away = ball.center_w - pos_w[:, None]
        scores[name] = jnp.sqrt((away * away).sum(-1)) - ball.radius
    return keep_best(scene, scores, limits)


def visible_solids(
    scene: Scene, pos_w: Array, rot_w: Array, rays_b: Array, range_m: float, limits: Counts
) -> Scene:
    """Return the scene with the nearest solids whose bounding spheres reach into the view cone.

    Args:
        scene: batched, (B, ...).
        pos_w: (B, 3) camera positions [m].
        rot_w: (B, 3, 3) body to world.
        rays_b: (R, 3) rays in body axes; the view cone around their mean contains them all.
        range_m: largest planar depth [m].
        limits: number of solids of each kind to keep.
    """
    unit = rays_b / jnp.linalg.norm(rays_b, axis=-1, keepdims=True)
    axis_b = unit.mean(0) / jnp.linalg.norm(unit.mean(0))
    cosine = (unit @ axis_b).min()
    sine = jnp.sqrt(1 - cosine**2)
    reach = range_m * jnp.linalg.norm(rays_b, axis=-1).max()
    axis_w = rot_w @ axis_b
    scores = {}
    for name, ball in bounds(scene).items():
        away = ball.center_w - pos_w[:, None]
        squared = (away * away).sum(-1)
        along = (away * axis_w[:, None]).sum(-1)
        across = jnp.sqrt(jnp.maximum(squared - along * along, 0.0))
        outside_cone = across * cosine - along * sine > ball.radius
        distance = jnp.sqrt(squared) - ball.radius
        invisible = (outside_cone & (distance > 0)) | (distance > reach)
        scores[name] = jnp.where(invisible, _INVISIBLE + distance, distance)
    return keep_best(scene, scores, limits)
