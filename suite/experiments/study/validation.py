"""Success in the trainer's own dynamics: a policy on fixed worlds that no training has seen.

Flight, collision and passing are the trainer's code (`suite/train/rollout.py`): the nearest of the
`NEAR` solids at `PATH_SAMPLES` points of a step's path, closer than `BODY_RADIUS_M`.
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
"""Of a policy's parameters; fits `suite.train.training_loop.Watch`."""


class Scores(NamedTuple):
    """What each trial came to, (B,) each, until its end: a collision or the last gate."""

    gates: jax.Array
    """Passed."""
    collided: jax.Array
    """Bool."""
    crossed: jax.Array
    """Bool: all gates passed, without a collision before."""
    v_max: jax.Array
    """Largest speed [m/s]."""
    reward: jax.Array
    """Summed; zero where there was none."""


def scored(
    passed: jax.Array,
    clearance: jax.Array,
    speed: jax.Array,
    gates: int,
    reward: jax.Array | float = 0.0,
) -> Scores:
    """Return the trials' scores.

    A step that both collides and passes a gate collides: which came first is not known.

    Args:
        passed: (T, B) bool, a gate was passed in the step.
        clearance: (T, B) least signed distance of the body's centre in the step [m].
        speed: (T, B) at the step's end [m/s].
        gates: how many a trial has.
        reward: (T, B) of the step.
    """
    hit = clearance < BODY_RADIUS_M
    passed = passed & ~hit
    over = jnp.cumsum(hit | (jnp.cumsum(passed, 0) >= gates), 0) > 0
    ran = jnp.concatenate([jnp.ones_like(over[:1]), ~over[:-1]])
    count = (passed & ran).sum(0)
    return Scores(
        gates=count,
        collided=(hit & ran).any(0),
        crossed=count >= gates,
        v_max=jnp.where(ran, speed, 0.0).max(0),
        reward=jnp.where(ran, reward, 0.0).sum(0),
    )


def validation_worlds(config: TrainConfig, trials: int, seed: int, seconds: float) -> TrainConfig:
    """Return `config` with the worlds of a validation: all from rest, at full speed, for a time.

    Tracks, obstacles and the spread of the dynamics stay those of the training. Its field of view,
    which all worlds of an iteration share, is the camera's.
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
        config: of `validation_worlds`; its seed sets the images' noise.
        reward: (worlds, before, body, target) -> (B,), of a step.
    """
    rollout, episode = make_rollout(config, reward), config.episode

    @jax.jit
    def fly(params: network.Params, worlds: Worlds) -> Scores:
        embedding_shift = jnp.zeros((episode.steps, episode.batch, config.spec.hidden_size))
        key = jax.random.key(np.uint32(config.seed))
        _, records = rollout(params, embedding_shift, worlds, key, network.encode)
        noted = 0.0 if reward is None else records.noted
        gates = worlds.scene.gates.center_w.shape[1]
        return scored(records.passed, records.clearance, records.speed, gates, noted)

    return fly


def measured(scores: Scores) -> dict[str, float]:
    """Return what the trials came to.

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
    """Return measure(params) -> numbers of `measured`, on the same worlds at every call.

    Args:
        config: the training's; its dynamics are flown.
        trials: worlds.
        seed: of the worlds; not one that is trained on.
        seconds: of a trial, from standing start [s].
        reward: (worlds, before, body, target) -> (B,), of a step.
    """
    config = validation_worlds(config, trials, seed, seconds)
    fly, worlds = make_flight(config, reward), sample_worlds(config, 0)
    placed: Worlds = jax.tree.map(jnp.asarray, worlds)
    return lambda params: measured(fly(params, placed))
