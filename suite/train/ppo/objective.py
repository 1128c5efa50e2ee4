"""The advantages and the clipped objective of PPO (Schulman et al. 2016, 2017)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from policies.networks import network
from suite.train.ppo.config import PpoConfig
from suite.train.ppo.rollout import Record, log_probability


class Actor(NamedTuple):
    """The policy and its exploration."""

    params: network.Params
    """The policy's parameters."""
    log_deviation: jax.Array
    """(3,) logarithm of the standard deviation [m/s^2] of the exploration on each axis."""


class Sequences(NamedTuple):
    """The inputs of the objective from a rollout of T steps in B worlds."""

    records: Record
    """(T, B, ...) what the policy observed and did; the log-probabilities are those of the policy
    that flew."""
    advantage: jax.Array
    """(T, B) advantage of the action over the mean one, normalised over the rollout."""
    start: jax.Array
    """(1, B, hidden) recurrent state at the start of every episode of a world."""


def advantages(
    reward: jax.Array, value: jax.Array, done: jax.Array, discount: float, trace: float
) -> jax.Array:
    """Return the generalised advantage estimates (T, B) (Schulman et al. 2016, Eq. 16).

    The return after the rollout's end is the value that the critic estimates. The return after a
    collision is zero.

    Args:
        reward: (T, B) reward of each step.
        value: (T + 1, B) the critic's values of the states before each step and after the last one.
        done: (T, B) bool: the episode ended with the step.
        discount: gamma.
        trace: lambda.
    """
    going = 1.0 - done
    error = reward + discount * going * value[1:] - value[:-1]

    def add_error(
        later: jax.Array, step: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        error_now, going_now = step
        total = error_now + discount * trace * going_now * later
        return total, total

    return jax.lax.scan(add_error, jnp.zeros_like(error[0]), (error, going), reverse=True)[1]


def action_means(params: network.Params, embeddings: jax.Array, sequences: Sequences) -> jax.Array:
    """Return the policy's actions (T, B, 3) without exploration, from embeddings (T, B, hidden).

    The recurrent state is set back to that of the start after the end of an episode.
    """
    start, records = sequences.start[0], sequences.records

    def step(
        hidden: jax.Array, now: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        embedding, state, done = now
        mean, hidden = network.recur(params, hidden, embedding, state)
        return jnp.where(done[:, None], start, hidden), mean

    return jax.lax.scan(step, start, (embeddings, records.state, records.done))[1]


def clipped_loss(
    config: PpoConfig, actor: Actor, embeddings: jax.Array, sequences: Sequences
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return minus the clipped objective (Schulman et al. 2017, Eq. 7) and numbers of the curve.

    Args:
        config: has the clip limit and the weight of the entropy.
        actor: the policy and its exploration, with gradient.
        embeddings: (T, B, hidden) embeddings of the images, with gradient.
        sequences: the rollout, and its advantages.
    """
    mean, flown = action_means(actor.params, embeddings, sequences), sequences.records
    log_ratio = log_probability(mean, actor.log_deviation, flown.action_b) - flown.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    gain = jnp.minimum(ratio * sequences.advantage, clipped * sequences.advantage).mean()
    # The entropy of a normal distribution, without its constant.
    entropy = actor.log_deviation.sum()
    numbers = {
        # Schulman's estimate of the divergence, which is never negative.
        "divergence": (ratio - 1.0 - log_ratio).mean(),
        "clipped": (jnp.abs(ratio - 1.0) > config.clip).mean(),
    }
    return -gain - config.entropy * entropy, numbers
