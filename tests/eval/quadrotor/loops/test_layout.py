"""Each motor turns the body the way its place and spin say."""

import numpy as np

from eval.quadrotor.loops.filters import layout_of
from eval.quadrotor.vehicle_file import load_vehicle


def test_left_motors_roll_right_rear_ones_pitch_down_clockwise_ones_yaw_left():
    roll, pitch, yaw = layout_of(load_vehicle("crazyflie21").rotors)
    np.testing.assert_allclose(roll, [-1, -1, 1, 1])
    np.testing.assert_allclose(pitch, [-1, 1, 1, -1])
    np.testing.assert_allclose(yaw, [-1, 1, -1, 1])
