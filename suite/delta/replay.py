"""Recorded actions flown again in the point mass, corrected or not."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from policies.networks import delta_network
from suite.delta.burn_in import state_after
from suite.delta.windows import PointMassWindows
from suite.train.config import PointMassConfig
from suite.train.dynamics import point_mass
from tracks.geometry.rotation import to_local, to_world
from tracks.geometry.scene import Array


class PointMassModel(NamedTuple):
    """Constants of the replayed point mass, scalars and one vector."""

    lag: Array
    """Rate at which the acceleration follows the command [1/s]."""
    drag: Array
    """(3,) linear drag in body axes [1/s]."""
    delay: Array
    """Delay of a command in decisions."""


def nominal_model(config: PointMassConfig) -> PointMassModel:
    """Return the middle of the trainer's ranges."""
    along = (config.drag, config.drag, config.drag_up)
    return PointMassModel(
        jnp.asarray(config.lag_mean),
        jnp.asarray([(low + high) / 2 for low, high in along]),
        jnp.asarray(sum(config.action_delay) / 2),
    )


def replay(
    model: PointMassModel, windows: PointMassWindows, delta: delta_network.Params | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return pos_w, vel_w (N, T, 3) after every decision, and the corrections (N, T, 3).

    The state is the simulated one throughout (Eq. delta_action_loss); only the nose direction,
    which the point mass does not decide, follows the record.

    Args:
        model: constants of the point mass.
        windows: the record, N windows of T decisions.
        delta: parameters of the Delta Action network; None leaves the actions as they are.
    """
    count = windows.action_b.shape[0]
    rot_w = jnp.asarray(windows.rot_w)
    air_b = to_local(rot_w, windows.vel_w[:, 0])
    thrust_w = windows.acc_w + to_world(rot_w, model.drag * air_b)
    body = point_mass.PointMassState(
        pos_w=jnp.asarray(windows.pos_w[:, 0]),
        vel_w=jnp.asarray(windows.vel_w[:, 0]),
        thrust_w=thrust_w,
        acc_w=jnp.asarray(windows.acc_w),
        rot_w=rot_w,
        heading_w=jnp.asarray(windows.heading_w[:, 0]),
        commands_w=jnp.asarray(windows.commands_w),
    )

    def step(
        carry: tuple[point_mass.PointMassState, jax.Array], inputs: tuple[jax.Array, ...]
    ) -> tuple[tuple[point_mass.PointMassState, jax.Array], tuple[jax.Array, ...]]:
        body, hidden = carry
        action, heading, time_step = inputs
        correction = jnp.zeros_like(action)
        if delta is not None:
            vel_b = to_local(body.rot_w, body.vel_w)
            correction, hidden = delta_network.step(delta, hidden, vel_b, body.rot_w[:, 2], action)
        constants = point_mass.PointMassParams(
            lag=jnp.broadcast_to(model.lag, count),
            drag=jnp.broadcast_to(model.drag, (count, 3)),
            wind_w=jnp.zeros((count, 3)),
            time_step=time_step,
            delay=jnp.broadcast_to(model.delay, count),
        )
        body = point_mass.step(body, constants, action + correction, body.pos_w, 0.0, 0.0)
        body = body._replace(
            heading_w=heading,
            rot_w=point_mass.attitude(jax.lax.stop_gradient(body.thrust_w), heading),
        )
        return (body, hidden), (body.pos_w, body.vel_w, correction)

    by_step = (
        jnp.swapaxes(windows.action_b, 0, 1),
        jnp.swapaxes(windows.heading_w, 0, 1)[1:],
        jnp.swapaxes(windows.time_step, 0, 1),
    )
    start = (body, state_after(delta, windows.burn_in))
    _, flown = jax.lax.scan(step, start, by_step)
    pos_w, vel_w, correction_b = (jnp.swapaxes(x, 0, 1) for x in flown)
    return pos_w, vel_w, correction_b
