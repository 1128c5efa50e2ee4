"""Replay recorded actions in the trainer's point mass, with or without a Delta Action Model.

Such a model is valid only for the dynamics that it was fitted to. Its checkpoint describes them
(key `plant`), and `check_corrects` compares this description with the dynamics of a training.
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
    """Parameters of the replayed point mass."""

    lag: Array
    """Rate at which the acceleration follows the command [1/s]."""
    drag: Array
    """(3,) linear drag in body axes [1/s]."""
    delay: Array
    """Delay of a command [decisions]."""


def nominal_model(config: PointMassConfig) -> PointMassModel:
    """Return the point mass at the middle of the trainer's ranges."""
    drag_ranges = (config.drag, config.drag, config.drag_up)
    return PointMassModel(
        jnp.asarray(config.lag_mean),
        jnp.asarray([(low + high) / 2 for low, high in drag_ranges]),
        jnp.asarray(sum(config.action_delay) / 2),
    )


def replay_point_mass(
    model: PointMassModel, windows: PointMassWindows, delta: delta_network.Params | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Simulate the windows; return positions and velocities after every decision, and corrections.

    They are pos_w [m], vel_w [m/s] and the corrections in body axes [m/s^2], (N, T, 3) each. A
    window is a short part of a measured flight. The measured state is used only at its start (Su et
    al. 2026, Eq. delta_action_loss). Only the heading, which the point mass does not determine, is
    the measured one in all steps. Without `delta`, the parameters of the Delta Action network,
    there is no correction.
    """
    count = windows.action_b.shape[0]
    rot_w = jnp.asarray(windows.rot_w)
    # The acceleration by thrust and gravity is the measured one plus the drag's share.
    vel_b = to_local(rot_w, windows.vel_w[:, 0])
    thrust_w = windows.acc_w + to_world(rot_w, model.drag * vel_b)
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
        # The step turned the heading to a gate; the measured one replaces it.
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
    _, results = jax.lax.scan(step, start, by_step)
    pos_w, vel_w, correction_b = (jnp.swapaxes(x, 0, 1) for x in results)
    return pos_w, vel_w, correction_b


POINT, QUAD = "point", "quad"
"""Names of the point mass and the quadrotor in `suite train --model`."""


def describe_dynamics(dynamics: PointMassConfig | QuadrotorConfig) -> dict[str, Any]:
    """Return the description of the corrected dynamics for a checkpoint: `model` and `plant`.

    `plant` has the parameters of the model: the middle of the point mass's ranges, or the contents
    of the vehicle file. The vehicle's name is empty, because it does not change the dynamics.
    """
    if isinstance(dynamics, PointMassConfig):
        return {"model": POINT, "plant": plain(nominal_model(dynamics))}
    return {"model": QUAD, "plant": {**plain(dynamics.vehicle), "name": ""}}


def check_corrects(
    fit: Mapping[str, Any],
    dynamics: PointMassConfig | QuadrotorConfig,
    rate_hz: float,
    checkpoint: Path,
) -> None:
    """Refuse a Delta Action Model of other dynamics than the training's.

    `fit` is the description in the checkpoint (a folder, for the message), `rate_hz` the rate of
    decisions in the training [Hz]. The network makes one step per decision.

    Raises:
        ValueError: if model, rate or parameters differ, or `fit` lacks one of them.
    """
    if missing := {"model", "rate_hz", "plant"} - fit.keys():
        raise ValueError(
            f"--delta {checkpoint}: its config.json lacks {', '.join(sorted(missing))} of the fit, "
            "so the dynamics that it corrects are unknown; fit again with suite delta"
        )
    training = describe_dynamics(dynamics)
    if fit["model"] != training["model"]:
        raise ValueError(
            f"--delta {checkpoint} corrects --model {fit['model']}, and this run has --model "
            f"{training['model']}; train with the model that it was fitted to"
        )
    rate = fit["rate_hz"]
    if abs(rate - rate_hz) > RATE_SHARE * rate_hz:
        changes = f"spec.rate_hz={round(rate)}"
        if isinstance(dynamics, PointMassConfig):
            # Its delay is in decisions: another rate would change it, and so the corrected model.
            changes += " physics.action_delay={:g},{:g}".format(*dynamics.action_delay)
        raise ValueError(
            f"--delta {checkpoint} was fitted to flights with {rate:.3g} decisions a second, and "
            f"this run has {rate_hz:g}: its memory is updated at each decision; fit again to "
            f"flights of a policy of {rate_hz:g} Hz, or give --finetune if the recipe's last phase "
            f"has {round(rate)} Hz, or --set {changes}"
        )
    if fit["plant"] == training["plant"]:
        return
    if isinstance(dynamics, QuadrotorConfig):
        name = dynamics.vehicle.name
        raise ValueError(
            f"--delta {checkpoint} was fitted to another vehicle than {name!r}; take its "
            f"--vehicle, or fit again with suite delta --model {QUAD} --vehicle"
        )
    raise ValueError(
        f"--delta {checkpoint} corrects a point mass with {_plant_text(fit['plant'])}, and this "
        f"run's has {_plant_text(training['plant'])}; take the --recipe it was fitted to, or fit "
        "again with suite delta --recipe"
    )


def _plant_text(plant: Mapping[str, Any]) -> str:
    drag = " ".join(f"{axis:.3g}" for axis in plant["drag"])
    return f"lag {plant['lag']:.3g} 1/s, drag {drag} 1/s, delay {plant['delay']:.3g} decisions"
