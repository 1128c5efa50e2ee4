"""PX4's rate loop and allocation, against numbers worked by hand."""

from dataclasses import replace

import numpy as np

from eval.quadrotor.loops import px4
from eval.quadrotor.loops.filters import layout_of
from eval.quadrotor.vehicle_file import load_vehicle

LAYOUT = layout_of(load_vehicle("crazyflie21").rotors)
PLAIN = replace(px4.Settings(), IMU_GYRO_CUTOFF=0.0, IMU_DGYRO_CUTOFF=0.0)
RIGHT_LEFT = np.array([-1.0, -1.0, 1.0, 1.0])
ROOT = 2.0**-0.5


def look(state, throttle, wanted, rate, settings=PLAIN):
    gains = px4.gains(settings, LAYOUT)
    return px4.look(
        gains, state, np.asarray(throttle), np.array(wanted), np.array(rate), 0.002, np.ones(3)
    )


def test_three_looks_by_hand():
    """P 0.15 x 0.1 = 0.015, times 0.707 a motor.

    The integral of the first look acts in the second: 0.2 x 0.1 x 0.002 x (1 - (0.1 / 6.981317)^2)
    = 3.999179e-5. At 0.01 rad/s P is 0.0135 and D 0.003 x 0.01 / 0.002 = 0.015.
    """
    state, motor = look(px4.start((), np), 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.5 + 0.015 * ROOT * RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(state.integral[0], 3.999179e-5, rtol=1e-6)
    state, motor = look(state, 0.5, [0.1, 0.0, 0.0], [0.01, 0.0, 0.0])
    torque = 0.0135 + 3.999179e-5 - 0.015
    np.testing.assert_allclose(motor, 0.5 + torque * ROOT * RIGHT_LEFT, atol=1e-9)


def test_thrust_gives_way_to_roll_and_yaw_to_thrust():
    """0.98 +- 0.0707: lowered by 0.0507. Full thrust with 0.1 of yaw: lowered by 0.1."""
    given = px4.allocate(LAYOUT, np.asarray(0.98), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(given, 1.0 - 0.1 * ROOT * (1.0 - RIGHT_LEFT), atol=1e-9)
    given = px4.allocate(LAYOUT, np.asarray(1.0), np.array([0.0, 0.0, 0.1]))
    np.testing.assert_allclose(given, [0.8, 1.0, 0.8, 1.0], atol=1e-9)


def test_without_airmode_no_thrust_is_added_for_roll():
    """At 0.02 of thrust roll is taken back until the lowest motors are at zero: +-0.02."""
    given = px4.allocate(LAYOUT, np.asarray(0.02), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(given, 0.02 + 0.02 * RIGHT_LEFT, atol=1e-9)


def test_no_integral_into_saturation():
    state, _ = look(px4.start((), np), 0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert state.lost[0] > 0.1
    after, _ = look(state, 0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(after.integral, state.integral)


def test_no_integral_into_what_the_clip_takes_from_yaw():
    """Torque 0.54 at a thrust of 0.6: 1.14 and 0.06, lowered by 0.14 to 1 and -0.08, clipped to 0.

    Of the 0.54 there are 0.5 left.
    """
    settings = replace(PLAIN, MC_YAWRATE_P=0.54)
    state, motor = look(px4.start((), np), 0.6, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], settings)
    np.testing.assert_allclose(motor, [0.0, 1.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(state.lost, [0.0, 0.0, 0.04], atol=1e-9)
    after, _ = look(state, 0.6, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], settings)
    np.testing.assert_allclose(after.integral, state.integral)


def test_thrust_is_no_torque_on_uneven_arms():
    """Rear arms of half the length: what thrust alone gives is not taken for a lost torque."""
    rotors = load_vehicle("crazyflie21").rotors
    hubs = [(x if x > 0.0 else 0.5 * x, y, z) for x, y, z in rotors.position]
    gains = px4.gains(PLAIN, layout_of(replace(rotors, position=tuple(hubs))))
    asked = np.array([0.1, -0.1, 0.05])
    state, motor = px4.look(
        gains, px4.start((), np), np.asarray(0.5), asked, np.zeros(3), 0.002, np.ones(3)
    )
    assert 0.0 < motor.min() and motor.max() < 1.0
    np.testing.assert_array_equal(state.lost, 0.0)


def test_the_slope_of_the_gyro_is_filtered_to_first_order():
    """At 30 Hz and 500 Hz k = 0.376991 / 1.376991 = 0.273779 of a slope of 5 rad/s^2."""
    settings = replace(PLAIN, IMU_DGYRO_CUTOFF=30.0)
    state, _ = look(px4.start((), np), 0.5, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], settings)
    for k, left in ((1, 1.0 - 0.273779), (2, (1.0 - 0.273779) ** 2)):
        state, _ = look(state, 0.5, [0.0, 0.0, 0.0], [0.01 * k, 0.0, 0.0], settings)
        np.testing.assert_allclose(state.accel[0], 5.0 * (1.0 - left), rtol=1e-5)
    # From half the sampling rate on it passes all.
    settings = replace(PLAIN, IMU_DGYRO_CUTOFF=250.0)
    state, _ = look(state, 0.5, [0.0, 0.0, 0.0], [0.01, 0.0, 0.0], settings)
    np.testing.assert_allclose(state.accel[0], -5.0)


def test_the_integrals_limit_is_one_of_torque():
    """As much with K = 2: 0.3 of roll, of which roll's 0.707 goes to a motor."""
    twice = replace(PLAIN, MC_ROLLRATE_K=2.0)
    state = px4.start((), np)._replace(integral=np.array([0.29999, 0.0, 0.0]))
    after, _ = look(state, 0.5, [0.2, 0.0, 0.0], [0.0, 0.0, 0.0], twice)
    assert after.integral[0] == PLAIN.MC_RR_INT_LIM == 0.3
    _, motor = look(after, 0.5, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], twice)
    np.testing.assert_allclose(motor, 0.5 + 0.3 * ROOT * RIGHT_LEFT, atol=1e-9)


def test_the_thrust_model_is_undone():
    """0.5 u^2 + 0.5 u = 0.375 at u = 0.5."""
    np.testing.assert_allclose(px4.signal(np.asarray(0.5), np.array([0.375, 1.0])), [0.5, 1.0])
    _, motor = look(
        px4.start((), np), 0.5, [0, 0, 0], [0.0, 0.0, 0.0], replace(PLAIN, THR_MDL_FAC=0.3)
    )
    np.testing.assert_allclose(motor, 0.5)
