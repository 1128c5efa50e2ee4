"""A policy's trial beside a plan: ratios where both finish, and the leg that goes around."""

import pytest

from suite.experiments.study.beside import beside, goes_around
from tests.support.laps import flown


def test_both_finish_and_one_goes_around():
    plan, mine = flown(lap_s=3.0), flown(lap_s=9.0, circles_at=4)
    lap = beside(plan, mine)
    assert lap.planned_s == 3.0 and lap.policy_s == 9.0 and lap.ratio == pytest.approx(3.0)
    assert lap.path == pytest.approx(1.27, abs=0.02)
    assert goes_around(lap) and lap.around and lap.around.gate == 4
    assert not goes_around(beside(plan, plan)) and beside(plan, plan).path == 1.0


def test_without_an_end_there_is_no_ratio():
    plan, lost = flown(lap_s=3.0), flown(lap_s=1.0, success=False)
    assert beside(plan, lost)[1:5] == (3.0, None, None, None)
    assert beside(lost, plan)[1:5] == (None, 3.0, None, None)
