"""Rotor speeds that cannot carry the vehicle are found, by their factor where it has a name."""

import numpy as np
import pytest

from eval.importers.checks.weight import check_weight
from tests.support.vehicles import PLAIN

HOVER = np.sqrt(PLAIN.mass * 9.81 / (4 * PLAIN.rotors.thrust_coefficient))


def rows(factor=1.0):
    return {"motor": np.full((50, 4), HOVER * factor), "time": np.arange(50.0)}


def test_speeds_that_carry_the_weight_are_fine():
    given = rows(1.1)
    assert check_weight(given, PLAIN, True)[0].level == "ok"
    np.testing.assert_allclose(given["motor"], HOVER * 1.1)


@pytest.mark.parametrize(
    ("factor", "words"), [(6.0, "6 pole pairs"), (60 / (2 * np.pi), "rpm"), (7.1, "7 pole pairs")]
)
def test_a_factor_with_a_name_is_put_right(factor, words):
    given = rows(factor)
    finding = check_weight(given, PLAIN, True)[0]
    assert finding.level == "corrected"
    assert words in finding.text
    np.testing.assert_allclose(given["motor"], HOVER, rtol=0.05)
    given = rows(factor)
    assert check_weight(given, PLAIN, False)[0].level == "doubt"
    np.testing.assert_allclose(given["motor"], HOVER * factor)


@pytest.mark.parametrize("factor", [6.5, 11.0, 11.5, 10.2])
def test_a_factor_between_two_names_is_left_to_its_owner(factor):
    """By either the speeds would look well; the wrong one would be off by a sixth or less."""
    given = rows(factor)
    finding = check_weight(given, PLAIN, True)[0]
    assert finding.level == "doubt" and " or " in finding.text
    np.testing.assert_allclose(given["motor"], HOVER * factor)


def test_a_factor_without_a_name_is_a_doubt():
    assert check_weight(rows(2.5), PLAIN, True)[0].level == "doubt"
    assert check_weight(rows(), None, True)[0].level == "note"
