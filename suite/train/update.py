"""One gradient step of a training: sum the shards' gradients, apply AdamW, report the curve.

A shard is a part of the batch whose gradient is computed separately (`shards.py`). The curve is the
learning curve: a table of numbers, such as loss and speed, with a row per gradient step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from policies.networks import delta_network, network
from suite.train.config import OptimizerConfig, TrainConfig
from suite.train.shards import Shard, batch_mean, curve_numbers, make_shards
from suite.train.worlds import Worlds

RATE_END, WEIGHT_DECAY = 1e-5, 1e-2
"""Learning rate at the end of every phase (or the peak rate, if that is lower), and AdamW's
decoupled weight decay."""


class TrainState(NamedTuple):
    """State of a run between iterations."""

    params: network.Params
    """The policy's parameters."""
    optimizer: optax.OptState
    """AdamW's state."""
    iteration: jax.Array
    """Number of finished gradient steps, a scalar."""
    hidden: jax.Array
    """(B, hidden) the policy's recurrent states at random steps of the last rollout, with which
    worlds of the next rollout start."""


def make_optimizer(config: OptimizerConfig, begin: int = 0) -> optax.GradientTransformation:
    """Return AdamW with warm-up, cosine decay and optional clipping by global norm.

    A phase begins after `begin` gradient steps of the run. The schedule starts again there, while
    AdamW's moments and its count of steps are kept.
    """
    rate = optax.warmup_cosine_decay_schedule(
        0.0,
        config.rate,
        config.warmup,
        max(config.iterations, config.warmup + 1),
        min(RATE_END, config.rate),
    )
    adamw = optax.adamw(
        lambda step: rate(step - begin), b2=config.memory, weight_decay=WEIGHT_DECAY
    )
    clip = optax.clip_by_global_norm(config.clip) if config.clip > 0 else optax.identity()
    # A chain also without clipping: phases with and without it share one state.
    return optax.chain(clip, adamw)


def start_state(config: TrainConfig, params: network.Params | None = None) -> TrainState:
    """Return the state before the first iteration; `params` None draws random parameters."""
    start = network.init(jax.random.key(config.seed), config.spec) if params is None else params
    hidden = jnp.zeros((config.episode.batch, config.spec.hidden_size))
    return TrainState(
        params=start,
        optimizer=make_optimizer(config.optimizer).init(start),
        iteration=jnp.zeros((), int),
        hidden=hidden,
    )


def make_update(
    config: TrainConfig, delta: delta_network.Params | None = None, begin: int = 0
) -> Callable[[TrainState, Worlds], tuple[TrainState, dict[str, jax.Array]]]:
    """Return update(state, worlds) -> (state', the curve's row), which makes one gradient step.

    It is compiled on the first call. A phase begins after `begin` gradient steps of the run.
    `delta` is as for `suite.train.run.train`.
    """
    optimizer, shards_of = make_optimizer(config.optimizer, begin), make_shards(config, delta)

    @jax.jit
    def step(state: TrainState, shards: list[Shard]) -> tuple[TrainState, dict[str, jax.Array]]:
        batch = batch_mean(shards)
        change, optimizer_state = optimizer.update(batch.gradient, state.optimizer, state.params)
        after = TrainState(
            # optax has a general type for trees; it returns the type of its argument.
            params=cast(network.Params, optax.apply_updates(state.params, change)),
            optimizer=optimizer_state,
            iteration=state.iteration + 1,
            hidden=batch.hidden,
        )
        return after, curve_numbers(batch)

    def update(state: TrainState, worlds: Worlds) -> tuple[TrainState, dict[str, jax.Array]]:
        return step(state, shards_of(state.params, state.hidden, state.iteration, worlds))

    return update
