"""Train a policy with PPO (proximal policy optimisation), the baseline of the suite's own training.

An iteration flies a rollout, computes its advantages, and makes several passes over it that train
two networks: the policy (actor) and the critic. A minibatch has whole worlds (simulated scenes with
a drone), with backpropagation through their whole rollouts. As in the differentiable trainer, the
images of a minibatch are encoded at once, outside the loop over steps.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from policies.networks import network
from suite.common.console import Console
from suite.common.stages import Estimate
from suite.train import run as trainer
from suite.train.config import check
from suite.train.gradient import sampled_encoder_gradient
from suite.train.ppo import critic
from suite.train.ppo.config import PpoConfig
from suite.train.ppo.objective import Actor, Sequences, advantages, clipped_loss
from suite.train.ppo.rollout import Record, make_rollout
from suite.train.training_loop import Outcome, Run, RunPhase, Watch, flight_note, train_in_folder
from suite.train.worlds import Worlds, sample_worlds
from tracks.common.files import plain
from tracks.input.ranges import check_ranges

STEPS_PER_CORE_S = 8000.0
"""Environment steps a second of a processor core, in a rollout or a learning pass; a rough value
for the estimate."""
COMPILE_S = 20.0
"""Time to compile, for the estimate [s]."""


class PpoState(NamedTuple):
    """State of a run between iterations."""

    actor: Actor
    """The policy and its exploration."""
    critic: critic.Params
    """Parameters of the critic."""
    optimizer: optax.OptState
    """State of the actor's optimiser."""
    critic_optimizer: optax.OptState
    """State of the critic's optimiser."""
    iteration: jax.Array
    """Number of finished iterations, a scalar."""
    hidden: jax.Array
    """(B, hidden) recurrent states from random steps of the last rollout."""

    @property
    def params(self) -> network.Params:
        """The policy's parameters."""
        return self.actor.params


def make_optimizers(
    config: PpoConfig,
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Return the actor's and the critic's optimiser."""
    steps = config.iterations * config.epochs * config.minibatches
    rate = optax.linear_schedule(config.rate, 0.0, max(1, steps))
    actor = optax.chain(optax.clip_by_global_norm(config.gradient_clip), optax.adam(rate))
    return actor, optax.adam(config.critic_rate)


def start_state(config: PpoConfig) -> PpoState:
    """Return the state before the first iteration; the policy starts as in the trainer."""
    params = network.init(jax.random.key(config.seed), config.spec)
    # The explicit type is needed: with a weak type the second iteration would compile again.
    actor = Actor(params, jnp.full(3, math.log(config.deviation), jnp.float32))
    critic_key = jax.random.fold_in(jax.random.key(config.seed), 1)
    critic_params = critic.init(critic_key, config.critic_size, critic.feature_count(config.spec))
    actor_optimizer, critic_optimizer = make_optimizers(config)
    return PpoState(
        actor=actor,
        critic=critic_params,
        optimizer=actor_optimizer.init(actor),
        critic_optimizer=critic_optimizer.init(critic_params),
        iteration=jnp.zeros((), int),
        hidden=jnp.zeros((config.episode.batch, config.spec.hidden_size)),
    )


def shuffled(key: jax.Array, count: int, epochs: int, parts: int) -> jax.Array:
    """Return the indices of each minibatch, (epochs * parts, count // parts).

    Each of the `epochs` shuffles the `count` indices and divides them into `parts` minibatches.
    """
    orders = [jax.random.permutation(k, count) for k in jax.random.split(key, epochs)]
    return jnp.stack(orders).reshape(epochs * parts, count // parts)


def actor_gradient(
    config: PpoConfig, actor: Actor, sequences: Sequences, key: jax.Array
) -> tuple[Actor, dict[str, jax.Array]]:
    """Return the gradient of the clipped loss, and numbers of the learning curve by name.

    `key` selects the images for the encoder's gradient, with `episode.image_stride`.
    """
    images = sequences.records.image
    steps, batch = images.shape[:2]
    embeddings = network.encode(actor.params, images.reshape(-1, *images.shape[2:]))
    embeddings = embeddings.reshape(steps, batch, -1)
    (loss, numbers), (direct, cotangents) = jax.value_and_grad(
        clipped_loss, argnums=(1, 2), has_aux=True
    )(config, actor, embeddings, sequences)
    stride = config.episode.image_stride
    through_images = sampled_encoder_gradient(actor.params, images, cotangents, stride, key)
    params = jax.tree.map(jnp.add, direct.params, through_images)
    return direct._replace(params=params), {"loss": loss, **numbers}


def curve_numbers(records: Record) -> dict[str, jax.Array]:
    """Return a rollout's numbers of the learning curve by name.

    Of the passed gates, only those of each world's first episode count.
    """
    # 1 until the end of a world's first episode, then 0.
    in_first_episode = jnp.cumprod(
        1 - jnp.concatenate([jnp.zeros_like(records.done[:1]), records.done[:-1]]), 0
    )
    numbers = {
        "reward": records.reward.total().mean(),
        "gates": (records.passed * in_first_episode).sum(0).mean(),
        "collided": records.done.any(0).mean(),
        "speed": records.speed.mean(),
        "speed_max": records.speed.max(0).mean(),
    }
    return numbers | {f"reward_{k}": v.mean() for k, v in records.reward._asdict().items()}


def make_update(
    config: PpoConfig,
) -> Callable[[PpoState, Worlds], tuple[PpoState, dict[str, jax.Array]]]:
    """Return update(state, worlds) -> (state', the curve's row), which makes one iteration of PPO.

    It is compiled on the first call.
    """
    batch, steps = config.episode.batch, config.episode.steps
    rollout = make_rollout(config.shared)
    actor_optimizer, critic_optimizer = make_optimizers(config)
    seed = jax.random.key(np.uint32(config.seed))

    def train_actor(
        state: PpoState, sequences: Sequences, key: jax.Array
    ) -> tuple[PpoState, dict[str, jax.Array]]:
        def learn(
            carry: tuple[Actor, optax.OptState], part: tuple[jax.Array, jax.Array]
        ) -> tuple[tuple[Actor, optax.OptState], dict[str, jax.Array]]:
            (actor, optimizer), (rows, key) = carry, part
            minibatch = jax.tree.map(lambda array: array[:, rows], sequences)
            gradient, numbers = actor_gradient(config, actor, minibatch, key)
            squares = [(leaf * leaf).sum() for leaf in jax.tree.leaves(gradient)]
            numbers["gradient_norm"] = jnp.sqrt(jnp.stack(squares).sum())
            change, optimizer = actor_optimizer.update(gradient, optimizer, actor)
            # optax has a general type for trees; it returns the type of its argument.
            return (cast(Actor, optax.apply_updates(actor, change)), optimizer), numbers

        rows = shuffled(key, batch, config.epochs, config.minibatches)
        parts = rows, jax.random.split(key, len(rows))
        (actor, optimizer), numbers = jax.lax.scan(learn, (state.actor, state.optimizer), parts)
        return state._replace(actor=actor, optimizer=optimizer), numbers

    def train_critic(
        state: PpoState, inputs: jax.Array, goal: jax.Array, key: jax.Array
    ) -> PpoState:
        def loss_of(params: critic.Params, rows: jax.Array) -> jax.Array:
            return ((critic.value(params, inputs[:, rows]) - goal[:, rows]) ** 2).mean()

        def learn(
            carry: tuple[critic.Params, optax.OptState], rows: jax.Array
        ) -> tuple[tuple[critic.Params, optax.OptState], None]:
            params, optimizer = carry
            gradient = jax.grad(loss_of)(params, rows)
            change, optimizer = critic_optimizer.update(gradient, optimizer, params)
            return (cast(critic.Params, optax.apply_updates(params, change)), optimizer), None

        rows = shuffled(key, batch, config.critic_epochs, config.minibatches)
        start = state.critic, state.critic_optimizer
        (params, optimizer), _ = jax.lax.scan(learn, start, rows)
        return state._replace(critic=params, critic_optimizer=optimizer)

    @jax.jit
    def update(state: PpoState, worlds: Worlds) -> tuple[PpoState, dict[str, jax.Array]]:
        keys = jax.random.split(jax.random.fold_in(seed, state.iteration), 4)
        worlds = worlds._replace(hidden=state.hidden * worlds.remembers[:, None])
        actor = state.actor
        # The rollout, and the advantages of its actions.
        records, last_inputs = rollout(actor.params, actor.log_deviation, worlds, keys[0])
        inputs = jnp.concatenate([records.critic_inputs, last_inputs[None]])
        value = critic.value(state.critic, inputs)
        reward = config.reward_scale * records.reward.total()
        advantage = advantages(reward, value, records.done, config.discount, config.trace)
        goal = advantage + value[:-1]
        normalised = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        sequences = Sequences(records, normalised, worlds.hidden[None])
        # Train both networks; then keep recurrent states for starts of the next rollout.
        state, numbers = train_actor(state, sequences, keys[1])
        state = train_critic(state, records.critic_inputs, goal, keys[2])
        step = jax.random.randint(keys[3], (batch,), 0, steps)
        hidden = records.hidden[step, jnp.arange(batch)]
        state = state._replace(iteration=state.iteration + 1, hidden=hidden)
        numbers = curve_numbers(records) | jax.tree.map(jnp.mean, numbers)
        numbers["value_loss"] = (advantage**2).mean()
        numbers["explained"] = 1.0 - advantage.var() / (goal.var() + 1e-8)
        numbers["deviation"] = jnp.exp(actor.log_deviation).mean()
        return state, numbers

    return update


def estimate(config: PpoConfig) -> Estimate:
    """Return the approximate time and memory of a run on this machine's devices."""
    passes = 1 + config.epochs
    return trainer.estimate(config.shared, STEPS_PER_CORE_S, COMPILE_S, passes=passes, images=3)


def train_ppo(
    config: PpoConfig, folder: Path, console: Console, watch: Watch | None = None
) -> Outcome:
    """Train for the configured iterations; the same call again resumes the run in `folder`.

    Raises:
        ValueError: for invalid settings, and if the folder has another run.
        WorkFailed: if a number of the curve is not finite.
    """
    check_ranges(config)
    shared, batch = config.shared, config.episode.batch
    check(shared)
    if batch % config.minibatches:
        raise ValueError(
            f"minibatches is {config.minibatches}, allowed are divisors of episode.batch ({batch})"
        )
    phase = RunPhase(
        end=config.iterations,
        spec=config.spec,
        frames=batch * config.episode.steps,
        worlds=functools.partial(sample_worlds, shared),
        make_update=lambda: make_update(config),
        note=functools.partial(flight_note, "reward"),
    )
    origin = {"config": plain(config), "from": None, "delta": None, "method": "ppo"}
    run = Run(config, origin, folder, estimate(config))
    return train_in_folder([phase], run, start_state(config), console, watch)
