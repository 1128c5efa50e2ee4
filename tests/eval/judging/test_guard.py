"""A policy's output checked and limited; the monitor around a policy and its way out."""

import time
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.judging import monitor
from eval.judging.guard import ActionLimits, guard_action
from eval.judging.judge import Record
from eval.judging.policy_checks.in_flight import Outputs
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules
from policies.observation import encode_depth
from policies.spec import NoAnswer, PolicySpec
from tests.support.courses import fly_on, straight
from tests.support.marks import more
from tests.support.pilots import Pursuit, Steady
from tracks.geometry.camera import pixel_rays_b

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
    np.testing.assert_array_equal(found.largest, [4.0, np.nan, 40.0, np.nan])
    assert not found.late.any()


@settings(max_examples=20)
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
    # The mean upward action is over the answers that came in time.
    outputs, climbing = Outputs(2, limits.action), np.tile([0.0, 0.0, 1.0], (2, 4))
    outputs.add(guard_action(limits, last, last, 0.0, "p"), climbing)
    in_time = outputs.columns(0)["action_up"]
    outputs.add(late, climbing)
    assert outputs.columns(0)["action_up"] == in_time != 0.0


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


@pytest.mark.parametrize("world", ["mujoco", more("reference")])
def test_the_trial_says_so(world):
    how = {"seeds": range(4), "slots": 3, "rules": Rules(time_limit_s=0.295)}
    pilot = Faulty(1.0, spec=PolicySpec(rate_hz=100.0))
    found, _ = fly_on(pilot, straight(), vehicle=VEHICLE, world=world, **how)
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


@pytest.mark.parametrize(("world", "concerned"), [("mujoco", 2), more("reference", 1)])
@pytest.mark.parametrize(
    ("slow", "deadline_s"),
    [(Slow(3.0, 0.3), 0.2), (Slow(3.0, 0.0, NoAnswer("it.onnx: does not come to an end")), None)],
    ids=["late", "none"],
)
def test_a_late_answer_ends_its_trials_and_the_run_goes_on(slow, deadline_s, world, concerned):
    """An answer is for two trials; in the reference world, which has one slot, for one."""
    limits, slow.asked = ActionLimits(deadline_s=deadline_s), 0
    how = {"seeds": range(4), "slots": 2, "rules": Rules(time_limit_s=0.3), "limits": limits}
    warned = slow.error and world == "mujoco"  # the reference prints nothing
    why = (
        "policy 'pursuit' gave no action: it.onnx: does not come to an end; the trials that waited"
    )
    with pytest.warns(UserWarning, match=why) if warned else nullcontext():
        found, _ = fly_on(slow, straight(), vehicle=VEHICLE, world=world, **how)
    assert [r.seed for r in found] == [0, 1, 2, 3]
    assert {(r.ended_by, r.success) for r in found} == {("timeout", False)}
    assert [r.late_actions for r in found] == [1] * concerned + [0] * (4 - concerned)
    # Asked at 0, 1/30 and 2/30 s: there the trial ends, and the answer is not flown.
    wanted_s = [2 / 30] * concerned + [0.3] * (4 - concerned)
    assert [r.time_s for r in found] == pytest.approx(wanted_s, abs=0.002)


def test_a_trial_whose_first_answer_is_late_ends_where_it_started():
    how = {"seeds": range(5), "slots": 2, "limits": ActionLimits(deadline_s=0.0)}
    found, flights = fly_on(Pursuit(3.0), straight(), vehicle=VEHICLE, record=Record(), **how)
    assert {(r.late_actions, r.ended_by, r.time_s) for r in found} == {(1, "timeout", 0.0)}
    assert [len(flight.time_s) for flight in flights] == [0] * 5


SPEC = PolicySpec(rate_hz=15.0)
PERIOD_S = 1.0 / SPEC.rate_hz


def observation(vel_b=(5.0, 0.0, 0.0), depth_m=10.0, last_b=(0.0, 0.0, 0.0), up_b=(0.0, 0.0, 1.0)):
    """One level observation before a wall that fills the image at a planar depth."""
    state = np.array([[*vel_b, *up_b, 5.0, 0.0, 0.0, *last_b]], np.float32)
    depth = np.broadcast_to(depth_m, (SPEC.camera.height, SPEC.camera.width))
    image = encode_depth(SPEC.depth, np.array(depth, float), SPEC.camera.range_m)
    return state, image[None].astype(np.float32)


def seen(**changed):
    return monitor.seen_of(SPEC, *observation(**changed))


def test_depths_come_back_as_points_along_the_rays():
    found = seen(depth_m=2.0)
    rays = pixel_rays_b(SPEC.camera)
    np.testing.assert_allclose(found.points_b[0], 2.0 * rays, atol=1e-5)
    assert found.hit.all() and not seen().hit.any()


def test_tilt_and_speed_bend_an_action_and_small_ones_pass():
    gentle = np.array([[2.0, 1.0, 0.5]])
    np.testing.assert_allclose(monitor.limited(gentle, seen()), gentle, atol=1e-12)
    wild = monitor.limited(np.array([[200.0, 0.0, 0.0]]), seen(vel_b=(1.0, 0.0, 0.0)))[0]
    tilt = np.degrees(np.arctan2(wild[0], wild[2] + 9.81))
    assert tilt == pytest.approx(monitor.TILT_DEG)
    fast = monitor.limited(np.array([[5.0, 1.0, 0.0]]), seen(vel_b=(15.0, 0.0, 0.0)))[0]
    np.testing.assert_allclose(fast, [0.0, 1.0, 0.0], atol=1e-12)
    braking = np.array([[-5.0, 0.0, 0.0]])
    assert (monitor.limited(braking, seen(vel_b=(15.0, 0.0, 0.0))) == braking).all()


def test_how_near_a_path_comes_is_worked_out():
    times = np.array([0.0, 0.2, 0.4])
    ahead = seen(vel_b=(5.0, 0.0, 0.0), depth_m=3.0)
    coast = monitor.clearance(ahead, np.zeros((1, 3)), None, times, PERIOD_S)
    points = ahead.points_b[0]
    path = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    expected = np.linalg.norm(points[None] - path[:, None], axis=-1).min()
    assert coast == pytest.approx(expected)
    stop = monitor.clearance(ahead, np.array([[-20.0, 0, 0]]), None, times, PERIOD_S)
    assert stop > coast
    assert monitor.clearance(seen(), np.zeros((1, 3)), None, times, PERIOD_S) == np.inf


def test_a_way_out_is_taken_at_the_last_moment_and_not_before():
    """Towards a wall as wide as the image: from afar the policy has its will, near it has not."""
    will = np.zeros((1, 3))
    taken_at, action, view, blocked = None, will, seen(), 0
    times = np.linspace(0.025, monitor.HORIZON_S, 24)
    for depth_m in np.arange(6.0, 0.3, -0.1):
        view = seen(vel_b=(4.0, 0.0, 0.0), depth_m=depth_m)
        action, taken = monitor.last_moment(will, view, PERIOD_S)
        if taken[0]:
            taken_at = depth_m
            break
        assert (action == will).all()
        ahead = monitor.clearance(view, will, None, times, PERIOD_S)
        blocked += bool(ahead[0] < monitor.CLEARANCE_M)
    assert blocked >= 3  # its path is blocked and there is time yet
    assert taken_at is not None and 0.6 < taken_at < 2.5
    assert any((action == way).all() for way in monitor.ways_out(view))
    assert action[0, 0] < 0 or action[0, 2] > 0
    # The same wall, flown away from, is left alone.
    away = seen(vel_b=(-4.0, 0.0, 0.0), depth_m=taken_at)
    assert not monitor.last_moment(will, away, PERIOD_S)[1][0]


def test_every_row_is_judged_by_itself():
    parts = [observation(depth_m=d) for d in (9.0, 1.2, 0.8)]
    state, image = (np.concatenate(each) for each in zip(*parts, strict=True))
    policy = monitor.Monitored(Steady(spec=SPEC))
    fresh = np.ones(3, bool)
    together, _ = policy.act(policy.start(3), state, image, fresh)
    assert policy.interventions > 0 and policy.name == "steady+monitor"
    for k, part in enumerate(parts):
        alone, _ = monitor.Monitored(Steady(spec=SPEC)).act(policy.start(1), *part, fresh[:1])
        np.testing.assert_array_equal(together[k], alone[0])


def test_an_answer_that_is_no_number_stays_one():
    nothing = monitor.Monitored(Steady((np.nan, 0.0, 0.0), spec=SPEC))
    action, _ = nothing.act(nothing.start(1), *observation(depth_m=1.0), np.ones(1, bool))
    assert np.isnan(action).any()
