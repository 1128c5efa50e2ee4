"""The baseline's quadrotors fly what the trainer's fly."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from eval.effects import EFFECTS
from eval.quadrotor.vehicle_file import load_vehicle
from suite.experiments.bench import torch_quadrotor
from suite.experiments.bench.torch_baseline import attitude
from suite.train.config import QuadrotorConfig
from suite.train.dynamics import quadrotor

CONFIG = QuadrotorConfig(
    load_vehicle("racer5"),
    com_std_m=0.003,
    trim_std=0.01,
    thrust_spread=0.1,
    lag_spread_s=0.03,
    delay_spread_s=0.07,
)
PERIOD_S, DECAY = 1 / 15, 0.9


def drawn(config, count):
    period = np.full(count, PERIOD_S, np.float32)
    effects = quadrotor.draw_effects(config, count, np.random.default_rng(3))
    return quadrotor.QuadrotorParams(period, effects)


def test_both_quadrotors_fly_the_same_way():
    rng = np.random.default_rng(3)
    params, cut = drawn(CONFIG, 5), quadrotor.substeps(CONFIG, PERIOD_S)
    pos_w, vel_w, target_w = (rng.normal(0, s, (5, 3)).astype(np.float32) for s in (1, 3, 9))
    heading_w = np.tile(np.array([0.6, 0.8, 0.0], np.float32), (5, 1))
    # Wild enough that rotors come to both ends of their thrust.
    actions = rng.normal(0, 12, (6, 5, 3)).astype(np.float32)
    begin, step = quadrotor.quadrotor_dynamics(CONFIG, PERIOD_S, DECAY)
    ours = begin(params, *map(jnp.asarray, (pos_w, vel_w, heading_w)))
    goal_w, key = jnp.asarray(target_w), jax.random.key(0)
    move = jax.jit(lambda body, action: step(body, params, action, goal_w, key))
    plants = torch_quadrotor.prepare(CONFIG, params, cut.dt)
    rot_w = attitude(torch.zeros(5, 3), torch.as_tensor(heading_w))
    theirs = torch_quadrotor.start(plants, torch.as_tensor(pos_w), torch.as_tensor(vel_w), rot_w)
    for action in actions:
        ours = move(ours, action)
        theirs = torch_quadrotor.step(
            theirs, plants, torch.as_tensor(action), torch.as_tensor(target_w), cut, DECAY
        )
    assert np.abs(ours.pos_w - pos_w).max() > 1.0
    for name in ("pos_w", "vel_w", "acc_w", "rot_w", "rate_b", "heading_w"):
        one, two = getattr(ours, name), getattr(theirs, name)
        np.testing.assert_allclose(one, two, rtol=2e-3, atol=2e-3, err_msg=name)
    np.testing.assert_allclose(ours.plant.rotor_speed, theirs.rotor_speed, rtol=2e-3, atol=0.5)


def test_it_refuses_what_it_does_not_fly():
    sagging = EFFECTS["quadratic_drag"].values(np.full(3, 0.1))
    vehicle = replace(CONFIG.vehicle, effects={**CONFIG.vehicle.effects, "quadratic_drag": sagging})
    config = replace(CONFIG, vehicle=vehicle)
    with pytest.raises(ValueError, match="effects.quadratic_drag is in the vehicle, allowed"):
        torch_quadrotor.prepare(config, drawn(config, 2), 0.004)
