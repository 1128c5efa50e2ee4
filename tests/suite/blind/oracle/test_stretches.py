"""Stretches of flights, and how much they tell of each number of the catalogue."""

import numpy as np
import pytest

from eval.effects import nameable_effects
from suite.blind.oracle.information import Column, columns_of, detectable, information, left_over
from suite.blind.oracle.stretches import (
    cut,
    replay,
    state_columns,
    stretch_plant,
    whitened,
    without_start,
)
from suite.diagnose.plans.simulate import SENSORS, fly
from suite.diagnose.plans.trajectory import Trajectory
from tests.support.ways import BARE, bare_flights


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


@pytest.fixture(scope="module")
def flights():
    return bare_flights()


def test_information_grows_with_flights_and_knows_hand_worked_parts(flights):
    sensors = SENSORS["estimator"]
    both, one = (information(BARE, cut(f), sensors) for f in (flights, flights[:1]))
    assert (np.diag(both.matrix) >= np.diag(one.matrix) - 1e-9).all()
    # A gyro bias moves one channel by itself; each row says 1 / sigma^2, less what the unknown
    # start takes (its rate and its drift in attitude).
    index = one.columns.index(Column("gyro_bias", "bias", 2))
    rows = 51 * sum(1 for _ in range(25, 1250 - 250, 250))
    most = rows / sensors.gyro**2
    assert 0.1 * most < one.matrix[index, index] < most


def test_lookalikes_look_alike_and_strangers_do_not(flights):
    info = information(BARE, cut(flights), SENSORS["capture"])
    change = {"rotor_drag": 6.0 * detectable(info.block("rotor_drag"), np.ones(1)) * np.ones(1)}
    near = left_over(info, change, "rotor_drag", "linear_drag", BARE)
    far = left_over(info, change, "rotor_drag", "com_offset", BARE)
    whole = 36.0 * 12.5
    assert near < 0.05 * whole and 0.5 * whole < far <= whole * (1 + 1e-6)


def test_every_effect_has_columns_but_what_cannot_be_told():
    names = {column.effect for column in columns_of(False)}
    assert names == set(nameable_effects()) - {"gusts"}
    assert Column("com_offset", "offset", 2) not in columns_of(False)
    sag = [c.parameter for c in columns_of(True) if c.effect == "battery_sag"]
    assert sag == ["per_volt"]
