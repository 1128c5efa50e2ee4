"""Training runs by name; `suite train --preset NAME`."""

from __future__ import annotations

from dataclasses import replace

from policies.spec import PolicySpec
from suite.train.config import (
    EpisodeConfig,
    LossConfig,
    OptimizerConfig,
    PointMassConfig,
    TrainConfig,
)
from tracks.names import unknown_name


def racer() -> TrainConfig:
    """Return the recipe of the shipped policy: what was measured to race best on two cores."""
    return TrainConfig()


def paper() -> TrainConfig:
    """Return the weights of Su et al. 2026 and the simulator of Zhang et al. 2025 as printed."""
    return TrainConfig(
        spec=PolicySpec(rate_hz=15.0),
        physics=PointMassConfig(action_delay=(0.0, 0.0), state_delay=1, image_delay=2),
        loss=LossConfig(),
        optimizer=OptimizerConfig(iterations=50_000, memory=0.999, clip=0.0, warmup=0),
    )


def small() -> TrainConfig:
    """Return a run of minutes on two cores, for `make race`: it flies, it does not win."""
    base = racer()
    return replace(base, optimizer=replace(base.optimizer, iterations=100))


def gpu() -> TrainConfig:
    """Return the racer's recipe with thousands of worlds at once, for an accelerator."""
    base = racer()
    return replace(
        base,
        episode=EpisodeConfig(**{**vars(base.episode), "batch": 2048}),
        optimizer=replace(base.optimizer, iterations=4000),
    )


def finetune(config: TrainConfig, share: float = 0.25) -> TrainConfig:
    """Return how a policy that `config` trained is fine-tuned, under a Delta Action Model or not.

    The steps are smaller, since the policy flies already, and the tracks are new ones.

    Args:
        config: how the policy was trained.
        share: gradient steps, as a share of that training's.
    """
    optimizer = config.optimizer
    return replace(
        config,
        episode=replace(config.episode, easy_until=0.0),
        optimizer=replace(
            optimizer,
            iterations=max(1, round(share * optimizer.iterations)),
            rate=0.3 * optimizer.rate,
        ),
        seed=config.seed + 1,
    )


PRESETS = {"racer": racer, "paper": paper, "small": small, "gpu": gpu}
"""Name -> function that returns the configuration; the docstring is its description."""


def preset(name: str) -> TrainConfig:
    """Return the recipe called `name`.

    Raises:
        ValueError: where there is none, with the names there are.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]()
