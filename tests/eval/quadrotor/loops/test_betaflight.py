"""Betaflight's rate loop and mixer, against numbers worked by hand."""

from dataclasses import replace

import numpy as np

from eval.quadrotor.loops import betaflight
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


def look(state, throttle, wanted, rate, settings=UNFILTERED):
    gains = betaflight.gains(settings, LAYOUT)
    return betaflight.look(
        gains, state, np.asarray(throttle), np.array(wanted), np.array(rate), 0.002, np.ones(3)
    )


def test_two_looks_by_hand():
    """0.1 rad/s is 5.729578 deg/s.

    First: P 0.032029 x 45 x 5.729578 = 8.258054, I 0.244381 x 80 x 5.729578 x 0.002 = 0.224032:
    0.008482086 of the range, 0.945 of a motor's. Second, the set point at 0.12 rad/s (change
    1.1459156 / 0.002 = 572.9578 deg/s^2) and the rate at 0.01 (0.5729578): P 9.083859 (e =
    6.3025357), I 0.224032 + 0.246435, D -0.000529 x 30 x 286.4789 = -4.546420, F 0.00013754 x 120 x
    572.9578 = 9.456555: 14.464461.
    """
    state, motor = look(betaflight.start((), np), 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.5 + 0.945 * 0.008482086 * RIGHT_LEFT, atol=1e-8)
    state, motor = look(state, 0.25, [0.12, 0.0, 0.0], [0.01, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.25 + 0.945 * 0.014464461 * RIGHT_LEFT, atol=1e-7)


def test_the_i_of_yaw_counts_two_and_a_half_times():
    """0.244381 x 80 x 2.5 x 5.729578 x 0.002 of yaw, 0.244381 x 80 x 5.729578 x 0.002 of roll."""
    state, _ = look(betaflight.start((), np), 0.5, [0.1, 0.0, 0.1], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(state.integral, [0.224032, 0.0, 0.560080], atol=1e-6)


def test_d_falls_above_the_breakpoint():
    """At full throttle D has lost 65 %: -0.35 x 4.546420."""
    state, _ = look(betaflight.start((), np), 0.6, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    settings = replace(UNFILTERED, p_roll=0.0, i_roll=0.0)
    _, motor = look(state, 0.999999, [0.0, 0.0, 0.0], [0.01, 0.0, 0.0], settings)
    np.testing.assert_allclose(np.ptp(motor), 2 * 0.945 * 0.35 * 0.004546420, rtol=1e-4)


def test_airmode_scales_the_range_and_moves_the_throttle():
    gains = betaflight.gains(UNFILTERED, LAYOUT)
    span, motor = betaflight.mixed(gains, np.asarray(0.0), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(span, 0.2)
    np.testing.assert_allclose(motor, 0.055 + 0.945 * np.array([0.0, 0.0, 0.2, 0.2]))
    span, motor = betaflight.mixed(gains, np.asarray(0.9), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(span, 2.0)
    np.testing.assert_allclose(motor, [0.055, 0.055, 1.0, 1.0])


def test_the_integral_stops_near_full_motors_and_by_fast_set_points():
    state, _ = look(betaflight.start((), np), 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    full = state._replace(span=np.asarray(1.0))
    after, _ = look(full, 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(after.integral, full.integral)
    never = replace(UNFILTERED, iterm_windup=100.0)
    after, _ = look(full, 0.5, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0], never)
    np.testing.assert_allclose(after.integral[0], 2 * 0.224032, atol=1e-6)
    relaxing = replace(UNFILTERED, iterm_relax_cutoff=15.0)
    jump, _ = look(state, 0.5, [3.0, 0.0, 0.0], [0.0, 0.0, 0.0], relaxing)
    np.testing.assert_allclose(jump.integral[0], state.integral[0])
