"""The race as gymnax has it: the trainer's own PPO's, one at a time, mapped and differentiable."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.envs.races import RaceConfig, Races
from eval.quadrotor.vehicle_file import load_vehicle
from suite.train.config import QuadrotorConfig
from suite.train.ppo.environment import JaxRace
from suite.train.rollout import world_keys
from tests.support.training import boxes_only, small_config

QUAD = QuadrotorConfig(load_vehicle("racer5"), attitude_hz=30.0, physics_hz=60.0)
ENV = JaxRace(replace(small_config(), quadrotor=QUAD), time_limit_s=0.1)
KEYS = jax.random.split(jax.random.key(1), 3)
reset = jax.jit(jax.vmap(ENV.reset, (0, None)))
step = jax.jit(jax.vmap(ENV.step, (0, 0, 0, None)))


@pytest.fixture(scope="module")
def worlds():
    drawn = ENV.worlds(4, seed=3)
    return drawn._replace(scene=boxes_only(drawn.scene))


def test_mapped_it_flies_what_the_batch_of_the_trainers_ppo_flies(worlds):
    seen, state = reset(KEYS, worlds)
    assert seen.state.shape == (3, 12) and seen.image.shape == (3, 20, 20)
    action = np.array([[0.1, 0.2, -0.1], [0.5, 0.0, 0.3], [-3.0, 0.0, 0.0]], np.float32)
    _, after, reward, done, info = step(KEYS, state, action, worlds)
    assert not done.any() and not info["truncated"].any()
    race = ENV._race

    @jax.jit
    def fly(worlds, wanted):
        own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[state.world], worlds)
        return race.fly(own, race.start(own), wanted, world_keys(KEYS[0], own))

    flown = fly(worlds, 20.0 * np.clip(action, -1, 1))
    before_w, after_w = state.episode.state.vel_w, after.episode.state.vel_w
    np.testing.assert_allclose(after_w[:, 0], flown[0].state.vel_w, rtol=1e-4, atol=1e-4)
    assert np.abs(after_w - before_w).max() > 0.1
    np.testing.assert_allclose(reward, 0.01 * flown[1].reward.total(), rtol=1e-3, atol=1e-4)


def test_an_episode_that_ends_starts_another_and_says_why(worlds):
    """One world sinks into the ground, one is upside down, one meets the time limit (3 steps)."""
    _, state = reset(KEYS, worlds)
    body = jax.tree.map(np.array, state.episode.state)
    body.pos_w[0, 0], body.vel_w[0, 0] = [100.0, 0.0, 0.2], [0.0, 0.0, -8.0]
    body.pos_w[1:, 0], body.vel_w[1:, 0] = [200.0, 0.0, 50.0], [0.0, 0.0, 0.0]
    body.rot_w[1, 0] = np.diag([1.0, -1.0, -1.0])
    state = state._replace(episode=state.episode._replace(state=body))
    hold, ended = jnp.zeros((3, 3)), []
    for _ in range(3):
        _, state, reward, done, info = step(KEYS, state, hold, worlds)
        ended.append({name: np.asarray(info[name]) for name in ("collided", "tipped", "truncated")})
        assert np.array_equal(done, info["collided"] | info["tipped"] | info["truncated"])
        assert (np.asarray(state.steps) == 0)[np.asarray(done)].all()
        if len(ended) == 1:
            assert (reward[:2] < -0.25).all() and np.abs(state.episode.state.pos_w[0]).max() < 90
    assert ended[0]["collided"][0] and ended[0]["tipped"][1] and not ended[0]["truncated"].any()
    assert ended[2]["truncated"][2]


def test_its_contract_is_that_of_the_judges_environments():
    assert ENV.contract == Races(RaceConfig(spec=ENV.config.spec), 1).contract
