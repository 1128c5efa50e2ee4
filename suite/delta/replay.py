"""Replay of recorded actions in the point mass, with or without corrections.

The checkpoint of a Delta Action Model names the dynamics that it corrects; trainings check it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from policies.networks import delta_network
from suite.delta.windows import RATE_SHARE, PointMassWindows, state_after
from suite.train.config import PointMassConfig, QuadrotorConfig
from suite.train.dynamics import point_mass
from tracks.common.files import plain
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
    """Return the point mass at the middle of the trainer's ranges."""
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

    The state is the simulated one in all steps (Eq. delta_action_loss); only the heading, which the
    point mass does not determine, is the recorded one.

    Args:
        model: constants of the point mass.
        windows: the record, N windows of T decisions.
        delta: parameters of the Delta Action network; None for no correction.
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
        body = point_mass.step(body, constants, action + correction, body.pos_w, 0.0)
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


POINT, QUAD = "point", "quad"
"""Names of the two models in `suite train --model`."""


def corrected(dynamics: PointMassConfig | QuadrotorConfig) -> dict[str, Any]:
    """Return the description of the corrected dynamics for a checkpoint.

    It has the middle of the point mass's ranges, or the vehicle file without its name.
    """
    if isinstance(dynamics, PointMassConfig):
        return {"model": POINT, "plant": plain(nominal_model(dynamics))}
    return {"model": QUAD, "plant": {**plain(dynamics.vehicle), "name": ""}}


def check_corrects(
    fit: Mapping[str, Any],
    dynamics: PointMassConfig | QuadrotorConfig,
    rate_hz: float,
    where: Path,
) -> None:
    """Refuse a Delta Action Model of other dynamics than the training's.

    Args:
        fit: from the checkpoint; without a model it counts as that of a point mass, and without a
            rate it fits any.
        dynamics: of the training.
        rate_hz: of the trained policy, since the network makes one step per decision.
        where: the checkpoint, for the message.

    Raises:
        ValueError: if they differ.
    """
    mine = corrected(dynamics)
    model = fit.get("model", POINT)
    if model != mine["model"]:
        raise ValueError(
            f"--delta {where} corrects --model {model}, and this run has --model "
            f"{mine['model']}; train with the model that it was fitted to"
        )
    rate = fit.get("rate_hz", rate_hz)
    if abs(rate - rate_hz) > RATE_SHARE * rate_hz:
        raise ValueError(
            f"--delta {where} was fitted to flights of {rate:.3g} decisions a second, and this "
            f"run has {rate_hz:g}: it remembers from one to the next; fit again to flights of a "
            f"policy of {rate_hz:g} Hz, or give --set spec.rate_hz={round(rate)}"
        )
    plant = fit.get("plant", mine["plant"])
    if plant == mine["plant"]:
        return
    if isinstance(dynamics, QuadrotorConfig):
        name = dynamics.vehicle.name
        raise ValueError(
            f"--delta {where} was fitted to another vehicle than {name!r}; take its "
            f"--vehicle, or fit again with suite delta --model {QUAD} --vehicle"
        )
    raise ValueError(
        f"--delta {where} corrects a point mass with {_words(plant)}, and this run's has "
        f"{_words(mine['plant'])}; take the --recipe it was fitted to, or fit again with suite "
        "delta --recipe"
    )


def _words(plant: Mapping[str, Any]) -> str:
    drag = " ".join(f"{axis:.3g}" for axis in plant["drag"])
    return f"lag {plant['lag']:.3g} 1/s, drag {drag} 1/s, delay {plant['delay']:.3g} decisions"
