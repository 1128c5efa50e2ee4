"""A policy's output checked and limited."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eval.judging.guard import ActionLimits, guard_action
from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import NoAnswer
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


class Slow(Pursuit):
    """Answers at once but for its third question, which it is asked later than `pause_s` after."""

    def __init__(self, speed, pause_s, error=None):
        super().__init__(speed)
        self.pause_s, self.error, self.asked = pause_s, error, 0

    def act(self, hidden, state, image, fresh):
        self.asked += 1
        if self.asked == 3:
            time.sleep(self.pause_s)
            if self.error:
                raise self.error
        return super().act(hidden, state, image, fresh)


@pytest.mark.parametrize("world", ["mujoco", "reference"])
@pytest.mark.parametrize(
    ("slow", "deadline_s"),
    [(Slow(3.0, 0.3), 0.2), (Slow(3.0, 0.0, NoAnswer("it.onnx: does not come to an end")), None)],
    ids=["late", "none"],
)
def test_a_late_answer_ends_the_trials_that_it_was_for_and_the_run_goes_on(slow, deadline_s, world):
    """The third of an answer for two trials; in the reference world, which has one trial, one."""
    options = JudgeOptions(
        slots=2, rules=Rules(time_limit_s=0.3), limits=ActionLimits(deadline_s=deadline_s)
    )
    slow.asked = 0
    trials = [TrialSpec("straight", 0, seed) for seed in range(5)]
    found = fly(slow, trials, VEHICLE, world, options, tracks={"straight": straight()})
    assert [result.seed for result in found] == [0, 1, 2, 3, 4]
    concerned = 2 if world == "mujoco" else 1
    late = [(r.late_actions, r.ended_by, r.success) for r in found]
    assert late == [(1, "timeout", False)] * concerned + [(0, "timeout", False)] * (5 - concerned)
    ended_s = [r.time_s for r in found]
    # Asked at 0, 1/30 and 2/30 s: there the trial ends, and the answer is not flown.
    assert ended_s[:concerned] == pytest.approx([2 / 30] * concerned, abs=0.002)
    assert ended_s[concerned:] == pytest.approx([0.3] * (5 - concerned))


def test_a_trial_whose_first_answer_is_late_ends_where_it_started():
    options = JudgeOptions(slots=2, limits=ActionLimits(deadline_s=0.0))
    trials = [TrialSpec("straight", 0, seed) for seed in range(5)]
    flights = []
    found = fly(
        Pursuit(3.0), trials, VEHICLE, "mujoco", options,
        lambda result, flight: flights.append(flight),
        Record(), tracks={"straight": straight()},
    )  # fmt: skip
    assert {(r.late_actions, r.ended_by, r.time_s) for r in found} == {(1, "timeout", 0.0)}
    assert [len(flight.time_s) for flight in flights] == [0] * 5
