"""Faults of a log from pose and gyro alone, on flights whose faults are known."""

import numpy as np
import pytest

from suite.diagnose.verdict.checks import check_kinematics, facts_of
from tests.support.diagnosis_flights import fly, fly_all
from tests.support.vehicles import PLAIN, with_effects

HALF_STEP_S = 0.001
"""MuJoCo turns the body by the rate at a step's end, which puts the pose half a step ahead."""


def flights(vehicle, count=3):
    return fly_all([vehicle] * count, range(count), duration_s=5.0)


def test_a_clean_log_has_no_faults():
    found = check_kinematics(flights(PLAIN))
    assert found is not None and found.flights == 3
    assert (np.abs(found.bias) < 2.0 * found.bias_ci).all() and found.bias_ci.max() < 0.004
    assert abs(found.offset + HALF_STEP_S) < 2.0 * found.offset_ci and found.offset_ci < 5e-4
    assert found.velocity_scale == pytest.approx(1.0, abs=0.01)


def test_bias_and_offset_are_found_together():
    truth = np.array([0.02, -0.01, 0.03])
    vehicle = with_effects(gyro_bias=(tuple(truth),), clock_offset=(0.012,))
    found = check_kinematics(flights(vehicle))
    assert found is not None
    assert (np.abs(found.bias - truth) < 2.0 * found.bias_ci).all()
    assert abs(found.offset - 0.012 + HALF_STEP_S) < 2.0 * found.offset_ci


def test_a_log_without_turns_has_no_offset_and_one_without_pose_nothing():
    log = fly(PLAIN, 0, duration_s=3.0)
    log.quat_wxyz[:] = [1.0, 0.0, 0.0, 0.0]
    log.rate_b[:] = 0.0
    found = check_kinematics([log])
    assert found is not None and np.isinf(found.offset_ci)
    log.quat_wxyz[:] = np.nan
    assert check_kinematics([log]) is None


def test_the_facts_of_a_log():
    log = fly(PLAIN, 0, duration_s=3.0, motors=True)
    log.pos_w[30:60] = np.nan
    found = facts_of(log)
    assert found.rows == 301 and found.duration_s == pytest.approx(3.0)
    assert found.rate_hz == pytest.approx(100.0) and found.missing == pytest.approx(30 / 301)
    assert found.channels == "commands, velocity, rotor speeds"
