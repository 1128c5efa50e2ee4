"""What a planned path must keep: the gates in order, clear of solids. What it breaks as numbers."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.worlds.slots import layout_of, pad_gates
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.crossing import sides
from tracks.geometry.gates import yaw_rotation
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Array, Gates, Scene, pad
from tracks.track import Track

PLACE_M = 0.05
"""An excess of 1: so much too near, or too far aside [m]."""


class Course(NamedTuple):
    """What one track asks of a path; rows of several have leading shapes."""

    gates: Gates
    """(G, ...) in flight order."""
    scene: Scene
    """All solids, padded."""
    start_w: Array
    """(3,) [m]."""
    rot_w: Array
    """(3, 3) attitude at the start."""
    room_m: Array
    """() the distance that the body's centre keeps from everything [m]."""


class Passing(NamedTuple):
    """How a path passes G gates."""

    time_s: Array
    """(G,) [s]."""
    excess: Array
    """(G, V + 2) not positive where it passes them inside their openings; as in `Judged`."""


def course_of(track: Track, room_m: float) -> Course:
    """Return what `track` asks of a path that keeps `room_m` [m] from everything."""
    layout = layout_of([track])
    gates = pad_gates(track.scene.gates, layout.gates, layout.corners)
    scene = pad(track.scene._replace(gates=gates), layout.solids)
    return Course(
        gates, scene, track.start_pos_w, yaw_rotation(track.start_yaw), np.float64(room_m)
    )


def passing(course: Course, pos_w: Array, dt: Array) -> Passing:
    """Return how the path pos_w (T, 3), a point every `dt` [s], passes the gates."""
    gates = course.gates
    place_g = to_local(gates.rot_w[:, None], pos_w - gates.center_w[:, None])  # (G, T, 3)
    held = jax.lax.stop_gradient(place_g)
    through = (held[:, :-1, 0] < 0.0) & (held[:, 1:, 0] >= 0.0)
    off = (held[:, :-1] ** 2).sum(-1) + jnp.where(through, 0.0, 1e4)
    index = jnp.argmin(off, axis=1)
    rows = jnp.arange(len(index))
    before, after = place_g[rows, index], place_g[rows, index + 1]
    travel = after[:, 0] - before[:, 0]
    crosses = through[rows, index]
    share = jnp.where(crosses, -before[:, 0] / jnp.where(crosses, travel, 1.0), 0.5)
    point = before[:, 1:] + share[:, None] * (after - before)[:, 1:]
    inside = inside_by(gates.opening_g, point)
    missed = jnp.stack([before[:, 0], -after[:, 0]], axis=-1)
    return Passing(
        (index + share) * dt,
        jnp.concatenate([course.room_m - inside, missed], axis=-1) / PLACE_M,
    )


def inside_by(opening_g: Array, point_g: Array) -> Array:
    """Return how far inside each side of its opening (G, V, 2) a point (G, 2) is, (G, V) [m].

    Sides of no length count as far away.
    """
    edge, turn = sides(opening_g, point_g)
    length = jnp.sqrt((edge**2).sum(-1))
    real = length > 1e-9
    return jnp.where(real, turn / jnp.where(real, length, 1.0), 10.0)


def nearness(course: Course, pos_w: Array) -> Array:
    """Return by how much points (T, 3) are too near to solids, (T,) as in `Judged`.

    The distance's gradient is the direction away from the nearest surface, which is exact.
    """
    held = jax.lax.stop_gradient(pos_w)
    batch = jax.tree.map(lambda array: jnp.asarray(array)[None], course.scene)
    distance, away_w = nearest_obstacle(batch, held[None])
    gap = distance[0] + ((pos_w - held) * away_w[0]).sum(-1)
    return (course.room_m - gap) / PLACE_M
