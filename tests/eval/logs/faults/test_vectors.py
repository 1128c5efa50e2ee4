"""Axes and unit of a logged velocity, compared with the path's derivative."""

import numpy as np
import pytest

from eval.logs.faults.vectors import check_velocity


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
