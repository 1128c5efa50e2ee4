"""Gates passed and seen ahead in training; the encoder's gradient from few images."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.observation import View, observe
from suite.delta.replay import nominal_model
from suite.train import losses, rollout
from suite.train.config import LossConfig, PointMassConfig
from suite.train.dynamics.point_mass import PointMassParams
from suite.train.gradient import make_gradient
from suite.train.rollout import make_rollout
from suite.train.worlds import sample_worlds
from tests.support.training import (
    SPEC,
    boxes_worlds,
    fresh_params,
    largest_difference,
    small_config,
)

KEY = jax.random.key(3)
STILL = {
    "drag": (0.0, 0.0),
    "drag_up": (0.0, 0.0),
    "wind_std": (0.0, 0.0, 0.0),
    "action_delay": (0.0, 0.0),
}


def blind(params, image):
    return jnp.zeros((image.shape[0], SPEC.hidden_size))


def flown(config, worlds):
    embedding_shift = jnp.zeros((config.episode.steps, worlds.pos_w.shape[0], SPEC.hidden_size))
    run = jax.jit(make_rollout(config), static_argnums=4)
    return run(fresh_params(config.spec), embedding_shift, worlds, KEY, blind)[1]


def at_first_gate(config, ahead_m):
    """Worlds that fly at 3 m/s along the first gate's axis, the next one 4 m behind it."""
    worlds = boxes_worlds(config)
    gates = worlds.scene.gates
    forward = gates.rot_w[:, 0, :, 0]
    center = np.array(gates.center_w)
    center[:, 1] = center[:, 0] + 4 * forward
    return worlds._replace(
        scene=worlds.scene._replace(gates=gates._replace(center_w=center)),
        pos_w=center[:, 0] - ahead_m * forward, vel_w=3 * forward,
        target=np.zeros(len(center), np.int32),
    )  # fmt: skip


@pytest.mark.parametrize(("pass_first", "progress"), [(True, -3.0), (False, 3.0)])
def test_the_step_that_passes_a_gate_is_progress_to_the_next_where_asked(pass_first, progress):
    loss = {"progress": 1.0, "pass_first": pass_first}
    config = small_config(1, 1, physics=STILL, loss=loss)
    records = flown(config, at_first_gate(config, 0.02))
    assert bool(records.passed[0, 0])
    assert float(records.terms["progress"][0, 0]) == pytest.approx(progress, abs=0.2)


def test_the_step_before_is_progress_to_the_gate():
    config = small_config(1, 1, physics=STILL, loss={"progress": 1.0})
    records = flown(config, at_first_gate(config, 1.0))
    assert not bool(records.passed[0, 0])
    assert float(records.terms["progress"][0, 0]) == pytest.approx(-3.0, abs=0.2)


def test_the_policy_is_shown_the_gate_after_the_next(monkeypatch):
    """The second gate's centre, the last one's where none comes after, and the next's direction."""
    seen = []

    def spy(spec, view, action_b):
        jax.debug.callback(lambda *shown: seen.append(shown), view.second_w, view.axis_w)
        return observe(spec, view, action_b)

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
    expected = [rot[0, 0, :, 0], rot[1, 3, :, 0], rot[2, 7, :, 0]]
    np.testing.assert_allclose(seen[0][1], expected, atol=1e-6)


def test_the_encoders_gradient_from_every_third_image_is_right_on_average():
    """Without noise the key sets nothing but the first image: the three choices' mean is exact."""
    config = small_config(steps=6, physics={"depth_noise": 0.0})
    sparse = replace(config, episode=replace(config.episode, image_stride=3))
    worlds, params = boxes_worlds(config), fresh_params()
    whole = make_gradient(config)(params, worlds, KEY, None)[0]
    run, found = jax.jit(make_gradient(sparse)), {}
    for seed in range(40):
        gradient = run(params, worlds, jax.random.key(seed), None)[0]
        found[round(float(gradient["conv1.weight"][0, 0, 0, 0]), 9)] = gradient
        if len(found) == 3:
            break
    assert len(found) == 3
    mean = jax.tree.map(lambda *parts: sum(parts) / 3, *found.values())
    assert largest_difference(mean, whole) < 1e-4
    for gradient in found.values():
        np.testing.assert_allclose(gradient["action.weight"], whole["action.weight"], atol=1e-6)


@pytest.mark.parametrize("stride", [0, 4, 7])
def test_a_stride_that_does_not_divide_the_steps_is_refused(stride):
    config = small_config(steps=6, image_stride=stride)
    with pytest.raises(ValueError, match=rf"image_stride is {stride}, allowed are divisors .*6"):
        make_gradient(config)


def test_a_state_on_its_way_at_the_start_is_that_of_a_level_drone_at_rest():
    """The judge's own words for it: the third row of the rotation is (0, 0, 1)."""
    config = replace(small_config(2), physics=PointMassConfig(state_delay=1))
    zero = np.zeros(3)
    seen = View(zero, np.eye(3), zero, zero, zero, zero)
    expected = observe(config.spec, seen, zero).state
    np.testing.assert_array_equal(rollout.states_at_start(2, config), np.tile(expected, (2, 1, 1)))


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
    found = losses.approach_shift(config, jnp.array([place_g]))
    np.testing.assert_allclose(found, [shift], atol=1e-6)
    assert losses.approach_shift(LossConfig(), jnp.array([place_g])) == 0.0


def test_hovering_above_the_frame_there_is_progress_to_be_made_backwards():
    """1.2 m above the gate the way to its centre is down, through the bar; the goal lies before."""
    terms = {}
    for approach in (0.0, 1.5):
        loss = {"progress": 1.0, "approach_m": approach}
        config = small_config(2, 1, physics=STILL, loss=loss)
        worlds = at_first_gate(config, 0.0)
        turn = worlds.scene.gates.rot_w[:, 0]
        worlds = worlds._replace(pos_w=worlds.pos_w + 1.2 * turn[:, :, 2], vel_w=-2 * turn[:, :, 0])
        terms[approach] = np.asarray(flown(config, worlds).terms["progress"][0])
    assert np.all(terms[0.0] > -0.3) and np.all(terms[1.5] < -0.8)


def test_beyond_the_last_gate_progress_goes_straight_on():
    loss = {"progress": 1.0, "approach_m": 1.5}
    config = small_config(1, 1, physics=STILL, loss=loss)
    worlds = at_first_gate(config, -3.0)
    first = worlds.scene.gates.center_w[:, 0]
    center = np.array(worlds.scene.gates.center_w)
    center[:, -1] = first
    turn = np.array(worlds.scene.gates.rot_w)
    turn[:, -1] = turn[:, 0]
    gates = worlds.scene.gates._replace(center_w=center, rot_w=turn)
    worlds = worlds._replace(
        scene=worlds.scene._replace(gates=gates), target=np.full(1, center.shape[1], np.int32)
    )
    term = flown(config, worlds).terms["progress"]
    assert float(term[0, 0]) == pytest.approx(-3.0, abs=0.2)


def test_worlds_beside_a_gate_have_missed_it():
    config = small_config(batch=60, rest_share=0.0, missed_share=1.0, start_speed=5.0)
    worlds = sample_worlds(config, 0)
    gates, rows = worlds.scene.gates, np.arange(60)
    turn = gates.rot_w[rows, worlds.target]
    local = np.einsum("bij,bi->bj", turn, worlds.pos_w - gates.center_w[rows, worlds.target])
    assert np.all(np.abs(local[:, 0] - 0.25) < 0.96)
    assert np.mean(np.hypot(local[:, 1], local[:, 2]) > 0.85) > 0.9
    assert np.all(local[:, 2] < 1.81) and np.any(local[:, 2] > 1.0)
    assert np.linalg.norm(worlds.vel_w, axis=-1).max() < 5.0


def test_none_has_missed_a_gate_unless_asked():
    """The default's worlds are what they were before there was the setting."""
    config = small_config(batch=8, rest_share=0.0)
    with_some = replace(config, episode=replace(config.episode, missed_share=0.5))
    one, other = (sample_worlds(c, 3).pos_w for c in (config, with_some))
    assert np.abs(one - other).max() > 0.1
    gates = sample_worlds(config, 3).scene.gates
    assert np.all(np.isfinite(gates.center_w))


def test_drag_along_the_bodys_z_has_a_range_of_its_own():
    config = small_config()
    plain = sample_worlds(config, 2)
    physics = replace(config.physics, drag_up=(3.0, 4.0))
    changed = sample_worlds(replace(config, physics=physics), 2)
    before, after = (worlds.constants for worlds in (plain, changed))
    assert isinstance(before, PointMassParams) and isinstance(after, PointMassParams)
    across, up = after.drag[:, :2], after.drag[:, 2]
    np.testing.assert_array_equal(across, before.drag[:, :2])
    assert np.all((up >= 3.0) & (up <= 4.0))
    np.testing.assert_array_equal(changed.pos_w, plain.pos_w)
    np.testing.assert_allclose(nominal_model(physics).drag, [0.45, 0.45, 3.5])
