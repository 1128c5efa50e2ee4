"""Worlds that live for several rollouts, and the terms that ease missed gates and passing."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.train.gradient import make_gradient
from suite.train.rollout import make_rollout, start_memory
from suite.train.update import (
    Carry,
    device_mesh,
    make_update,
    next_worlds,
    rollouts_left,
    start_state,
)
from suite.train.worlds import sample_worlds
from tests.support.training import SPEC, boxes_worlds, fresh_params, small_config

KEY = jax.random.key(3)


def blind(params, image):
    return jnp.zeros((image.shape[0], SPEC.hidden_size))


def flown(config, worlds, steps, memory=None):
    nudge = jnp.zeros((steps, worlds.pos_w.shape[0], SPEC.hidden_size))
    run = jax.jit(make_rollout(config), static_argnums=4)
    return run(fresh_params(), nudge, worlds, KEY, blind, None, memory)[1]


def test_two_short_rollouts_are_one_long_one():
    config = small_config(steps=4, segments=2)
    worlds = boxes_worlds(config)
    worlds = worlds._replace(stop=np.full(4, 99))
    whole, end = flown(config, worlds, 8)
    first, middle = flown(config, worlds, 4)
    second, after = flown(config, worlds, 4, middle)
    np.testing.assert_allclose(jnp.concatenate([first.pos_w, second.pos_w]), whole.pos_w, atol=1e-5)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(end), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_world_that_stops_waits_where_it_stopped():
    config = small_config(steps=4, segments=2)
    worlds = boxes_worlds(config)._replace(stop=np.array([2, 4, 4, 4]))
    records, end = flown(config, worlds, 4)
    np.testing.assert_array_equal(end.body.pos_w[0], records.pos_w[1, 0])
    np.testing.assert_array_equal(end.body.pos_w[1], records.pos_w[3, 1])
    np.testing.assert_array_equal(end.hidden[0], records.hidden[1, 0])
    assert not np.any(end.crashed)


def test_who_lives_on():
    """Fresh worlds have the rest of their rollouts left; crashed and finished ones have none."""
    config = small_config(batch=5, segments=3)
    worlds = boxes_worlds(config)
    end = start_memory(config, worlds)
    gates = worlds.scene.gates.center_w.shape[1]
    end = end._replace(crashed=jnp.array([0.0, 0, 0, 1, 0]), target=jnp.array([1, 2, 3, 1, gates]))
    left = rollouts_left(config, jnp.array([0, 2, 1, 2, 2]), worlds, end)
    assert left.tolist() == [2, 1, 0, 0, 0]


def test_those_with_none_left_are_replaced():
    config = small_config(batch=3, steps=6, segments=3)
    old, fresh = (jax.tree.map(jnp.asarray, boxes_worlds(config, i)) for i in (0, 1))
    old = old._replace(stop=jnp.array([2, 3, 4]))
    stand = start_memory(config, old)._replace(alive=jnp.zeros(3), target=jnp.array([4, 4, 4]))
    worlds, memory = next_worlds(
        config, Carry(old, stand, jnp.array([1, 0, 2])), fresh, start_memory(config, fresh)
    )
    np.testing.assert_array_equal(worlds.pos_w[jnp.array([0, 2])], old.pos_w[jnp.array([0, 2])])
    np.testing.assert_array_equal(worlds.pos_w[1], fresh.pos_w[1])
    assert memory.target.tolist() == [4, fresh.target[1], 4]
    assert worlds.stop.tolist() == [6, fresh.stop[1], 6]
    assert np.all(memory.alive == 1)


def test_an_update_goes_on_where_the_last_one_ended(monkeypatch):
    config = small_config(steps=4, segments=2, rest_share=0.5)
    monkeypatch.setattr("suite.train.update.sample_worlds", boxes_worlds)
    state = start_state(config, fresh_params())
    update = make_update(config, device_mesh(config))
    first, _ = update(state, boxes_worlds(config, 0))
    assert first.carry.left.tolist() == [1, 1, 1, 1]
    second, _ = update(first, boxes_worlds(config, 1))
    np.testing.assert_array_equal(second.carry.worlds.pos_w, first.carry.worlds.pos_w)
    assert second.carry.left.tolist() == [0, 0, 0, 0]
    third, _ = update(second, boxes_worlds(config, 2))
    np.testing.assert_array_equal(third.carry.worlds.pos_w, boxes_worlds(config, 2).pos_w)


def test_worlds_past_a_gate_have_missed_it():
    config = small_config(batch=60, rest_share=0.0, missed_share=1.0, start_speed=4.0)
    worlds = sample_worlds(config, 0)
    gates, rows = worlds.scene.gates, np.arange(60)
    away = worlds.pos_w - gates.center_w[rows, worlds.target]
    local = np.einsum("bij,bi->bj", gates.rot_w[rows, worlds.target], away)
    assert np.all(local[:, 0] >= -1e-4) and np.all(local[:, 0] < 1.6)
    assert np.all(np.hypot(local[:, 1], 2 * local[:, 2]) > 0.6)
    along = np.einsum("bi,bi->b", gates.rot_w[rows, worlds.target, :, 0], worlds.vel_w)
    assert np.mean(along > 0) > 0.9


def test_none_has_missed_a_gate_unless_asked():
    base = small_config(batch=8, rest_share=0.0)
    with_none = replace(base, episode=replace(base.episode, missed_share=0.0))
    np.testing.assert_array_equal(sample_worlds(base, 3).pos_w, sample_worlds(with_none, 3).pos_w)


def test_the_step_that_passes_a_gate_is_progress_to_the_next():
    """A world that flies along the line of its gates at 3 m/s, a step across the first plane."""
    still = {"drag": (0.0, 0.0), "wind_std": (0.0, 0.0, 0.0), "action_delay": (0.0, 0.0)}
    terms = {}
    for first in (False, True):
        config = small_config(1, 1, physics=still, loss={"pass_first": first, "progress": 1.0})
        worlds = boxes_worlds(config)
        gates = worlds.scene.gates
        forward = gates.rot_w[:, 0, :, 0]
        center = np.array(gates.center_w)
        center[:, 1] = center[:, 0] + 4 * forward
        worlds = worlds._replace(
            scene=worlds.scene._replace(gates=gates._replace(center_w=center)),
            pos_w=center[:, 0] - 0.02 * forward, vel_w=3 * forward,
            target=np.zeros(1, np.int32),
        )  # fmt: skip
        records, _ = flown(config, worlds, 1)
        assert bool(records.passed[0, 0])
        terms[first] = float(records.terms.progress[0, 0])
    assert terms[True] == pytest.approx(-3.0, abs=0.2)
    assert terms[False] == pytest.approx(3.0, abs=0.2)


def test_the_gradient_of_a_continued_rollout_does_not_reach_the_past():
    config = small_config(steps=4, segments=2)
    worlds = boxes_worlds(config)
    _, _, _, end = jax.jit(make_gradient(config))(fresh_params(), worlds, KEY, None)
    run = jax.jit(make_gradient(config))
    gradient = run(fresh_params(), worlds, KEY, None, end)[0]
    assert all(np.all(np.isfinite(g)) for g in gradient.values())
    assert max(float(np.abs(g).max()) for g in gradient.values()) > 0
