"""Forces, torques and the state's derivative, worked by hand."""

import numpy as np
import pytest

from suite.blind.continuous.air import Wind
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery, Body, rotation
from suite.blind.continuous.quadrotor import quadrotor_of
from tests.support.vehicles import PLAIN, with_effects

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
    force_b, torque_b, _ = body.forces(state_of(**state), SPEED, NOW, body.blowing)
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
