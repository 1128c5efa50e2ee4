"""Flights of the point mass flown again from their windows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import delta_network
from suite.delta.replay import PointMassModel, nominal_model, replay
from suite.delta.windows import cut_windows
from suite.train.config import PointMassConfig
from tests.support.point_mass_flights import fly


def errors(plant, windows, delta=None):
    pos, vel, _ = jax.jit(replay)(plant, windows, delta)
    return np.abs(pos - windows.pos_w[:, 1:]).max(), np.abs(vel - windows.vel_w[:, 1:]).max()


@pytest.mark.parametrize("delay", [0.0, 0.6, 1.7])
def test_flights_of_the_point_mass_replay_as_they_were_flown(delay):
    """Rounding in float32 and the start's acceleration from velocities 1 ms apart."""
    plant = PointMassModel(np.float32(10.0), np.zeros(3, np.float32), np.float32(delay))
    windows = cut_windows(fly(plant), 1.0, 0.2)
    assert windows.action_b.shape[1:] == (30, 3) and len(windows.acc_w) > 20
    travelled = np.linalg.norm(windows.pos_w[:, -1] - windows.pos_w[:, 0], axis=-1)
    assert travelled.mean() > 1
    pos, vel = errors(plant, windows)
    assert pos < 2e-3 and vel < 5e-3
    wrong = errors(plant._replace(delay=np.float32(delay + 0.3)), windows)
    assert wrong[0] > 10 * pos
    slower = errors(plant._replace(lag=np.float32(8.0)), windows)
    assert slower[0] > 10 * pos


def test_drag_at_the_start_is_that_of_the_step_before():
    """The log has the drag of now, the point mass that of a step ago: centimetres over 1 s."""
    plant = PointMassModel(np.float32(10.0), np.array([0.3, 0.4, 0.5], np.float32), np.float32(0.5))
    windows = cut_windows(fly(plant), 1.0, 0.2)
    pos, vel = errors(plant, windows)
    assert pos < 0.03 and vel < 0.03
    without = errors(plant._replace(drag=np.zeros(3, np.float32)), windows)
    assert without[0] > 0.2


def test_a_fresh_delta_changes_nothing_and_a_constant_one_acts_as_the_action():
    plant = nominal_model(PointMassConfig())
    windows = cut_windows(fly(plant), 0.5, 0.3)
    delta = delta_network.init(jax.random.key(0))
    plain = jax.jit(replay)(plant, windows, None)
    same = jax.jit(replay)(plant, windows, delta)
    np.testing.assert_array_equal(plain[0], same[0])
    assert not np.any(same[2])
    delta["output.bias"] = jnp.asarray([1.0, -0.5, 0.2])
    shifted = windows._replace(action_b=windows.action_b + np.array([1.0, -0.5, 0.2], np.float32))
    pos, _, correction = jax.jit(replay)(plant, windows, delta)
    np.testing.assert_allclose(correction[:, 0], np.tile([1.0, -0.5, 0.2], (len(pos), 1)))
    np.testing.assert_allclose(pos, jax.jit(replay)(plant, shifted, None)[0], atol=1e-5)
