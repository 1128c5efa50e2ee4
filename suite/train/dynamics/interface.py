"""The interface of the trainer's dynamics, and `make_dynamics`, which selects one of two models.

The models are a point mass and the differentiable quadrotor of a vehicle file. Both move B worlds
(simulated scenes with a drone) at once and have gradients.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax

from suite.train.config import TrainConfig
from suite.train.dynamics import point_mass

if TYPE_CHECKING:
    from suite.train.dynamics.quadrotor import QuadrotorParams, QuadrotorState


DynamicsState: TypeAlias = "point_mass.PointMassState | QuadrotorState"
"""State of B worlds. Rollouts (simulated flights) read pos_w, vel_w, acc_w and rot_w only."""
WorldParams: TypeAlias = "point_mass.PointMassParams | QuadrotorParams"
"""Parameters that are drawn once per world. Both models have `time_step`, the policy's period."""


class Dynamics(NamedTuple):
    """Pure functions over B worlds; state and parameters are pytrees of arrays (B, ...)."""

    start: Callable[[Any, jax.Array, jax.Array, jax.Array], Any]
    """(constants, pos_w (B, 3) [m], vel_w (B, 3) [m/s], heading_w (B, 3)) -> the state of upright
    drones; `constants` are the worlds' parameters, heading_w are horizontal unit vectors."""
    step: Callable[[Any, Any, jax.Array, jax.Array, jax.Array], Any]
    """(state, constants, action_b (B, 3) [m/s^2], target_w (B, 3) [m], keys (B,)) -> the state one
    policy period later; the heading follows the direction to `target_w`."""


def make_dynamics(config: TrainConfig) -> Dynamics:
    """Return the dynamics that `config` trains through."""
    if config.quadrotor is not None:
        # Imported here, so that training through the point mass does not load the judge's physics.
        from suite.train.dynamics.quadrotor import quadrotor_dynamics

        period = 1.0 / config.spec.rate_hz
        return Dynamics(*quadrotor_dynamics(config.quadrotor, period, config.loss.gradient_decay))

    decay = config.loss.gradient_decay
    return Dynamics(
        start=lambda constants, *state: point_mass.start(*state),
        step=lambda body, constants, action_b, target_w, keys: point_mass.step(
            body, constants, action_b, target_w, decay
        ),
    )
