"""Spreads by name, each left out alone, and what is left without any."""

from dataclasses import replace

import numpy as np
import pytest

from suite.train.dynamics.quadrotor import draw_effects
from suite.train.dynamics.spreads import fixed, spreads
from suite.train.presets import preset


def test_each_spread_of_a_quadrotor_is_left_out_alone():
    recipe = preset("swift-quad")
    assert recipe.quadrotor is not None
    found = spreads(recipe)
    assert list(found) == [
        "mass", "thrust", "rotor lag", "drag", "delay", "rate gain", "centre of mass",
        "torque trim", "wind", "image",
    ]  # fmt: skip
    assert found["delay"].quadrotor == replace(recipe.quadrotor, delay_spread_s=0.0)
    assert found["image"].quadrotor == recipe.quadrotor
    assert all(replace(each, quadrotor=None, physics=recipe.physics) ==
               replace(recipe, quadrotor=None) for each in found.values())  # fmt: skip
    assert "delay" not in spreads(found["delay"])


def test_quadrotors_without_spreads_are_all_alike():
    recipe = fixed(preset("swift-quad"))
    assert recipe.quadrotor is not None
    assert spreads(recipe) == {}
    drawn = draw_effects(recipe.quadrotor, 4, np.random.default_rng(0))
    for values in drawn.values():
        for value in values:
            assert np.ptp(np.asarray(value), axis=0).max() == 0


def test_point_masses_without_spreads_have_the_middle_of_their_ranges():
    recipe = preset("swift")
    still = fixed(recipe)
    assert replace(still, physics=recipe.physics) == recipe
    physics = still.physics
    assert physics.drag == pytest.approx((0.45, 0.45))
    assert physics.drag_up == pytest.approx((1.1, 1.1))
    assert physics.action_delay == (0.75, 0.75) and physics.lag_mean == recipe.physics.lag_mean
    assert not (physics.lag_std or any(physics.wind_std) or physics.time_step_std)
    assert physics.depth_noise == 0 and physics.fov_scale == (1, 1)
