"""Impossible rotor speeds are found by what they would lift; between two units they stay."""

import numpy as np
import pytest

from eval.logs.faults.drive.motors import check_lift, check_motors
from tests.support.vehicles import PLAIN

HOVER = np.sqrt(PLAIN.mass * 9.81 / (4 * PLAIN.rotors.thrust_coefficient))


def found(factor, vehicle=PLAIN):
    rows = {"motor": np.full((50, 4), HOVER * factor), "time": np.arange(50.0)}
    (finding,) = check_lift(rows, vehicle)
    return finding


@pytest.mark.parametrize("factor", [0.98, 1.03])
def test_speeds_that_carry_the_weight_are_fine(factor):
    assert found(factor).status == "ok"


def test_what_an_effect_can_do_is_no_fault():
    assert (found(1.1).status, found(1.1).fault) == ("note", "thrust_scale")


@pytest.mark.parametrize(
    ("factor", "words", "scale"),
    [
        (6.0, "6 pole pairs", 6.0),
        (60 / (2 * np.pi), "rpm", 9.549296586),
        (7.1, "7 pole pairs", 7.0),
    ],
)
def test_a_factor_with_a_name_is_put_right(factor, words, scale):
    finding = found(factor)
    assert finding.status == "corrected" and words in finding.evidence
    assert finding.fix == f"--read motor={1 / scale:.10g}"


@pytest.mark.parametrize("factor", [6.5, 11.0, 11.5, 10.2])
def test_a_factor_between_two_names_is_left_to_its_owner(factor):
    """By either the speeds would look well; the wrong one would be off by a sixth or less."""
    finding = found(factor)
    assert finding.is_open and " or " in finding.evidence


def test_a_factor_without_a_name_is_a_doubt():
    assert found(2.5).is_open
    assert found(1.0, None).status == "note"
    assert found(14 / 12).fault == "motor_poles" and "14" in found(14 / 12).fix
    assert found(5**-0.5).fault == "vehicle_mass"


def test_without_a_gyro_order_and_spin_are_not_identifiable():
    found = check_motors({"motor": np.full((50, 4), HOVER), "time": np.arange(50.0)}, PLAIN)
    assert {one.fault for one in found} == {"motor_order", "motor_spin"}
    assert {one.status for one in found} == {"not identifiable"}
