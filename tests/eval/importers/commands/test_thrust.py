"""Normalised thrust becomes thrust per mass by what is told, by the vehicle, or by what is felt."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers.commands import thrust_command
from eval.importers.options import ImportOptions
from eval.vehicles.vehicle import MotorMap
from tests.support.vehicles import PLAIN


def rows(felt=None, count=200):
    """Rows with a throttle from 0.2 to 0.8, and where `felt` is given an accelerometer."""
    throttle = np.linspace(0.2, 0.8, count)
    found = {"throttle": throttle[:, None]}
    if felt is not None:
        found["acc"] = felt * throttle[:, None] * np.array([0.0, 0.0, 1.0])
    return found


@pytest.mark.parametrize(
    ("felt", "options", "full", "by"),
    [
        (25.0, ImportOptions(full_thrust=20.0, vehicle=PLAIN), 20.0, "as told"),
        # Four rotors of 1.6e-6 N s^2 at 2100 rad/s on 0.75 kg.
        (37.632, ImportOptions(vehicle=PLAIN), 37.632, "by the vehicle file"),
        (25.0, ImportOptions(), 25.0, "by the accelerometer"),
    ],
)
def test_full_throttle_is_what_is_told_or_built_or_felt(felt, options, full, by):
    found = rows(felt)
    (finding,) = thrust_command(found, options)
    np.testing.assert_allclose(found["cmd_thrust"], full * found["throttle"], rtol=1e-12)
    assert finding.level == "note" and by in finding.text


def test_a_vehicle_that_does_not_fit_what_was_felt_is_doubted():
    findings = thrust_command(rows(37.632 / 2), ImportOptions(vehicle=PLAIN))
    assert [finding.level for finding in findings] == ["note", "doubt"]
    assert "2.00 times what the accelerometer felt" in findings[1].text


@pytest.mark.parametrize("found", [rows(), rows(25.0, count=50)])
def test_where_nothing_tells_the_scale_thrust_is_left_out(found):
    (finding,) = thrust_command(found, ImportOptions())
    assert "cmd_thrust" not in found and finding.level == "doubt"
    assert "give --vehicle FILE or --full-thrust" in finding.text


def test_a_thrust_that_is_there_stays():
    found = rows() | {"cmd_thrust": np.ones((200, 1))}
    assert thrust_command(found, ImportOptions(full_thrust=20.0)) == []
    assert (found["cmd_thrust"] == 1.0).all()


def test_a_throttle_goes_through_the_vehicles_motors_with_the_battery():
    """u = 0.5 x 3/4: 4 x 0.159375 N over the mass; see test_motors.py."""
    vehicle = replace(PLAIN, motors=MotorMap((0.2, 0.6), 4.0))
    rows = {"throttle": np.full((3, 1), 0.5), "voltage": np.full((3, 1), 3.0)}
    findings = thrust_command(rows, ImportOptions(vehicle=vehicle))
    np.testing.assert_allclose(rows["cmd_thrust"], 4 * 0.159375 / vehicle.mass)
    assert "with the battery's voltage" in findings[0].text
