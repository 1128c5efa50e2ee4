"""Gates passed, missed and seen ahead in training; the encoder's gradient from few images."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.observation import state_vector
from suite.train import rollout
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
STILL = {"drag": (0.0, 0.0), "wind_std": (0.0, 0.0, 0.0), "action_delay": (0.0, 0.0)}


def blind(params, image):
    return jnp.zeros((image.shape[0], SPEC.hidden_size))


def flown(config, worlds):
    nudge = jnp.zeros((config.episode.steps, worlds.pos_w.shape[0], SPEC.hidden_size))
    run = jax.jit(make_rollout(config), static_argnums=4)
    return run(fresh_params(config.spec), nudge, worlds, KEY, blind)[1]


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


def test_the_step_that_passes_a_gate_is_progress_to_the_next():
    config = small_config(1, 1, physics=STILL, loss={"progress": 1.0})
    records = flown(config, at_first_gate(config, 0.02))
    assert bool(records.passed[0, 0])
    assert float(records.terms.progress[0, 0]) == pytest.approx(-3.0, abs=0.2)


def test_the_step_before_is_progress_to_the_gate():
    config = small_config(1, 1, physics=STILL, loss={"progress": 1.0})
    records = flown(config, at_first_gate(config, 1.0))
    assert not bool(records.passed[0, 0])
    assert float(records.terms.progress[0, 0]) == pytest.approx(-3.0, abs=0.2)


def test_the_policy_is_shown_the_gate_after_the_next(monkeypatch):
    """What reaches the state: the second gate's centre, the last one's where none comes after."""
    seen = []

    def spy(pos_w, vel_w, rot_w, gate_w, action_b, second_w=None):
        seen.append(second_w)
        return state_vector(pos_w, vel_w, rot_w, gate_w, action_b, second_w)

    monkeypatch.setattr(rollout, "state_vector", spy)
    config = replace(small_config(3, 1), spec=replace(SPEC, second_gate=True))
    worlds = boxes_worlds(config)._replace(target=np.array([0, 3, 7], np.int32))
    nudge = jnp.zeros((1, 3, SPEC.hidden_size))
    with jax.disable_jit():
        make_rollout(config)(fresh_params(config.spec), nudge, worlds, KEY, blind)
    center = worlds.scene.gates.center_w
    expected = [center[0, 1], center[1, 4], center[2, 7]]
    np.testing.assert_allclose(seen[0], expected, atol=1e-6)


def test_worlds_past_a_gate_have_missed_it():
    config = small_config(batch=60, rest_share=0.0, missed_share=1.0, start_speed=4.0)
    worlds = sample_worlds(config, 0)
    gates, rows = worlds.scene.gates, np.arange(60)
    turn = gates.rot_w[rows, worlds.target]
    local = np.einsum("bij,bi->bj", turn, worlds.pos_w - gates.center_w[rows, worlds.target])
    assert np.all(local[:, 0] >= -1e-4) and np.all(local[:, 0] < 1.6)
    assert np.all(np.hypot(local[:, 1], 2 * local[:, 2]) > 0.6)
    assert np.mean(np.einsum("bi,bi->b", turn[:, :, 0], worlds.vel_w) > 0) > 0.9


def test_progress_beyond_a_missed_gate_leads_back_in_front_of_it():
    """Beside the gate and beyond its plane: flying back counts, flying at its centre less."""
    config = small_config(2, 1, physics=STILL, loss={"progress": 1.0, "approach_m": 2.0})
    worlds = at_first_gate(config, -0.5)
    turn = worlds.scene.gates.rot_w[:, 0]
    worlds = worlds._replace(pos_w=worlds.pos_w + 1.5 * turn[:, :, 1])
    back = np.array([-2.5, -1.5, 0.0])
    vel = np.einsum("bij,j->bi", turn, 3 * back / np.linalg.norm(back))
    records = flown(config, worlds._replace(vel_w=vel.astype(np.float32)))
    np.testing.assert_allclose(records.terms.progress[0], -3.0, atol=0.2)


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
