"""Worlds that the next rollout goes on with: those still flying, and those before their crash.

A rollout of a few seconds from a start that was drawn shows a policy few of the states that it
brings itself into. Worlds that live on do, and those that are flown again from before their crash
are of the tracks and places where it fails. A whole state is taken over, the vehicle's and the
policy's, so that nothing tells the policy that a rollout ended.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from suite.train.config import TrainConfig
from suite.train.rollout import RolloutCarry, choose, make_start
from suite.train.worlds import Worlds, sample_worlds


def nothing_carried(config: TrainConfig) -> Worlds:
    """Return what the first rollout finds: worlds of which none goes on."""
    worlds = jax.tree.map(jnp.asarray, sample_worlds(config, 0))
    start = jax.jit(make_start(config))(worlds)
    # With their types said: weak ones would have the second iteration compiled again.
    start = jax.tree.map(lambda array: jnp.asarray(array, array.dtype), start)
    return worlds._replace(flown=start, begun=jnp.zeros(len(worlds.target), bool))


def taken_over(config: TrainConfig, worlds: Worlds, carried: Worlds) -> Worlds:
    """Return fresh `worlds` with those of `carried` that go on in the place of as many."""
    begun = jnp.asarray(carried.begun)
    kept = choose(begun, carried._replace(flown=None, begun=None), worlds)
    return kept._replace(
        # The field of view is an iteration's own, and no world that goes on is stopped on the way.
        fov_scale=worlds.fov_scale,
        stop=jnp.where(begun, config.episode.steps, worlds.stop),
        flown=carried.flown,
        begun=begun,
    )


def carried_over(
    config: TrainConfig, key: jax.Array, worlds: Worlds, after: RolloutCarry, hit: jax.Array
) -> Worlds:
    """Return what a rollout in `worlds` leaves to the next: with `begun`, which of them go on.

    A world that crashed goes on from before that, where it was flying long enough; one that flies
    and has gates left goes on from the end; each with the share of `config`.

    Args:
        config: of the run.
        key: of the draws.
        worlds: (B, ...).
        after: (T, B, ...) what they carried after each step.
        hit: (T, B) bool, in which step they crashed.
    """
    episode = config.episode
    steps, batch = after.alive.shape
    dice, early = jax.random.split(key)
    drawn = jax.random.uniform(dice, (2, batch))
    low, high = (config.spec.rate_hz * seconds for seconds in episode.again_before_s)
    back = jax.random.uniform(early, (batch,), minval=low, maxval=high)
    before = jnp.argmax(hit, axis=0) - jnp.maximum(jnp.round(back), 1.0).astype(int)
    again = hit.any(0) & (before >= 0) & (drawn[0] < episode.again)
    flying = (after.alive[-1] > 0) & (after.target[-1] < worlds.scene.gates.center_w.shape[1])
    flying = flying & (drawn[1] < episode.live_on)
    step, world = jnp.where(again, before, steps - 1), jnp.arange(batch)
    flown = jax.tree.map(lambda array: array[step, world], after)
    one, taken = jnp.ones(batch), again | flying
    flown = flown._replace(alive=one, going=one, survival=one)
    # A world that crashed may be anywhere by now, and what is saved must be finite.
    flown = choose(taken, flown, jax.tree.map(jnp.zeros_like, flown))
    return worlds._replace(flown=flown, begun=taken)
