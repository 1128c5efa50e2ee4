"""The differentiable point mass with first-order lag (Zhang et al. 2025; Su et al. 2026, III-B).

Its acceleration approaches the command exponentially, at a rate that is called lag. Only position,
velocity and acceleration have gradients. The attitude follows the direction of the thrust, without
a gradient.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import HEADING_RATE
from tracks.geometry.rotation import to_local, to_world
from tracks.geometry.scene import Array


class PointMassParams(NamedTuple):
    """Parameters that are drawn once per world, as numpy or JAX arrays."""

    lag: Array
    """(B,) rate at which the acceleration follows the command [1/s]."""
    drag: Array
    """(B, 3) linear drag in body axes [1/s]."""
    wind_w: Array
    """(B, 3) constant wind [m/s]."""
    time_step: Array
    """(B,) length of a step, one period of the policy [s]."""
    delay: Array
    """(B,) delay of a command, 0 to 2 [time steps]."""


class PointMassState(NamedTuple):
    """State of the point mass."""

    pos_w: Array
    """(B, 3) position [m]."""
    vel_w: Array
    """(B, 3) velocity [m/s]."""
    thrust_w: Array
    """(B, 3) net acceleration by thrust and gravity, after the lag and without drag [m/s^2]."""
    acc_w: Array
    """(B, 3) net acceleration [m/s^2]."""
    rot_w: Array
    """(B, 3, 3) attitude, body to world."""
    heading_w: Array
    """(B, 3) wanted heading, horizontal unit vectors."""
    commands_w: Array
    """(B, 2, 3) the last two commands, latest first [m/s^2]."""


def attitude(thrust_w: jax.Array, heading_w: jax.Array) -> jax.Array:
    """Return the attitude (B, 3, 3), body to world, of bodies with this thrust and heading.

    Body z is along the specific force (acceleration without gravity), body x towards the heading.

    Args:
        thrust_w: (B, 3) net acceleration by thrust and gravity [m/s^2].
        heading_w: (B, 3) wanted heading, horizontal unit vectors.
    """
    force = thrust_w + jnp.asarray([0.0, 0.0, GRAVITY])
    size = jnp.linalg.norm(force, axis=-1, keepdims=True)
    # In free fall the specific force has no direction: then z is world up.
    up = jnp.where(size > 1e-3, force / jnp.maximum(size, 1e-3), jnp.asarray([0.0, 0.0, 1.0]))
    left = jnp.cross(up, heading_w)
    left = left / jnp.maximum(jnp.linalg.norm(left, axis=-1, keepdims=True), 1e-6)
    return jnp.stack([jnp.cross(left, up), left, up], axis=-1)


def start(pos_w: jax.Array, vel_w: jax.Array, heading_w: jax.Array) -> PointMassState:
    """Return upright bodies at pos_w (B, 3) [m] with velocity vel_w (B, 3) [m/s], without thrust.

    heading_w (B, 3) are horizontal unit vectors.
    """
    zero = jnp.zeros_like(pos_w)
    rot_w = attitude(zero, heading_w)
    commands = jnp.zeros((pos_w.shape[0], 2, 3), pos_w.dtype)
    return PointMassState(pos_w, vel_w, zero, zero, rot_w, heading_w, commands)


def faded(x: jax.Array, factor: jax.Array | float) -> jax.Array:
    """Return x, with its gradient multiplied by factor (gradient decay of Zhang et al. 2025)."""
    return x * factor + jax.lax.stop_gradient(x * (1 - factor))


def step(
    body: PointMassState,
    constants: PointMassParams,
    action_b: jax.Array,
    target_w: jax.Array,
    gradient_decay: float,
) -> PointMassState:
    """Return the body one policy period later.

    A command acts `delay` steps after its decision. If the delay is not a whole number of steps,
    the weighted mean of two commands acts.

    Args:
        body: the present state.
        constants: the parameters of each world.
        action_b: (B, 3) wanted net acceleration in the present body axes [m/s^2].
        target_w: (B, 3) the gate that the heading follows [m].
        gradient_decay: decay rate of the gradients of position and velocity [1/s].
    """
    dt = constants.time_step[:, None]
    # The delayed command: weights of the last three commands, by their age in steps.
    command = to_world(jax.lax.stop_gradient(body.rot_w), action_b)
    history = jnp.concatenate([command[:, None], body.commands_w], axis=1)
    age = jnp.arange(3.0)
    share = jnp.maximum(0.0, 1.0 - jnp.abs(constants.delay[:, None] - age))
    delayed = (share[..., None] * history).sum(1)

    # First-order lag and drag, then the motion with decayed gradients.
    keep = jnp.exp(-constants.lag[:, None] * dt)
    thrust = delayed * (1 - keep) + body.thrust_w * keep
    rot = jax.lax.stop_gradient(body.rot_w)
    airspeed_b = to_local(rot, body.vel_w - constants.wind_w)
    acc = thrust - to_world(rot, constants.drag * airspeed_b)
    fade = jnp.exp(-gradient_decay * dt)
    pos, vel = faded(body.pos_w, fade), faded(body.vel_w, fade)
    pos = pos + vel * dt + 0.5 * body.acc_w * dt * dt
    vel = vel + 0.5 * (body.acc_w + acc) * dt

    # The heading turns towards the gate; it stays if it would have no direction.
    horizontal = jnp.asarray([1.0, 1.0, 0.0])
    to_gate = jax.lax.stop_gradient(target_w - pos) * horizontal
    to_gate = to_gate / jnp.maximum(jnp.linalg.norm(to_gate, axis=-1, keepdims=True), 1e-3)
    blend = jnp.exp(-HEADING_RATE * dt)
    heading = body.heading_w * blend + to_gate * (1 - blend)
    size = jnp.linalg.norm(heading, axis=-1, keepdims=True)
    heading = jnp.where(size > 1e-3, heading / jnp.maximum(size, 1e-3), body.heading_w)
    rot = attitude(jax.lax.stop_gradient(thrust), heading)
    return PointMassState(pos, vel, thrust, acc, rot, heading, history[:, :2])
