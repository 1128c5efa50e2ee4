"""Stretches of flights: where they are cut, that they fly again, and what a start can explain."""

import numpy as np
import pytest

from suite.blind.oracle.strength import given_vehicle
from suite.blind.oracle.stretches import (
    cut,
    replay,
    state_columns,
    stretch_plant,
    whitened,
    without_start,
)
from suite.diagnose.plans.sensors import SENSORS
from suite.diagnose.plans.simulate import fly
from suite.diagnose.plans.trajectory import Trajectory

BARE = given_vehicle("bare")


@pytest.fixture(scope="module")
def flight():
    return fly(BARE, BARE, [Trajectory("figure_eight", 2.0, speed=3.0, size=2.0)])[0]


def test_stretches_start_after_the_commands_that_a_delay_may_need(flight):
    stretches = cut([flight])
    # 1000 steps of 2 ms, 25 of room, then every 250 while 250 are left.
    np.testing.assert_allclose(stretches.start_s, 0.002 * np.array([25, 275, 525]))
    assert stretches.command.shape == (250, 3, 4) and stretches.history.shape == (3, 4, 25)
    np.testing.assert_array_equal(stretches.history[1, 0, :2], flight.acting.thrust[[274, 273]])


def test_the_same_physics_flies_the_recorded_states_again(flight):
    channels = replay(cut([flight]), stretch_plant(BARE))
    rows = 275 + flight.period * np.arange(len(channels.pos_w))
    np.testing.assert_allclose(channels.pos_w[:, 1], flight.motion.pos_w[rows], atol=1e-9)
    np.testing.assert_allclose(channels.rate_b[:, 1], flight.motion.rate_b[rows], atol=1e-9)


def test_differences_are_counted_in_noise_and_a_start_explains_its_own(flight):
    stretches, plant, sensors = cut([flight]), stretch_plant(BARE), SENSORS["estimator"]
    base = replay(stretches, plant)
    moved = base._replace(pos_w=base.pos_w + [sensors.pos, 0.0, 0.0])
    apart = whitened(sensors, moved, base)
    assert apart.shape[0] == 3
    # One number a row is off by one standard deviation, the others are not.
    np.testing.assert_allclose((apart**2).sum(1), len(base.pos_w), rtol=1e-9)
    left = without_start(state_columns(stretches, plant, sensors, base), apart)
    np.testing.assert_allclose(left, 0.0, atol=1e-5)
