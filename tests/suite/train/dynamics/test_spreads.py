"""Spreads by name, each left out alone, what is left without any, and as vehicles drawn by them."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules
from suite.train.config import PointMassConfig
from suite.train.dynamics.quadrotor import draw_effects
from suite.train.dynamics.spreads import fixed, race_settings, spreads
from suite.train.overrides import phase_configs
from suite.train.recipes import named_recipe


def test_each_spread_of_a_quadrotor_is_left_out_alone():
    recipe = named_recipe("race")
    assert recipe.quadrotor is not None
    found = spreads(recipe)
    assert list(found) == [
        "mass", "thrust", "rotor lag", "drag", "delay", "rate gain", "centre of mass",
        "torque trim", "wind", "image",
    ]  # fmt: skip
    assert found["delay"].quadrotor == replace(recipe.quadrotor, delay_spread_s=0.0)
    assert found["image"].quadrotor == recipe.quadrotor
    alike = {"quadrotor": None, "physics": recipe.physics, "phases": ()}
    assert all(replace(each, **alike) == replace(recipe, **alike) for each in found.values())
    last = phase_configs(found["delay"])[-1].quadrotor
    assert last is not None and last.delay_spread_s == 0.0, "no phase brings it back"
    assert "delay" not in spreads(found["delay"])


def test_quadrotors_without_spreads_are_all_alike():
    recipe = fixed(named_recipe("race"))
    assert recipe.quadrotor is not None
    assert spreads(recipe) == {}
    drawn = draw_effects(recipe.quadrotor, 4, np.random.default_rng(0))
    for values in drawn.values():
        for value in values:
            assert np.ptp(np.asarray(value), axis=0).max() == 0


def test_point_masses_without_spreads_have_the_middle_of_their_ranges():
    recipe = replace(named_recipe("race-paper"), physics=PointMassConfig(drag_up=(0.2, 2.0)))
    still = fixed(recipe)
    assert replace(still, physics=recipe.physics) == recipe
    physics = still.physics
    assert physics.drag == pytest.approx((0.45, 0.45))
    assert physics.drag_up == pytest.approx((1.1, 1.1))
    assert physics.action_delay == (0.75, 0.75) and physics.lag_mean == recipe.physics.lag_mean
    assert not (physics.lag_std or any(physics.wind_std) or physics.time_step_std)
    assert physics.depth_noise == 0 and physics.fov_scale == (1, 1)


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
