"""The monitor around a policy: what it bends, when it takes a way out, and when it does not."""

import numpy as np
import pytest

from eval.judging.monitor import (
    Monitored,
    MonitorLimits,
    clearance,
    last_moment,
    limited,
    seen_of,
    ways_out,
)
from policies.observation import encode_depth
from policies.spec import PolicySpec
from tests.support.pilots import Steady
from tracks.geometry.camera import pixel_rays_b

SPEC = PolicySpec(rate_hz=15.0)
LIMITS = MonitorLimits()
PERIOD_S = 1.0 / SPEC.rate_hz


def given(vel_b=(5.0, 0.0, 0.0), depth_m=10.0, last_b=(0.0, 0.0, 0.0), up_b=(0.0, 0.0, 1.0)):
    """One level observation before a wall that fills the image at a planar depth."""
    state = np.array([[*vel_b, *up_b, 5.0, 0.0, 0.0, *last_b]], np.float32)
    depth = np.broadcast_to(depth_m, (SPEC.camera.height, SPEC.camera.width))
    image = encode_depth(SPEC.depth, np.array(depth, float), SPEC.camera.range_m)
    return state, image[None].astype(np.float32)


def seen(**changed):
    return seen_of(SPEC, *given(**changed))


def test_depths_come_back_as_points_along_the_rays():
    found = seen(depth_m=2.0)
    rays = pixel_rays_b(SPEC.camera)
    np.testing.assert_allclose(found.points_b[0], 2.0 * rays, atol=1e-5)
    assert found.hit.all() and not seen().hit.any()


def test_tilt_and_speed_bend_an_action_and_small_ones_pass():
    gentle = np.array([[2.0, 1.0, 0.5]])
    np.testing.assert_allclose(limited(LIMITS, gentle, seen()), gentle, atol=1e-12)
    wild = limited(LIMITS, np.array([[200.0, 0.0, 0.0]]), seen(vel_b=(1.0, 0.0, 0.0)))[0]
    tilt = np.degrees(np.arctan2(wild[0], wild[2] + 9.81))
    assert tilt == pytest.approx(LIMITS.tilt_deg)
    fast = limited(LIMITS, np.array([[5.0, 1.0, 0.0]]), seen(vel_b=(15.0, 0.0, 0.0)))[0]
    np.testing.assert_allclose(fast, [0.0, 1.0, 0.0], atol=1e-12)
    braking = np.array([[-5.0, 0.0, 0.0]])
    assert (limited(LIMITS, braking, seen(vel_b=(15.0, 0.0, 0.0))) == braking).all()


def test_how_near_a_path_comes_is_worked_out():
    times = np.array([0.0, 0.2, 0.4])
    ahead = seen(vel_b=(5.0, 0.0, 0.0), depth_m=3.0)
    coast = clearance(LIMITS, ahead, np.zeros((1, 3)), None, times, PERIOD_S)
    points = ahead.points_b[0]
    path = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    expected = np.linalg.norm(points[None] - path[:, None], axis=-1).min()
    assert coast == pytest.approx(expected)
    stop = clearance(LIMITS, ahead, np.array([[-20.0, 0, 0]]), None, times, PERIOD_S)
    assert stop > coast
    assert clearance(LIMITS, seen(), np.zeros((1, 3)), None, times, PERIOD_S) == np.inf


def test_a_way_out_is_taken_at_the_last_moment_and_not_before():
    """Towards a wall as wide as the image: from afar the policy has its will, near it has not."""
    will = np.zeros((1, 3))
    taken_at, action, view, blocked = None, will, seen(), 0
    times = np.linspace(0.025, LIMITS.horizon_s, 24)
    for depth_m in np.arange(6.0, 0.3, -0.1):
        view = seen(vel_b=(4.0, 0.0, 0.0), depth_m=depth_m)
        action, taken = last_moment(LIMITS, will, view, PERIOD_S)
        if taken[0]:
            taken_at = depth_m
            break
        assert (action == will).all()
        ahead = clearance(LIMITS, view, will, None, times, PERIOD_S)
        blocked += bool(ahead[0] < LIMITS.clearance_m)
    assert blocked >= 3  # its path is blocked and there is time yet
    assert taken_at is not None and 0.6 < taken_at < 2.5
    assert any((action == way).all() for way in ways_out(LIMITS, view))
    assert action[0, 0] < 0 or action[0, 2] > 0
    # The same wall, flown away from, is left alone.
    away = seen(vel_b=(-4.0, 0.0, 0.0), depth_m=taken_at)
    assert not last_moment(LIMITS, will, away, PERIOD_S)[1][0]


def test_every_row_is_judged_by_itself():
    parts = [given(depth_m=d) for d in (9.0, 1.2, 0.8)]
    state, image = (np.concatenate(each) for each in zip(*parts, strict=True))
    policy = Monitored(Steady(spec=SPEC))
    fresh = np.ones(3, bool)
    together, _ = policy.act(policy.start(3), state, image, fresh)
    assert policy.interventions > 0 and policy.name == "steady+monitor"
    for k, part in enumerate(parts):
        alone, _ = Monitored(Steady(spec=SPEC)).act(policy.start(1), *part, fresh[:1])
        np.testing.assert_array_equal(together[k], alone[0])


def test_an_answer_that_is_no_number_stays_one():
    nothing = Monitored(Steady((np.nan, 0.0, 0.0), spec=SPEC))
    action, _ = nothing.act(nothing.start(1), *given(depth_m=1.0), np.ones(1, bool))
    assert np.isnan(action).any()
