"""Shards: the same bits on any number of cores, the numbers of the curve, remembered states."""

import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.train import shards
from suite.train.config import check
from suite.train.shards import check_processes, curve_numbers, flight_numbers, sample_hidden
from suite.train.update import make_update, start_state
from tests.support.canonical import NOISY, gradient_of, update_of
from tests.support.training import boxes_worlds, fresh_params, largest_difference, small_config

KEY = jax.random.key(3)


def test_shards_divide_the_batch_and_processes_the_shards(monkeypatch):
    with pytest.raises(ValueError, match=r"episode\.batch is 6, allowed are multiples of episode"):
        check(small_config(batch=6, shards=4))
    monkeypatch.setattr(shards.jax, "process_count", lambda: 3)
    with pytest.raises(ValueError, match="shards is 4, allowed with 3 processes are multiples of"):
        check_processes(small_config(batch=8, shards=4))


@pytest.fixture(scope="module")
def sharded():
    """Return a configuration of four shards, and its update for two cores."""
    config = replace(NOISY, episode=replace(NOISY.episode, shards=4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "usable_cores", lambda: 2)
        return config, make_update(config)


def test_two_threads_compute_shards_at_once_and_come_to_the_same_bits(sharded, monkeypatch):
    """Each thread waits for the other, so that one after the other would never end.

    The first update is computed one shard after the other, so that each is compiled once.
    """
    config, update = sharded
    both, names = threading.Barrier(2, timeout=60), list[str]()
    real = shards.jax.block_until_ready

    def met(found):
        names.append(threading.current_thread().name)
        if len(names) > config.episode.shards:
            both.wait()
        return real(found)

    monkeypatch.setattr(shards.jax, "block_until_ready", met)
    state, worlds = start_state(config), boxes_worlds(config)
    alone, together = update(state, worlds), update(state, worlds)
    assert len(set(names[: config.episode.shards])) == 1
    assert len(set(names[config.episode.shards :])) == 2
    jax.tree.map(np.testing.assert_array_equal, together, alone)


def test_shards_have_the_gradient_of_the_whole_batch(sharded):
    """The sums run in another order; noise is a world's own, whichever shard it is in."""
    ends = []
    for config, update in (sharded, (NOISY, update_of(NOISY))):
        state = start_state(config)
        for number in range(3):  # the first one's rate is 0
            state, numbers = update(state, boxes_worlds(config, number))
        ends.append((state.params, state.hidden, numbers))
    for found, expected in zip(*ends, strict=True):
        assert largest_difference(found, expected) < 1e-3


def test_the_curve_and_remembered_states_are_of_steps_that_counted():
    worlds, params = boxes_worlds(NOISY), fresh_params()
    worlds = worlds._replace(stop=np.array([1, 1, 1, 1]))
    gradient, loss, records = gradient_of(NOISY)(params, worlds, KEY, None)
    after = np.arange(6)[:, None] > 0
    # What comes later would be a gate and a collision at 100 m/s.
    records = records._replace(
        passed=after & np.ones_like(records.passed),
        speed=np.where(after, 100.0, records.speed),
        clearance=np.where(after, -1.0, records.clearance),
    )
    shard = shards.Shard(gradient, flight_numbers(loss, records), records.hidden[0])
    numbers = curve_numbers(shard)
    for name in ("speed", "speed_max"):
        assert numbers[name] == pytest.approx(np.mean(records.speed[0]), rel=1e-6)
    assert numbers["collided"] == numbers["gates"] == 0 and "counted" not in numbers
    assert numbers["memory"] == pytest.approx(np.abs(records.hidden).mean())
    assert 0 < numbers["memory"] < 0.5, "a fresh network's is far from saturated"
    worlds = worlds._replace(stop=np.array([6, 6, 6, 1]))
    records = gradient_of(NOISY)(params, worlds, KEY, None)[2]
    before = jnp.full((4, NOISY.spec.hidden_size), 9.0)
    drawn = jax.jit(jax.vmap(lambda keys: sample_hidden(keys, records, before)))
    seen = np.asarray(drawn(jax.random.split(KEY, (80, 4))))
    for world in range(3):
        known = np.asarray(records.hidden[:, world])
        assert all(any(np.array_equal(row, k) for k in known) for row in seen[:, world])
        assert len(np.unique(seen[:, world, 0])) == 6
    last = seen[:, 3]
    kept = (last == 9.0).all(-1)
    assert 0 < kept.sum() < 80
    assert np.array_equal(last[~kept], np.tile(records.hidden[0, 3], ((~kept).sum(), 1)))
