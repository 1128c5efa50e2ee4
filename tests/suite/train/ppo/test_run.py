"""PPO: its rollout with exploration, what a run leaves and refuses, the same curve with a stop."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import network
from suite.common import curve
from suite.common.console import Console
from suite.train.ppo import update as run
from suite.train.ppo.config import ppo_like
from suite.train.ppo.objective import Actor, Sequences, action_means
from suite.train.ppo.rollout import log_probability, make_rollout
from tests.support.training import SPEC, assert_same_run, boxes_worlds, fresh_params, small_config

DELAYS = {"image_delay": 2, "state_delay": 1, "depth_noise": 0.02}
CONFIG = replace(
    ppo_like(small_config(4, 6, physics=DELAYS, image_stride=2), iterations=3),
    epochs=2, minibatches=2, critic_epochs=2, critic_size=8,
)  # fmt: skip


make_update = cache(run.make_update)


@pytest.fixture(autouse=True)
def _small_scenes(monkeypatch):
    monkeypatch.setattr(run, "sample_worlds", boxes_worlds)
    monkeypatch.setattr(run, "make_update", make_update)


def test_a_stopped_run_resumes_exactly_and_leaves_a_policy(tmp_path, monkeypatch):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert run.train_ppo(CONFIG, whole, Console()).iterations == 3
    assert [row["iteration"] for row in curve.read(whole)] == [0, 1, 2]
    policy = load_policy_checkpoint(whole / "policy")
    assert policy.spec == SPEC
    fresh = run.start_state(CONFIG).params
    assert all(np.any(policy.params[name] != np.array(value)) for name, value in fresh.items())

    def worlds(config, iteration):
        if iteration == 1:
            raise KeyboardInterrupt
        return boxes_worlds(config, iteration)

    monkeypatch.setattr(run, "sample_worlds", worlds)
    with pytest.raises(KeyboardInterrupt):
        run.train_ppo(CONFIG, stopped, Console())
    assert [row["iteration"] for row in curve.read(stopped)] == [0]
    monkeypatch.setattr(run, "sample_worlds", boxes_worlds)
    run.train_ppo(CONFIG, stopped, Console())
    assert_same_run(stopped, whole)
    with pytest.raises(ValueError, match="holds another run.*discount"):
        run.train_ppo(replace(CONFIG, discount=0.5), whole, Console())


def test_minibatches_and_strides_that_do_not_divide_are_refused(tmp_path):
    for wrong in (3, 0):
        with pytest.raises(ValueError, match=r"minibatches is \d, allowed are divisors .*\(4\)"):
            make_update(replace(CONFIG, minibatches=wrong))
    config = replace(CONFIG, episode=replace(CONFIG.episode, image_stride=4))
    with pytest.raises(ValueError, match=r"image_stride is 4, allowed are divisors .*\(6\)"):
        run.train_ppo(config, tmp_path / "run", Console())
    assert not list(tmp_path.iterdir())


def test_the_density_is_a_normal_one():
    mean, action = jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([1.5, 2.0, 1.0])
    deviation = np.array([0.5, 1.0, 2.0])
    density = np.exp(-0.5 * np.array([1.0, 0.0, -1.0]) ** 2) / (deviation * np.sqrt(2 * np.pi))
    found = log_probability(mean, jnp.log(deviation), action)
    assert float(found) == pytest.approx(np.log(density.prod()))


roll = jax.jit(make_rollout(CONFIG.shared))


def crashing(worlds):
    """Return the worlds with the first one just above the ground and sinking."""
    pos, vel = np.array(worlds.pos_w), np.array(worlds.vel_w)
    pos[0], vel[0] = [100.0, 0.0, 0.5], [0.0, 0.0, -4.0]
    return worlds._replace(pos_w=pos, vel_w=vel)


def flown(worlds):
    actor = Actor(fresh_params(), jnp.full(3, -1.0))
    records, _ = roll(actor.params, actor.log_deviation, worlds, jax.random.key(2))
    return actor, records


def test_the_learner_meets_the_actions_density_that_the_rollout_recorded():
    """Through delays, collisions and recurrent states of the start: a ratio of one everywhere."""
    worlds = crashing(boxes_worlds(CONFIG.shared))
    hidden = np.random.default_rng(0).normal(size=worlds.hidden.shape).astype(np.float32)
    actor, records = flown(worlds._replace(hidden=hidden))
    assert bool(records.done[:, 0].any()) and not bool(records.done[-1, 0])
    embeddings = jax.jit(network.encode)(actor.params, records.image.reshape(-1, 20, 20))
    sequences = Sequences(
        state=records.state, action_b=records.action_b, log_prob=records.log_prob,
        done=records.done, advantage=records.log_prob, start=jnp.asarray(hidden)[None],
    )  # fmt: skip
    mean = jax.jit(action_means)(actor.params, embeddings.reshape(6, 4, -1), sequences)
    found = log_probability(mean, actor.log_deviation, records.action_b)
    np.testing.assert_allclose(found, records.log_prob, atol=1e-3)


def test_a_world_that_crashed_starts_again_as_it_started():
    _, records = flown(crashing(boxes_worlds(CONFIG.shared)))
    again, seen = int(np.argmax(records.done[:, 0])) + 1, records.critic_inputs
    np.testing.assert_allclose(seen[again, 0], seen[0, 0], atol=1e-6)
    np.testing.assert_array_equal(records.state[again, 0], records.state[0, 0])
    assert not np.allclose(seen[again, 1], seen[0, 1])
