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
"""Settings that both trainings have."""


@dataclass(frozen=True)
class PpoConfig:
    """A PPO run (Schulman et al. 2017): policy, dynamics and worlds are the trainer's."""

    spec: PolicySpec = field(default_factory=lambda: PolicySpec(rate_hz=15.0))
    """Rate, camera and encodings of the policy."""
    physics: PointMassConfig = field(default_factory=PointMassConfig)
    """Dynamics and their randomisation."""
    quadrotor: QuadrotorConfig | None = None
    """Train through this quadrotor; None: through the point mass of `physics`."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Only the safety radius r_q is used, by the reward."""
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    """Worlds and horizon; `stop_from` and `finish` are not used, since the critic learns the value
    of later steps and a world is reset at its end."""
    seed: Seed = 0
    """Seed of the parameters, the tracks, the randomisation and the exploration."""
    iterations: Iterations = 200
    """Rollouts, each followed by `epochs` times `minibatches` gradient steps."""
    discount: Share = 0.97
    """gamma of the return, per policy period [1]."""
    trace: Share = 0.95
    """lambda of generalised advantage estimation (Schulman et al. 2016) [1]."""
    clip: Annotated[float, Range(0.0, 10.0, above=True)] = 0.2
    """epsilon: how far the ratio of an action's new to its old probability may be from 1 and still
    count in the objective [1]."""
    epochs: Annotated[int, Range(1, 10_000)] = 4
    """Passes of the policy over a rollout."""
    minibatches: Annotated[int, Range(1, 10_000)] = 4
    """Gradient steps of a pass, each over a part of the worlds; must divide `episode.batch`."""
    rate: Annotated[float, Range(0.0, 10.0)] = 3e-3
    """Adam's initial learning rate of the policy; it falls linearly to zero."""
    gradient_clip: Annotated[float, Range(0.0, 1e12, above=True)] = 1.0
    """Largest global norm of the policy's gradient."""
    entropy: Annotated[float, Range(0.0, 1e6)] = 0.01
    """Weight of the exploration's entropy in the objective [1]."""
    deviation: Annotated[float, Range(1e-3, 100.0)] = 2.0
    """Initial standard deviation of the exploration, on each axis of the action [m/s^2]."""
    reward_scale: Annotated[float, Range(0.0, 1e6, above=True)] = 0.01
    """Factor on rewards for the critic, which gives returns around one [1]."""
    critic_size: Annotated[int, Range(1, 8192)] = 128
    """Width of the critic's two hidden layers."""
    critic_rate: Annotated[float, Range(0.0, 10.0)] = 1e-3
    """Adam's learning rate of the critic."""
    critic_epochs: Annotated[int, Range(1, 10_000)] = 16
    """Passes of the critic over a rollout; without images they cost little."""

    @property
    def shared(self) -> TrainConfig:
        """The differentiable training in the shared worlds and dynamics."""
        shared = {name: getattr(self, name) for name in SHARED}
        return TrainConfig(**shared, optimizer=OptimizerConfig(iterations=self.iterations))


def ppo_like(config: TrainConfig, iterations: int) -> PpoConfig:
    """Return PPO with its default settings in the worlds and dynamics of `config`."""
    shared = {name: getattr(config, name) for name in SHARED}
    return PpoConfig(**shared, iterations=iterations)
