"""The engine against solutions worked by hand; its forces and torques are in test_air.py."""

import numpy as np
import pytest

from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery
from suite.blind.continuous.engine import fly
from suite.blind.continuous.quadrotor import quadrotor_of
from suite.blind.continuous.timing import schedule
from tests.support.vehicles import PLAIN, with_effects, with_lag

BATTERY = Battery(16.5, 0.02, 0.35)
HOVER = 9.81


def flown(vehicle, stamps, commands, speed=(0.0, 0.0, 0.0), push=None, loop_s=0.002, step_s=1e-3):
    """One flight from level, with `commands` (thrust, rates) row by row."""
    quadrotor = quadrotor_of(vehicle)
    start = np.zeros((1, 13))
    start[0, POS], start[0, VEL], start[0, QUAT] = [0, 0, 5.0], speed, [1, 0, 0, 0]
    stamps = np.array(stamps, dtype=float)[:, None]

    def pilot(seen):
        command = np.array([commands[min(seen.number, len(commands) - 1)]], dtype=float)
        return command, command

    plan = schedule(stamps, loop_s, quadrotor.delay, step_s)
    return fly(quadrotor, plan, start, pilot, np.random.default_rng(0), BATTERY, push)


def test_a_rotors_lag_is_that_of_first_order():
    # Omega from a to b: thrust is k (b + (a - b) e^(-t/tau))^2, summed by hand over 0.1 s.
    lagged, tau, time_s = with_lag(PLAIN, 0.03), 0.03, 0.1
    run = flown(lagged, [0.0, time_s], [(14.0, 0, 0, 0)])
    a, b = (np.sqrt(0.75 * c / 4 / 1.6e-6) for c in (HOVER, 14.0))
    left = np.exp(-time_s / tau)
    np.testing.assert_allclose(run.speed[-1, 0], b + (a - b) * left, rtol=1e-12)
    square = (
        b**2 * time_s + 2 * b * (a - b) * tau * (1 - left) + (a - b) ** 2 * tau / 2 * (1 - left**2)
    )
    climb = 4 * 1.6e-6 * square / 0.75 - HOVER * time_s
    assert run.state[-1, 0, VEL][2] == pytest.approx(climb, rel=1e-9)


def test_steady_wind_is_what_drag_brings_the_vehicle_to():
    truth = with_effects(linear_drag=((2.0, 2.0, 0.0),), constant_wind=((3.0, -1.0, 0.0),))
    vel_w = flown(truth, [0.0, 1.0], [(HOVER, 0, 0, 0)]).state[-1, 0, VEL]
    np.testing.assert_allclose(vel_w, (1 - np.exp(-2.0)) * np.array([3.0, -1.0, 0]), atol=1e-8)


def test_the_rate_loop_measures_at_its_ticks_and_at_rows_and_not_at_a_late_command():
    # Held torque: a period of length h moves the rate by K h (command - rate).
    run = flown(PLAIN, [0.0, 0.0037, 0.01], [(HOVER, 0.4, 0, 0), (HOVER, 0.4, 0, 0)])
    rate, expected = 0.0, []
    for held in (0.002, 0.0017, 0.002, 0.002, 0.002, 0.0003):
        rate += 20.0 * held * (0.4 - rate)
        expected.append(rate)
    ticks = np.flatnonzero(run.schedule.is_tick[:, 0])
    np.testing.assert_allclose(run.state[ticks[1:], 0, RATE][:, 0], expected[:-1], rtol=1e-9)
    assert run.state[-1, 0, RATE][0] == pytest.approx(expected[-1], rel=1e-9)
    late = with_effects(command_delay=(0.0013,))
    run = flown(late, [0.0, 0.002, 0.004], [(HOVER, 0.4, 0, 0), (HOVER, -5.0, 0, 0)])
    measured = 20.0 * 0.4 * 0.0007
    end = measured + 20.0 * (0.4 - measured) * 0.0013 + 20.0 * (-5.0 - measured) * 0.0007
    assert run.state[-1, 0, RATE][0] == pytest.approx(end, rel=1e-9)


def test_a_push_is_felt_and_kept():
    def push(seen, force_b, length_s):
        assert force_b[0, 2] == pytest.approx(0.75 * HOVER)
        return np.array([[0.75, 0.0, 0.0]])

    run = flown(PLAIN, [0.0, 0.5], [(HOVER, 0, 0, 0)], push=push)
    assert run.state[-1, 0, VEL][0] == pytest.approx(0.5) and run.push_b[3, 0, 0] == 0.75
    many = flown(PLAIN, [0.0, 0.1, 0.2, 0.3], [(HOVER, 0, 0, 0)] * 3, push=push)
    assert many.acc_b[1:, 0, 0] == pytest.approx(np.full(2, 0.75 / PLAIN.mass))


def test_the_accelerometer_is_that_of_before_the_command_and_the_voltage_falls_from_the_first_row():
    run = flown(PLAIN, [0.0, 0.5, 1.0], [(HOVER, 0, 0, 0), (2 * HOVER, 0, 0, 0)])
    np.testing.assert_allclose(run.acc_b[:, 0], [[0, 0, HOVER]] * 2, atol=1e-12)
    np.testing.assert_allclose(run.voltage[:, 0], [16.5, 16.5 - 0.02 * 0.5])
    later = flown(PLAIN, [0.0, 0.5, 1.0, 1.5], [(2 * HOVER, 0, 0, 0)])
    # Twice the squared speeds of a hover cost 0.35 V more.
    assert later.voltage[2, 0] == pytest.approx(16.5 - 0.02 - 0.35)
    assert later.acc_b[2, 0, 2] == pytest.approx(2 * HOVER)
    truth = with_effects(battery_sag=(0.0, 0.1))
    run = flown(truth, [-0.2, 0.0, 0.5], [(2 * HOVER, 0, 0, 0)])
    # The first row, at time 0, sees 16.15 V; half a second later it is 10 mV less.
    np.testing.assert_allclose(run.voltage[:, 0], [16.5, 16.15])
    climb = run.state[-1, 0, VEL][2] - run.state[run.schedule.block[1], 0, VEL][2]
    assert climb == pytest.approx(HOVER * 0.5 - 2 * HOVER * 0.1 * 0.02 * 0.5**2 / 2, rel=1e-6)
