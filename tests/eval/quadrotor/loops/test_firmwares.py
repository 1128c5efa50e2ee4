"""Rate loops and mixers of Betaflight, the Crazyflie and PX4, against numbers worked by hand."""

from dataclasses import replace

import numpy as np

from eval.quadrotor.loops import betaflight, crazyflie, px4
from eval.quadrotor.loops.filters import layout_of
from eval.quadrotor.vehicle_file import load_vehicle

LAYOUT = layout_of(load_vehicle("crazyflie21").rotors)

UNFILTERED = replace(
    betaflight.Settings(),
    gyro_lpf1_static_hz=0.0,
    gyro_lpf2_static_hz=0.0,
    dterm_lpf1_static_hz=0.0,
    dterm_lpf2_static_hz=0.0,
    rc_smoothing_setpoint_cutoff=0.0,
    iterm_relax_cutoff=0.0,
)

RIGHT_LEFT = np.array([-1.0, -1.0, 1.0, 1.0])


def betaflight_look(state, throttle, wanted, rate, settings=UNFILTERED):
    gains = betaflight.gains(settings, LAYOUT)
    return betaflight.update(
        gains, state, np.asarray(throttle), np.array(wanted), np.array(rate), 0.002, np.ones(3)
    )


def test_two_looks_of_betaflight_by_hand():
    """0.1 rad/s is 5.729578 deg/s.

    First: P 0.032029 x 45 x 5.729578 = 8.258054, I 0.244381 x 80 x 5.729578 x 0.002 = 0.224032:
    0.008482086 of the range, 0.945 of a motor's. Second, the set point at 0.12 rad/s (change
    1.1459156 / 0.002 = 572.9578 deg/s^2) and the rate at 0.01 (0.5729578): P 9.083859 (e =
    6.3025357), I 0.224032 + 0.246435, D -0.000529 x 30 x 286.4789 = -4.546420, F 0.00013754 x 120 x
    572.9578 = 9.456555: 14.464461.
    """
    state, motor = betaflight_look(betaflight.start((), np), 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.5 + 0.945 * 0.008482086 * RIGHT_LEFT, atol=1e-8)
    state, motor = betaflight_look(state, 0.25, [0.12, 0.0, 0.0], [0.01, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.25 + 0.945 * 0.014464461 * RIGHT_LEFT, atol=1e-7)


def test_the_i_of_betaflights_yaw_counts_two_and_a_half_times():
    """0.244381 x 80 x 2.5 x 5.729578 x 0.002 of yaw, 0.244381 x 80 x 5.729578 x 0.002 of roll."""
    state, _ = betaflight_look(betaflight.start((), np), 0.5, [0.1, 0.0, 0.1], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(state.integral, [0.224032, 0.0, 0.560080], atol=1e-6)


def test_betaflights_d_falls_above_the_breakpoint():
    """At full throttle D has lost 65 %: -0.35 x 4.546420."""
    state, _ = betaflight_look(betaflight.start((), np), 0.6, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    settings = replace(UNFILTERED, p_roll=0.0, i_roll=0.0)
    _, motor = betaflight_look(state, 0.999999, [0.0, 0.0, 0.0], [0.01, 0.0, 0.0], settings)
    np.testing.assert_allclose(np.ptp(motor), 2 * 0.945 * 0.35 * 0.004546420, rtol=1e-4)


def test_betaflights_airmode_scales_the_range_and_moves_the_throttle():
    gains = betaflight.gains(UNFILTERED, LAYOUT)
    span, motor = betaflight.mixed(gains, np.asarray(0.0), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(span, 0.2)
    np.testing.assert_allclose(motor, 0.055 + 0.945 * np.array([0.0, 0.0, 0.2, 0.2]))
    span, motor = betaflight.mixed(gains, np.asarray(0.9), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(span, 2.0)
    np.testing.assert_allclose(motor, [0.055, 0.055, 1.0, 1.0])


def test_betaflights_integral_stops_near_full_motors_and_by_fast_set_points():
    state, _ = betaflight_look(betaflight.start((), np), 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    full = state._replace(span=np.asarray(1.0))
    after, _ = betaflight_look(full, 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(after.integral, full.integral)
    never = replace(UNFILTERED, iterm_windup=100.0)
    after, _ = betaflight_look(full, 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0], never)
    np.testing.assert_allclose(after.integral[0], 2 * 0.224032, atol=1e-6)
    relaxing = replace(UNFILTERED, iterm_relax_cutoff=15.0)
    jump, _ = betaflight_look(state, 0.5, [3.0, 0.0, 0.0], [0.0, 0.0, 0.0], relaxing)
    np.testing.assert_allclose(jump.integral[0], state.integral[0])


CRAZYFLIE = crazyflie.gains(crazyflie.Settings(), layout_of(load_vehicle("crazyflie21").rotors))

ONE = np.ones(3)


def crazyflie_look(state, throttle, wanted, rate):
    return crazyflie.update(
        CRAZYFLIE, state, np.asarray(throttle), np.array(wanted), np.array(rate), 0.002, ONE
    )


def test_two_looks_of_the_crazyflie_by_hand():
    """0.1 rad/s is 5.729578 deg/s.

    First: P 250 x 5.729578 = 1432.394, I 500 x 5.729578 x 0.002 = 5.729578: 1438.124, half of it
    off M1 and M2 (right) and onto M3 and M4 (left). Second, at 0.01 rad/s: P 1289.155,
    I 500 x 0.021772396 = 10.886198, D -2.5 x 0.5729578 / 0.002 = -716.197: 583.844.
    """
    state = crazyflie.start((), np)
    state, motor = crazyflie_look(state, 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    share = 0.5 * 1438.124 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, -1, 1, 1]), atol=1e-7)
    state, motor = crazyflie_look(state, 0.5, [0.1, 0.0, 0.0], [0.01, 0.0, 0.0])
    share = 0.5 * 583.844 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, -1, 1, 1]), atol=1e-7)


def test_the_crazyflies_yaw_counts_whole_and_against_the_spin():
    """120 x 5.729578 + 16.7 x 0.01145916 = 687.741 on M2 and M4, which turn clockwise."""
    _, motor = crazyflie_look(crazyflie.start((), np), 0.5, [0.0, 0.0, 0.1], [0.0, 0.0, 0.0])
    share = 687.741 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, 1, -1, 1]), atol=1e-7)


def test_the_crazyflies_limit_of_0_is_none_as_in_the_firmware():
    free = crazyflie.gains(crazyflie.Settings(roll_ilimit=0.0), CRAZYFLIE.layout)
    state = crazyflie.start((), np)._replace(integral=np.array([40.0, 0.0, 0.0]))
    state, _ = crazyflie.update(
        free, state, np.asarray(0.5), np.array([0.1, 0.0, 0.0]), np.zeros(3), 0.002, ONE
    )
    np.testing.assert_allclose(state.integral[0], 40.0 + 5.729578 * 0.002)


def test_the_crazyflies_integral_is_limited_and_full_motors_lower_all():
    state = crazyflie.start((), np)._replace(integral=np.array([33.2999, 0.0, 0.0]))
    state, motor = crazyflie_look(state, 0.95, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(state.integral[0], 33.3)
    # P 14323.94 + I 16650 = 30973.94: 0.95 +- 0.236316, lowered by 0.186316.
    np.testing.assert_allclose(motor, [0.527368, 0.527368, 1.0, 1.0], atol=1e-5)


PLAIN = replace(px4.Settings(), IMU_GYRO_CUTOFF=0.0, IMU_DGYRO_CUTOFF=0.0)

ROOT = 2.0**-0.5


def px4_look(state, throttle, wanted, rate, settings=PLAIN):
    gains = px4.gains(settings, LAYOUT)
    return px4.update(
        gains, state, np.asarray(throttle), np.array(wanted), np.array(rate), 0.002, np.ones(3)
    )


def test_three_looks_of_px4_by_hand():
    """P 0.15 x 0.1 = 0.015, times 0.707 a motor.

    The integral of the first look acts in the second: 0.2 x 0.1 x 0.002 x (1 - (0.1 / 6.981317)^2)
    = 3.999179e-5. At 0.01 rad/s P is 0.0135 and D 0.003 x 0.01 / 0.002 = 0.015.
    """
    state, motor = px4_look(px4.start((), np), 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.5 + 0.015 * ROOT * RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(state.integral[0], 3.999179e-5, rtol=1e-6)
    state, motor = px4_look(state, 0.5, [0.1, 0.0, 0.0], [0.01, 0.0, 0.0])
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


def test_no_integral_of_px4_into_saturation():
    state, _ = px4_look(px4.start((), np), 0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert state.lost[0] > 0.1
    after, _ = px4_look(state, 0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(after.integral, state.integral)


def test_no_integral_of_px4_into_what_the_clip_takes_from_yaw():
    """Torque 0.54 at a thrust of 0.6: 1.14 and 0.06, lowered by 0.14 to 1 and -0.08, clipped to 0.

    Of the 0.54 there are 0.5 left.
    """
    settings = replace(PLAIN, MC_YAWRATE_P=0.54)
    state, motor = px4_look(px4.start((), np), 0.6, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], settings)
    np.testing.assert_allclose(motor, [0.0, 1.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(state.lost, [0.0, 0.0, 0.04], atol=1e-9)
    after, _ = px4_look(state, 0.6, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], settings)
    np.testing.assert_allclose(after.integral, state.integral)


def test_thrust_is_no_torque_on_uneven_arms():
    """Rear arms of half the length: what thrust alone gives is not taken for a lost torque."""
    rotors = load_vehicle("crazyflie21").rotors
    hubs = [(x if x > 0.0 else 0.5 * x, y, z) for x, y, z in rotors.position]
    gains = px4.gains(PLAIN, layout_of(replace(rotors, position=tuple(hubs))))
    asked = np.array([0.1, -0.1, 0.05])
    state, motor = px4.update(
        gains, px4.start((), np), np.asarray(0.5), asked, np.zeros(3), 0.002, np.ones(3)
    )
    assert 0.0 < motor.min() and motor.max() < 1.0
    np.testing.assert_array_equal(state.lost, 0.0)


def test_the_slope_of_the_gyro_is_filtered_to_first_order():
    """At 30 Hz and 500 Hz k = 0.376991 / 1.376991 = 0.273779 of a slope of 5 rad/s^2."""
    settings = replace(PLAIN, IMU_DGYRO_CUTOFF=30.0)
    state, _ = px4_look(px4.start((), np), 0.5, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], settings)
    for k, left in ((1, 1.0 - 0.273779), (2, (1.0 - 0.273779) ** 2)):
        state, _ = px4_look(state, 0.5, [0.0, 0.0, 0.0], [0.01 * k, 0.0, 0.0], settings)
        np.testing.assert_allclose(state.accel[0], 5.0 * (1.0 - left), rtol=1e-5)
    # From half the sampling rate on it passes all.
    settings = replace(PLAIN, IMU_DGYRO_CUTOFF=250.0)
    state, _ = px4_look(state, 0.5, [0.0, 0.0, 0.0], [0.01, 0.0, 0.0], settings)
    np.testing.assert_allclose(state.accel[0], -5.0)


def test_the_integrals_limit_is_one_of_torque():
    """As much with K = 2: 0.3 of roll, of which roll's 0.707 goes to a motor."""
    twice = replace(PLAIN, MC_ROLLRATE_K=2.0)
    state = px4.start((), np)._replace(integral=np.array([0.29999, 0.0, 0.0]))
    after, _ = px4_look(state, 0.5, [0.2, 0.0, 0.0], [0.0, 0.0, 0.0], twice)
    assert after.integral[0] == PLAIN.MC_RR_INT_LIM == 0.3
    _, motor = px4_look(after, 0.5, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], twice)
    np.testing.assert_allclose(motor, 0.5 + 0.3 * ROOT * RIGHT_LEFT, atol=1e-9)


def test_the_thrust_model_is_undone():
    """0.5 u^2 + 0.5 u = 0.375 at u = 0.5."""
    np.testing.assert_allclose(px4.signal(np.asarray(0.5), np.array([0.375, 1.0])), [0.5, 1.0])
    _, motor = px4_look(
        px4.start((), np), 0.5, [0, 0, 0], [0.0, 0.0, 0.0], replace(PLAIN, THR_MDL_FAC=0.3)
    )
    np.testing.assert_allclose(motor, 0.5)
