"""One update: its devices, the numbers of its curve, and the states it remembers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.train.update import curve_numbers, device_mesh, sample_hidden
from tests.support.canonical import NOISY, gradient_of
from tests.support.training import boxes_worlds, fresh_params, small_config

KEY = jax.random.key(3)


def test_devices_that_are_not_there_or_do_not_divide_the_batch():
    have = len(jax.devices())
    with pytest.raises(ValueError, match=f"devices is {have + 1}, allowed is 1 to {have}, or None"):
        device_mesh(replace(small_config(), devices=have + 1))
    with pytest.raises(ValueError, match="devices is -1"):
        device_mesh(replace(small_config(), devices=-1))
    assert device_mesh(small_config()).size >= 1


def test_the_curve_is_of_steps_that_count():
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
    numbers = curve_numbers(loss, gradient, records)
    first = np.mean(records.speed[0])
    assert numbers["speed"] == pytest.approx(first) == numbers["speed_max"]
    assert numbers["collided"] == numbers["gates"] == 0
    assert numbers["memory"] == pytest.approx(np.abs(records.hidden).mean())
    assert 0 < numbers["memory"] < 0.5, "a fresh network's is far from saturated"


def test_remembered_states_are_of_steps_that_counted():
    worlds, params = boxes_worlds(NOISY), fresh_params()
    worlds = worlds._replace(stop=np.array([6, 6, 6, 1]))
    records = gradient_of(NOISY)(params, worlds, KEY, None)[2]
    before = jnp.full((4, NOISY.spec.hidden_size), 9.0)
    drawn = jax.jit(jax.vmap(lambda key: sample_hidden(key, records, before)))
    seen = np.asarray(drawn(jax.random.split(KEY, 80)))
    for world in range(3):
        known = np.asarray(records.hidden[:, world])
        assert all(any(np.array_equal(row, k) for k in known) for row in seen[:, world])
        assert len(np.unique(seen[:, world, 0])) == 6
    last = seen[:, 3]
    kept = (last == 9.0).all(-1)
    assert 0 < kept.sum() < 80
    assert np.array_equal(last[~kept], np.tile(records.hidden[0, 3], ((~kept).sum(), 1)))
