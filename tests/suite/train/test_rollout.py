"""The whole rollout and its gradient: what is cut out of it, images outside the loop, the field."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from policies.networks import delta_network, network
from policies.observation import observe
from suite.train import losses, rollout
from suite.train.config import PointMassConfig
from suite.train.dynamics import point_mass
from suite.train.dynamics.interface import make_dynamics
from suite.train.gradient import encoder_gradient, sampled_encoder_gradient
from suite.train.losses import UNIT_FIELD
from suite.train.rollout import make_rollout, view_in
from suite.train.step import target_gate
from suite.train.worlds import sample_worlds
from tests.support.canonical import NOISY, gradient_of
from tests.support.training import (
    KEY,
    SPEC,
    blind,
    boxes_worlds,
    doubled,
    fresh_params,
    largest_difference,
    loss_of,
    small_config,
)
from tracks.geometry.field import attractive_field, magnetic_field

TILTED = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2]).as_matrix()


CONFIG = small_config(batch=3, steps=4)
plain_gradient = jax.jit(jax.grad(loss_of(CONFIG)))


@pytest.fixture(scope="module")
def two_pass():
    """Return (config, worlds, params, gradient, loss, records) of the trainer's own method."""
    worlds, params = boxes_worlds(NOISY), fresh_params()
    return NOISY, worlds, params, *gradient_of(NOISY)(params, worlds, KEY, None)


def test_records_are_those_of_the_flight(two_pass):
    config, worlds, _, _, loss, records = two_pass
    assert records.image.shape == (6, 4, 20, 20) and records.pos_w.shape == (6, 4, 3)
    assert float(sum(term.mean() for term in records.terms.values())) == pytest.approx(
        float(loss), rel=1e-5
    )
    first = np.linalg.norm(np.array(records.pos_w[0]) - worlds.pos_w, axis=-1)
    assert np.all(first < 8 * 0.05)
    assert np.ptp(np.array(records.image)) > 1


def test_training_casts_one_ray_a_pixel_whatever_the_camera_casts_in_flight(monkeypatch):
    config, cast = small_config(), []
    worlds = boxes_worlds(config)
    state = make_dynamics(config).start(worlds.constants, *map(jnp.asarray, worlds[1:4]))

    def spy(scene, pos_w, rot_w, rays, *_):
        cast.append(rays)
        return jnp.ones((len(pos_w), len(rays)))

    monkeypatch.setattr(rollout, "depth_image", spy)

    @partial(jax.jit, static_argnums=0)
    def rays_of(rays, state):
        camera = replace(SPEC.camera, rays=rays)
        observer = rollout.make_observer(replace(config, spec=replace(SPEC, camera=camera)))
        observer.observe(
            worlds, state, jnp.asarray(worlds.target), state.pos_w, jax.random.split(KEY, 4)
        )
        return cast[-1]

    one, two = rays_of(1, state), rays_of(2, state)
    assert one.shape == (SPEC.camera.height * SPEC.camera.width, 3)
    np.testing.assert_array_equal(one, two)


@pytest.fixture
def held_attitude(float64, monkeypatch):
    """Hold the attitude: its gradient is cut on purpose, so differences must not move it."""
    held = jnp.asarray(TILTED)
    monkeypatch.setattr(
        point_mass, "attitude", lambda thrust, _: jnp.broadcast_to(held, (*thrust.shape[:-1], 3, 3))
    )


def test_the_rollouts_gradient_is_that_of_finite_differences(held_attitude, monkeypatch):
    """Where nothing is cut: no decay, no field, no closing speed, attitude held."""
    config = small_config(
        steps=8,
        physics={"state_delay": 1, "image_delay": 1},
        loss={"gradient_decay": 0.0, "field_gain": 0.0, "collide": 0.0},
    )
    monkeypatch.setattr(losses, "BARRIER_SLOPE", -4.0)  # smooth enough for differences
    both = jax.jit(jax.value_and_grad(loss_of(config)))
    params, worlds = doubled(fresh_params()), doubled(boxes_worlds(config))
    gradient = both(params, worlds)[1]
    rng = np.random.default_rng(0)
    for name in ("state.weight", "gru.weight_hidden", "gru.bias_input", "action.weight"):
        direction = rng.normal(size=params[name].shape)
        ahead, behind = (
            both({**params, name: params[name] + h * direction}, worlds)[0] for h in (1e-5, -1e-5)
        )
        slope = float(ahead - behind) / 2e-5
        assert abs(slope) > 1e-4
        assert float((gradient[name] * direction).sum()) == pytest.approx(slope, rel=1e-5)


def fly(params, worlds):
    """Return positions and velocities (T, B, 3) of a blind flight: a plain loop of its own."""
    body = point_mass.start(worlds.pos_w, worlds.vel_w, worlds.heading_w)
    batch = worlds.pos_w.shape[0]
    hidden, action = jnp.zeros((batch, SPEC.hidden_size)), jnp.zeros((batch, 3))
    positions, velocities = [], []
    _, target_w = target_gate(worlds.scene.gates, worlds.target)
    for _ in range(CONFIG.episode.steps):
        state = observe(CONFIG.spec, view_in(worlds, body, worlds.target), action).state
        action, hidden = network.recur(params, hidden, blind(params, state), state)
        body = point_mass.step(body, worlds.constants, action, target_w, 0.916)
        positions.append(body.pos_w)
        velocities.append(body.vel_w)
    return jnp.stack(positions), jnp.stack(velocities)


@jax.jit
def pull_at(worlds, pos_w, vel_w):
    """Return u_A of every world's first gate, 1 across the centre of a gate of 1 m."""
    gate, _ = target_gate(worlds.scene.gates, worlds.target)
    field = magnetic_field(gate.center_w, gate.rot_w, gate.opening_g, pos_w)
    return attractive_field(field, vel_w, 0.3) / (2e-5 * UNIT_FIELD) ** 0.7


def test_the_field_enters_as_the_paper_says(float64):
    """Eq. final_optimization: the gradient changes by -u_A pulled back through the positions."""
    worlds, params = doubled(boxes_worlds(CONFIG)), doubled(fresh_params())
    with_field, without = (plain_gradient(params, worlds, None, gain) for gain in (0.42, 0.0))
    change = jax.tree.map(jnp.subtract, with_field, without)

    @jax.jit
    def pulled_back(params):
        (pos, vel), back = jax.vjp(lambda p: fly(p, worlds), params)
        pull = 0.42 * pull_at(worlds, pos, vel)
        return back((-pull / (pos.shape[0] * pos.shape[1]), jnp.zeros_like(vel)))[0]

    expected = pulled_back(params)
    used = [name for name in expected if np.abs(np.array(expected[name])).max() > 0]
    assert {"state.weight", "gru.weight_input", "action.weight"} <= set(used)
    assert largest_difference({k: change[k] for k in used}, {k: expected[k] for k in used}) < 1e-6


def test_the_fields_strength_depends_on_neither_horizon_nor_batch(float64, steps=8, batch=6):
    """A world that hangs still: every step pulls alike, so the mean is one step's pull."""
    still = {"drag": (0.0, 0.0), "drag_up": (0.0, 0.0), "wind_std": (0.0, 0.0, 0.0)}
    config = small_config(batch, steps, physics=still, rest_share=1.0)
    worlds, params = doubled(boxes_worlds(config)), doubled(fresh_params(lively=0.0))
    loss = loss_of(config)

    @jax.jit
    def start_gradient(gain):
        move = lambda pos: loss(params, worlds._replace(pos_w=pos), None, gain)  # noqa: E731
        return jax.grad(move)(worlds.pos_w)

    # Decay fades what comes back through the steps: step k's pull by its k-th power.
    fade = np.exp(-config.loss.gradient_decay * np.array(worlds.constants.time_step))
    share = np.mean([fade ** (k + 1) for k in range(steps)], axis=0)
    pull = 0.42 * np.array(pull_at(worlds, worlds.pos_w, worlds.vel_w)) * share[:, None]
    change = np.array(start_gradient(0.0) - start_gradient(0.42))
    np.testing.assert_allclose(change * batch, pull, rtol=1e-6, atol=1e-9)


def test_images_carry_no_gradient_to_the_state(float64):
    worlds, params = doubled(boxes_worlds(CONFIG)), doubled(fresh_params())

    @jax.jit
    def start_gradient(free, held):
        def encode(params, image):
            bright = image.mean((1, 2))[:, None] * jnp.ones(SPEC.hidden_size)
            return free * bright + held * jax.lax.stop_gradient(bright)

        loss = loss_of(CONFIG, encode)
        return jax.grad(lambda p: loss(params, worlds._replace(pos_w=p)))(worlds.pos_w)

    seen = start_gradient(1.0, 0.0)
    np.testing.assert_allclose(seen, start_gradient(0.0, 1.0), atol=1e-12)
    assert np.abs(np.array(seen - start_gradient(0.0, 0.0))).max() > 1e-6


def test_a_delta_action_is_frozen_and_changes_the_gradient(float64):
    worlds, params = doubled(boxes_worlds(CONFIG)), doubled(fresh_params())
    delta = doubled(delta_network.init(jax.random.key(1)))
    base, unmoved = (plain_gradient(params, worlds, d, 0.0) for d in (None, delta))
    used = [name for name in base if np.abs(np.array(base[name])).max() > 0]

    def apart(gradient):
        return largest_difference({k: gradient[k] for k in used}, {k: base[k] for k in used})

    assert unmoved.keys() == params.keys() and apart(unmoved) < 1e-9
    delta["output.weight"] += 0.5
    assert apart(plain_gradient(params, worlds, delta, 0.0)) > 1e-2


def test_a_world_that_crashed_deep_leaves_the_loss(two_pass):
    _, worlds, params = two_pass[:3]
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
    records = gradient_of(NOISY)(params, moved, KEY, None)[2]
    total = np.abs(sum(np.array(term) for term in records.terms.values()))
    assert np.all(total[0] > 0)
    assert not np.any(total[1:, :2]) and np.all(total[1:, 2:] > 0)


def test_the_policy_is_shown_the_gate_after_the_next(monkeypatch):
    """The second gate's centre, the last one's where none comes after, and both directions."""
    seen = []

    def spy(spec, view, action_b, speed):
        shown = view.second_w, view.axis_w, view.second_axis_w
        jax.debug.callback(lambda *shown: seen.append(shown), *shown)
        return observe(spec, view, action_b, speed)

    monkeypatch.setattr(rollout, "observe", spy)
    config = replace(small_config(3, 1), spec=replace(SPEC, second_gate=True, gate_axis=True))
    worlds = boxes_worlds(config)._replace(target=np.array([0, 3, 7], np.int32))

    @jax.jit
    def fly(params):
        embedding_shift = jnp.zeros((1, 3, SPEC.hidden_size))
        make_rollout(config)(params, embedding_shift, worlds, KEY, blind)

    fly(fresh_params(config.spec))  # nothing is returned, so little is compiled
    jax.effects_barrier()
    center = worlds.scene.gates.center_w
    expected = [center[0, 1], center[1, 4], center[2, 7]]
    np.testing.assert_allclose(seen[0][0], expected, atol=1e-6)
    rot = worlds.scene.gates.rot_w
    for found, numbers in zip(seen[0][1:], ([0, 3, 7], [1, 4, 7]), strict=True):
        np.testing.assert_allclose(found, rot[range(3), numbers, :, 0], atol=1e-6)


def test_a_state_on_its_way_at_the_start_is_that_of_the_start():
    """A world that starts in flight knows its speed and its gate from the first decision on."""
    config = replace(small_config(2), physics=PointMassConfig(state_delay=2))
    config = replace(config, spec=replace(config.spec, speed_input=True))
    worlds = sample_worlds(config, 0)
    worlds = worlds._replace(vel_w=3.0 * worlds.heading_w)
    state = make_dynamics(config).start(worlds.constants, *map(jnp.asarray, worlds[1:4]))
    found = jax.jit(lambda *start: rollout.observed_at_start(*start, config))(worlds, state)
    assert found.shape == (2, 2, config.spec.state_size)
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    np.testing.assert_allclose(np.linalg.norm(found[:, 0, :3], axis=-1), 3.0, rtol=1e-6)
    to_gate = target_gate(worlds.scene.gates, worlds.target)[1] - worlds.pos_w
    far = np.linalg.norm(to_gate, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(found[:, 0, 6:9], axis=-1), far, rtol=1e-5)
    np.testing.assert_array_equal(found[:, 0, -1], worlds.speed_command)


def test_a_stopped_world_leaves_the_loss_and_a_remembered_state_is_flown():
    worlds, params = boxes_worlds(NOISY), fresh_params()
    run = gradient_of(NOISY)
    _, _, records = run(params, worlds._replace(stop=np.array([6, 2, 1, 6])), KEY, None)
    assert np.array_equal(
        records.alive.T, [[1] * 6, [1, 1, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0], [1] * 6]
    )
    for term in records.terms.values():
        assert (np.asarray(term)[np.asarray(records.alive) == 0] == 0).all()
    remembered = worlds._replace(hidden=np.full_like(worlds.hidden, 0.5))
    first = run(params, remembered, KEY, None)[2].hidden[0]
    assert np.abs(np.asarray(first - records.hidden[0])).max() > 0.1


@pytest.mark.parametrize("finish", [False, True])
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
    records = gradient_of(config)(fresh_params(lively=0.0), worlds, KEY, None)[2]
    passed = np.asarray(records.passed)
    assert (passed.sum(0) == [1, 1, 1, 0]).all()
    after = np.cumsum(passed, 0) - passed > 0
    assert after.any()
    assert np.array_equal(np.asarray(records.alive) == 0, after & finish)


whole_gradient = jax.jit(encoder_gradient)


def test_images_outside_the_loop_give_the_gradient_of_the_plain_loop(two_pass):
    """The sums run in another order in float32: 1e-4 of each array's largest entry."""
    config, worlds, params, gradient, loss, _ = two_pass
    plain = jax.jit(jax.value_and_grad(loss_of(config, network.encode)))
    expected_loss, expected = plain(params, worlds, None, config.loss.field_gain)
    assert float(loss) == pytest.approx(float(expected_loss), rel=1e-5)
    sizes = {k: float(np.abs(np.array(g)).max()) for k, g in expected.items()}
    assert min(sizes.values()) > 1e-7, sizes
    assert largest_difference(gradient, expected) < 1e-4


def test_the_encoders_gradient_does_not_depend_on_its_chunks(two_pass, monkeypatch):
    params = two_pass[2]
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.normal(size=(12, 20, 20)), jnp.float32)
    cotangents = jnp.asarray(rng.normal(size=(12, 8)), jnp.float32)
    inputs = params, images, cotangents
    whole = whole_gradient(*inputs)
    monkeypatch.setattr("suite.train.gradient.CHUNK", 5)
    in_chunks = jax.jit(lambda *inputs: encoder_gradient(*inputs))
    assert largest_difference(in_chunks(*inputs), whole) < 1e-5


def test_the_encoders_gradient_from_every_other_image_is_right_on_average(two_pass):
    params, rng = two_pass[2], np.random.default_rng(1)
    images = jnp.asarray(rng.normal(size=(6, 2, 20, 20)), jnp.float32)
    cotangents = jnp.asarray(rng.normal(size=(6, 2, 8)), jnp.float32)
    whole = whole_gradient(params, images.reshape(12, 20, 20), cotangents.reshape(12, 8))
    keys = {int(jax.random.randint(key, (), 0, 2)): key for key in jax.random.split(KEY, 8)}
    sampled = jax.jit(sampled_encoder_gradient, static_argnums=3)
    halves = [sampled(params, images, cotangents, 2, keys[k]) for k in (0, 1)]
    mean = jax.tree.map(lambda one, other: (one + other) / 2, *halves)
    assert largest_difference(mean, whole) < 1e-5
