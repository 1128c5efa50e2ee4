"""The whole rollout: gradients, what is cut out of them, and how the field enters."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from policies import delta_network, network
from policies.observation import state_vector
from suite.train import point_mass
from suite.train.gradient import encoder_gradient, make_gradient
from suite.train.losses import UNIT_FIELD
from suite.train.rollout import make_rollout, target_gate
from tests.support.training import (
    SPEC,
    boxes_worlds,
    doubled,
    fresh_params,
    largest_difference,
    small_config,
)
from tracks.field import attractive_field, magnetic_field

TILTED = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2]).as_matrix()
KEY = jax.random.key(5)


def blind(params, image):
    """Return embeddings of nothing, for tests that are not about images."""
    return jnp.zeros((image.shape[0], SPEC.hidden_size))


def loss_of(config, encode=blind):
    """Return loss(params, worlds, delta) of the plain loop with `encode` inside."""
    rollout = make_rollout(config)

    def loss(params, worlds, delta=None):
        nudge = jnp.zeros((config.episode.steps, worlds.pos_w.shape[0], SPEC.hidden_size))
        return rollout(params, nudge, worlds, KEY, encode, delta)[0]

    return loss


@pytest.fixture(scope="module")
def two_pass():
    """Return (config, worlds, params, gradient, loss, records) of the trainer's own method."""
    config = small_config(physics={"depth_noise": 0.02})
    worlds, params = boxes_worlds(config), fresh_params()
    return config, worlds, params, *jax.jit(make_gradient(config))(params, worlds, KEY, None)


def test_images_outside_the_loop_give_the_gradient_of_the_plain_loop(two_pass):
    """The sums run in another order in float32: 1e-4 of each array's largest entry."""
    config, worlds, params, gradient, loss, _ = two_pass
    plain = jax.jit(jax.value_and_grad(loss_of(config, network.encode)))
    expected_loss, expected = plain(params, worlds)
    assert float(loss) == pytest.approx(float(expected_loss), rel=1e-5)
    assert all(np.abs(np.array(g)).max() > 1e-5 for g in jax.tree.leaves(expected))
    assert largest_difference(gradient, expected) < 1e-4


def test_the_encoders_gradient_does_not_depend_on_its_chunks(two_pass, monkeypatch):
    params = two_pass[2]
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.normal(size=(12, 20, 20)), jnp.float32)
    cotangents = jnp.asarray(rng.normal(size=(12, 8)), jnp.float32)
    whole = encoder_gradient(params, images, cotangents)
    monkeypatch.setattr("suite.train.gradient.CHUNK", 5)
    assert largest_difference(encoder_gradient(params, images, cotangents), whole) < 1e-5


def test_records_are_those_of_the_flight(two_pass):
    config, worlds, _, _, loss, records = two_pass
    assert records.image.shape == (6, 4, 20, 20) and records.pos_w.shape == (6, 4, 3)
    assert float(sum(term.mean() for term in records.terms)) == pytest.approx(float(loss), rel=1e-5)
    first = np.linalg.norm(np.array(records.pos_w[0]) - worlds.pos_w, axis=-1)
    assert np.all(first < 8 * 0.05)
    assert np.ptp(np.array(records.image)) > 1


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def held_attitude(float64, monkeypatch):
    """Hold the attitude: its gradient is cut on purpose, so differences must not move it."""
    held = jnp.asarray(TILTED)
    monkeypatch.setattr(
        point_mass, "attitude", lambda thrust, _: jnp.broadcast_to(held, (*thrust.shape[:-1], 3, 3))
    )


def test_the_rollouts_gradient_is_that_of_finite_differences(held_attitude):
    """Where nothing is cut: no decay, no field, no closing speed, attitude held."""
    config = small_config(
        steps=8,
        physics={"state_delay": 1, "image_delay": 1},
        loss={"gradient_decay": 0.0, "field_gain": 0.0, "collide": 0.0, "barrier_slope": -4.0},
    )
    loss = jax.jit(loss_of(config))
    params, worlds = doubled(fresh_params()), doubled(boxes_worlds(config))
    gradient = jax.jit(jax.grad(loss_of(config)))(params, worlds)
    rng = np.random.default_rng(0)
    for name in ("state.weight", "gru.weight_hidden", "gru.bias_input", "action.weight"):
        direction = rng.normal(size=params[name].shape)
        ends = [loss({**params, name: params[name] + h * direction}, worlds) for h in (1e-5, -1e-5)]
        slope = float(ends[0] - ends[1]) / 2e-5
        assert abs(slope) > 1e-4
        assert float((gradient[name] * direction).sum()) == pytest.approx(slope, rel=1e-5)


def reference_positions(config, worlds):
    """Return params -> positions (T, B, 3), velocities and target gates: a loop of its own."""
    gates = worlds.scene.gates

    def fly(params):
        body = point_mass.start(worlds.pos_w, worlds.vel_w, worlds.heading_w)
        batch = worlds.pos_w.shape[0]
        hidden, action = jnp.zeros((batch, SPEC.hidden_size)), jnp.zeros((batch, 3))
        positions, velocities = [], []
        for _ in range(config.episode.steps):
            _, target_w = target_gate(gates, worlds.target)
            state = state_vector(body.pos_w, body.vel_w, body.rot_w, target_w, action)
            action, hidden = network.recur(params, hidden, blind(params, state), state)
            body = point_mass.step(
                body, worlds.constants, action, target_w, 6.0, config.loss.gradient_decay
            )
            positions.append(body.pos_w)
            velocities.append(body.vel_w)
        return jnp.stack(positions), jnp.stack(velocities)

    return fly


def test_the_field_enters_as_the_paper_says(float64):
    """Eq. final_optimization: the gradient changes by -u_A pulled back through the positions."""
    config = small_config(loss={"field_gain": 0.42})
    worlds, params = doubled(boxes_worlds(config)), doubled(fresh_params())
    without = replace(config, loss=replace(config.loss, field_gain=0.0))
    grad = [jax.jit(jax.grad(loss_of(c)))(params, worlds) for c in (config, without)]
    change = jax.tree.map(jnp.subtract, *grad)

    def positions_and_pull(params):
        pos, vel = reference_positions(config, worlds)(params)
        gate, _ = target_gate(worlds.scene.gates, worlds.target)
        field = magnetic_field(gate.center_w, gate.rot_w, gate.opening_g, pos)
        unit = (2e-5 * UNIT_FIELD) ** (1 - config.loss.field_decay)
        return pos, 0.42 * attractive_field(field, vel, config.loss.field_decay) / unit

    def pulled(params):
        pos, pull_back, pull = jax.vjp(lambda p: positions_and_pull(p), params, has_aux=True)
        return pos, pull_back, pull

    _, pull_back, pull = pulled(params)
    count = config.episode.steps * config.episode.batch
    (expected,) = pull_back(-pull / count)
    used = [name for name in expected if np.abs(np.array(expected[name])).max() > 0]
    assert {"state.weight", "gru.weight_input", "action.weight"} <= set(used)
    assert largest_difference({k: change[k] for k in used}, {k: expected[k] for k in used}) < 1e-6


@pytest.mark.parametrize("copies", [1, 3])
def test_the_gradient_of_the_same_worlds_twice_is_the_same(float64, copies):
    config = small_config(loss={"field_gain": 5.0})
    worlds, params = doubled(boxes_worlds(config)), doubled(fresh_params())
    once = jax.jit(jax.grad(loss_of(config)))(params, worlds)
    many = jax.tree.map(lambda x: jnp.concatenate([jnp.asarray(x)] * copies), worlds)
    again = jax.jit(jax.grad(loss_of(config)))(params, many)
    assert largest_difference(again, once) < 1e-9


@pytest.mark.parametrize(("steps", "batch"), [(4, 2), (8, 2), (8, 6)])
def test_the_fields_strength_depends_on_neither_horizon_nor_batch(float64, steps, batch):
    """A world that hangs still: every step pulls alike, so the mean is one step's pull."""
    still = {"drag": (0.0, 0.0), "wind_std": (0.0, 0.0, 0.0)}
    config = small_config(batch, steps, physics=still, loss={"field_gain": 0.42}, rest_share=1.0)
    worlds, params = doubled(boxes_worlds(config)), doubled(fresh_params(lively=0.0))
    loss = loss_of(config)
    gradient = jax.jit(jax.grad(lambda pos: loss(params, worlds._replace(pos_w=pos))))(worlds.pos_w)
    bare = replace(config, loss=replace(config.loss, field_gain=0.0))
    plain = loss_of(bare)
    rest = jax.jit(jax.grad(lambda pos: plain(params, worlds._replace(pos_w=pos))))(worlds.pos_w)
    # Decay fades what comes back through the steps: step k's pull by its k-th power.
    fade = np.exp(-config.loss.gradient_decay * np.array(worlds.constants.time_step))
    share = np.mean([fade ** (k + 1) for k in range(steps)], axis=0)
    gate, _ = target_gate(worlds.scene.gates, worlds.target)
    field = magnetic_field(gate.center_w, gate.rot_w, gate.opening_g, worlds.pos_w)
    pull = attractive_field(field, worlds.vel_w, config.loss.field_decay)
    pull = 0.42 * np.array(pull) / (2e-5 * UNIT_FIELD) ** 0.7
    np.testing.assert_allclose(
        np.array(rest - gradient) * batch, pull * share[:, None], rtol=1e-6, atol=1e-12
    )


def test_images_carry_no_gradient_to_the_state(float64):
    config = small_config()
    worlds, params = doubled(boxes_worlds(config)), doubled(fresh_params())

    def seeing(params, image):
        return image.mean((1, 2))[:, None] * jnp.ones(SPEC.hidden_size)

    def held(params, image):
        return jax.lax.stop_gradient(seeing(params, image))

    def start_gradient(encode):
        loss = loss_of(config, encode)
        return jax.jit(jax.grad(lambda p: loss(params, worlds._replace(pos_w=p))))(worlds.pos_w)

    seen = start_gradient(seeing)
    np.testing.assert_allclose(seen, start_gradient(held), atol=1e-12)
    assert np.abs(np.array(seen - start_gradient(blind))).max() > 1e-6


def test_a_delta_action_is_frozen_and_changes_the_gradient(two_pass):
    config, worlds, params = two_pass[:3]
    delta = delta_network.init(jax.random.key(1))
    grad = jax.jit(jax.grad(loss_of(config), argnums=0))
    base = grad(params, worlds)
    assert largest_difference(grad(params, worlds, delta), base) < 1e-5
    delta["output.weight"] += 0.5
    assert largest_difference(grad(params, worlds, delta), base) > 1e-2


def test_a_world_that_crashed_deep_leaves_the_loss(two_pass):
    config, worlds, params = two_pass[:3]
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
    nudge = jnp.zeros((6, 4, SPEC.hidden_size))
    _, records = jax.jit(make_rollout(config), static_argnums=4)(params, nudge, moved, KEY, blind)
    total = np.abs(sum(np.array(term) for term in records.terms))
    assert np.all(total[0] > 0)
    assert not np.any(total[1:, :2]) and np.all(total[1:, 2:] > 0)
