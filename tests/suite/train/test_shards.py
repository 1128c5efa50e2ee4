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
from suite.train.update import start_state
from tests.support.canonical import NOISY, gradient_of, shards_of, update_of
from tests.support.training import boxes_worlds, fresh_params, largest_difference, small_config

KEY = jax.random.key(3)


def test_shards_divide_the_batch_and_processes_the_shards(monkeypatch):
    with pytest.raises(ValueError, match=r"episode\.batch is 6, allowed are multiples of episode"):
        check(small_config(batch=6, shards=4))
    monkeypatch.setattr(shards.jax, "process_count", lambda: 3)
    with pytest.raises(ValueError, match="shards is 4, allowed with 3 processes are multiples of"):
        check_processes(small_config(batch=8, shards=4))


def test_two_threads_compute_shards_at_once_and_come_to_the_same_bits(monkeypatch):
    """Each thread waits for the other, so that one after the other would never end."""
    both, names = threading.Barrier(2, timeout=60), list[str]()
    update, state, worlds = update_of(NOISY), start_state(NOISY), boxes_worlds(NOISY)
    with monkeypatch.context() as patch:
        patch.setattr(shards.ThreadPoolExecutor, "map", lambda _, *given: map(*given))
        alone = update(state, worlds)
    real = shards.jax.block_until_ready

    def met(found):
        names.append(threading.current_thread().name)
        both.wait()
        return real(found)

    monkeypatch.setattr(shards.jax, "block_until_ready", met)
    jax.tree.map(np.testing.assert_array_equal, update(state, worlds), alone)
    assert len(set(names)) == len(names) == 2


def test_the_first_shards_are_computed_one_after_the_other_so_that_one_thread_compiles(monkeypatch):
    names = []
    note = lambda *given: names.append(threading.current_thread()) or given[0]  # noqa: E731
    monkeypatch.setattr(shards.jax, "jit", lambda _: note)
    compute, state = shards.make_shards(NOISY), start_state(NOISY)
    for _ in range(2):
        compute(state.params, state.hidden, state.iteration, boxes_worlds(NOISY))
    assert [name is threading.main_thread() for name in names] == [True, True, False, False]


def test_shards_and_images_outside_the_loop_give_the_gradient_of_the_plain_loop(monkeypatch):
    """Sums of float32 in another order: 1e-4 of an array's largest. Noise is a world's own."""
    config, plain = replace(NOISY, episode=replace(NOISY.episode, shards=1)), gradient_of(NOISY)
    state, worlds = start_state(NOISY), boxes_worlds(NOISY)
    hidden = jax.random.normal(KEY, state.hidden.shape)
    given = state.params, hidden, state.iteration, worlds
    found = shards.batch_mean(shards_of(NOISY)(*given))
    monkeypatch.setattr(shards, "make_gradient", lambda _: plain)
    monkeypatch.setattr(shards.jax, "device_put", lambda tree, _: tree)
    with monkeypatch.context() as patch:
        patch.setattr(shards.jax, "jit", lambda function: function)
        whole = shards.make_shards(config)
    expected = shards.batch_mean(whole(*given))
    sizes = {k: float(np.abs(np.array(g)).max()) for k, g in expected.gradient.items()}
    assert min(sizes.values()) > 1e-7, sizes
    for one, other in zip(found, expected, strict=True):
        assert largest_difference(one, other) < 1e-4


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
