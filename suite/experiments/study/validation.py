"""Measure a policy's success in the trainer's dynamics, on worlds that no training uses.

A world is one simulated scene and drone.

Flight, collisions and passed gates are computed by the trainer's code (`suite/train/rollout.py`): a
collision is a distance below `BODY_RADIUS_M` at one of `PATH_SAMPLES` points of a step's path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from policies.networks import network
from suite.train.config import TrainConfig
from suite.train.rollout import Note, make_rollout
from suite.train.step import BODY_RADIUS_M
from suite.train.worlds import Worlds, sample_worlds

Measure = Callable[[network.Params], dict[str, float]]
"""(parameters of a policy) -> numbers, as `suite.train.training_loop.Watch` calls it."""


class Scores(NamedTuple):
    """Results of each trial, (B,) each, until its end: a collision or the last gate."""

    gates: jax.Array
    """Number of passed gates."""
    collided: jax.Array
    """Bool."""
    crossed: jax.Array
    """Bool: all gates passed, without a collision before."""
    v_max: jax.Array
    """Largest speed [m/s]."""
    reward: jax.Array
    """Sum over the trial; zero without a reward."""


def score_trials(
    passed: jax.Array,
    clearance: jax.Array,
    speed: jax.Array,
    gates: int,
    reward: jax.Array | float = 0.0,
) -> Scores:
    """Return the trials' scores.

    A step with both a collision and a passed gate counts as a collision: their order is unknown.

    Args:
        passed: (T, B) bool, a gate was passed in the step.
        clearance: (T, B) smallest signed distance of the body's centre in the step [m].
        speed: (T, B) at the step's end [m/s].
        gates: number of gates of a trial.
        reward: (T, B) of the step.
    """
    collision = clearance < BODY_RADIUS_M
    passed = passed & ~collision
    ended = jnp.cumsum(collision | (jnp.cumsum(passed, 0) >= gates), 0) > 0
    # The step that ends a trial is the last one that counts.
    counts = jnp.concatenate([jnp.ones_like(ended[:1]), ~ended[:-1]])
    total = (passed & counts).sum(0)
    return Scores(
        gates=total,
        collided=(collision & counts).any(0),
        crossed=total >= gates,
        v_max=jnp.where(counts, speed, 0.0).max(0),
        reward=jnp.where(counts, reward, 0.0).sum(0),
    )


def validation_worlds(config: TrainConfig, trials: int, seed: int, seconds: float) -> TrainConfig:
    """Return `config` with the worlds of a validation: all start at rest and fly at full speed.

    Tracks, obstacles and the spread of the dynamics are those of the training. The field of view is
    the camera's, without its spread.
    """
    episode = replace(
        config.episode,
        batch=trials,
        steps=round(seconds * config.spec.rate_hz),
        rest_share=1.0,
        stop_from=1.0,
        race_share=1.0,
    )
    physics = replace(config.physics, fov_scale=(1.0, 1.0))
    return replace(config, seed=seed, episode=episode, physics=physics)


def make_flight(
    config: TrainConfig, reward: Note | None = None
) -> Callable[[network.Params, Worlds], Scores]:
    """Return fly(params, worlds) -> scores, compiled on its first call.

    Args:
        config: from `validation_worlds`; its seed determines the noise of the images.
        reward: (worlds, before, after, target) -> (B,), of a step.
    """
    rollout, episode = make_rollout(config, reward), config.episode

    @jax.jit
    def fly(params: network.Params, worlds: Worlds) -> Scores:
        embedding_shift = jnp.zeros((episode.steps, episode.batch, config.spec.hidden_size))
        key = jax.random.key(np.uint32(config.seed))
        _, records = rollout(params, embedding_shift, worlds, key, network.encode)
        rewards = 0.0 if reward is None else records.noted
        gates = worlds.scene.gates.center_w.shape[1]
        return score_trials(records.passed, records.clearance, records.speed, gates, rewards)

    return fly


def mean_scores(scores: Scores) -> dict[str, float]:
    """Return the results over all trials.

    They are `success_cross` (all gates passed without a collision), `collision_free` (no collision,
    whatever gates were passed), `v_max` (median of the trials' largest speeds) and `v_max_most`
    (the largest of them) [m/s], and the means of `gates` and `reward`.
    """
    numbers = {
        "success_cross": scores.crossed.mean(),
        "collision_free": 1.0 - scores.collided.mean(),
        "v_max": jnp.median(scores.v_max),
        "v_max_most": scores.v_max.max(),
        "gates": scores.gates.mean(),
        "reward": scores.reward.mean(),
    }
    return {name: float(value) for name, value in numbers.items()}


def make_validation(
    config: TrainConfig, trials: int, seed: int, seconds: float, reward: Note | None = None
) -> Measure:
    """Return measure(params) -> numbers of `mean_scores`, on the same worlds at every call.

    Args:
        config: of the training, whose dynamics are flown.
        trials: number of worlds.
        seed: of the worlds; not a training seed.
        seconds: length of a trial, from a standing start [s].
        reward: (worlds, before, after, target) -> (B,), of a step.
    """
    config = validation_worlds(config, trials, seed, seconds)
    fly, worlds = make_flight(config, reward), sample_worlds(config, 0)
    on_device: Worlds = jax.tree.map(jnp.asarray, worlds)
    return lambda params: mean_scores(fly(params, on_device))
