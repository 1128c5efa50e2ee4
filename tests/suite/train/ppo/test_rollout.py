"""A rollout with exploration: its density, and worlds that start again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import network
from suite.train.ppo.objective import Actor, Sequences, action_means
from suite.train.ppo.rollout import log_probability, make_rollout
from tests.suite.train.ppo.test_run import CONFIG
from tests.support.training import boxes_worlds, fresh_params


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
    embeddings = network.encode(actor.params, records.image.reshape(-1, 20, 20))
    sequences = Sequences(
        state=records.state, action_b=records.action_b, log_prob=records.log_prob,
        done=records.done, advantage=records.log_prob, start=jnp.asarray(hidden)[None],
    )  # fmt: skip
    mean = action_means(actor.params, embeddings.reshape(6, 4, -1), sequences)
    found = log_probability(mean, actor.log_deviation, records.action_b)
    np.testing.assert_allclose(found, records.log_prob, atol=1e-3)


def test_a_world_that_crashed_starts_again_as_it_started():
    worlds = crashing(boxes_worlds(CONFIG.shared))
    _, records = flown(worlds)
    again = int(np.argmax(records.done[:, 0])) + 1
    np.testing.assert_allclose(records.seen[again, 0], records.seen[0, 0], atol=1e-6)
    np.testing.assert_array_equal(records.state[again, 0], records.state[0, 0])
    assert not np.allclose(records.seen[again, 1], records.seen[0, 1])
