"""`suite train`: a policy by backpropagation through the point mass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from suite.console import Console
from suite.train.config import TrainConfig
from suite.train.overrides import override
from suite.train.presets import preset
from tracks.files import plain


@dataclass(frozen=True)
class Config:
    """Train a policy; the same command again resumes where it was stopped."""

    preset: str = "racer"
    """The recipe: racer (the shipped policy's), small, gpu or paper."""
    out: Path = Path("runs/train")
    """Folder of the run; a run that stands there is resumed."""
    seed: int = 0
    """Seed of the parameters, the tracks and the randomisation."""
    iterations: int | None = None
    """Gradient steps, instead of the preset's."""
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Start from this policy's checkpoint instead of fresh parameters."""
    delta: Path | None = None
    """Train under this frozen Delta Action Model (a checkpoint of `suite delta`)."""
    set: tuple[str, ...] = ()
    """Change settings by name, such as loss.progress=0.4 episode.batch=128."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def resolve(config: Config) -> TrainConfig:
    """Return the run that the options ask for.

    Raises:
        ValueError: for an unknown preset or setting, naming what is allowed.
    """
    run = replace(preset(config.preset), seed=config.seed)
    if config.iterations is not None:
        run = replace(run, optimizer=replace(run.optimizer, iterations=config.iterations))
    return override(run, config.set)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Train and say where the policy is and how the curve ended."""
    import jax

    from policies.delta_file import load_delta
    from policies.network import fitted
    from policies.policy_file import load_policy_checkpoint
    from suite.train.run import train

    params, delta = None, None
    if config.from_ is not None:
        params = jax.tree.map(jax.numpy.asarray, load_policy_checkpoint(config.from_).params)
        params = fitted(params, resolve(config).spec)
    if config.delta is not None:
        delta = jax.tree.map(jax.numpy.asarray, load_delta(config.delta).params)
    outcome = train(resolve(config), config.out, console, params, delta)
    last = outcome.last
    console.say(
        f"{outcome.iterations} iterations; at the end {last['gates']:.2f} gates a rollout, "
        f"{last['collided']:.0%} collided, {last['speed']:.1f} m/s"
    )
    console.say(f"policy: {outcome.policy}")
    return plain(outcome)
