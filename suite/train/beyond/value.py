"""The value of what comes after a rollout: learnt from its returns, paid at its end.

A rollout is short, and what its last second does is felt after it. A critic that knows the worlds
(Xu et al. 2022, "Accelerated Policy Learning with Parallel Differentiable Simulation") tells the
policy what its last state is worth, with gradient: how much progress is to come, none where it
crashes first. Progress is never counted as less than none, so to crash never pays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from suite.train.beyond import critic
from suite.train.config import TrainConfig


class Critic(NamedTuple):
    """A critic as it learns."""

    params: critic.Params
    """Of its network."""
    optimizer: optax.OptState
    """Of Adam."""


class Way(NamedTuple):
    """What a critic learns from: a rollout of T steps."""

    seen: jax.Array
    """(T + 1, B, F) its features before each step and after the last."""
    worth: jax.Array
    """(T, B) progress of the step, never less than none [m/s]."""
    alive: jax.Array
    """(T + 1, B) 1 where the world counted in the loss, else 0."""
    hit: jax.Array
    """(T, B) bool: the world crashed in the step."""
    stopped: jax.Array
    """(T, B) bool: it was taken out of the loss by the step's end, and would have flown on."""


def start_critic(config: TrainConfig) -> Critic:
    """Return a fresh critic for a run of `config`."""
    key = jax.random.fold_in(jax.random.key(config.seed), 1)
    params = critic.init(key, config.critic.size, critic.features_of(config.spec))
    return Critic(params, optax.adam(config.critic.rate).init(params))


def discount(config: TrainConfig) -> float:
    """Return by how much progress counts less for each decision later."""
    return math.exp(-1.0 / (config.critic.horizon_s * config.spec.rate_hz))


def to_come(config: TrainConfig, value: jax.Array) -> jax.Array:
    """Return the weighted loss of states with `value` (B,) [m/s] after the last step.

    It is minus all progress to come, in the unit of a loss averaged over the rollout's steps.
    """
    decisions = 1.0 / (1.0 - discount(config))
    return -config.loss.value * value * decisions / config.episode.steps


def returns(config: TrainConfig, value: jax.Array, way: Way) -> jax.Array:
    """Return what the critic is to say before each step, (T, B) [m/s].

    Nothing comes after a crash. A world that was stopped flies on, and what comes is what the
    critic says there. One that leaves the loss otherwise, at its last gate, is taken to fly on as
    it did in the step before: the progress of the step that passes a gate may be to that gate.

    Args:
        config: horizon and trace.
        value: (T + 1, B) what it says now, without gradient [m/s].
        way: the rollout.
    """
    fade, trace = discount(config), config.critic.trace

    def back(later: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        worth, steady, following, goes_on, hit, stopped = now
        ahead = (1.0 - trace) * following + trace * later
        ended = jnp.where(hit, 0.0, jnp.where(stopped, following, steady))
        ahead = jnp.where(goes_on > 0, ahead, ended)
        total = (1.0 - fade) * worth + fade * ahead
        return total, total

    steady = jnp.concatenate([way.worth[:1], way.worth[:-1]])
    steps = way.worth, steady, value[1:], way.alive[1:], way.hit, way.stopped
    return jax.lax.scan(back, value[-1], steps, reverse=True)[1]


def make_teach(config: TrainConfig) -> Callable[[Critic, Way], tuple[Critic, dict[str, jax.Array]]]:
    """Return teach(critic, way) -> (critic', numbers of the curve)."""
    adam = optax.adam(config.critic.rate)

    def teach(held: Critic, way: Way) -> tuple[Critic, dict[str, jax.Array]]:
        goal = returns(config, critic.value(held.params, way.seen), way)
        seen, counts = way.seen[:-1], way.alive[:-1]
        total = jnp.maximum(counts.sum(), 1.0)

        def error(params: critic.Params) -> jax.Array:
            return (counts * (critic.value(params, seen) - goal) ** 2).sum() / total

        def learn(held: Critic, _: None) -> tuple[Critic, jax.Array]:
            found, gradient = jax.value_and_grad(error)(held.params)
            change, optimizer = adam.update(gradient, held.optimizer, held.params)
            # optax types any tree of parameters; it gives back the one it was given.
            params = cast(critic.Params, optax.apply_updates(held.params, change))
            return Critic(params, optimizer), found

        held, errors = jax.lax.scan(learn, held, None, length=config.critic.passes)
        mean = (counts * goal).sum() / total
        spread = (counts * (goal - mean) ** 2).sum() / total
        return held, {"value": mean, "value_explained": 1.0 - errors[0] / (spread + 1e-8)}

    return teach
