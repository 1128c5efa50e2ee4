"""The engine, its forces and torques against solutions worked by hand."""

import numpy as np
import pytest

from suite.blind.continuous.air import Wind
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery, Body, rotation
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


def test_a_climb_without_lag_is_a_parabola():
    end = flown(PLAIN, [0.0, 0.5, 1.0], [(12.81, 0, 0, 0)]).state[-1, 0]
    np.testing.assert_allclose(end[POS], [0.0, 0.0, 6.5], atol=1e-12)
    np.testing.assert_allclose(end[VEL], [0.0, 0.0, 3.0], atol=1e-12)


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


def test_a_fall_against_linear_drag():
    run = flown(with_effects(linear_drag=((0.3, 0.2, 0.5),)), [0.0, 1.0], [(0.0, 0, 0, 0)])
    assert run.state[-1, 0, VEL][2] == pytest.approx(-HOVER / 0.5 * (1 - np.exp(-0.5)), rel=1e-8)


def test_steady_wind_is_what_drag_brings_the_vehicle_to():
    truth = with_effects(linear_drag=((2.0, 2.0, 0.0),), constant_wind=((3.0, -1.0, 0.0),))
    vel_w = flown(truth, [0.0, 1.0], [(HOVER, 0, 0, 0)]).state[-1, 0, VEL]
    np.testing.assert_allclose(vel_w, (1 - np.exp(-2.0)) * np.array([3.0, -1.0, 0]), atol=1e-8)


def test_the_rate_loop_measures_at_its_ticks_and_anew_at_every_row():
    # Held torque: a period of length h moves the rate by K h (command - rate).
    run = flown(PLAIN, [0.0, 0.0037, 0.01], [(HOVER, 0.4, 0, 0), (HOVER, 0.4, 0, 0)])
    rate, expected = 0.0, []
    for held in (0.002, 0.0017, 0.002, 0.002, 0.002, 0.0003):
        rate += 20.0 * held * (0.4 - rate)
        expected.append(rate)
    ticks = np.flatnonzero(run.schedule.is_tick[:, 0])
    np.testing.assert_allclose(run.state[ticks[1:], 0, RATE][:, 0], expected[:-1], rtol=1e-9)
    assert run.state[-1, 0, RATE][0] == pytest.approx(expected[-1], rel=1e-9)


def test_a_command_that_comes_inside_a_period_acts_from_then():
    # 1.3 ms late: until then a hover, and the rate is still the one measured at the tick.
    late = with_effects(command_delay=(0.0013,))
    run = flown(late, [0.0, 0.002], [(HOVER + 2.0, 0.4, 0, 0)])
    end = run.state[-1, 0]
    assert end[RATE][0] == pytest.approx(20.0 * 0.4 * 0.0007, rel=1e-9)
    assert end[VEL][2] == pytest.approx(2.0 * 0.0007, rel=1e-5)


def test_a_command_inside_a_period_meets_the_rates_of_the_last_tick():
    late = with_effects(command_delay=(0.0013,))
    run = flown(late, [0.0, 0.002, 0.004], [(HOVER, 0.4, 0, 0), (HOVER, -5.0, 0, 0)])
    measured = 20.0 * 0.4 * 0.0007
    end = measured + 20.0 * (0.4 - measured) * 0.0013 + 20.0 * (-5.0 - measured) * 0.0007
    assert run.state[-1, 0, RATE][0] == pytest.approx(end, rel=1e-9)


def test_the_last_command_holds_until_the_next_arrives():
    late = with_effects(command_delay=(0.013,))
    commands = [(HOVER + 1.0, 0, 0, 0), (HOVER - 1.0, 0, 0, 0), (HOVER + 1.0, 0, 0, 0)]
    run = flown(late, [0.0, 0.01, 0.031, 0.04], commands)
    # Up from 13 to 23 ms, down from 23 to 40 ms; the third command would come at 44 ms.
    assert run.state[-1, 0, VEL][2] == pytest.approx(0.010 - 0.017, abs=1e-9)


def test_a_spin_without_torque_keeps_its_momentum():
    # The rate loop cancels w x (J w) at each tick; rotors at rest give no torque at all.
    quadrotor = quadrotor_of(PLAIN)
    start = np.zeros((1, 13))
    start[0, QUAT], start[0, RATE] = [1, 0, 0, 0], [3.0, -4.0, 2.0]

    def pilot(seen):
        # What the loop then asks for is no torque: the rates of a free body.
        rate_b, inertia = seen.rate_b[0], quadrotor.inertia
        turning = np.cross(rate_b, inertia * rate_b)
        command = np.append(0.0, rate_b - turning / (inertia * quadrotor.nominal.rate_gain))
        return command[None], command[None]

    def momentum(state):
        spin_b = quadrotor.inertia * state[:, RATE]
        return (rotation(state[:, QUAT]) @ spin_b[:, :, None])[0, :, 0]

    stamps = np.arange(0, 0.2001, 5e-4)[:, None]
    plan = schedule(stamps, 0.002, 0.0)
    run = fly(quadrotor, plan, start, pilot, np.random.default_rng(0), BATTERY)
    np.testing.assert_allclose(momentum(run.state[-1]), momentum(start), rtol=1e-9)
    assert np.abs(run.state[-1, 0, RATE] - start[0, RATE]).max() > 0.1, "it tumbled"


def test_a_push_is_felt_and_kept():
    def push(seen, force_b, length_s):
        assert force_b[0, 2] == pytest.approx(0.75 * HOVER)
        return np.array([[0.75, 0.0, 0.0]])

    run = flown(PLAIN, [0.0, 0.5], [(HOVER, 0, 0, 0)], push=push)
    assert run.state[-1, 0, VEL][0] == pytest.approx(0.5) and run.push_b[3, 0, 0] == 0.75
    many = flown(PLAIN, [0.0, 0.1, 0.2, 0.3], [(HOVER, 0, 0, 0)] * 3, push=push)
    assert many.acc_b[1:, 0, 0] == pytest.approx(np.full(2, 0.75 / PLAIN.mass))


def test_the_accelerometer_is_that_of_before_the_command_and_the_voltage_falls():
    run = flown(PLAIN, [0.0, 0.5, 1.0], [(HOVER, 0, 0, 0), (2 * HOVER, 0, 0, 0)])
    np.testing.assert_allclose(run.acc_b[:, 0], [[0, 0, HOVER]] * 2, atol=1e-12)
    np.testing.assert_allclose(run.voltage[:, 0], [16.5, 16.5 - 0.02 * 0.5])
    later = flown(PLAIN, [0.0, 0.5, 1.0, 1.5], [(2 * HOVER, 0, 0, 0)])
    # Twice the squared speeds of a hover cost 0.35 V more.
    assert later.voltage[2, 0] == pytest.approx(16.5 - 0.02 - 0.35)
    assert later.acc_b[2, 0, 2] == pytest.approx(2 * HOVER)


def test_sag_goes_by_the_voltage_of_the_first_row():
    truth = with_effects(battery_sag=(0.0, 0.1))
    run = flown(truth, [-0.2, 0.0, 0.5], [(2 * HOVER, 0, 0, 0)])
    # The first row, at time 0, sees 16.15 V; half a second later it is 10 mV less.
    assert run.voltage[1, 0] == pytest.approx(16.15)
    climb = run.state[-1, 0, VEL][2] - run.state[run.schedule.block[1], 0, VEL][2]
    assert climb == pytest.approx(HOVER * 0.5 - 2 * HOVER * 0.1 * 0.02 * 0.5**2 / 2, rel=1e-6)


SPEED = np.array([[1000.0, 500.0, 1500.0, 1000.0]])
"""Thrusts of 1.6, 0.4, 3.6 and 1.6 N."""
NOW = np.zeros((1, 1))


def body_of(vehicle=PLAIN):
    quadrotor = quadrotor_of(vehicle)
    wind = Wind(quadrotor.effects, 1, np.random.default_rng(0))
    return Body(quadrotor, wind, Battery(16.0, 0.1, 0.3), np.full((1, 1), 4e6))


def state_of(vel=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0)):
    state = np.zeros((1, 13))
    state[0, POS], state[0, VEL], state[0, QUAT], state[0, RATE] = [0, 0, 9], vel, quat, rate
    return state


def wrench(vehicle=PLAIN, **state):
    body = body_of(vehicle)
    force_b, torque_b, _ = body.forces(state_of(**state), SPEED, NOW, body.wind_at_start_w)
    return force_b[0], torque_b[0]


def test_a_quaternion_turns_the_body_to_the_world():
    quarter = np.sqrt([[0.5, 0.0, 0.0, 0.5]])
    np.testing.assert_allclose(rotation(quarter)[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    about_x = np.array([[np.cos(0.1), np.sin(0.1), 0.0, 0.0]])
    cos, sin = np.cos(0.2), np.sin(0.2)
    np.testing.assert_allclose(
        rotation(about_x)[0], [[1, 0, 0], [0, cos, -sin], [0, sin, cos]], atol=1e-15
    )


def test_rotors_push_up_turn_by_their_arms_and_against_their_spin():
    force_b, torque_b = wrench()
    np.testing.assert_allclose(force_b, [0.0, 0.0, 7.2])
    # y f: (-1.6 - 0.4 + 3.6 + 1.6) 0.1; -x f: -(1.6 - 0.4 - 3.6 + 1.6) 0.075;
    # -s k_Q Omega^2: -2.2e-8 (1 - 0.25 + 2.25 - 1) 1e6.
    np.testing.assert_allclose(torque_b, [0.32, 0.06, -0.044], atol=1e-15)


def test_a_tilted_thrust_and_a_moved_centre_of_mass():
    force_b, torque_b = wrench(with_effects(thrust_tilt=((0.0, 0.1),)))
    np.testing.assert_allclose(force_b, 7.2 * np.array([np.sin(0.1), 0.0, np.cos(0.1)]))
    np.testing.assert_allclose(torque_b, [0.32, 0.06, -0.044], atol=1e-15)
    # Arms r - d: the torque changes by -d_y f, +d_x f.
    _, moved = wrench(with_effects(com_offset=((0.01, 0.02, 0.3),)))
    np.testing.assert_allclose(moved, [0.32 - 0.144, 0.06 + 0.072, -0.044], atol=1e-15)


def test_airspeed_is_relative_to_the_wind_in_body_axes():
    truth = with_effects(linear_drag=((1.0, 2.0, 3.0),), constant_wind=((1.0, 0.0, 0.0),))
    quarter = np.sqrt([0.5, 0.0, 0.0, 0.5])
    # 3 m/s along world y against a wind along x: (3, 1, 0) seen from a body that looks along y.
    force_b, _ = wrench(truth, vel=(0.0, 3.0, 0.0), quat=quarter)
    np.testing.assert_allclose(force_b - [0, 0, 7.2], -0.75 * np.array([3.0, 2.0, 0.0]), atol=1e-14)


def test_the_derivative_of_a_tumbling_body():
    body = body_of(with_effects(mass_offset=(0.05,), inertia_scale=((1.0, 2.0, 1.0),)))
    quarter, rate = np.sqrt([0.5, 0.0, 0.0, 0.5]), np.array([1.0, 2.0, 3.0])
    state = state_of((4.0, 5.0, 6.0), quarter, rate)
    change = body.derivative(state, SPEED, NOW, 0.0, np.array([[0.8, 0.0, 0.0]]))[0]
    np.testing.assert_array_equal(change[POS], [4.0, 5.0, 6.0])
    # 7.2 N up and 0.8 N along the nose, which looks along world y, on 0.8 kg.
    np.testing.assert_allclose(change[VEL], [0.0, 1.0, 9.0 - 9.81], atol=1e-14)
    # q (0, w) / 2 with q = (r, 0, 0, r): (-3, 1 - 2, 2 + 1, 3) r / 2
    root = np.sqrt(0.5)
    np.testing.assert_allclose(change[QUAT], 0.5 * root * np.array([-3.0, -1.0, 3.0, 3.0]))
    # w x (J w) with J = (2.5, 4.2, 4.3) 1e-3: ((4.3 - 4.2) 6, (2.5 - 4.3) 3, (4.2 - 2.5) 2) 1e-3
    turning = np.array([0.6e-3, -5.4e-3, 3.4e-3])
    torque = np.array([0.32, 0.06, -0.044])
    np.testing.assert_allclose(change[RATE], (torque - turning) / [2.5e-3, 4.2e-3, 4.3e-3])


def test_voltage_falls_with_time_and_power():
    body = body_of()
    # 4.5e6 (rad/s)^2 in place of 4e6 in a hover: an eighth more power.
    assert body.drop(np.array([[2.0]]), SPEED)[0, 0] == pytest.approx(0.2 + 0.3 / 8.0)
    assert body.drop(np.array([[-2.0]]), SPEED)[0, 0] == pytest.approx(0.3 / 8.0)
