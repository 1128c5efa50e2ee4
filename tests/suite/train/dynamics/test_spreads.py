"""Vehicles that environments draw as the trainer does."""

import copy
import pickle

import numpy as np
import pytest

from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules
from suite.train.recipes import race_settings


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
