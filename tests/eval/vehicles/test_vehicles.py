"""A vehicle: whether it can exist and fly, and its motors' thrust by commands, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle, parse_vehicle, vehicle_table
from eval.vehicles.vehicle import MotorMap, command_of_thrust, motor_speed, motor_thrust
from eval.vehicles.vehicle_check import check_vehicle
from tests.support.vehicles import PLAIN


def test_a_vehicle_that_flies_passes_and_is_a_key():
    check_vehicle(PLAIN)
    assert PLAIN.rotors.thrust_max == pytest.approx(7.056)
    assert hash(PLAIN.rotors) == hash(replace(PLAIN.rotors))
    # A flat body has the largest moment exactly at the sum of the other two.
    check_vehicle(replace(PLAIN, inertia=(0.1, 0.2, 0.1 + 0.2)))


@pytest.mark.parametrize(
    ("vehicle", "message"),
    [
        (replace(PLAIN, mass=1e-300), "mass = 1e-300: must be from 0.0001 to 10000 kg"),
        (replace(PLAIN, inertia=(1e-300,) * 3), "inertia = .*must be from 1e-10"),
        (
            replace(PLAIN, rotors=replace(PLAIN.rotors, speed_max=1070.0)),
            "too weak to hover; a rotor gives 1.83 N and 1.84 N",
        ),
    ],
)
def test_what_cannot_fly_is_refused(vehicle, message):
    with pytest.raises(ValueError, match=message):
        check_vehicle(vehicle)


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
        ({"thrust": [0.1, 0.1], "voltage": 4.0, "volts": 1.0}, "Did you mean 'voltage'"),
    ):
        with pytest.raises(ValueError, match=reason):
            parse_vehicle({**table, "motors": motors})
