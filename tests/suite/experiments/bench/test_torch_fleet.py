"""The baseline's fleet flies what the trainer's flies."""

import jax
import jax.numpy as jnp
import numpy as np
import torch

from suite.experiments.bench import torch_fleet
from suite.experiments.bench.torch_baseline import attitude, to_torch
from suite.train.dynamics import reduced
from suite.train.dynamics.fleet import FleetConfig


def test_both_fleets_fly_the_same_way():
    rng = np.random.default_rng(3)
    params = reduced.draw_fleet(FleetConfig(), 1 / 15, 5, rng)
    pos_w, vel_w, target_w = (rng.normal(0, s, (5, 3)).astype(np.float32) for s in (1, 3, 9))
    heading_w = np.tile(np.array([0.6, 0.8, 0.0], np.float32), (5, 1))
    actions = rng.normal(0, 5, (6, 5, 3)).astype(np.float32)
    goal_w = jnp.asarray(target_w)
    ours = reduced.start(params, *map(jnp.asarray, (pos_w, vel_w, heading_w)))
    move = jax.jit(lambda body, action: reduced.step(body, params, action, goal_w, 4, 0.9))
    given = to_torch(params)
    rot_w = attitude(torch.zeros(5, 3), torch.as_tensor(heading_w))
    theirs = torch_fleet.start(given, torch.as_tensor(pos_w), torch.as_tensor(vel_w), rot_w)
    for action in actions:
        ours = move(ours, action)
        theirs = torch_fleet.step(
            theirs, given, torch.as_tensor(action), torch.as_tensor(target_w), 4, 0.9
        )
    assert np.abs(ours.pos_w - pos_w).max() > 1.0
    for name, one, two in zip(ours._fields, ours, theirs, strict=True):
        np.testing.assert_allclose(one, two, rtol=2e-3, atol=2e-3, err_msg=name)
