"""Describe one step of training for the losses and the reward: motion, gate, nearest obstacles.

A step is one period of the policy (from one decision to the next). A world is one simulated scene
and drone; B of them step at once. `make_step` computes a `Step` from the states before and after
the step. The goal is the point towards which the losses reward progress.
"""

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
"""Radius of the drone: a smaller distance to a surface is a collision [m]."""
NEAR = Counts(boxes=8, cylinders=4, capsules=3, spheres=3)
"""Number of solids of each kind, the ones near the drone, among which the nearest is searched."""
BEYOND_M = 10.0
"""Distance of the goal behind the last gate once that gate is passed, so that the drone does not
learn to brake at it [m]. With `episode.finish` a world ends at the last gate; then only the step
that passes it has this goal."""
PATH_SAMPLES = 4
"""Number of points of a step's path at which the nearest obstacle is searched. At 7 m/s and 30 Hz
they are 6 cm apart, less than the body's radius."""
APPROACH_FREE_M = 0.3
"""Distance from the gate's axis up to which the goal is the gate's centre [m]."""


class Step(NamedTuple):
    """One step of B worlds: the inputs of all loss terms."""

    pos_w: jax.Array
    """(B, 3) position at the step's end [m]."""
    vel_w: jax.Array
    """(B, 3) velocity at the step's end [m/s]."""
    acc_w: jax.Array
    """(B, 3) net acceleration at the step's end [m/s^2]."""
    jerk_w: jax.Array
    """(B, 3) change of the acceleration in the step, divided by the time step [m/s^3]."""
    up: jax.Array
    """(B,) cosine of the tilt (world z component of body z) at the step's end. It has a gradient if
    the attitude of the dynamics has one."""
    margin: jax.Array
    """(B, S) distance to the nearest solid, minus the safety radius r_q, at S points of the step's
    path, with gradient [m]."""
    away_w: jax.Array
    """(B, S, 3) unit vectors away from that solid, along which `margin` grows."""
    goal_w: jax.Array
    """(B, 3) goal of the progress term [m]."""
    place_g: jax.Array
    """(B, 3) position in the frame of the gate of the goal [m]."""
    gate: Gates
    """(B, ...) next gate at the step's beginning; its attractive field u_A guides the drone."""
    passed: jax.Array
    """(B,) bool: the drone crossed the opening of `gate` in the step."""
    clearance: jax.Array
    """(B,) smallest signed distance to a solid on the step's path [m]."""
    speed_command: jax.Array | None = None
    """(B,) the commanded speed, 0 to 1, if the policy has that input; else None."""


def norm(vector: jax.Array) -> jax.Array:
    """Return the length over the last axis, with a finite gradient at zero."""
    return jnp.sqrt((vector * vector).sum(-1) + 1e-12)


def target_gate(gates: Gates, target: jax.Array, ahead: int = 0) -> tuple[Gates, jax.Array]:
    """Return the next gate (B, ...) of each world and the point to fly to (B, 3) [m].

    As in the judge, the last gate is returned where there is no later one. `target` (B,) is the
    number of passed gates. `ahead` gates are skipped: 1 returns the gate after the next one.
    """
    count = gates.center_w.shape[1]
    index = jnp.minimum(target + ahead, count - 1)
    gate = jax.tree.map(lambda array: jax.vmap(lambda rows, i: rows[i])(array, index), gates)
    beyond = jnp.where(target >= count, BEYOND_M, 0.0)[:, None]
    return gate, gate.center_w + beyond * gate.rot_w[:, :, 0]


def approach_shift(config: LossConfig, place_g: jax.Array) -> jax.Array:
    """Return by how much the goal is moved to a point before the gate, on its axis, (B,) [m].

    The further the drone is off the axis or beyond the gate's plane, the larger the distance. The
    straight line to the gate's centre would hit the frame. `place_g` (B, 3) are positions in the
    gates' frames [m]. The largest shift is `approach_m`.
    """
    place_g = jax.lax.stop_gradient(place_g)
    distance_off = norm(place_g[:, 1:]) + jnp.maximum(place_g[:, 0], 0.0)
    return jnp.clip(distance_off - APPROACH_FREE_M, 0.0, config.approach_m)


def margin_of(
    config: LossConfig, distance: jax.Array, away_w: jax.Array, path_w: jax.Array
) -> jax.Array:
    """Return the distance to the nearest solid, minus the safety radius, (B, S) [m].

    The search for the nearest solid is not differentiated. The gradient of the distance with
    respect to the path is the direction away from the solid; this is exact.

    Args:
        config: has the safety radius r_q.
        distance: (B, S) signed distance at `path_w`, without gradient [m].
        away_w: (B, S, 3) unit vectors along which `distance` grows.
        path_w: (B, S, 3) points of the path, with gradient [m].
    """
    # Zero in value; its gradient with respect to the path is `away_w`.
    shift = ((path_w - jax.lax.stop_gradient(path_w)) * away_w).sum(-1)
    return distance + shift - config.safety_radius_m


def make_step(
    config: LossConfig,
    worlds: Worlds,
    before: DynamicsState,
    after: DynamicsState,
    target: jax.Array,
) -> Step:
    """Return the step from `before` to `after` of worlds that have passed `target` (B,) gates.

    Gates and obstacles are evaluated without gradient.
    """
    gates = worlds.scene.gates
    gate, _ = target_gate(gates, target)
    count = gates.center_w.shape[1]
    # Whether the path crosses the opening of the next gate.
    ends_w = jax.lax.stop_gradient((before.pos_w, after.pos_w))
    passed, _ = crossing(gate.center_w, gate.rot_w, gate.opening_g, *ends_w)
    passed = passed & (target < count)
    # The goal: a gate, or a point before it.
    goal_index = target + (passed & config.pass_first)
    goal_gate, goal_w = target_gate(gates, goal_index)
    place_g = to_local(goal_gate.rot_w, after.pos_w - goal_gate.center_w)
    shift = (goal_index < count) * approach_shift(config, place_g)
    goal_w = goal_w - shift[:, None] * goal_gate.rot_w[:, :, 0]
    # The nearest solids along the path.
    share = (jnp.arange(PATH_SAMPLES) + 1.0) / PATH_SAMPLES
    path_w = before.pos_w[:, None] + share[:, None] * (after.pos_w - before.pos_w)[:, None]
    distance, away_w = nearest_obstacle(worlds.scene, jax.lax.stop_gradient(path_w), NEAR)
    margin = margin_of(config, distance, away_w, path_w)
    return Step(
        pos_w=after.pos_w,
        vel_w=after.vel_w,
        acc_w=after.acc_w,
        jerk_w=(after.acc_w - before.acc_w) / worlds.constants.time_step[:, None],
        up=after.rot_w[:, 2, 2],
        margin=margin,
        away_w=away_w,
        goal_w=goal_w,
        place_g=place_g,
        gate=gate,
        passed=passed,
        clearance=distance.min(-1),
        speed_command=worlds.speed_command,
    )
