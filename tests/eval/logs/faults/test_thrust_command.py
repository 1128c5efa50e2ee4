"""A thrust command in another unit or sign is found by the force that the path needs."""

import numpy as np
import pytest

from eval.logs.faults.drive.commands import check_thrust_command
from tests.support.vehicles import PLAIN


def found(factor, vehicle=PLAIN):
    time_s = np.arange(0.0, 4.0, 0.01)
    force = 9.81 + 2.0 * np.sin(3.0 * time_s)
    acc = np.column_stack([np.zeros_like(force), np.zeros_like(force), force])
    rows = {"time": time_s, "acc": acc, "cmd_thrust": factor * force[:, None]}
    return check_thrust_command(rows, vehicle)


@pytest.mark.parametrize("factor", [1.0, 0.88, 1.3])
def test_a_command_near_the_force_is_fine(factor):
    (finding,) = found(factor)
    assert finding.status == "ok"


@pytest.mark.parametrize(
    ("factor", "words", "fix"),
    [
        (1.0 / 9.81, "multiples of gravity", "9.81"),
        (0.92 / 9.81, "multiples of gravity", "9.81"),
        (-1.0, "down is positive", "-1"),
        (-1.0 / 9.81, "down is positive", "-9.81"),
    ],
)
def test_a_unit_or_a_sign_is_corrected(factor, words, fix):
    (finding,) = found(factor)
    assert finding.status == "corrected" and words in finding.evidence
    assert finding.fix == f"--read cmd_thrust={fix}"


def test_newtons_need_the_mass_and_a_share_of_full_thrust_has_no_unit():
    heavy = PLAIN.__class__(**{**vars(PLAIN), "mass": 4.0})
    (finding,) = found(4.0, heavy)
    assert "newtons" in finding.evidence and finding.fix == "--read cmd_thrust=0.25"
    light = PLAIN.__class__(**{**vars(PLAIN), "mass": 0.78})
    for factor in (0.78, 0.84):
        (finding,) = found(factor, light)
        assert finding.fault == "thrust_command_unit" and not finding.is_open, "or thrust is lower"
    (finding,) = found(4.0, None)
    assert finding.is_open and finding.fault == "thrust_command_unit"
    (finding,) = found(0.67)
    assert (finding.status, finding.fault) == ("note", "thrust_scale"), "the mass may be 0.5 kg"
    (finding,) = found(0.03)
    assert finding.is_open and "share of full thrust" in finding.evidence


def test_a_log_without_force_or_command_is_not_checked():
    rows = {"time": np.arange(9.0), "cmd_thrust": np.ones((9, 1))}
    assert check_thrust_command(rows) == []
    rows = {"time": np.arange(9.0), "acc": np.full((9, 3), 9.81)}
    assert check_thrust_command(rows) == []
