"""A policy's output checked and limited."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eval.judging.guard import ActionLimits, guard_action
from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from tests.support.courses import straight
from tests.support.pilots import Pursuit

VEHICLE = load_vehicle("reference")
LIMITS = ActionLimits(size=10.0)


def test_each_fault():
    last = np.array([[1.0, 2.0, 3.0]] * 4)
    action = np.array([[0, 3, 4], [np.nan, 0, 0], [0, -30, 40], [np.inf, 0, 0]], np.float32)
    found = guard_action(LIMITS, action, last, 0.0, "p")
    assert found.action_b == pytest.approx(
        np.array([[0, 3, 4], [1, 2, 3], [0, -6, 8], [1, 2, 3]]), abs=1e-12
    )
    assert found.bad.tolist() == [False, True, False, True]
    assert found.limited.tolist() == [False, False, True, False]
    assert not found.late.any()


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), min_size=3, max_size=3))
def test_whatever_comes_out_is_finite_and_within_the_limit(values):
    found = guard_action(LIMITS, np.array([values]), np.zeros((1, 3)), 0.0, "p")
    assert np.isfinite(found.action_b).all()
    assert np.linalg.norm(found.action_b) <= 10.0 * (1 + 1e-12)


def test_late_answers_are_not_flown():
    limits = ActionLimits(deadline_s=0.01)
    last, action = np.ones((2, 3)), np.array([[np.nan] * 3, [5.0] * 3])
    late = guard_action(limits, action, last, 0.02, "p")
    assert (late.action_b == last).all() and late.late.all() and not late.bad.any()
    assert not guard_action(limits, action, last, 0.005, "p").late.any()


@pytest.mark.parametrize(
    "answer", [np.zeros((2, 4)), np.zeros(3), np.array([["a", "b", "c"]] * 2), None]
)
def test_something_else_than_actions_is_refused(answer):
    with pytest.raises(ValueError, match="policy 'p' returned"):
        guard_action(LIMITS, answer, np.zeros((2, 3)), 0.0, "p")


class Faulty(Pursuit):
    """Gives NaN at every third decision of a trial, too much at every fifth."""

    def act(self, hidden, state, image, fresh):
        action, _ = super().act(np.zeros((len(state), 3)), state, image, fresh)
        count = np.where(fresh, 0, hidden[:, 0]) + 1
        action = np.where((count % 3 == 0)[:, None], np.float32(np.nan), action)
        action = np.where((count % 5 == 0)[:, None], np.float32(1e30), action)
        return action, count[:, None]


@pytest.mark.parametrize("world", ["mujoco", "reference"])
def test_the_trial_says_so(world):
    options = JudgeOptions(slots=3, rules=Rules(time_limit_s=0.99))
    trials = [TrialSpec("straight", 0, seed) for seed in range(4)]
    found = fly(Faulty(1.0), trials, VEHICLE, world, options, tracks={"straight": straight()})
    # 30 decisions: 10 thirds of which 2 are fifths too, 6 fifths.
    assert {(r.bad_actions, r.limited_actions, r.late_actions) for r in found} == {(8, 6, 0)}


def test_late_answers_are_counted_and_the_drone_flies_on():
    from eval.judging.judge import ActionLimits

    options = JudgeOptions(
        slots=2,
        rules=Rules(time_limit_s=0.5),
        limits=ActionLimits(deadline_s=0.0, late_most=100),
    )
    trials = [TrialSpec("straight", 0, 0)]
    (found,) = fly(
        Pursuit(3.0), trials, VEHICLE, "mujoco", options, tracks={"straight": straight()}
    )
    assert (found.late_actions, found.ended_by) == (15, "timeout")
    assert abs(found.pos_x) < 0.01  # the action flown was the first: none


def test_a_policy_that_is_late_all_the_time_ends_the_trials_and_not_the_run():
    from eval.judging.judge import ActionLimits

    options = JudgeOptions(slots=2, limits=ActionLimits(deadline_s=0.0, late_most=3))
    trials = [TrialSpec("straight", 0, seed) for seed in range(5)]
    found = fly(Pursuit(3.0), trials, VEHICLE, "mujoco", options, tracks={"straight": straight()})
    assert [result.seed for result in found] == [0, 1, 2, 3, 4]
    assert {(r.late_actions, r.ended_by, r.success) for r in found} == {(3, "timeout", False)}
    assert all(r.time_s < 0.2 for r in found)
