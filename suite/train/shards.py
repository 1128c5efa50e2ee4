"""Compute the gradient of a batch in shards, in parallel, and sum them in a fixed order.

A shard is a part of a batch of worlds (simulated scenes with a drone). The number of shards is a
setting of the run and does not depend on the number of cores, devices and processes. The same
compiled program computes all shards, and their gradients are summed in the order of the shards.
Therefore the sums have the same bits with any number of cores.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from policies.networks import delta_network, network
from suite.common.running import hosts
from suite.train.config import TrainConfig
from suite.train.gradient import make_gradient
from suite.train.rollout import StepRecord, world_keys
from suite.train.step import BODY_RADIUS_M
from suite.train.worlds import Worlds
from tracks.common.work import usable_cores


class Shard(NamedTuple):
    """Results of a shard, or of a whole batch."""

    gradient: network.Params
    """Gradient of the loss, the mean over worlds."""
    numbers: dict[str, jax.Array]
    """Numbers of the learning curve by name: scalars, means over worlds."""
    hidden: jax.Array
    """(B, hidden) the policy's recurrent state at a random step of each world."""


def flight_numbers(loss: jax.Array, records: StepRecord) -> dict[str, jax.Array]:
    """Return a shard's numbers of the learning curve by name, means over its worlds.

    Gates, collisions and speeds are those of the steps that count in the loss; `counted` is the
    share of these steps. `memory` is the mean size of the recurrent states. If it is near 1, they
    are saturated, and the observation has no influence on the action.
    """
    counts = records.alive > 0
    speed = jnp.where(counts, records.speed, 0.0)
    collided = counts & (records.clearance < BODY_RADIUS_M)
    numbers = {
        "loss": loss,
        "gates": (records.passed & counts).sum(0).mean(),
        "collided": collided.any(0).mean(),
        "speed": speed.mean(),
        "counted": counts.mean(),
        "speed_max": speed.max(0).mean(),
        "memory": jnp.abs(records.hidden).mean(),
    }
    return numbers | {f"loss_{k}": v.mean() for k, v in records.terms.items()}


def curve_numbers(shard: Shard) -> dict[str, jax.Array]:
    """Return a row of the learning curve, metrics.jsonl, from the results of a whole batch."""
    numbers = dict(shard.numbers)
    # The mean speed over all steps, divided by the share of steps that count: that of those steps.
    numbers["speed"] = numbers["speed"] / jnp.maximum(numbers.pop("counted"), 1e-6)
    squares = sum((leaf * leaf).sum() for leaf in shard.gradient.values())
    return numbers | {"gradient_norm": jnp.sqrt(squares)}


def sample_hidden(keys: jax.Array, records: StepRecord, before: jax.Array) -> jax.Array:
    """Return the policy's recurrent states (B, hidden) at a random step of each world.

    Worlds of the next rollout start with them. A world that no longer counts in the loss at that
    step keeps the state `before`.

    Args:
        keys: (B,) random keys of the worlds.
        records: (T, B, ...) records of the rollout.
        before: (B, hidden) the states from the rollout before.
    """
    steps, batch = records.alive.shape
    step = jax.vmap(lambda key: jax.random.randint(key, (), 0, steps))(keys)
    world = jnp.arange(batch)
    counts = records.alive[step, world] > 0
    return jnp.where(counts[:, None], records.hidden[step, world], before)


def check_processes(config: TrainConfig) -> None:
    """Refuse a number of shards that is not a multiple of the number of processes.

    Raises:
        ValueError: naming both numbers.
    """
    shards, processes = config.episode.shards, jax.process_count()
    if shards % processes:
        raise ValueError(
            f"episode.shards is {shards}, allowed with {processes} processes are multiples of "
            f"{processes}"
        )


def make_shards(
    config: TrainConfig, delta: delta_network.Params | None = None
) -> Callable[[network.Params, jax.Array, jax.Array, Worlds], list[Shard]]:
    """Return shards(params, hidden, iteration, worlds) -> all shards of a batch, in order.

    `worlds` is the whole batch; `hidden` (B, hidden) are recurrent states from the last rollout.
    Every process computes its part of the shards and receives those of the others. `delta` is as
    for `suite.train.run.train`.
    """
    gradient_of, seed = make_gradient(config), jax.random.key(np.uint32(config.seed))
    shards, size = config.episode.shards, config.episode.batch // config.episode.shards
    per_process, devices = shards // jax.process_count(), jax.local_devices()
    own_shards = range(per_process * jax.process_index(), per_process * (jax.process_index() + 1))
    # On a CPU each thread keeps a core busy; an accelerator needs one thread.
    most_threads = usable_cores() if jax.default_backend() == "cpu" else len(devices)
    pool, compiled = ThreadPoolExecutor(min(len(own_shards), most_threads)), False

    @jax.jit
    def compute(
        params: network.Params, hidden: jax.Array, iteration: jax.Array, worlds: Worlds
    ) -> Shard:
        key = jax.random.fold_in(seed, iteration)
        # Only worlds that start between two gates have a recurrent state from before.
        before = hidden[worlds.number]
        worlds = worlds._replace(hidden=before * worlds.remembers[:, None])
        gradient, loss, records = gradient_of(params, worlds, key, delta)
        keys = world_keys(jax.random.fold_in(key, config.episode.batch), worlds)
        return Shard(gradient, flight_numbers(loss, records), sample_hidden(keys, records, before))

    def sharded(
        params: network.Params, hidden: jax.Array, iteration: jax.Array, worlds: Worlds
    ) -> list[Shard]:
        nonlocal compiled

        def compute_on_device(shard: int) -> Shard:
            part = jax.tree.map(lambda leaf: leaf[shard * size : (shard + 1) * size], worlds)
            arguments = (params, hidden, iteration, part)
            # Accelerators round products by default, too coarsely for rotations. Both settings
            # are those of this thread; a program may have chosen others for all threads.
            with jax.enable_x64(False), jax.default_matmul_precision("highest"):
                result = compute(*jax.device_put(arguments, devices[shard % len(devices)]))
            return jax.block_until_ready(jax.device_put(result, devices[0]))

        # Several threads would all compile the same program at the first call.
        run = pool.map if compiled else map
        results = list(run(compute_on_device, own_shards))
        compiled = True
        return hosts.gather(results)

    return sharded


def batch_mean(shards: list[Shard]) -> Shard:
    """Return the results of the whole batch: means of the shards, summed in their order."""
    gradient, numbers = jax.tree.map(
        lambda *leaves: functools.reduce(jnp.add, leaves) / len(leaves),
        *((shard.gradient, shard.numbers) for shard in shards),
    )
    return Shard(gradient, numbers, jnp.concatenate([shard.hidden for shard in shards]))
