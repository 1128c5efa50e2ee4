"""The reward of one step, for any policy's rollout (Su et al. 2026, Table "Reward Function").

It compares all training schemes on one scale, so its weights are constants and do not depend on
those of the training. Some values are not in the table, and are those of the differentiable
trainer: beta_2, the points of a step's path and the safety radius r_q
(`LossConfig.safety_radius_m`). Below, d is the distance to the nearest solid, v^c the speed towards
it, a_k the acceleration in step k and dt the policy's period.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax

from suite.train import losses
from suite.train.config import TrainConfig
from suite.train.dynamics.interface import DynamicsState
from suite.train.step import make_step
from suite.train.worlds import Worlds

COLLISION = -30.0
"""lambda_1, reward of a step that comes closer to a solid than r_q."""
BARRIER = -6.0
"""lambda_2, weight of ln(1 + e^{beta_2 (|d| - r_q)})."""
CLOSING = -3.0
"""lambda_3, weight of v^c max(1 - |d| + r_q, 0)^2 [s/m^3]."""
ACCELERATION = -1e-2
"""lambda_4, weight of |a|^2 [s^4/m^2]."""
JERK = -1e-3
"""lambda_5, weight of |(a_k - a_{k-1}) / dt|^2 [s^6/m^2]."""
PASS = 110.0
"""lambda_6, reward of a step that passes the gate."""
PROGRESS = 0.4
"""lambda_7, weight of the speed towards the gate [s/m]."""


class RewardTerms(NamedTuple):
    """Weighted terms, (B,) each; their sum is the reward of the step."""

    collision: jax.Array
    """Term of a collision (lambda_1)."""
    avoid: jax.Array
    """Terms of nearness to solids and of flight towards them (lambda_2, lambda_3)."""
    smooth: jax.Array
    """Terms of acceleration and jerk (lambda_4, lambda_5)."""
    passing: jax.Array
    """Term of a passed gate (lambda_6)."""
    progress: jax.Array
    """Term of the speed towards the gate (lambda_7)."""

    def total(self) -> jax.Array:
        """Return the reward (B,)."""
        return self.collision + self.avoid + self.smooth + self.passing + self.progress


def make_reward(config: TrainConfig) -> Callable[..., tuple[RewardTerms, jax.Array, jax.Array]]:
    """Return reward(worlds, before, after, target) -> (terms, clearance, passed), (B,) each.

    The step is that from the state `before` to the state `after` of worlds that have passed
    `target` (B,) gates. `terms` are the weighted terms, `clearance` is the smallest signed distance
    to a solid [m], and `passed` is whether a gate was passed. As in the judge, a gate is passed by
    crossing its opening; in the paper it is passed within a distance r_th of its centre. In a step
    that passes a gate, progress is measured towards the gate after it. The safety radius r_q is
    that of `config.loss`.
    """
    weights = replace(config.loss, pass_first=True, approach_m=0.0)

    def reward(
        worlds: Worlds, before: DynamicsState, after: DynamicsState, target: jax.Array
    ) -> tuple[RewardTerms, jax.Array, jax.Array]:
        step = make_step(weights, worlds, before, after, target)
        avoid = BARRIER * losses.barrier(step).mean(-1)
        smooth = ACCELERATION * losses.acceleration(weights, step)
        terms = RewardTerms(
            collision=COLLISION * (step.clearance < weights.safety_radius_m),
            avoid=avoid + CLOSING * losses.collide(weights, step),
            smooth=smooth + JERK * losses.jerk(weights, step),
            passing=PASS * step.passed,
            progress=PROGRESS * losses.speed_to_goal(step),
        )
        return terms, step.clearance, step.passed

    return reward
