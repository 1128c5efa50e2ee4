"""The rollout of PPO: fly the policy with random exploration, without gradients, and record it.

B worlds (simulated scenes with a drone) fly T policy periods in the trainer's dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from policies.networks import network
from suite.train.config import TrainConfig
from suite.train.ppo import critic
from suite.train.ppo.environment import make_race
from suite.train.ppo.reward import RewardTerms
from suite.train.rollout import Episode, world_keys
from suite.train.worlds import Worlds
from tracks.common.masks import select


class Record(NamedTuple):
    """Records of a step, (B, ...) each."""

    image: jax.Array
    """(B, height, width) of the observation."""
    state: jax.Array
    """(B, state_size) of the observation."""
    action_b: jax.Array
    """(B, 3) action with exploration [m/s^2]."""
    log_prob: jax.Array
    """Logarithm of the probability density of that action."""
    critic_inputs: jax.Array
    """(B, F) inputs of the critic, from the state before the step."""
    reward: RewardTerms
    """Reward of the step."""
    done: jax.Array
    """Bool: the drone touched a solid, and the world is reset."""
    hidden: jax.Array
    """(B, hidden) recurrent state after the step."""
    passed: jax.Array
    """Bool: a gate was passed."""
    speed: jax.Array
    """Speed at the step's end [m/s]."""


def log_probability(mean: jax.Array, log_deviation: jax.Array, action: jax.Array) -> jax.Array:
    """Return the logarithm of the probability density (...) of actions of a normal distribution.

    Args:
        mean: (..., 3) mean of the distribution, the policy's output [m/s^2].
        log_deviation: (3,) logarithm of the standard deviation, the same in every state.
        action: (..., 3) the actions [m/s^2].
    """
    standardised = (action - mean) * jnp.exp(-log_deviation)
    return -(0.5 * standardised * standardised + log_deviation + 0.5 * jnp.log(2 * jnp.pi)).sum(-1)


def make_rollout(config: TrainConfig) -> Callable[..., tuple[Record, jax.Array]]:
    """Return rollout(params, log_deviation, worlds, key) -> (records (T, B, ...), inputs (B, F)).

    An episode ends when the drone touches a solid. Its world is then reset to its start, and the
    policy's recurrent state to that of the start. `inputs` are the critic's inputs from the states
    after the last step.
    """
    race = make_race(config)

    def rollout(
        params: network.Params, log_deviation: jax.Array, worlds: Worlds, key: jax.Array
    ) -> tuple[Record, jax.Array]:
        start = race.start(worlds), jnp.asarray(worlds.hidden)

        def step(
            carry: tuple[Episode, jax.Array], key: jax.Array
        ) -> tuple[tuple[Episode, jax.Array], Record]:
            keys = world_keys(key, worlds)
            before, hidden = carry
            observation, episode = race.observe(worlds, before, keys)
            mean, hidden = network.step(params, hidden, observation.state, observation.image)
            # The worlds' keys use the numbers 0 to B - 1, so B gives one that no world has.
            noise = jax.random.normal(jax.random.fold_in(key, len(mean)), mean.shape)
            action = mean + jnp.exp(log_deviation) * noise
            after, result = race.fly(worlds, episode, action, keys)
            record = Record(
                image=observation.image,
                state=observation.state,
                action_b=action,
                log_prob=log_probability(mean, log_deviation, action),
                critic_inputs=critic.features(worlds, before.state, before.target),
                reward=result.reward,
                done=result.collided,
                hidden=hidden,
                passed=result.passed,
                speed=jnp.linalg.norm(after.state.vel_w, axis=-1),
            )
            return select(result.collided, start, (after, hidden)), record

        (last, _), records = jax.lax.scan(step, start, jax.random.split(key, config.episode.steps))
        return records, critic.features(worlds, last.state, last.target)

    return rollout
