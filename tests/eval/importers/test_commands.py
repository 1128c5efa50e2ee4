"""Thrust, motors and set points of a log become commands in the vehicle's units and order."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers.commands import SHIPPED_ORDER, order_motors, rates_wanted, thrust_command
from eval.importers.options import ImportOptions
from eval.vehicles.vehicle import MotorMap
from tests.support.vehicles import PLAIN


def thrust_rows(felt=None, count=200):
    """Rows with a throttle from 0.2 to 0.8, and where `felt` is given an accelerometer."""
    throttle = np.linspace(0.2, 0.8, count)
    found = {"throttle": throttle[:, None]}
    if felt is not None:
        found["acc"] = felt * throttle[:, None] * np.array([0.0, 0.0, 1.0])
    return found


@pytest.mark.parametrize(
    ("felt", "options", "full", "by"),
    [
        (25.0, ImportOptions(full_thrust=20.0, vehicle=PLAIN), 20.0, "as given"),
        # Four rotors of 1.6e-6 N s^2 at 2100 rad/s on 0.75 kg.
        (37.632, ImportOptions(vehicle=PLAIN), 37.632, "by the vehicle file"),
        (25.0, ImportOptions(), 25.0, "by the accelerometer"),
    ],
)
def test_full_throttle_is_what_is_told_or_built_or_felt(felt, options, full, by):
    found = thrust_rows(felt)
    (finding,) = thrust_command(found, options)
    np.testing.assert_allclose(found["cmd_thrust"], full * found["throttle"], rtol=1e-12)
    assert finding.status == "note" and by in finding.evidence


@pytest.mark.parametrize("found", [thrust_rows(), thrust_rows(25.0, count=50)])
def test_where_nothing_tells_the_scale_thrust_is_left_out(found):
    (finding,) = thrust_command(found, ImportOptions())
    assert "cmd_thrust" not in found and finding.status == "doubt"
    assert "give --vehicle FILE or --full-thrust" in finding.evidence


def test_a_thrust_that_is_there_stays():
    found = thrust_rows() | {"cmd_thrust": np.ones((200, 1))}
    assert thrust_command(found, ImportOptions(full_thrust=20.0)) == []
    assert (found["cmd_thrust"] == 1.0).all()


def test_a_throttle_goes_through_the_vehicles_motors_with_the_battery():
    """u = 0.5 x 3/4: 4 x 0.159375 N over the mass; see test_motors.py."""
    vehicle = replace(PLAIN, motors=MotorMap((0.2, 0.6), 4.0))
    rows = {"throttle": np.full((3, 1), 0.5), "voltage": np.full((3, 1), 3.0)}
    findings = thrust_command(rows, ImportOptions(vehicle=vehicle))
    np.testing.assert_allclose(rows["cmd_thrust"], 4 * 0.159375 / vehicle.mass)
    assert "with the battery's voltage" in findings[0].evidence


def motor_rows():
    return {"motor": np.array([[10.0, 20.0, 30.0, 40.0]]), "motor_cmd": np.array([[1.0, 2, 3, 4]])}


def test_without_places_the_order_stays():
    found = motor_rows()
    assert order_motors(found, None, None) == []
    np.testing.assert_array_equal(found["motor"], [[10, 20, 30, 40]])
    assert order_motors({}, SHIPPED_ORDER, None) == []


def test_places_in_any_unit_set_the_order():
    found = motor_rows()
    backwards = tuple((90.0 * x, 70.0 * y) for x, y in reversed(SHIPPED_ORDER))
    (finding,) = order_motors(found, backwards, None)
    np.testing.assert_array_equal(found["motor"], [[40, 30, 20, 10]])
    np.testing.assert_array_equal(found["motor_cmd"], [[4, 3, 2, 1]])
    assert finding.evidence == "put in the order of the shipped vehicles: the file's 4, 3, 2, 1"


def test_the_vehicles_own_hubs_go_before_the_shipped_ones():
    hubs = PLAIN.rotors.position
    turned = replace(PLAIN.rotors, position=(hubs[1], hubs[2], hubs[3], hubs[0]))
    found = motor_rows()
    (finding,) = order_motors(found, SHIPPED_ORDER, replace(PLAIN, rotors=turned))
    np.testing.assert_array_equal(found["motor"], [[20, 30, 40, 10]])
    assert "vehicle 'plain'" in finding.evidence


def set_points(angle):
    half = 0.5 * angle
    return {
        "quat": np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        "cmd_quat": np.tile([np.cos(half), 0.0, np.sin(half), 0.0], (2, 1)),
    }


def test_the_error_times_the_gain_within_the_limit():
    given = set_points(0.1)
    rates_wanted(given, PLAIN)
    gain = PLAIN.controller.attitude_gain[1]
    np.testing.assert_allclose(given["cmd_rate"], [[0.0, 0.1 * gain, 0.0]] * 2)
    given = set_points(3.0)
    rates_wanted(given, PLAIN)
    np.testing.assert_allclose(given["cmd_rate"][0, 1], PLAIN.controller.rate_max[1])


def test_without_a_vehicle_they_are_left_out():
    given = set_points(0.1)
    assert rates_wanted(given, None)[0].status == "doubt"
    assert set(given) == {"quat"}
