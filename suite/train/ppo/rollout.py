"""A rollout with exploration and without gradients, in the trainer's worlds and dynamics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from policies.networks import network
from suite.train.config import TrainConfig
from suite.train.dynamics.interface import make_dynamics
from suite.train.ppo import critic
from suite.train.ppo.reward import RewardTerms, make_reward
from suite.train.rollout import make_sight, observed_at_start, queue, world_keys
from suite.train.step import BODY_RADIUS_M, target_gate
from suite.train.worlds import Worlds


class EpisodeCarry(NamedTuple):
    """What an episode carries from step to step."""

    state: Any
    """Of the dynamics."""
    target: jax.Array
    """(B,) gates passed, counted from the track's first."""
    hidden: jax.Array
    """(B, hidden) of the policy."""
    action_b: jax.Array
    """(B, 3) the last action [m/s^2]."""
    images: jax.Array
    """(B, image_delay, height, width) on their way, oldest first."""
    observed: jax.Array
    """(B, state_delay, state_size) on their way, oldest first."""


class Record(NamedTuple):
    """What a step leaves behind, (B, ...) each."""

    image: jax.Array
    """(B, height, width) that the policy saw."""
    state: jax.Array
    """(B, state_size) that it saw."""
    action_b: jax.Array
    """(B, 3) what it did [m/s^2]."""
    log_prob: jax.Array
    """Logarithm of the density of that action."""
    seen: jax.Array
    """(B, F) what the critic saw before the step."""
    reward: RewardTerms
    """Of the step."""
    done: jax.Array
    """Bool: the drone touched a solid, and the world starts again."""
    hidden: jax.Array
    """(B, hidden) recurrent state after the step."""
    passed: jax.Array
    """Bool: a gate was passed."""
    speed: jax.Array
    """[m/s]."""


def log_probability(mean: jax.Array, log_deviation: jax.Array, action: jax.Array) -> jax.Array:
    """Return the log density (...) of actions (..., 3) around mean (..., 3).

    Args:
        mean: (..., 3) [m/s^2].
        log_deviation: (3,) logarithm of the standard deviation, the same in every state.
        action: (..., 3) [m/s^2].
    """
    away = (action - mean) * jnp.exp(-log_deviation)
    return -(0.5 * away * away + log_deviation + 0.5 * jnp.log(2 * jnp.pi)).sum(-1)


def choose(where: jax.Array, ones: Any, others: Any) -> Any:
    """Return the leaves (B, ...) of `ones` for worlds `where` (B,) is true, else of `others`."""
    return jax.tree.map(lambda one, other: jax.vmap(jnp.where)(where, one, other), ones, others)


def make_rollout(config: TrainConfig) -> Callable[..., tuple[Record, jax.Array]]:
    """Return rollout(params, log_deviation, worlds, key) -> (records (T, B, ...), seen (B, F)).

    An episode ends where the drone touches a solid; its world then starts again as it started,
    with the recurrent state that it had. `seen` is what the critic sees after the last step.
    """
    spec, physics = config.spec, config.physics
    sight, reward, dynamics = make_sight(config), make_reward(config), make_dynamics(config)

    def rollout(
        params: network.Params, log_deviation: jax.Array, worlds: Worlds, key: jax.Array
    ) -> tuple[Record, jax.Array]:
        batch = worlds.pos_w.shape[0]
        state = dynamics.start(worlds.constants, worlds.pos_w, worlds.vel_w, worlds.heading_w)
        start = EpisodeCarry(
            state=state,
            target=worlds.target,
            hidden=jnp.asarray(worlds.hidden),
            action_b=jnp.zeros((batch, 3)),
            # An image of zeros is embedded as zeros, which is how the trainer's rollouts start.
            images=jnp.zeros((batch, physics.image_delay, spec.camera.height, spec.camera.width)),
            observed=observed_at_start(worlds, state, config),
        )

        def step(carry: EpisodeCarry, key: jax.Array) -> tuple[EpisodeCarry, Record]:
            before, target = carry.state, carry.target
            keys = world_keys(key, worlds)
            seen = sight(worlds, before, target, carry.action_b, keys)
            state, observed = queue(carry.observed, seen.state)
            image, images = queue(carry.images, seen.image)
            mean, hidden = network.step(params, carry.hidden, state, image)
            noise = jax.random.normal(jax.random.fold_in(key, 1), mean.shape)
            action = mean + jnp.exp(log_deviation) * noise
            _, target_w = target_gate(worlds.scene.gates, target)
            after = dynamics.step(before, worlds.constants, action, target_w, keys)
            terms, clearance, passed = reward(worlds, before, after, target)
            done = clearance < BODY_RADIUS_M
            record = Record(
                image=image,
                state=state,
                action_b=action,
                log_prob=log_probability(mean, log_deviation, action),
                seen=critic.features(worlds, before, target),
                reward=terms,
                done=done,
                hidden=hidden,
                passed=passed,
                speed=jnp.linalg.norm(after.vel_w, axis=-1),
            )
            going = EpisodeCarry(after, target + passed, hidden, action, images, observed)
            return choose(done, start, going), record

        last, records = jax.lax.scan(step, start, jax.random.split(key, config.episode.steps))
        return records, critic.features(worlds, last.state, last.target)

    return rollout
