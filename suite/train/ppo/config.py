"""All settings of a PPO run: those shared with the differentiable trainer, and those of PPO.

PPO (proximal policy optimisation) is the baseline that the differentiable trainer is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from policies.spec import PolicySpec
from suite.train.config import (
    EpisodeConfig,
    LossConfig,
    OptimizerConfig,
    PointMassConfig,
    QuadrotorConfig,
    TrainConfig,
)
from tracks.input.ranges import Iterations, Range, Seed, Share

SHARED = ("spec", "physics", "quadrotor", "loss", "episode", "seed")
"""Settings that PPO and the differentiable training have in common."""


@dataclass(frozen=True)
class PpoConfig:
    """A PPO run (Schulman et al. 2017) with the policy, dynamics and worlds of the trainer."""

    spec: PolicySpec = field(default_factory=lambda: PolicySpec(rate_hz=15.0))
    """Rate, camera and encodings of the policy."""
    physics: PointMassConfig = field(default_factory=PointMassConfig)
    """The point mass and its randomisation, and delays and noise of the observation."""
    quadrotor: QuadrotorConfig | None = None
    """The quadrotor through which the policy is trained; None: the point mass of `physics`."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Of these settings only the safety radius r_q is used, by the reward."""
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    """Worlds (simulated scenes and drones) and number of steps. `shards`, `stop_from` and `finish`
    are not used: the critic learns the value of later steps, and a world is reset at the end of an
    episode."""
    seed: Seed = 0
    """Seed of the parameters, the tracks, the randomisation and the exploration."""
    iterations: Iterations = 200
    """Rollouts, each followed by `epochs` times `minibatches` gradient steps."""
    discount: Share = 0.97
    """gamma, the discount of the return in each policy period."""
    trace: Share = 0.95
    """lambda of generalised advantage estimation (Schulman et al. 2016)."""
    clip: Annotated[float, Range(0.0, 10.0, above=True)] = 0.2
    """epsilon: the ratio of an action's new to its old probability counts in the objective up to
    this distance from 1."""
    epochs: Annotated[int, Range(1, 10_000)] = 1
    """Passes of the policy over a rollout."""
    minibatches: Annotated[int, Range(1, 10_000)] = 2
    """Gradient steps of a pass, each over a part of the worlds; must divide `episode.batch`."""
    rate: Annotated[float, Range(0.0, 10.0)] = 3e-3
    """Adam's initial learning rate of the policy; it falls linearly to zero."""
    gradient_clip: Annotated[float, Range(0.0, 1e12, above=True)] = 1.0
    """Largest global norm of the policy's gradient."""
    entropy: Annotated[float, Range(0.0, 1e6)] = 0.01
    """Weight of the exploration's entropy in the objective."""
    deviation: Annotated[float, Range(1e-3, 100.0)] = 2.0
    """Initial standard deviation of the exploration (random change of the action), on each axis
    [m/s^2]."""
    reward_scale: Annotated[float, Range(0.0, 1e6, above=True)] = 0.01
    """Factor on all rewards, so that the returns that the critic estimates are around one."""
    critic_size: Annotated[int, Range(1, 8192)] = 128
    """Width of the critic's two hidden layers."""
    critic_rate: Annotated[float, Range(0.0, 10.0)] = 1e-3
    """Adam's learning rate of the critic."""
    critic_epochs: Annotated[int, Range(1, 10_000)] = 16
    """Passes of the critic over a rollout; without images they cost little."""

    @property
    def shared(self) -> TrainConfig:
        """The settings of a differentiable training in the same worlds and dynamics."""
        shared = {name: getattr(self, name) for name in SHARED}
        return TrainConfig(**shared, optimizer=OptimizerConfig(iterations=self.iterations))


def ppo_like(config: TrainConfig, iterations: int) -> PpoConfig:
    """Return the settings of PPO in the worlds and dynamics of `config`, otherwise the defaults."""
    shared = {name: getattr(config, name) for name in SHARED}
    return PpoConfig(**shared, iterations=iterations)
