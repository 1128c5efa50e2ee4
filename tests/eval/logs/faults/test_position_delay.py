"""The delay of a position against the attitude."""

from dataclasses import replace

import numpy as np
import pytest

from eval.logs.faults.check import CheckContext, check_log
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN


@pytest.fixture(scope="module")
def log():
    return fly(PLAIN, 0, duration_s=8.0)


def shifted(log, late_s):
    """Return the log with the position (and the velocity from it) of `late_s` before."""
    time_s = log.time_s - late_s
    pos, vel = (
        np.stack([np.interp(time_s, log.time_s, column) for column in value.T], axis=1)
        for value in (log.pos_w, log.vel_w)
    )
    return replace(log, pos_w=pos, vel_w=vel)


def findings(log):
    found, _ = check_log(log, CheckContext(PLAIN))
    open_ones = [finding for finding in found if finding.is_open]
    return open_ones, [f for f in found if "position delay" in (f.signal, f.fault)]


@pytest.mark.parametrize("late_s", [-0.4, -0.1, 0.06, 0.2, 0.4])
def test_a_late_position_and_a_set_point_are_the_only_finding(log, late_s):
    (found,), _ = findings(shifted(log, late_s))
    assert found.fault == "position_delay" and found.size == pytest.approx(late_s, abs=0.005)
    assert ("set point" in found.evidence) == (late_s < 0.0) == ("measured position" in found.fix)
    assert ("late" in found.evidence) == (late_s > 0.0)


def test_a_position_in_time_and_wrong_axes_are_no_delay(log):
    opened, (fine,) = findings(log)
    assert not opened and fine.status == "ok"
    assert findings(shifted(log, 0.03))[0] == []
    swapped = replace(log, pos_w=log.pos_w[:, [1, 0, 2]], vel_w=log.vel_w[:, [1, 0, 2]])
    assert "position_delay" not in {finding.fault for finding in findings(swapped)[0]}


def test_without_acceleration_the_delay_is_not_identifiable(log):
    still = replace(
        log,
        pos_w=np.zeros_like(log.pos_w) + [0.0, 0.0, 1.0],
        vel_w=np.zeros_like(log.vel_w),
        quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (len(log.time_s), 1)),
    )
    assert all(f.status == "not identifiable" for f in findings(still)[1])
