"""What keeps the policy from counting the steps of a rollout: random stops, remembered states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.train.gradient import make_gradient
from suite.train.update import curve_numbers, sample_hidden
from suite.train.worlds import sample_worlds
from tests.support.training import boxes_worlds, fresh_params, small_config

KEY = jax.random.key(3)


def test_worlds_at_rest_stop_early_and_forget_the_others_remember():
    config = small_config(batch=64, steps=30, rest_share=0.5, stop_from=0.33)
    worlds = sample_worlds(config, 0)
    rests = worlds.remembers == 0
    assert 0 < rests.sum() < 64
    assert (worlds.vel_w[rests] == 0).all()
    assert (worlds.stop[~rests] == 30).all()
    assert worlds.stop[rests].min() >= 10
    assert len(np.unique(worlds.stop[rests])) > 5


def test_a_stopped_world_leaves_the_loss_and_a_remembered_state_is_flown():
    config = small_config(steps=4)
    worlds, params = boxes_worlds(config), fresh_params()
    run = jax.jit(make_gradient(config))
    _, _, records = run(params, worlds._replace(stop=np.array([4, 2, 1, 4])), KEY, None)
    assert np.array_equal(records.alive.T, [[1, 1, 1, 1], [1, 1, 0, 0], [1, 0, 0, 0], [1] * 4])
    for term in records.terms.values():
        assert (np.asarray(term)[np.asarray(records.alive) == 0] == 0).all()
    remembered = worlds._replace(hidden=np.full_like(worlds.hidden, 0.5))
    first = run(params, remembered, KEY, None)[2].hidden[0]
    assert np.abs(np.asarray(first - records.hidden[0])).max() > 0.1


@pytest.mark.parametrize("finish", [False, True])
def test_a_world_that_has_passed_its_last_gate_leaves_the_loss_where_that_is_the_finish(finish):
    config = small_config(steps=4, finish=finish)
    worlds = boxes_worlds(config)
    gates, last = worlds.scene.gates, worlds.scene.gates.center_w.shape[1] - 1
    ahead = gates.rot_w[:, last, :, 0]
    # 0.2 m before their last gates at 4 m/s, but for one that has the gate before them to pass.
    worlds = worlds._replace(
        pos_w=gates.center_w[:, last] - 0.2 * ahead,
        vel_w=4 * ahead,
        heading_w=ahead,
        target=np.array([last, last, last, last - 1]),
    )
    records = jax.jit(make_gradient(config))(fresh_params(lively=0.0), worlds, KEY, None)[2]
    passed = np.asarray(records.passed)
    assert (passed.sum(0) == [1, 1, 1, 0]).all()
    after = np.cumsum(passed, 0) - passed > 0
    assert after.any()
    assert np.array_equal(np.asarray(records.alive) == 0, after & finish)


def test_the_curve_is_of_steps_that_count():
    config = small_config(steps=4)
    worlds, params = boxes_worlds(config), fresh_params()
    worlds = worlds._replace(stop=np.array([1, 1, 1, 1]))
    gradient, loss, records = jax.jit(make_gradient(config))(params, worlds, KEY, None)
    after = np.arange(4)[:, None] > 0
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
    config = small_config(steps=4)
    worlds, params = boxes_worlds(config), fresh_params()
    worlds = worlds._replace(stop=np.array([4, 4, 4, 1]))
    records = jax.jit(make_gradient(config))(params, worlds, KEY, None)[2]
    before = jnp.full((4, config.spec.hidden_size), 9.0)
    seen = np.stack([sample_hidden(jax.random.key(i), records, before) for i in range(40)])
    for world in range(3):
        known = np.asarray(records.hidden[:, world])
        assert all(any(np.array_equal(row, k) for k in known) for row in seen[:, world])
        assert len(np.unique(seen[:, world, 0])) == 4
    last = seen[:, 3]
    kept = (last == 9.0).all(-1)
    assert 0 < kept.sum() < 40
    assert np.array_equal(last[~kept], np.tile(records.hidden[0, 3], ((~kept).sum(), 1)))
