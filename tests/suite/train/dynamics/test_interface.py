"""What a configuration trains through: the point mass, or the quadrotor of its vehicle."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from suite.train.config import QuadrotorConfig
from suite.train.dynamics import point_mass
from suite.train.dynamics.interface import make_dynamics
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
