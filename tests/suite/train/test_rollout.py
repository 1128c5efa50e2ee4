"""A step, the whole rollout and its gradient: what is cut out of it, images, the field."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from policies.networks import network
from suite.train import losses, rollout
from suite.train.config import LossConfig, PointMassConfig
from suite.train.dynamics import point_mass
from suite.train.dynamics.interface import make_dynamics
from suite.train.gradient import sampled_encoder_gradient
from suite.train.losses import UNIT_FIELD, speed_to_goal
from suite.train.rollout import view_in
from suite.train.step import BEYOND_M, PATH_SAMPLES, approach_shift, make_step, target_gate
from suite.train.worlds import sample_worlds
from tests.support.marks import more
from tests.support.training import (
    KEY,
    NOISY,
    SPEC,
    assert_slopes,
    blind,
    boxes_worlds,
    doubled,
    flown_of,
    fresh_params,
    largest_difference,
    loss_of,
    small_config,
)
from tracks.geometry.field import attractive_field, magnetic_field


def test_training_casts_one_ray_a_pixel_whatever_the_camera_casts_in_flight(monkeypatch):
    camera = replace(SPEC.camera, rays=2)
    config, cast = replace(small_config(), spec=replace(SPEC, camera=camera)), []
    worlds = boxes_worlds(config)

    def spy(scene, pos_w, rot_w, rays, *_):
        cast.append(rays.shape)
        return jnp.ones((len(pos_w), len(rays)))

    monkeypatch.setattr(rollout, "depth_image", spy)
    observer = rollout.Observer(config)

    def look(keys):
        state = make_dynamics(config).start(worlds.constants, *map(jnp.asarray, worlds[1:4]))
        return observer.observe(worlds, observer.start(worlds, state, (SPEC.hidden_size,)), keys)

    jax.eval_shape(look, jax.random.split(KEY, 4))
    assert cast == [(camera.height * camera.width, 3)]


DELAYED = small_config(batch=6, steps=8, physics={"state_delay": 1, "image_delay": 1})
FREE = {"gradient_decay": 0.0, "field_gain": 0.0, "collide": 0.0}
"""Weights with which nothing of a gradient is cut."""


@pytest.fixture(scope="module")
def slopes():
    """Return a function (params, worlds, weights, free, held) -> (loss, gradients) of DELAYED.

    Gradients are by the parameters and by where the worlds start. The policy sees how bright an
    image is, `free` times with and `held` times without gradient. The attitude is held: its
    gradient is cut on purpose, so differences must not move it.
    """
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2]).as_matrix()

    def loss(params, pos_w, worlds, weights, free, held):
        def encode(_, image):
            bright = image.mean((1, 2))[:, None] * jnp.ones(SPEC.hidden_size)
            return free * bright + held * jax.lax.stop_gradient(bright)

        return loss_of(DELAYED, encode)(params, worlds._replace(pos_w=pos_w), **weights)

    both = jax.jit(jax.value_and_grad(loss, (0, 1)))
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        held_w = lambda thrust, _: jnp.broadcast_to(turn, (*thrust.shape[:-1], 3, 3))  # noqa: E731
        patch.setattr(point_mass, "attitude", held_w)
        patch.setattr(losses, "BARRIER_SLOPE", -4.0)  # smooth enough for differences
        params, worlds = doubled(fresh_params()), doubled(boxes_worlds(DELAYED))
        compiled = both.lower(params, worlds.pos_w, worlds, FREE, 0.0, 0.0).compile()

    return lambda params, worlds, weights, *see: compiled(
        params, worlds.pos_w, worlds, weights, *(see or (0.0, 0.0))
    )


def test_the_rollouts_gradient_is_that_of_finite_differences(float64, slopes):
    """Where nothing is cut: no decay, no field, no closing speed, attitude held."""
    params, worlds = doubled(fresh_params()), doubled(boxes_worlds(DELAYED))
    names = ("state.weight", "gru.weight_hidden", "gru.bias_input", "action.weight")

    def along(params, way):
        loss, (gradient, _) = slopes(params, worlds, FREE)
        return loss, sum((gradient[name] * way[name]).sum() for name in names)

    assert_slopes(along, params, names, 1e-5, rel=1e-5)


@jax.jit
def pull_at(worlds, pos_w, vel_w):
    """Return u_A of every world's first gate, 1 across the centre of a gate of 1 m."""
    gate, _ = target_gate(worlds.scene.gates, worlds.target)
    field = magnetic_field(gate.center_w, gate.rot_w, gate.opening_g, pos_w)
    return attractive_field(field, vel_w, 0.3) / (2e-5 * UNIT_FIELD) ** 0.7


AIR = {"drag": (0.0, 0.0), "drag_up": (0.0, 0.0), "wind_std": (0.0, 0.0, 0.0)}
STILL = small_config(batch=6, steps=8, physics=AIR, rest_share=1.0)


def test_the_fields_strength_depends_on_neither_horizon_nor_batch(float64, slopes):
    """A world that hangs still: every step pulls alike, so the mean is one step's pull."""
    config, steps, batch = STILL, STILL.episode.steps, STILL.episode.batch
    worlds, params = doubled(boxes_worlds(config)), doubled(fresh_params(lively=0.0))
    # Decay fades what comes back through the steps: step k's pull by its k-th power.
    fade = np.exp(-config.loss.gradient_decay * np.array(worlds.constants.time_step))
    share = np.mean([fade ** (k + 1) for k in range(steps)], axis=0)
    pull = 0.42 * np.array(pull_at(worlds, worlds.pos_w, worlds.vel_w)) * share[:, None]
    decay = {**FREE, "gradient_decay": config.loss.gradient_decay}
    pulled, free = (
        slopes(params, worlds, {**decay, "field_gain": gain})[1][1] for gain in (0.42, 0.0)
    )
    change = np.array(free - pulled)
    np.testing.assert_allclose(change * batch, pull, rtol=1e-6, atol=1e-9)


def test_images_carry_no_gradient_to_the_state(float64, slopes):
    of = partial(slopes, doubled(fresh_params()), doubled(boxes_worlds(STILL)), FREE)
    seen, held, without = (of(*see)[1][1] for see in ((1.0, 0.0), (0.0, 1.0), (0.0, 0.0)))
    np.testing.assert_allclose(seen, held, atol=1e-12)
    assert np.abs(np.array(seen - without)).max() > 1e-6


def test_a_world_that_crashed_deep_leaves_the_loss():
    worlds, params = boxes_worlds(NOISY), fresh_params()
    inside = worlds.scene.gates.center_w[:, 0]
    boxes = worlds.scene.boxes
    wall = np.array(boxes.half_size)
    wall[:2, 0] = 3.0
    center = np.array(boxes.center_w)
    center[:2, 0] = inside[:2]
    moved = worlds._replace(
        pos_w=np.array(inside), vel_w=0 * worlds.vel_w,
        scene=worlds.scene._replace(boxes=boxes._replace(center_w=center, half_size=wall)),
    )  # fmt: skip
    records = flown_of(NOISY)(params, moved, KEY)[1]
    total = np.abs(sum(np.array(term) for term in records.terms.values()))
    assert np.all(total[0] > 0)
    assert not np.any(total[1:, :2]) and np.all(total[1:, 2:] > 0)


def test_the_policy_is_shown_the_gate_after_the_next():
    """The second gate's centre, the last one's where none comes after, and both directions."""
    worlds = boxes_worlds(small_config(3))
    target = jnp.asarray([0, 3, 7])
    body = jax.jit(point_mass.start)(worlds.pos_w, worlds.vel_w, worlds.heading_w)
    seen, gates, rows = jax.jit(view_in)(worlds, body, target), worlds.scene.gates, range(3)
    np.testing.assert_array_equal(seen.second_w, gates.center_w[rows, [1, 4, 7]])
    np.testing.assert_array_equal(seen.axis_w, gates.rot_w[rows, target, :, 0])
    np.testing.assert_array_equal(seen.second_axis_w, gates.rot_w[rows, [1, 4, 7], :, 0])


def test_what_is_delayed_is_shown_so_many_steps_later_and_before_them_the_start():
    for delay, expected in ((0, [1, 2, 3, 4]), (2, [0, 0, 1, 2])):
        waiting, shown = jnp.zeros((1, delay, 1)), []
        for new in range(1, 5):
            now, waiting = rollout.queue(waiting, jnp.full((1, 1), float(new)))
            shown.append(float(now[0, 0]))
        assert shown == expected
    # A world that starts in flight knows its speed and its gate from the first decision on.
    config = replace(small_config(2), physics=PointMassConfig(state_delay=2))
    config = replace(config, spec=replace(config.spec, speed_input=True))
    worlds = sample_worlds(config, 0)
    worlds = worlds._replace(vel_w=3.0 * worlds.heading_w)
    state = jax.jit(make_dynamics(config).start)(worlds.constants, *worlds[1:4])
    start = rollout.Observer(config).start
    found = jax.jit(lambda *given: start(*given, (1,)).observed)(worlds, state)
    assert found.shape == (2, 2, config.spec.state_size)
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    np.testing.assert_allclose(np.linalg.norm(found[:, 0, :3], axis=-1), 3.0, rtol=1e-6)
    to_gate = worlds.scene.gates.center_w[range(2), worlds.target] - worlds.pos_w
    far = np.linalg.norm(to_gate, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(found[:, 0, 6:9], axis=-1), far, rtol=1e-5)
    np.testing.assert_array_equal(found[:, 0, -1], worlds.speed_command)


def test_a_stopped_world_leaves_the_loss_and_a_remembered_state_is_flown():
    worlds, params = boxes_worlds(NOISY), fresh_params()
    run = flown_of(NOISY)
    _, records = run(params, worlds._replace(stop=np.array([6, 2, 1, 6])), KEY)
    assert np.array_equal(
        records.alive.T, [[1] * 6, [1, 1, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0], [1] * 6]
    )
    for term in records.terms.values():
        assert (np.asarray(term)[np.asarray(records.alive) == 0] == 0).all()
    remembered = worlds._replace(hidden=np.full_like(worlds.hidden, 0.5))
    first = run(params, remembered, KEY)[1].hidden[0]
    assert np.abs(np.asarray(first - records.hidden[0])).max() > 0.1


@pytest.mark.parametrize("finish", [more(False), True])
def test_a_world_that_has_passed_its_last_gate_leaves_the_loss_where_that_is_the_finish(finish):
    config = replace(NOISY, episode=replace(NOISY.episode, finish=finish))
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
    shift, fly = jnp.zeros((6, 4, SPEC.hidden_size)), rollout.make_rollout(config)

    @jax.jit
    def flown(params):
        records = fly(params, shift, worlds, KEY, blind)[1]
        return records.passed, records.alive

    passed, alive = map(np.asarray, flown(fresh_params(lively=0.0)))
    assert (passed.sum(0) == [1, 1, 1, 0]).all()
    after = np.cumsum(passed, 0) - passed > 0
    assert after.any()
    assert np.array_equal(alive == 0, after & finish)


def test_the_encoders_gradient_is_that_of_its_chunks_and_on_average_of_every_other_image(
    monkeypatch,
):
    params, rng = fresh_params(), np.random.default_rng(1)
    images = jnp.asarray(rng.normal(size=(6, 2, 20, 20)), jnp.float32)
    cotangents = jnp.asarray(rng.normal(size=(6, 2, 8)), jnp.float32)

    @jax.jit
    def whole(params):
        encoded = jax.vjp(lambda own: network.encode(own, images.reshape(12, 20, 20)), params)
        return encoded[1](cotangents.reshape(12, 8))[0]

    monkeypatch.setattr("suite.train.gradient.CHUNK", 4)  # two chunks of three images
    keys = {int(jax.random.randint(key, (), 0, 2)): key for key in jax.random.split(KEY, 8)}
    sampled = jax.jit(sampled_encoder_gradient, static_argnums=3)
    halves = [sampled(params, images, cotangents, 2, keys[k]) for k in (0, 1)]
    mean = jax.tree.map(lambda one, other: (one + other) / 2, *halves)
    assert largest_difference(mean, whole(params)) < 1e-5


stepped = jax.jit(make_step, static_argnums=0)


@pytest.mark.parametrize(
    ("place_g", "shift"),
    [
        ((-4.0, 0.2, 0.1), 0.0),  # on the axis: straight on
        ((-4.0, 0.0, 1.0), 0.7),  # as much before the gate as it is off the axis, less 0.3
        ((0.0, 0.0, 1.2), 0.9),  # above the frame
        ((0.8, 0.6, 0.0), 1.1),  # beyond the plane
        ((2.0, 3.0, 0.0), 1.5),  # at most so far
    ],
)
def test_the_point_before_the_gate_that_progress_is_measured_to(place_g, shift):
    config = LossConfig(approach_m=1.5)
    found = approach_shift(config, jnp.array([place_g]))
    np.testing.assert_allclose(found, [shift], atol=1e-6)
    assert approach_shift(LossConfig(), jnp.array([place_g])) == 0.0


@pytest.mark.parametrize(("pass_first", "speed"), [(False, -3.0), more(True, 3.0)])
def test_a_step_through_a_gate_and_its_numbers(pass_first, speed):
    """From 0.1 m before the first gate to 0.1 m behind it at 3 m/s; the second is straight on."""
    worlds = boxes_worlds(small_config(2))
    gates = worlds.scene.gates
    forward, center = gates.rot_w[:, 0, :, 0], np.array(gates.center_w)
    center[:, 1] = center[:, 0] + 4 * forward
    worlds = worlds._replace(scene=worlds.scene._replace(gates=gates._replace(center_w=center)))
    before, after = (
        point_mass.start(center[:, 0] + x * forward, 3 * forward, worlds.heading_w)
        for x in (-0.1, 0.1)
    )
    after = after._replace(acc_w=jnp.asarray([[1.0, 0, 0], [0, 2.0, 0]]))
    config = LossConfig(pass_first=pass_first)
    step = stepped(config, worlds, before, after, jnp.zeros(2, int))
    assert step.passed.all()
    np.testing.assert_allclose(speed_to_goal(step), [speed, speed], atol=1e-3)
    aim = center[:, int(pass_first)]
    turn = gates.rot_w[:, int(pass_first)]
    place = np.einsum("bij,bi->bj", turn, np.array(after.pos_w) - aim)
    np.testing.assert_allclose(step.place_g, place, atol=1e-4)
    np.testing.assert_allclose(step.jerk_w, after.acc_w / worlds.constants.time_step[:, None])
    assert step.margin.shape == (2, PATH_SAMPLES)
    np.testing.assert_allclose(
        step.clearance, step.margin.min(-1) + config.safety_radius_m, atol=1e-6
    )
    past = stepped(config, worlds, before, after, jnp.full(2, 8))
    assert not past.passed.any(), "all gates are passed already"


def test_above_the_frame_the_goal_is_before_the_gate_and_past_the_last_gate_beyond_it():
    """1.2 m above the gate the straight way to its centre leads down through the bar."""
    worlds = boxes_worlds(small_config(2))
    gates, above = worlds.scene.gates, np.array([0.0, 0.0, 1.2], np.float32)
    center, turn = (array[[0, 1], [0, -1]] for array in (gates.center_w, gates.rot_w))
    body = point_mass.start(center + turn @ above, 0.0 * center, worlds.heading_w)
    step = stepped(LossConfig(approach_m=1.5), worlds, body, body, np.array([0, 8]))
    ahead_m = np.array([[-0.9], [BEYOND_M]])
    np.testing.assert_allclose(step.goal_w, center + ahead_m * turn[:, :, 0], atol=1e-5)
