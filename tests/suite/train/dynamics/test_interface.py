"""Each loop's dynamics of one interface; environments draw vehicles as the trainer does."""

import copy
import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules
from suite.train.config import QuadrotorConfig
from suite.train.dynamics import point_mass
from suite.train.dynamics.interface import make_dynamics
from suite.train.recipes import race_settings
from suite.train.worlds import sample_worlds
from tests.support.training import small_config
from tests.support.vehicles import PLAIN

CONFIG = small_config(batch=2, loss={"gradient_decay": 0.4})
ACTION, TARGET = jnp.asarray([[1.0, 0.5, 2.0]] * 2), jnp.asarray([[9.0, 1.0, 2.0]] * 2)


def started(config):
    worlds, dynamics = sample_worlds(config, 0), make_dynamics(config)
    body = jax.jit(dynamics.start)(worlds.constants, *worlds[1:4])
    return worlds, dynamics, body


def test_the_point_mass_is_stepped_with_the_runs_settings():
    worlds, dynamics, body = started(CONFIG)
    assert isinstance(worlds.constants, point_mass.PointMassParams)
    now = body, worlds.constants, ACTION, TARGET
    found = jax.jit(dynamics.step)(*now, jax.random.split(jax.random.key(0), 2))
    expected = jax.jit(point_mass.step)(*now, 0.4)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_vehicle_is_flown_as_a_quadrotor_of_the_same_interface():
    config = replace(CONFIG, quadrotor=QuadrotorConfig(PLAIN))
    worlds, dynamics, body = started(config)
    np.testing.assert_allclose(body.rot_w[:, 2, 2], 1.0, atol=1e-6, err_msg="upright")
    after = jax.jit(dynamics.step)(
        body, worlds.constants, ACTION, TARGET, jax.random.split(jax.random.key(0), 2)
    )
    np.testing.assert_allclose(worlds.constants.time_step, 1 / config.spec.rate_hz, rtol=1e-6)
    moved = np.asarray(after.pos_w - body.pos_w)
    wanted = worlds.vel_w / config.spec.rate_hz
    assert np.abs(moved - wanted).max() < 0.05 and np.all(after.vel_w[:, 2] > body.vel_w[:, 2])
    assert after.acc_w.shape == (2, 3) and not isinstance(after, point_mass.PointMassState)


def test_environments_draw_their_vehicles_as_the_trainer_does():
    settings = race_settings("race")
    drawn, config = settings["vehicle"], settings["vehicle"].config
    rng = np.random.default_rng(0)
    many = [drawn(rng) for _ in range(60)]
    mass = np.array([vehicle.effects["mass_offset"].offset for vehicle in many])
    assert mass.std() == pytest.approx(config.mass_std * config.vehicle.mass, rel=0.3)
    own = config.vehicle.effects.get("motor_lag")
    assert own is None or len({vehicle.effects["motor_lag"] for vehicle in many}) == 60
    assert copy.deepcopy(drawn) == pickle.loads(pickle.dumps(drawn)) == drawn


def test_vehicles_of_their_own_fly_at_once_as_they_fly_alone():
    settings = {**race_settings("race"), "track": "circular", "rules": Rules(0.3)}
    many = RaceVectorEnv(3, **settings)
    alone = [RaceEnv(**settings) for _ in range(3)]
    seen, _ = many.reset(seed=5)
    states = [env.reset(seed=5 + k)[0]["state"] for k, env in enumerate(alone)]
    action = np.array([0.3, 0.1, 0.1], np.float32)
    for _ in range(12):
        assert np.array_equal(seen["state"], states)
        seen, _, terminated, truncated, _ = many.step(np.tile(action, (3, 1)))
        states = [env.step(action)[0]["state"] for env in alone]
        for k in np.flatnonzero(terminated | truncated):
            states[k] = alone[k].reset()[0]["state"]
    speeds = np.linalg.norm(seen["state"][:, :3], axis=-1)
    assert len(set(speeds.round(4).tolist())) == 3


def test_vehicles_that_differ_in_more_than_effects_are_refused():
    names = iter(("racer5", "racer5", "reference"))
    env = RaceVectorEnv(2, vehicle=lambda rng: load_vehicle(next(names)))
    with pytest.raises(ValueError, match="the function drew name reference after racer5"):
        env.reset(seed=0)
