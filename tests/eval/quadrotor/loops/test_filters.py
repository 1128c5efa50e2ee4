"""Filters by hand and by definition; each motor turns the body as its place and spin say."""

import numpy as np
import pytest

from eval.quadrotor.loops.filters import Pair, butterworth, layout_of, pt1, settled
from eval.quadrotor.vehicle_file import load_vehicle


def test_first_order_by_hand():
    """2 pi 100 0.002 = 1.256637; k = 1.256637 / 2.256637 = 0.556862."""
    out = pt1(np.array([1.0]), np.array([3.0]), np.asarray(100.0), 0.002)
    np.testing.assert_allclose(out, 1.0 + 2.0 * 0.556862, atol=2e-6)
    np.testing.assert_allclose(pt1(np.array([1.0]), np.array([3.0]), np.asarray(0.0), 0.002), 3.0)


@pytest.mark.parametrize(("hz", "gain"), [(0.01, 1.0), (30.0, 2.0**-0.5), (240.0, 0.01)])
def test_second_order_has_half_the_power_at_its_cutoff(hz, gain):
    memory, out, dt = Pair(np.zeros(1), np.zeros(1)), [], 0.002
    time = np.arange(0, 1 if hz > 1 else 30, dt)
    wave = np.sin(2 * np.pi * hz * time)
    for value in wave:
        memory, y = butterworth(memory, np.array([value]), np.asarray(30.0), dt)
        out.append(y[0])
    half = len(out) // 2
    ratio = np.std(out[half:]) / np.std(wave[half:])
    assert abs(ratio - gain) < 0.02


def test_a_settled_filter_stays_where_it_is():
    rest = settled(np.array([2.0]), np.asarray(30.0), 0.002)
    memory, out = butterworth(rest, np.array([2.0]), np.asarray(30.0), 0.002)
    np.testing.assert_allclose(out, 2.0)
    np.testing.assert_allclose(memory.first, rest.first)


def test_left_motors_roll_right_rear_ones_pitch_down_clockwise_ones_yaw_left():
    roll, pitch, yaw = layout_of(load_vehicle("crazyflie21").rotors)
    np.testing.assert_allclose(roll, [-1, -1, 1, 1])
    np.testing.assert_allclose(pitch, [-1, 1, 1, -1])
    np.testing.assert_allclose(yaw, [-1, 1, -1, 1])
