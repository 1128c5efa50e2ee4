"""Measure the success of a policy in the dynamics of the training, on worlds that no training uses.

A collision is a distance to an obstacle below `BODY_RADIUS_M`, at one of `PATH_SAMPLES` points on
the path of a step.
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
"""Parameters of a policy -> measures by name; `suite.train.training_loop.Watch` calls it."""


class Scores(NamedTuple):
    """Results of B trials. A trial ends with a collision or the last gate, or after its time."""

    gates: jax.Array
    """(B,) number of passed gates."""
    collided: jax.Array
    """(B,) bool: the trial ended with a collision."""
    crossed: jax.Array
    """(B,) bool: all gates passed, without a collision before."""
    v_max: jax.Array
    """(B,) largest speed [m/s]."""
    reward: jax.Array
    """(B,) sum of the rewards of the steps; zero if no reward is computed."""


def score_trials(
    passed: jax.Array,
    clearance: jax.Array,
    speed: jax.Array,
    gates: int,
    reward: jax.Array | float = 0.0,
) -> Scores:
    """Return the scores of B trials from the records of their T steps.

    A step with both a collision and a passed gate counts as a collision: their order is unknown.

    Args:
        passed: (T, B) bool, whether a gate was passed in the step.
        clearance: (T, B) smallest distance from the centre of the body to an obstacle in the step,
            negative inside an obstacle [m].
        speed: (T, B) speed at the end of the step [m/s].
        gates: number of gates of a trial.
        reward: (T, B) reward of the step.
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

    Tracks, obstacles and the randomisation of the dynamics are those of the training. The field of
    view is that of the camera, without randomisation.
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

    The seed of `config` (from `validation_worlds`) determines the image noise. `reward` maps
    (worlds, state before, state after, target) to the reward of a step, (B,).
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
    """Return the measures of all trials together, by name.

    They are the shares of trials `success_cross` (all gates passed without a collision) and
    `collision_free` (no collision, whatever gates were passed); `v_max` (median over the trials of
    the largest speed) and `v_max_most` (largest speed of all trials) [m/s]; and the means of
    `gates` and `reward`.
    """
    measures = {
        "success_cross": scores.crossed.mean(),
        "collision_free": 1.0 - scores.collided.mean(),
        "v_max": jnp.median(scores.v_max),
        "v_max_most": scores.v_max.max(),
        "gates": scores.gates.mean(),
        "reward": scores.reward.mean(),
    }
    return {name: float(value) for name, value in measures.items()}


def make_validation(
    config: TrainConfig, trials: int, seed: int, seconds: float, reward: Note | None = None
) -> Measure:
    """Return measure(params) -> measures of `mean_scores`, on the same worlds at every call.

    A trial takes `seconds` from a standing start [s]. No training uses the `seed` of the worlds.
    `reward` is as in `make_flight`.
    """
    config = validation_worlds(config, trials, seed, seconds)
    fly, worlds = make_flight(config, reward), sample_worlds(config, 0)
    on_device: Worlds = jax.tree.map(jnp.asarray, worlds)
    return lambda params: mean_scores(fly(params, on_device))
