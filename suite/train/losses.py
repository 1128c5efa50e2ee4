"""The training loss of one step, as a table of terms (Su et al. 2026, Sec. III-C).

Each term is a function that returns a loss (B,), one per world (a simulated scene and drone) of the
batch. A new term needs that function, a line in `LOSSES` and its weight in `LossConfig`. The names
L_..., beta and u_A are those of the paper. The margin is the distance of a point to the nearest
solid, minus the safety radius. The (attractive) field pulls the gradient towards the gate. The goal
of the progress term is the gate or a point before it. The path is the straight line that the drone
flies in the step; terms evaluate S points of it.
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

BARRIER_HEIGHT, BARRIER_SLOPE = 2.0, -32.0
"""beta_1 (dimensionless) and beta_2 [1/m] of L_clearance. The paper does not print them: its table
of the reward has lambda_2 = -lambda_C beta_1, and beta_2 is that of Zhang et al. 2025."""
FIELD_DECAY = 0.3
"""lambda_A of the field u_A, as the paper prints it: a larger one makes u_A fall more slowly with
the distance."""
TILT_FREE_DEG = 65.0
"""Tilt up to which L_tilt is 0, because fast turns need about this much [deg]."""
UNIT_FIELD = 11.313708498984761
"""Size of the magnetic field divided by the current, |B| / C_I, at the centre of a square gate of
1 m: 8 sqrt(2) [1/m]."""
MAX_PULL = 5.0
"""Largest allowed size of the field, relative to that at the centre of a 1 m gate."""


Term = Callable[[LossConfig, Step], jax.Array]
"""(parameters of the term, step) -> the loss (B,), without its weight."""


def barrier(step: Step) -> jax.Array:
    """Return ln(1 + e^{beta_2 margin}), (B, S), which grows if a point of the path is too near."""
    return jax.nn.softplus(BARRIER_SLOPE * step.margin)


def clearance(_: LossConfig, step: Step) -> jax.Array:
    """Return L_clearance, which keeps the drone away from solids: the mean over the path."""
    return (BARRIER_HEIGHT * barrier(step)).mean(1)


def collide(_: LossConfig, step: Step) -> jax.Array:
    """Return L_collide, which penalises flight towards near solids: the mean over the path [m^3/s].

    The velocity has no gradient: the term moves the path away from the solid.
    """
    fixed_vel = jax.lax.stop_gradient(step.vel_w)
    closing_speed = jnp.maximum(-(step.away_w * fixed_vel[:, None]).sum(-1), 0.0)
    return (closing_speed * jnp.maximum(1.0 - step.margin, 0.0) ** 2).mean(1)


def acceleration(_: LossConfig, step: Step) -> jax.Array:
    """Return L_a, the squared acceleration [m^2/s^4]."""
    return (step.acc_w * step.acc_w).sum(1)


def jerk(_: LossConfig, step: Step) -> jax.Array:
    """Return L_j, the squared jerk [m^2/s^6]."""
    return (step.jerk_w * step.jerk_w).sum(1)


def tilt(_: LossConfig, step: Step) -> jax.Array:
    """Return L_tilt: 0 up to a tilt of `TILT_FREE_DEG`, then growing to 1 at 90 degrees."""
    # `step.up` is the cosine of the tilt.
    free_up = math.cos(math.radians(TILT_FREE_DEG))
    return (jnp.maximum(free_up - step.up, 0.0) / free_up) ** 2


def speed_to_goal(step: Step) -> jax.Array:
    """Return the speed (B,) towards the goal of the progress term [m/s]."""
    to_goal = step.goal_w - step.pos_w
    return (step.vel_w * to_goal).sum(1) / norm(to_goal)


def progress(config: LossConfig, step: Step) -> jax.Array:
    """Return L_p, the negative speed towards the goal [m/s].

    For a policy with a commanded speed, progress counts up to that speed only, and a faster flight
    is penalised. A command of 1 means no limit.
    """
    command = step.speed_command
    if command is None:
        return -speed_to_goal(step)
    slow, fast = config.speed_range
    limit = jnp.where(command < 1.0, slow + (fast - slow) * command, jnp.inf)
    return jnp.maximum(norm(step.vel_w) - limit, 0.0) - jnp.minimum(speed_to_goal(step), limit)


def progress_norm(_: LossConfig, step: Step) -> jax.Array:
    """Return L_p^norm, which rewards the direction of flight alone; for an ablation."""
    return -speed_to_goal(step) / (norm(step.vel_w) + 1e-3)


def projection(config: LossConfig, step: Step) -> jax.Array:
    """Return L_proj, which can replace the field: the squared distance to the gate's axis [m^2].

    It has a weight that falls with the distance to the gate.
    """
    nearness = jnp.exp(-config.projection_decay * jax.lax.stop_gradient(norm(step.place_g)))
    return (step.place_g[:, 1:] ** 2).sum(1) * nearness


def guidance(_: LossConfig, step: Step) -> jax.Array:
    """Return a term of value 0 whose gradient with respect to the position is minus the field u_A.

    u_A points along the magnetic field of a current around the gate's opening. Near the gate it is
    about 0 for a velocity in that direction. For a velocity across the field, its size is 1 at the
    centre of a 1 m gate. At the gate's edges it would be unbounded, so it is limited to MAX_PULL.
    """
    fixed_pos, fixed_vel = jax.lax.stop_gradient(step.pos_w), jax.lax.stop_gradient(step.vel_w)
    gate = step.gate
    field = magnetic_field(gate.center_w, gate.rot_w, gate.opening_g, fixed_pos)
    pull = attractive_field(field, fixed_vel, FIELD_DECAY)
    pull = pull / (CURRENT * UNIT_FIELD) ** (1 - FIELD_DECAY)
    pull = pull * jnp.minimum(1.0, MAX_PULL / norm(pull))[:, None]
    return -(jax.lax.stop_gradient(pull) * (step.pos_w - fixed_pos)).sum(1)


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
}
"""Name in the learning curve -> the terms that are added under this name, each with the name of its
weight in `LossConfig`."""


def weighted(config: LossConfig, step: Step) -> dict[str, jax.Array]:
    """Return the weighted terms (B,) by name; their sum is the loss of the step."""

    def total(terms: tuple[tuple[Term, str], ...]) -> jax.Array:
        products = (getattr(config, weight) * term(config, step) for term, weight in terms)
        return functools.reduce(jnp.add, products)

    return {name: total(terms) for name, terms in LOSSES.items()}
