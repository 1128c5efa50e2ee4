"""Axes and unit of a logged velocity, compared with the path's derivative."""

import numpy as np
import pytest

from eval.logs.faults.relation import match
from eval.logs.faults.vectors import check_gyro, check_velocity


def findings(vel_of, seed=0):
    """Return findings on a flight to and fro along a straight line, with noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 10.0, 0.01)
    along = np.array([0.7, -1.65, 0.05])
    pos = np.sin(0.8 * time_s)[:, None] * along
    vel = vel_of(0.8 * np.cos(0.8 * time_s)[:, None] * along)
    noise = rng.standard_normal((2, len(time_s), 3))
    rows = {"time": time_s, "pos": pos + 0.003 * noise[0], "vel": vel + 0.03 * noise[1]}
    return {one.fault: one for one in check_velocity(rows) if one.fault}


@pytest.mark.parametrize("seed", range(4))
def test_on_a_straight_line_no_axis_is_taken_for_another(seed):
    """There x and y are proportional, and y over x is no unit."""
    assert "velocity_unit" not in findings(lambda vel: vel, seed)


def test_another_unit_on_a_straight_line_is_found():
    found = findings(lambda vel: 100.0 * vel)["velocity_unit"]
    assert found.status == "corrected" and "cm/s" in found.evidence


def test_axes_that_move_in_proportion_are_no_evidence_of_their_order():
    found = findings(lambda vel: vel)
    assert found["velocity_frame"].status == "not identifiable"
    assert "y,x,z" in found["velocity_frame"].evidence


def test_swapped_axes_are_found_though_they_resemble_each_other():
    rng = np.random.default_rng(5)
    first, other, weak = rng.standard_normal((3, 500))
    wanted = np.column_stack([first, 0.6 * first + 0.8 * other, 0.02 * weak])
    given = wanted[:, [1, 0, 2]] + 0.015 * rng.standard_normal(wanted.shape)
    found = match(wanted, given)
    assert (found.axes, found.rival) == ("y,x,z", "") and found.is_turned
    assert not match(wanted, wanted).is_turned


@pytest.mark.parametrize(("factor", "status"), [(57.3, "doubt"), (1.0, "not identifiable")])
def test_rates_that_no_gyro_measures_are_a_fault_without_an_attitude(factor, status):
    time_s = np.arange(0.0, 10.0, 0.01)
    rate = factor * np.column_stack([3.0 * np.sin(time_s), np.cos(2.0 * time_s), 0.1 * time_s])
    found = {one.fault: one.status for one in check_gyro({"time": time_s, "rate": rate})}
    assert found["gyro_scale"] == status
