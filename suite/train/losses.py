"""The loss of one step, per world (Su et al. 2026, Sec. III-C): a table of terms.

A new term is a function of a `Step`, a line in `LOSSES` and its weight in `LossConfig`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from suite.train.config import LossConfig
from suite.train.step import Step, norm
from tracks.geometry.field import CURRENT, attractive_field, magnetic_field
from tracks.geometry.gates import rectangle

UNIT_FIELD = 11.313708498984761
"""|B| / C_I at the centre of a square gate of 1 m: 8 sqrt(2) [1/m]."""
MAX_PULL = 5.0
"""Largest field pull relative to that at the centre of a 1 m gate [1]."""


Term = Callable[[LossConfig, Step], jax.Array]
"""(shape of the term, step) -> the loss (B,), not weighted."""


def clearance(config: LossConfig, step: Step) -> jax.Array:
    """Return L_clearance, the mean over the path [1]."""
    barrier = config.barrier_height * jax.nn.softplus(config.barrier_slope * step.gap)
    return barrier.mean(-1)


def collide(_: LossConfig, step: Step) -> jax.Array:
    """Return L_collide, the mean over the path [m^3/s]."""
    held_vel = jax.lax.stop_gradient(step.vel_w)
    closing = jnp.maximum(-(step.away_w * held_vel[:, None]).sum(-1), 0.0)
    return (closing * jnp.maximum(1.0 - step.gap, 0.0) ** 2).mean(-1)


def acceleration(_: LossConfig, step: Step) -> jax.Array:
    """Return L_a [m^2/s^4]."""
    return (step.acc_w * step.acc_w).sum(-1)


def jerk(_: LossConfig, step: Step) -> jax.Array:
    """Return L_j [m^2/s^6]."""
    return (step.jerk_w * step.jerk_w).sum(-1)


def tilt(config: LossConfig, step: Step) -> jax.Array:
    """Return L_tilt, the square of how far body z is down from `tilt_from_deg` to level [1]."""
    least = math.cos(math.radians(config.tilt_from_deg))
    return (jnp.maximum(least - step.up, 0.0) / least) ** 2


def speed_to_goal(step: Step) -> jax.Array:
    """Return the speed (B,) towards the point that progress is measured to [m/s]."""
    to_goal = step.goal_w - step.pos_w
    return (step.vel_w * to_goal).sum(-1) / norm(to_goal)


def progress(config: LossConfig, step: Step) -> jax.Array:
    """Return L_p, minus the speed towards the goal as far as it is asked for [m/s].

    Beyond the speed that a world is asked for, more progress counts nothing and speed, whichever
    way, costs.
    """
    if step.wanted is None:
        return -speed_to_goal(step)
    slow, fast = config.speed_range
    limit = jnp.where(step.wanted < 1.0, slow + (fast - slow) * step.wanted, jnp.inf)
    return jnp.maximum(norm(step.vel_w) - limit, 0.0) - jnp.minimum(speed_to_goal(step), limit)


def progress_norm(_: LossConfig, step: Step) -> jax.Array:
    """Return L_p^norm, the ablation's progress by direction alone [1]."""
    return -speed_to_goal(step) / (norm(step.vel_w) + 1e-3)


def projection(config: LossConfig, step: Step) -> jax.Array:
    """Return L_proj, the scalar substitute for the field: how far off the gate's axis [m^2]."""
    near = jnp.exp(-config.projection_decay * jax.lax.stop_gradient(norm(step.place_g)))
    return (step.place_g[:, 1:] ** 2).sum(-1) * near


def guidance(config: LossConfig, step: Step) -> jax.Array:
    """Return the term whose position gradient is -u_A / u_A(centre of a 1 m gate); 0 in value.

    At the wires the field has no bound, so its pull is held to MAX_PULL.
    """
    held_pos, held_vel = jax.lax.stop_gradient(step.pos_w), jax.lax.stop_gradient(step.vel_w)
    gate = step.gate
    wires_g = _square_around(gate.opening_g) if config.field_square else gate.opening_g
    field = magnetic_field(gate.center_w, gate.rot_w, wires_g, held_pos)
    pull = attractive_field(field, held_vel, config.field_decay)
    pull = pull / (CURRENT * UNIT_FIELD) ** (1 - config.field_decay)
    pull = pull * jnp.minimum(1.0, MAX_PULL / norm(pull))[:, None]
    return -(jax.lax.stop_gradient(pull) * (step.pos_w - held_pos)).sum(-1)


def survival(_: LossConfig, step: Step) -> jax.Array:
    """Return minus the progress that is still flown for [m/s]: speed times probability to be there.

    Its gradient is that of the probability alone, so that a crash costs all the progress after it,
    and since no progress counts as less than none, to crash never pays.
    """
    worth = jax.lax.stop_gradient(jnp.maximum(speed_to_goal(step), 0.0))
    return -worth * step.survival


LOSSES: dict[str, tuple[tuple[Term, str], ...]] = {
    "clearance": ((clearance, "clearance"),),
    "collide": ((collide, "collide"),),
    "acceleration": ((acceleration, "acceleration"),),
    "jerk": ((jerk, "jerk"),),
    "tilt": ((tilt, "tilt"),),
    "progress": (
        (progress, "progress"),
        (progress_norm, "progress_norm"),
        (projection, "projection"),
    ),
    "guidance": ((guidance, "field_gain"),),
    "survival": ((survival, "survival"),),
}
"""Name in the curve -> its terms, each with the field of `LossConfig` that is its weight."""


AFTER_CRASH = ("survival",)
"""Names whose terms go on where a world has crashed: what would have been flown is the price."""


def weighted(config: LossConfig, step: Step) -> dict[str, jax.Array]:
    """Return the weighted terms (B,) by name; their sum is the loss of the step."""

    def total(terms: tuple[tuple[Term, str], ...]) -> jax.Array:
        parts = (getattr(config, weight) * term(config, step) for term, weight in terms)
        return functools.reduce(jnp.add, parts)

    return {name: total(terms) for name, terms in LOSSES.items()}


def _square_around(opening_g: jax.Array) -> jax.Array:
    """Return the square (B, 4, 2) around a regular opening (B, V, 2) whose first side is level."""
    side = -2.0 * opening_g[..., :1, 1:]
    return side * rectangle(1.0, 1.0)
