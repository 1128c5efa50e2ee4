"""The map of motor commands to thrust, against numbers worked by hand."""

from dataclasses import replace

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle, parse_vehicle, vehicle_table
from eval.vehicles.vehicle import MotorMap, command_of_thrust, motor_speed, motor_thrust
from tests.support.vehicles import PLAIN

MAP = MotorMap(thrust=(0.2, 0.6), voltage=4.0)


def test_thrust_goes_with_command_and_voltage():
    """u = 0.5 x 3/4 = 0.375; T = 0.2 x 0.375 + 0.6 x 0.140625 = 0.159375 N."""
    command = np.full((1, 4), 0.5)
    np.testing.assert_allclose(motor_thrust(MAP, command, np.array([3.0])), 0.159375)
    np.testing.assert_allclose(motor_thrust(MAP, command), 0.25)
    made_up_for = replace(MAP, voltage_exponent=0.0)
    np.testing.assert_allclose(motor_thrust(made_up_for, command, np.array([3.0])), 0.25)


def test_a_thrust_has_one_command():
    command = np.array([0.0, 0.3, 1.0])
    for curve in ((0.2, 0.6), (0.0, 0.8), (0.5, 0.0)):
        thrust = curve[0] * command + curve[1] * command**2
        np.testing.assert_allclose(command_of_thrust(curve, thrust), command, atol=1e-9)


def test_speed_is_that_of_the_thrust():
    vehicle = replace(PLAIN, motors=MAP)
    speed = motor_speed(vehicle, np.full((2, 4), 0.5), np.array([3.0, 4.0]))
    thrust = vehicle.rotors.thrust_coefficient * speed**2
    np.testing.assert_allclose(thrust[:, 0], [0.159375, 0.25])
    with pytest.raises(ValueError, match=r"no \[motors\]"):
        motor_speed(PLAIN, np.zeros((1, 4)))


def test_motors_come_back_from_a_file_and_wrong_ones_are_refused():
    crazyflie = load_vehicle("crazyflie21")
    table = vehicle_table(crazyflie)
    assert parse_vehicle(table) == crazyflie
    for motors, reason in (
        ({"thrust": [0.1, 0.1]}, r"\[motors\] has no 'voltage'"),
        ({"thrust": [0.1, -0.1], "voltage": 4.0}, "must grow"),
        (
            {"thrust": [0.1, 0.1], "voltage": 4.0, "volts": 1.0},
            "Did you mean 'voltage'",
        ),
    ):
        with pytest.raises(ValueError, match=reason):
            parse_vehicle({**table, "motors": motors})
