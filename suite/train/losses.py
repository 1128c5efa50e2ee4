"""The loss of one step, per world (Su et al. 2026, Sec. III-C)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from suite.train.config import LossConfig
from tracks.geometry.field import CURRENT, attractive_field, magnetic_field
from tracks.geometry.gates import rectangle
from tracks.geometry.scene import Gates

UNIT_FIELD = 11.313708498984761
"""|B| / C_I at the centre of a square gate of 1 m: 8 sqrt(2) [1/m]."""

MAX_PULL = 5.0
"""Largest field pull relative to that at the centre of a 1 m gate [1]."""


class Terms(NamedTuple):
    """Weighted terms, (B,) each; their sum is the loss of the step."""

    clearance: jax.Array
    collide: jax.Array
    acceleration: jax.Array
    jerk: jax.Array
    progress: jax.Array
    guidance: jax.Array
    """-u_A . p with u_A held: zero in value, its gradient is the field's."""


def _norm(vector: jax.Array) -> jax.Array:
    """Return the length over the last axis, with a finite gradient at zero."""
    return jnp.sqrt((vector * vector).sum(-1) + 1e-12)


def obstacle_terms(
    config: LossConfig, distance: jax.Array, away_w: jax.Array, path_w: jax.Array, vel_w: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return L_clearance and L_collide (B,) over the points of a step's path.

    The nearest obstacle comes from outside the differentiated graph; the distance's gradient with
    respect to the path is the direction away from it, which is exact.

    Args:
        config: barrier and radius.
        distance: (B, S) signed distance at path_w, no gradient [m].
        away_w: (B, S, 3) unit vectors along which it grows.
        path_w: (B, S, 3) points with gradient [m].
        vel_w: (B, 3) [m/s].
    """
    moved = ((path_w - jax.lax.stop_gradient(path_w)) * away_w).sum(-1)
    gap = distance + moved - config.safety_radius_m
    barrier = config.barrier_height * jax.nn.softplus(config.barrier_slope * gap)
    closing = jnp.maximum(-(away_w * jax.lax.stop_gradient(vel_w)[:, None]).sum(-1), 0.0)
    collide = closing * jnp.maximum(1.0 - gap, 0.0) ** 2
    return barrier.mean(-1), collide.mean(-1)


APPROACH_FREE_M = 0.3
"""So far off its axis a gate is still flown at straight [m]."""


def approach_shift(config: LossConfig, local_g: jax.Array) -> jax.Array:
    """Return how far before the gate the point lies that progress is measured to, (B,) [m].

    Args:
        config: the largest shift, `approach_m`.
        local_g: (B, 3) positions in the gates' frames [m].
    """
    local_g = jax.lax.stop_gradient(local_g)
    off = _norm(local_g[:, 1:]) + jnp.maximum(local_g[:, 0], 0.0)
    return jnp.clip(off - APPROACH_FREE_M, 0.0, config.approach_m)


def progress_term(
    config: LossConfig,
    pos_w: jax.Array,
    vel_w: jax.Array,
    target_w: jax.Array,
    place_g: jax.Array,
) -> jax.Array:
    """Return L_p with the ablation's variants L_p^norm and L_proj, weighted, (B,).

    Args:
        config: weights and decay.
        pos_w: (B, 3) [m].
        vel_w: (B, 3) [m/s].
        target_w: (B, 3) the point to fly to [m].
        place_g: (B, 3) the position in the target gate's frame [m]; L_proj counts the distance to
            the gate, whatever point before it `target_w` is.
    """
    to_gate = target_w - pos_w
    distance = _norm(to_gate)
    towards = (vel_w * to_gate).sum(-1) / distance
    total = -config.progress * towards - config.progress_norm * towards / (_norm(vel_w) + 1e-3)
    near = jnp.exp(-config.projection_decay * jax.lax.stop_gradient(_norm(place_g)))
    return total + config.projection * (place_g[:, 1:] ** 2).sum(-1) * near


def guidance_term(
    config: LossConfig, gates: Gates, pos_w: jax.Array, vel_w: jax.Array
) -> jax.Array:
    """Return the term whose position gradient is -field_gain u_A / u_A(centre of a 1 m gate).

    At the wires the field has no bound, so its pull is held to MAX_PULL times field_gain.

    Args:
        config: gain and decay of the field.
        gates: each world's target gate, (B, ...).
        pos_w: (B, 3) the only input that the gradient goes to [m].
        vel_w: (B, 3) [m/s].
    """
    held_pos, held_vel = jax.lax.stop_gradient(pos_w), jax.lax.stop_gradient(vel_w)
    wires_g = _square_around(gates.opening_g) if config.field_square else gates.opening_g
    field = magnetic_field(gates.center_w, gates.rot_w, wires_g, held_pos)
    pull = attractive_field(field, held_vel, config.field_decay)
    unit = (CURRENT * UNIT_FIELD) ** (1 - config.field_decay)
    pull = pull / unit
    pull = pull * jnp.minimum(1.0, MAX_PULL / _norm(pull))[:, None]
    return -config.field_gain * (jax.lax.stop_gradient(pull) * (pos_w - held_pos)).sum(-1)


def _square_around(opening_g: jax.Array) -> jax.Array:
    """Return the square (B, 4, 2) around a regular opening (B, V, 2) whose first side is level."""
    side = -2.0 * opening_g[..., :1, 1:]
    return side * rectangle(1.0, 1.0)


def smoothness_terms(
    config: LossConfig, acc_w: jax.Array, acc_before_w: jax.Array, time_step: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the weighted L_a and L_j (B,).

    Args:
        config: their weights.
        acc_w: (B, 3) net acceleration [m/s^2].
        acc_before_w: (B, 3) that of the step before [m/s^2].
        time_step: (B,) [s].
    """
    jerk = (acc_w - acc_before_w) / time_step[:, None]
    size, change = (acc_w * acc_w).sum(-1), (jerk * jerk).sum(-1)
    return config.acceleration * size, config.jerk * change
