"""The Crazyflie's rate loop, against numbers worked by hand."""

import numpy as np

from eval.quadrotor.loops import crazyflie
from eval.quadrotor.loops.filters import layout_of
from eval.quadrotor.vehicle_file import load_vehicle

GAINS = crazyflie.gains(crazyflie.Settings(), layout_of(load_vehicle("crazyflie21").rotors))
ONE = np.ones(3)


def look(state, throttle, wanted, rate):
    return crazyflie.look(
        GAINS, state, np.asarray(throttle), np.array(wanted), np.array(rate), 0.002, ONE
    )


def test_two_looks_by_hand():
    """0.1 rad/s is 5.729578 deg/s.

    First: P 250 x 5.729578 = 1432.394, I 500 x 5.729578 x 0.002 = 5.729578: 1438.124, half of it
    off M1 and M2 (right) and onto M3 and M4 (left). Second, at 0.01 rad/s: P 1289.155,
    I 500 x 0.021772396 = 10.886198, D -2.5 x 0.5729578 / 0.002 = -716.197: 583.844.
    """
    state = crazyflie.start((), np)
    state, motor = look(state, 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    share = 0.5 * 1438.124 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, -1, 1, 1]), atol=1e-7)
    state, motor = look(state, 0.5, [0.1, 0.0, 0.0], [0.01, 0.0, 0.0])
    share = 0.5 * 583.844 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, -1, 1, 1]), atol=1e-7)


def test_yaw_counts_whole_and_against_the_spin():
    """120 x 5.729578 + 16.7 x 0.01145916 = 687.741 on M2 and M4, which turn clockwise."""
    _, motor = look(crazyflie.start((), np), 0.5, [0.0, 0.0, 0.1], [0.0, 0.0, 0.0])
    share = 687.741 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, 1, -1, 1]), atol=1e-7)


def test_a_limit_of_0_is_none_as_in_the_firmware():
    free = crazyflie.gains(crazyflie.Settings(roll_ilimit=0.0), GAINS.layout)
    state = crazyflie.start((), np)._replace(integral=np.array([40.0, 0.0, 0.0]))
    state, _ = crazyflie.look(
        free, state, np.asarray(0.5), np.array([0.1, 0.0, 0.0]), np.zeros(3), 0.002, ONE
    )
    np.testing.assert_allclose(state.integral[0], 40.0 + 5.729578 * 0.002)


def test_the_integral_is_limited_and_full_motors_lower_all():
    state = crazyflie.start((), np)._replace(integral=np.array([33.2999, 0.0, 0.0]))
    state, motor = look(state, 0.95, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(state.integral[0], 33.3)
    # P 14323.94 + I 16650 = 30973.94: 0.95 +- 0.236316, lowered by 0.186316.
    np.testing.assert_allclose(motor, [0.527368, 0.527368, 1.0, 1.0], atol=1e-5)
