"""What the next rollout goes on with: worlds that fly, and those that crashed, before they did."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from policies.networks import network
from suite.train.beyond import carried
from suite.train.config import QuadrotorConfig
from suite.train.rollout import make_rollout, make_start
from tests.support.training import KEY, SPEC, boxes_worlds, fresh_params, small_config

ALIKE = {"depth_noise": 0.0, "fov_scale": (1.0, 1.0)}


def flown(config, params):
    """Return fly(worlds) -> the records of a rollout, without its gradient."""
    rollout = make_rollout(config)
    still = jnp.zeros((config.episode.steps, config.episode.batch, config.spec.hidden_size))
    return jax.jit(lambda worlds: rollout(params, still, worlds, KEY, network.encode)[1])


@pytest.mark.parametrize(
    "model", [pytest.param("point", marks=pytest.mark.slow), "late", "quadrotor"]
)
def test_two_rollouts_of_worlds_that_live_on_are_one_of_twice_the_length(model):
    late = {"state_delay": 1, "image_delay": 1} if model == "late" else {}
    config = small_config(steps=3, physics=ALIKE | late, live_on=1.0)
    if model == "quadrotor":
        config = replace(config, quadrotor=QuadrotorConfig(load_vehicle("racer5")))
    longer = replace(config, episode=replace(config.episode, steps=6))
    worlds, params = jax.tree.map(jnp.asarray, boxes_worlds(config)), fresh_params(lively=3.0)
    # In the air and at speed: nothing crashes within half a second.
    worlds = worlds._replace(pos_w=worlds.pos_w + jnp.asarray([0.0, 0.0, 20.0]))
    whole = flown(longer, params)(worlds._replace(stop=np.full(4, 6)))
    fly = flown(config, params)
    first = fly(worlds)
    left = carried.carried_over(config, KEY, worlds, first.after, first.hit)
    assert np.all(left.begun)
    fresh = jax.tree.map(jnp.asarray, boxes_worlds(config, 1))
    second = fly(carried.taken_over(config, fresh, left))
    pos_w = np.concatenate([first.pos_w, second.pos_w])
    np.testing.assert_allclose(pos_w, whole.pos_w, atol=1e-5)
    assert np.ptp(pos_w[3:], axis=0).max() > 0.01, "they move"


def after_of(config, steps, crash_at):
    """Return worlds, what steps carried, and where world i crashed: in step `crash_at`[i], or not.

    The z of the action is the step's number.
    """
    batch = config.episode.batch
    few = boxes_worlds(replace(config, episode=replace(config.episode, batch=4)))
    worlds = jax.tree.map(lambda array: jnp.asarray(np.repeat(array, batch // 4, axis=0)), few)
    start = make_start(config)(worlds)
    after = jax.tree.map(lambda array: jnp.broadcast_to(array, (steps, *array.shape)), start)
    number = jnp.broadcast_to(jnp.arange(steps)[:, None, None], after.action_b.shape)
    ends = np.array([steps if at is None else at for at in crash_at])
    alive = jnp.asarray(1.0 * (np.arange(steps)[:, None] < ends))
    hit = jnp.asarray(np.arange(steps)[:, None] == ends)
    return worlds, after._replace(action_b=1.0 * number, alive=alive), hit


def test_a_crashed_world_goes_on_from_one_to_two_seconds_before():
    config = small_config(steps=150, again=1.0)
    worlds, after, hit = after_of(config, 150, [120, 10, None, 149])
    seen = []
    for seed in range(30):
        left = carried.carried_over(config, jax.random.key(seed), worlds, after, hit)
        begun = np.asarray(left.begun, bool)
        assert begun.tolist() == [True, False, False, True], "the second crashed too early"
        assert list(left.flown.alive) == [1, 0, 0, 1] == list(left.flown.going)
        seen.append(np.array(left.flown.action_b[:, 2]))
    back = (np.array([120, 149]) - np.array(seen)[:, [0, 3]]) / SPEC.rate_hz
    assert back.min() >= 1.0 - 0.5 / SPEC.rate_hz and back.max() <= 2.0 + 0.5 / SPEC.rate_hz
    assert np.ptp(back) > 0.5


def test_shares_are_those_asked_for_and_a_world_with_no_gate_left_does_not_go_on():
    config = small_config(batch=256, steps=4, live_on=0.25)
    worlds, after, hit = after_of(config, 4, [None] * 256)
    taken = np.asarray(carried.carried_over(config, KEY, worlds, after, hit).begun)
    assert 0.15 < taken.mean() < 0.35
    done = after._replace(target=jnp.full_like(after.target, config.episode.gates))
    assert not np.any(carried.carried_over(config, KEY, worlds, done, hit).begun)
    config = small_config(batch=256, steps=4, again=0.25, again_before_s=(0.0, 0.0))
    worlds, after, hit = after_of(config, 4, [2] * 256)
    taken = np.asarray(carried.carried_over(config, KEY, worlds, after, hit).begun)
    assert 0.15 < taken.mean() < 0.35


def test_fresh_worlds_take_the_place_of_those_that_do_not_go_on():
    config = small_config(live_on=1.0)
    old, fresh = (jax.tree.map(jnp.asarray, boxes_worlds(config, i)) for i in (0, 1))
    taken = jnp.asarray([True, False, True, False])
    start = jax.jit(make_start(config))(old)
    mixed = carried.taken_over(config, fresh, old._replace(flown=start, begun=taken))
    gates = mixed.scene.gates.center_w
    for world, of in enumerate((old, fresh, old, fresh)):
        assert np.array_equal(gates[world], of.scene.gates.center_w[world])
        assert np.array_equal(mixed.constants.time_step[world], of.constants.time_step[world])
    assert np.array_equal(mixed.fov_scale, fresh.fov_scale)
    begun = make_start(config)(mixed)
    assert np.array_equal(begun.state.pos_w[1::2], fresh.pos_w[1::2])
    assert np.array_equal(begun.state.pos_w[::2], old.pos_w[::2])


def test_the_first_rollout_goes_on_with_nothing(monkeypatch):
    monkeypatch.setattr(carried, "sample_worlds", boxes_worlds)
    config = small_config(live_on=0.5)
    fresh = jax.tree.map(jnp.asarray, boxes_worlds(config, 1))
    mixed = carried.taken_over(config, fresh, carried.nothing_carried(config))
    assert np.array_equal(mixed.stop, fresh.stop)
    start = make_start(config)
    for ours, theirs in zip(
        jax.tree.leaves(start(mixed)), jax.tree.leaves(start(fresh)), strict=True
    ):
        assert np.array_equal(ours, theirs)
