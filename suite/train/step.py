"""One step of worlds, as the losses and the reward read it: where to, how near to what."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from suite.train.config import LossConfig
from suite.train.dynamics.interface import DynamicsState
from suite.train.worlds import Worlds
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.crossing import crossing
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Counts, Gates

BODY_RADIUS_M = 0.08
"""Closer than this to a surface is a collision [m]."""
NEAR = Counts(boxes=8, cylinders=4, capsules=3, spheres=3)
"""Solids of each kind among which the nearest obstacle is looked for."""
BEYOND_M = 10.0
"""After the last gate the target is this far behind it, so that nothing is gained by braking; with
`episode.finish` that is for the one step that passes the gate."""
PATH_SAMPLES = 4
"""Points of every step's path at which the nearest obstacle is looked for: at 7 m/s and 30 Hz they
are 6 cm apart, less than the body's radius."""
APPROACH_FREE_M = 0.3
"""So far off its axis a gate is still flown at straight [m]."""


class Step(NamedTuple):
    """What a term may read: one step of B worlds."""

    pos_w: jax.Array
    """(B, 3) at the step's end [m]."""
    vel_w: jax.Array
    """(B, 3) [m/s]."""
    acc_w: jax.Array
    """(B, 3) net acceleration [m/s^2]."""
    jerk_w: jax.Array
    """(B, 3) change of the acceleration from the step before, over the step's time [m/s^3]."""
    up: jax.Array
    """(B,) z of body z at the step's end, with gradient where the attitude has one [1]."""
    gap: jax.Array
    """(B, S) distance to the nearest solid beyond r_q at points of the path, with gradient [m]."""
    away_w: jax.Array
    """(B, S, 3) unit vectors along which it grows."""
    goal_w: jax.Array
    """(B, 3) the point that progress is measured to [m]."""
    place_g: jax.Array
    """(B, 3) position in the frame of the gate flown to, wherever before it the goal is [m]."""
    gate: Gates
    """(B, ...) whose field pulls: the one to pass when the step began."""
    passed: jax.Array
    """(B,) bool: that gate was crossed."""
    clearance: jax.Array
    """(B,) smallest signed distance to a solid on the way [m]."""
    wanted: jax.Array | None = None
    """(B,) the commanded speed, 0 to 1, where the policy has that input [1]."""


def norm(vector: jax.Array) -> jax.Array:
    """Return the length over the last axis, with a finite gradient at zero."""
    return jnp.sqrt((vector * vector).sum(-1) + 1e-12)


def target_gate(gates: Gates, target: jax.Array, ahead: int = 0) -> tuple[Gates, jax.Array]:
    """Return each world's current gate (B, ...) and the point to fly to (B, 3).

    With `ahead` it is the gate so many after that, or the last one where there is none, as the
    judge has it.
    """
    count = gates.center_w.shape[1]
    index = jnp.minimum(target + ahead, count - 1)
    gate = jax.tree.map(lambda array: jax.vmap(lambda rows, i: rows[i])(array, index), gates)
    beyond = jnp.where(target >= count, BEYOND_M, 0.0)[:, None]
    return gate, gate.center_w + beyond * gate.rot_w[:, :, 0]


def approach_shift(config: LossConfig, place_g: jax.Array) -> jax.Array:
    """Return how far before the gate the point lies that progress is measured to, (B,) [m].

    Args:
        config: the largest shift, `approach_m`.
        place_g: (B, 3) positions in the gates' frames [m].
    """
    place_g = jax.lax.stop_gradient(place_g)
    off = norm(place_g[:, 1:]) + jnp.maximum(place_g[:, 0], 0.0)
    return jnp.clip(off - APPROACH_FREE_M, 0.0, config.approach_m)


def gap_beyond(
    config: LossConfig, distance: jax.Array, away_w: jax.Array, path_w: jax.Array
) -> jax.Array:
    """Return the distance to the nearest solid beyond the safety radius, (B, S) [m].

    The nearest solid comes from outside the differentiated graph; the distance's gradient with
    respect to the path is the direction away from it, which is exact.

    Args:
        config: r_q.
        distance: (B, S) signed distance at `path_w`, no gradient [m].
        away_w: (B, S, 3) unit vectors along which it grows.
        path_w: (B, S, 3) points with gradient [m].
    """
    moved = ((path_w - jax.lax.stop_gradient(path_w)) * away_w).sum(-1)
    return distance + moved - config.safety_radius_m


def make_step(
    config: LossConfig,
    worlds: Worlds,
    before: DynamicsState,
    after: DynamicsState,
    target: jax.Array,
) -> Step:
    """Return the step from `before` to `after` of worlds that have passed `target` (B,) gates.

    Of `config` it takes where progress is measured to and r_q. Gates and obstacles are looked up on
    values without gradient.

    Args:
        config: of the losses.
        worlds: what there is.
        before: at the step's beginning.
        after: at its end.
        target: (B,) gates passed.
    """
    gates = worlds.scene.gates
    gate, _ = target_gate(gates, target)
    count = gates.center_w.shape[1]
    held = jax.lax.stop_gradient((before.pos_w, after.pos_w))
    passed, _ = crossing(gate.center_w, gate.rot_w, gate.opening_g, *held)
    passed = passed & (target < count)
    goal = target + (passed & config.pass_first)
    aim, aim_w = target_gate(gates, goal)
    place_g = to_local(aim.rot_w, after.pos_w - aim.center_w)
    shift = (goal < count) * approach_shift(config, place_g)
    goal_w = aim_w - shift[:, None] * aim.rot_w[:, :, 0]
    share = (jnp.arange(PATH_SAMPLES) + 1.0) / PATH_SAMPLES
    path_w = before.pos_w[:, None] + share[:, None] * (after.pos_w - before.pos_w)[:, None]
    distance, away_w = nearest_obstacle(worlds.scene, jax.lax.stop_gradient(path_w), NEAR)
    gap = gap_beyond(config, distance, away_w, path_w)
    return Step(
        pos_w=after.pos_w,
        vel_w=after.vel_w,
        acc_w=after.acc_w,
        jerk_w=(after.acc_w - before.acc_w) / worlds.constants.time_step[:, None],
        up=after.rot_w[:, 2, 2],
        gap=gap,
        away_w=away_w,
        goal_w=goal_w,
        place_g=place_g,
        gate=gate,
        passed=passed,
        clearance=distance.min(-1),
        wanted=worlds.wanted,
    )
