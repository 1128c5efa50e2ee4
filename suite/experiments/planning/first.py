"""The first plan: a path that a quadrotor could fly, by what its acceleration asks of it.

By differential flatness (Mellinger and Kumar 2011): the specific force is the acceleration less
gravity and drag, the thrust is its length, body z its direction, and body rates are how fast that
turns.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.interface import GRAVITY
from suite.experiments.planning.course import PLACE_M, Course, nearness, passing
from suite.experiments.planning.solver import FELT, SMOOTH, Judged
from suite.experiments.planning.spline import Spline, along, fitted, unpacked
from tracks.geometry.scene import Array
from tracks.track import Track

SAMPLES = 160
POINTS = 400
"""Of the path that the search starts from."""
BEYOND = 1.06
"""The path is looked at so far beyond its duration, which ends about the last gate."""
DRAG = 0.25
"""Of the air, about, in a plan that need not be exact [1/s]."""
SPEED = 4.0
"""Of the path that the search starts from [m/s]."""
SLOW = 3.0
"""By which it starts from rest [m/s^2]."""
THRUST, RATE, UP_Z = 1.0, 0.5, 0.05
"""Excesses of 1: of thrust [m/s^2], of turning [rad/s], of tilt [1]."""
END_S = 0.1
"""By how much the path's end may be off the last gate, at a cost of half a second [s]."""
AXIS_M = 0.3
"""So far before and behind a gate it is on its axis [m]."""


class Limits(NamedTuple):
    """What a first plan may ask of the vehicle."""

    thrust: float
    """Largest collective thrust per mass [m/s^2]."""
    least_thrust: float
    """[m/s^2]."""
    rate: float
    """Largest turn of body z [rad/s]."""
    upright: float
    """Least z of body z [1]."""


def guess(track: Track) -> Spline:
    """Return a slow path straight through the gates' centres, from rest."""
    gates = track.scene.gates
    axis, center = gates.rot_w[:, :, 0], gates.center_w
    near = [
        np.stack([c - AXIS_M * n, c, c + AXIS_M * n]) for c, n in zip(center, axis, strict=True)
    ]
    points = np.concatenate([track.start_pos_w[None], *near])[:-1]
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    ease_s = SPEED / SLOW
    duration_s = far[-1] / SPEED + 0.5 * ease_s
    time_s = np.linspace(0.0, duration_s, POINTS)
    gone = np.where(time_s < ease_s, 0.5 * SLOW * time_s**2, SPEED * (time_s - 0.5 * ease_s))
    path = np.stack([np.interp(gone, far, points[:, k]) for k in range(3)], axis=-1)
    return fitted(path, duration_s)


def first_plan(numbers: Array, rest: tuple[Course, Limits]) -> Judged:
    """Judge the spline of `numbers` as a path that is flown exactly."""
    course, limits = rest
    spline = unpacked(numbers)
    dt = spline.duration_s * BEYOND / SAMPLES
    path = along(spline, jnp.arange(SAMPLES + 1) * dt)
    gates = passing(course, path.pos_w, dt)
    force = path.acc_w + jnp.asarray([0.0, 0.0, GRAVITY]) + DRAG * path.vel_w
    size = jnp.sqrt((force**2).sum(-1) + 1e-6)
    up = force / size[:, None]
    turn = jnp.sqrt((jnp.diff(up, axis=0) ** 2).sum(-1) + 1e-12) / dt
    lap_s = gates.time_s[-1]
    counts = (jnp.arange(SAMPLES + 1) * dt <= jax.lax.stop_gradient(lap_s)).astype(float)
    excess = [
        gates.excess.reshape(-1),
        nearness(course, path.pos_w) * counts,
        (size - limits.thrust) / THRUST * counts,
        (limits.least_thrust - size) / THRUST * counts,
        (turn - limits.rate) / RATE * counts[1:],
        (limits.upright - up[:, 2]) / UP_Z * counts,
    ]
    off = [
        (spline.control_w[:3] - course.start_w).reshape(-1) / PLACE_M,
        (lap_s - spline.duration_s)[None] / END_S,
        SMOOTH * jnp.diff(spline.control_w, 3, axis=0).reshape(-1),
    ]
    felt = path.acc_w.reshape(-1) / FELT
    return Judged(lap_s, jnp.concatenate(excess), jnp.concatenate(off), felt)
