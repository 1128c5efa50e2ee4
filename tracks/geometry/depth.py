"""Render planar depth images by analytic ray casting, batched over scenes (JAX, for training).

Planar depth is the distance along the optical axis. Every solid is convex or a union of convex
parts. A ray is inside a convex part on an interval [enter, leave] of the ray parameter; the
interval of an intersection of sets is the intersection of their intervals. Rays have a component
of 1 along the optical axis, so the ray parameter is the planar depth. Shapes: B scenes with one
camera each, R rays, K solids of a kind; a solid's function gets one solid of each scene.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from tracks.geometry.cull import visible_solids
from tracks.geometry.scene import Array, Counts, Rods, Scene

_FAR = 1e9
"""Depth of a ray without a hit [m]."""
_TINY = 1e-12
"""Small number that avoids a division by zero."""


def _dot(a: Array, b: Array) -> Array:
    """Return the dot product over the last axis, written out so that XLA fuses it."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _entry(enter: Array, leave: Array) -> Array:
    """Return the start of an interval: 0 from inside, _FAR if it is empty or behind the camera."""
    return jnp.where((enter <= leave) & (leave > 0), jnp.maximum(enter, 0.0), _FAR)


def _nonzero(x: Array) -> Array:
    """Return x, or a tiny number where it is about zero, so that its reciprocal is finite."""
    return jnp.where(jnp.abs(x) < _TINY, _TINY, x)


def _slab(origin: Array, speed: Array, half: Array) -> tuple[Array, Array]:
    """Return the interval in which |origin + t speed| <= half."""
    inverse = 1.0 / _nonzero(speed)
    middle, spread = -origin * inverse, half * jnp.abs(inverse)
    return middle - spread, middle + spread


def _ball(square: Array, cross: Array, excess: Array) -> tuple[Array, Array]:
    """Return the interval in which square t^2 + 2 cross t + excess <= 0; empty: enter > leave."""
    discriminant = cross * cross - square * excess
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    inverse = 1.0 / jnp.maximum(square, _TINY)
    enter, leave = (-cross - root) * inverse, (-cross + root) * inverse
    return jnp.where(discriminant < 0, _FAR, enter), jnp.where(discriminant < 0, -_FAR, leave)


def _box(solid: tuple[Array, ...], rays: Array) -> Array:
    """Return the depths of hits on boxes."""
    # The camera's position in box axes (B, 3); the box's axes in the body frame as rows (B, 3, 3);
    # the box's half sizes (B, 3).
    origin, axes, half = solid
    enter, leave = -_FAR, _FAR
    for i in range(3):
        speed = _dot(axes[:, None, i], rays)
        near, far = _slab(origin[:, None, i], speed, half[:, None, i])
        enter, leave = jnp.maximum(enter, near), jnp.minimum(leave, far)
    return _entry(enter, leave)


def _sphere(solid: tuple[Array, ...], rays: Array) -> Array:
    """Return the depths of hits on spheres."""
    origin, radius = solid
    excess = _dot(origin, origin) - radius * radius
    return _entry(*_ball(_dot(rays, rays), _dot(origin[:, None], rays), excess[:, None]))


def _tube(solid: tuple[Array, ...], rays: Array) -> tuple[Array, Array]:
    """Return the interval inside a cylinder with flat ends."""
    origin, axis, radius, half = solid
    along, speed = _dot(origin, axis)[:, None], _dot(axis[:, None], rays)
    square = _dot(rays, rays) - speed * speed
    cross = _dot(origin[:, None], rays) - along * speed
    excess = _dot(origin, origin)[:, None] - along * along - (radius * radius)[:, None]
    enter, leave = _ball(square, cross, excess)
    near, far = _slab(along, speed, half[:, None])
    return jnp.maximum(enter, near), jnp.minimum(leave, far)


def _cylinder(solid: tuple[Array, ...], rays: Array) -> Array:
    return _entry(*_tube(solid, rays))


def _capsule(solid: tuple[Array, ...], rays: Array) -> Array:
    """Return the depths of hits on capsules: a cylinder and two spheres."""
    origin, axis, radius, half = solid
    offset = axis * half[:, None]
    ends = jnp.minimum(
        _sphere((origin - offset, radius), rays), _sphere((origin + offset, radius), rays)
    )
    return jnp.minimum(_entry(*_tube(solid, rays)), ends)


def _triangle(solid: tuple[Array, ...], rays: Array) -> Array:
    """Return the depths of hits on either side of triangles (Moeller & Trumbore 1997)."""
    corner, edge1, edge2 = solid  # (B, 3) each, in body axes, the corner relative to the camera
    across = jnp.cross(rays, edge2[:, None])
    determinant = _dot(edge1[:, None], across)
    inverse = 1.0 / _nonzero(determinant)
    u = _dot(-corner[:, None], across) * inverse
    normal = jnp.cross(-corner, edge1)
    v = _dot(rays, normal[:, None]) * inverse
    t = _dot(edge2, normal)[:, None] * inverse
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (jnp.abs(determinant) > _TINY)
    return jnp.where(hit, t, _FAR)


def _closest(
    depth: Array, cast: Callable[..., Array], solids: tuple[Array, ...], rays: Array
) -> Array:
    """Return the minimum of `depth` (B, R) and the depths of hits on solids (B, K, ...).

    The loop goes over the K solids. It keeps the running minimum in the CPU's cache and the
    arithmetic in vector registers, which one reduction of (B, K, R) does not.
    """
    count = solids[0].shape[1]
    if count == 0:
        return depth
    by_solid = tuple(jnp.moveaxis(array, 1, 0) for array in solids)

    def body(nearest: Array, solid: tuple[Array, ...]) -> tuple[Array, None]:
        return jnp.minimum(nearest, cast(solid, rays)), None

    return jax.lax.scan(body, depth, by_solid, unroll=min(count, 4))[0]


def _rods_b(rods: Rods, pos_w: Array, rot_w: Array) -> tuple[Array, ...]:
    """Return rods relative to the camera in body axes, for `_cylinder` and `_capsule`."""
    origin = (pos_w[:, None] - rods.center_w) @ rot_w
    return origin, rods.axis_w @ rot_w, rods.radius, rods.half_length


def depth_image(
    scene: Scene,
    pos_w: Array,
    rot_w: Array,
    rays_b: Array,
    range_m: float,
    limits: Counts | None = None,
) -> Array:
    """Return planar depths (B, R) [m], clipped to range_m; inside a solid the depth is 0.

    Args:
        scene: batched, (B, ...).
        pos_w: (B, 3) camera positions [m].
        rot_w: (B, 3, 3) body to world.
        rays_b: (R, 3) from `camera.pixel_rays_b`.
        range_m: largest depth [m].
        limits: numbers of the nearest visible solids of each kind that are used; None: all solids,
            which is exact.
    """
    if limits is not None:
        scene = visible_solids(scene, pos_w, rot_w, rays_b, range_m, limits)
    rays = rays_b[None]
    down = _dot(rot_w[:, None, 2], rays)
    depth = jnp.where(down < -_TINY, -pos_w[:, None, 2] / jnp.minimum(down, -_TINY), _FAR)
    depth = jnp.maximum(depth, 0.0)

    boxes = scene.boxes
    origin = ((pos_w[:, None] - boxes.center_w)[:, :, None] @ boxes.rot_w)[:, :, 0]
    axes = jnp.swapaxes(boxes.rot_w, -1, -2) @ rot_w[:, None]
    depth = _closest(depth, _box, (origin, axes, boxes.half_size), rays)
    depth = _closest(depth, _cylinder, _rods_b(scene.cylinders, pos_w, rot_w), rays)
    depth = _closest(depth, _capsule, _rods_b(scene.capsules, pos_w, rot_w), rays)
    origin = (pos_w[:, None] - scene.spheres.center_w) @ rot_w
    depth = _closest(depth, _sphere, (origin, scene.spheres.radius), rays)
    corners = (scene.triangles - pos_w[:, None, None]) @ rot_w[:, None]
    triangle = (
        corners[:, :, 0],
        corners[:, :, 1] - corners[:, :, 0],
        corners[:, :, 2] - corners[:, :, 0],
    )
    depth = _closest(depth, _triangle, triangle, rays)
    return jnp.minimum(depth, range_m)
