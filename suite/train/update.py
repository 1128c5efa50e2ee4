"""One gradient step: the gradient over all devices, AdamW, and the numbers of the curve."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from policies.networks import delta_network, network
from suite.common.running import hosts
from suite.train.config import OptimizerConfig, TrainConfig
from suite.train.gradient import shard_gradient
from suite.train.rollout import StepRecord
from suite.train.step import BODY_RADIUS_M
from suite.train.worlds import Worlds

RATE_END, WEIGHT_DECAY = 1e-5, 1e-2
"""Learning rate at the end of every run, and AdamW's decoupled weight decay."""


class TrainState(NamedTuple):
    """All that a run carries from one iteration to the next."""

    params: network.Params
    """The policy's."""
    optimizer: optax.OptState
    """Of AdamW."""
    iteration: jax.Array
    """Gradient steps done, a scalar."""
    hidden: jax.Array
    """(B, hidden) recurrent states from random steps of the last rollout."""


def make_optimizer(config: OptimizerConfig) -> optax.GradientTransformation:
    """Return AdamW with warm-up, cosine decay and optional clipping by global norm."""
    rate = optax.warmup_cosine_decay_schedule(
        0.0, config.rate, config.warmup, max(config.iterations, config.warmup + 1), RATE_END
    )
    adamw = optax.adamw(rate, b2=config.memory, weight_decay=WEIGHT_DECAY)
    if config.clip <= 0:
        return adamw
    return optax.chain(optax.clip_by_global_norm(config.clip), adamw)


def start_state(config: TrainConfig, params: network.Params | None = None) -> TrainState:
    """Return the state before the first iteration, from fresh or given parameters."""
    if params is None:
        params = network.init(jax.random.key(config.seed), config.spec)
    hidden = jnp.zeros((config.episode.batch, config.spec.hidden_size))
    return TrainState(
        params=params,
        optimizer=make_optimizer(config.optimizer).init(params),
        iteration=jnp.zeros((), int),
        hidden=hidden,
    )


def device_mesh(config: TrainConfig) -> Mesh:
    """Return the mesh of devices that share a batch.

    Raises:
        ValueError: where the devices asked for are not there or do not divide the batch.
    """
    have, batch = jax.devices(), config.episode.batch
    count = config.devices or max(n for n in range(1, len(have) + 1) if batch % n == 0)
    if not 0 < count <= len(have):
        raise ValueError(f"devices is {count}, allowed is 1 to {len(have)}, or None for all")
    if hosts.several() and count < len(have):
        raise ValueError(
            f"episode.batch is {batch}, and devices {config.devices}: the {len(have)} devices of "
            f"all {jax.process_count()} processes must divide the one, and the other be None"
        )
    if batch % count:
        raise ValueError(f"episode.batch is {batch}, not a multiple of the {count} devices")
    return Mesh(np.array(have[:count]), ("worlds",))


def state_place(mesh: Mesh) -> NamedSharding:
    """Return where a state goes before the first step: where the update leaves it.

    Placed otherwise, the second step would compile the update again.
    """
    return NamedSharding(mesh, PartitionSpec())


def shared_out(worlds: Worlds, mesh: Mesh) -> Worlds:
    """Return worlds with each process's part on its devices; as they are in one process alone."""
    if not hosts.several():
        return worlds
    place = NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))

    def part(leaf: np.ndarray) -> jax.Array:
        leaf = np.asarray(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype))
        return jax.make_array_from_callback(leaf.shape, place, lambda index: leaf[index])

    return jax.tree.map(part, worlds)


def curve_numbers(
    loss: jax.Array, gradient: network.Params, records: StepRecord
) -> dict[str, jax.Array]:
    """Return the numbers of the curve, scalars each: a row of metrics.jsonl.

    Gates, collisions and speeds are those of steps that count in the loss. `memory` is the mean
    size of the recurrent states: near 1 they are saturated, and nothing that is seen reaches the
    action.
    """
    counts = records.alive > 0
    speed = jnp.where(counts, records.speed, 0.0)
    hit = counts & (records.clearance < BODY_RADIUS_M)
    numbers = {
        "loss": loss,
        "gradient_norm": jnp.sqrt(sum((leaf * leaf).sum() for leaf in gradient.values())),
        "gates": (records.passed & counts).sum(0).mean(),
        "collided": hit.any(0).mean(),
        "speed": speed.sum() / jnp.maximum(counts.sum(), 1),
        "speed_max": speed.max(0).mean(),
        "memory": jnp.abs(records.hidden).mean(),
    }
    return numbers | {f"loss_{k}": v.mean() for k, v in records.terms.items()}


def sample_hidden(key: jax.Array, records: StepRecord, before: jax.Array) -> jax.Array:
    """Return the recurrent states (B, hidden) of a random step of each world.

    A world that had left the loss by that step keeps the state `before`.
    """
    steps, batch = records.alive.shape
    step = jax.random.randint(key, (batch,), 0, steps)
    world = jnp.arange(batch)
    taken = records.alive[step, world] > 0
    return jnp.where(taken[:, None], records.hidden[step, world], before)


def make_update(
    config: TrainConfig, mesh: Mesh, delta: delta_network.Params | None = None
) -> Callable[[TrainState, Worlds], tuple[TrainState, dict[str, jax.Array]]]:
    """Return update(state, worlds) -> (state', numbers of the curve), compiled on first call.

    `delta` is a frozen Delta Action network whose correction is added to every action.
    """
    optimizer = make_optimizer(config.optimizer)
    gradient_of = shard_gradient(config, mesh)
    seed, batch = jax.random.key(np.uint32(config.seed)), config.episode.batch

    # Every device holds the whole state, and the first process saves it.
    @functools.partial(jax.jit, out_shardings=state_place(mesh))
    def update(state: TrainState, worlds: Worlds) -> tuple[TrainState, dict[str, jax.Array]]:
        key = jax.random.fold_in(seed, state.iteration)
        worlds = worlds._replace(hidden=state.hidden * worlds.remembers[:, None])
        gradient, loss, records = gradient_of(state.params, worlds, key, delta)
        change, optimizer_state = optimizer.update(gradient, state.optimizer, state.params)
        numbers = curve_numbers(loss, gradient, records)
        state = TrainState(
            # optax types any tree of parameters; it gives back the one it was given.
            params=cast(network.Params, optax.apply_updates(state.params, change)),
            optimizer=optimizer_state,
            iteration=state.iteration + 1,
            hidden=sample_hidden(jax.random.fold_in(key, batch), records, state.hidden),
        )
        return state, numbers

    return update
