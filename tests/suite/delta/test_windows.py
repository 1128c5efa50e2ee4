"""Flights of the point mass cut into windows and flown again, and what the network saw before."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import delta_network
from suite.delta.replay import PointMassModel, nominal_model, replay_point_mass
from suite.delta.windows import (
    BurnIn,
    _heading,
    are_consecutive,
    burn_in_before,
    cut_windows,
    decision_period,
    decision_rate,
    state_after,
    without_memory,
)
from suite.train.config import PointMassConfig
from suite.train.dynamics import point_mass
from tests.support.point_mass_flights import fly


def flight(count=1):
    return fly(nominal_model(PointMassConfig()), count)


def thinned(log):
    """Return a log in which every other decision is none."""
    steps = np.cumsum(log.policy_step) - 1
    return replace(log, extra={**log.extra, "policy_step": log.policy_step & (steps % 2 == 0)})


def test_the_heading_of_any_attitude_is_recovered():
    """Thrusts point up, aside and down; the point mass makes the same attitude again."""
    rng = np.random.default_rng(1)
    thrust, angle = rng.normal(0, 15, (50, 3)), rng.uniform(0, 6.3, 50)
    level = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rot = np.array(point_mass.attitude(*map(jnp.asarray, (thrust, level))))
    assert 10 < (rot[:, 2, 2] < 0).sum() < 40
    again = point_mass.attitude(jnp.asarray(thrust), jnp.asarray(_heading(rot)))
    np.testing.assert_allclose(again, rot, atol=1e-4)


def test_windows_begin_a_stride_apart_and_leave_out_gaps_and_what_is_missing():
    (log,) = flight()
    whole = cut_windows([log], 0.5, 0.1)
    pos_w = np.where(np.arange(len(log.time_s))[:, None] == 90, np.nan, log.pos_w)
    holed = replace(log, pos_w=pos_w)
    some = cut_windows([holed], 0.5, 0.1)
    assert 0 < len(some.acc_w) < len(whole.acc_w) and np.all(np.isfinite(some.pos_w))
    with pytest.raises(ValueError, match="no window of 5.0 s in 1 flights \\(flight 0"):
        cut_windows([log], 5.0, 0.1)
    with pytest.raises(ValueError, match="flight 0: columns action_x"):
        cut_windows([replace(log, extra={})], 0.5, 0.1)
    for stride_s, apart_s in ((0.3, 0.3), (0.001, 1.0 / 30.0)):
        starts = cut_windows([log], 0.5, stride_s).pos_w[:, 0]
        at = [np.flatnonzero(np.isclose(log.pos_w, p, atol=1e-6).all(-1))[0] for p in starts]
        assert np.diff(log.time_s[at]) == pytest.approx(apart_s, abs=1e-3)
    lost = (log.time_s > 1.4) & (log.time_s < 1.6)
    extra = {k: np.asarray(v)[~lost] for k, v in log.extra.items()}
    names = ("time_s", "pos_w", "quat_wxyz", "vel_w", "rate_b")
    arrays = {name: getattr(log, name)[~lost] for name in names}
    gapped = replace(log, extra=extra, **arrays)
    found = cut_windows([gapped], 0.5, 0.1)
    assert len(found.time_step) and found.time_step.max() < 0.05
    once = np.zeros(len(log.time_s))
    once[10] = 1.0
    single = replace(log, extra={**log.extra, "policy_step": once})
    alone, both = cut_windows([log], 0.5, 0.3), cut_windows([log, single], 0.5, 0.3)
    assert len(both.pos_w) == len(alone.pos_w), "a single decision makes no window"


def test_windows_of_unlike_rates_are_cut_to_what_all_have():
    """A log of every other decision has half as many in a window, and in what came before it."""
    (log,) = flight()
    both = cut_windows([log, thinned(log)], 0.5, 0.3)
    assert both.action_b.shape[1] == both.pos_w.shape[1] - 1 == 8
    assert both.burn_in.seen.shape[1] == both.burn_in.inputs.shape[1] == 45
    # Rows of the whole log keep the latest of what came before them, not the first.
    alone = cut_windows([log], 0.5, 0.3)
    count = len(alone.pos_w)
    np.testing.assert_array_equal(both.burn_in.seen[:count], alone.burn_in.seen[:, -45:])


@pytest.mark.parametrize("rate_hz", [15.0, 45.0, 90.0])
def test_the_period_of_decisions_that_stand_on_rows_is_that_of_the_policy(rate_hz):
    time = np.ceil(np.arange(0.0, 20.0, 1.0 / rate_hz) * 100 - 1e-9) / 100
    assert decision_period(time, 0.01) == pytest.approx(1.0 / rate_hz, rel=2e-3)
    gap = np.concatenate([time, time[-1] + 3.0 + time])
    assert decision_period(gap, 0.01) == pytest.approx(1.0 / rate_hz, rel=2e-3)
    assert np.isnan(decision_period(time[:1], 0.01))


def test_the_rate_of_flights_is_that_of_their_policy_and_decisions_in_a_row_are_near():
    first, *rest = flight(3)
    # Rates within 5 % of the median are one.
    for share in (1.0, 1.04):
        rate = decision_rate([replace(first, time_s=first.time_s * share), *rest])
        assert rate == pytest.approx(30.0, rel=1e-3)
    with pytest.raises(ValueError, match="fit to flights of one rate"):
        decision_rate([replace(first, time_s=first.time_s * 1.06), *rest])
    with pytest.raises(ValueError, match=r"has 15 decisions a second, and most flights 30"):
        decision_rate([thinned(first), *rest])
    found = are_consecutive(np.array([1.0, 1.99, 2.0]), period_s=1.0, row_s=0.5)
    np.testing.assert_array_equal(found, [True, True, False])


def test_a_burn_in_ends_at_the_window_and_is_blank_before_the_flight():
    still, vel_w = np.tile(np.eye(3), (5, 1, 1)), np.arange(15.0).reshape(5, 3)
    inputs, seen = burn_in_before(still, vel_w, -vel_w, first=2, count=3)
    np.testing.assert_array_equal(seen, [0, 1, 1])
    np.testing.assert_array_equal(inputs[0], np.zeros(9))
    np.testing.assert_array_equal(inputs[2], [*vel_w[1], 0, 0, 1, *-vel_w[1]])
    inputs, seen = burn_in_before(still, vel_w, -vel_w, first=4, count=3)
    assert seen.all()
    np.testing.assert_array_equal(inputs[:, :3], vel_w[1:4])


def test_what_was_not_seen_is_not_remembered_and_a_share_of_the_windows_forgets():
    params = delta_network.init(jax.random.key(1))
    inputs = np.random.default_rng(0).normal(size=(2, 4, 9))
    late = BurnIn(inputs, np.tile([0.0, 0.0, 1.0, 1.0], (2, 1)))
    assert not np.any(state_after(params, BurnIn(inputs, np.zeros((2, 4)))))
    assert not np.any(state_after(None, late))
    found = state_after(params, late)
    assert np.abs(found).max() > 1e-3
    np.testing.assert_array_equal(
        found, state_after(params, BurnIn(inputs[:, 2:], late.seen[:, 2:]))
    )
    inputs = np.ones((5, 3, 9))
    part = without_memory(BurnIn(inputs, np.ones((5, 3))), 0.4)
    np.testing.assert_array_equal(part.seen, [[0.0] * 3] * 2 + [[1.0] * 3] * 3)
    assert [without_memory(part, share).seen.sum() for share in (0.0, 1.0)] == [9.0, 0.0]
    np.testing.assert_array_equal(part.inputs, inputs)


def errors(plant, windows, delta=None):
    pos, vel, _ = jax.jit(replay_point_mass)(plant, windows, delta)
    return np.abs(pos - windows.pos_w[:, 1:]).max(), np.abs(vel - windows.vel_w[:, 1:]).max()


@pytest.mark.parametrize("delay", [0.0, 1.7])
def test_flights_of_the_point_mass_replay_as_they_were_flown(delay):
    """Rounding in float32 and the start's acceleration from velocities 1 ms apart."""
    plant = PointMassModel(np.float32(10.0), np.zeros(3, np.float32), np.float32(delay))
    windows = cut_windows(fly(plant), 1.0, 0.2)
    assert windows.action_b.shape[1:] == (30, 3) and len(windows.acc_w) > 20
    travelled = np.linalg.norm(windows.pos_w[:, -1] - windows.pos_w[:, 0], axis=-1)
    assert travelled.mean() > 1
    pos, vel = errors(plant, windows)
    assert pos < 2e-3 and vel < 5e-3
    wrong = errors(plant._replace(delay=np.float32(delay + 0.3)), windows)
    assert wrong[0] > 10 * pos
    slower = errors(plant._replace(lag=np.float32(8.0)), windows)
    assert slower[0] > 10 * pos


def test_drag_at_the_start_is_that_of_the_step_before():
    """The log has the drag of now, the point mass that of a step ago: centimetres over 1 s."""
    plant = PointMassModel(np.float32(10.0), np.array([0.3, 0.4, 0.5], np.float32), np.float32(0.5))
    windows = cut_windows(fly(plant), 1.0, 0.2)
    pos, vel = errors(plant, windows)
    assert pos < 0.03 and vel < 0.03
    without = errors(plant._replace(drag=np.zeros(3, np.float32)), windows)
    assert without[0] > 0.2


def test_a_fresh_delta_changes_nothing_and_a_constant_one_acts_as_the_action():
    windows, push = cut_windows(flight(4), 0.5, 0.3), np.array([1.0, -0.5, 0.2], np.float32)
    replay = jax.jit(partial(replay_point_mass, nominal_model(PointMassConfig())))
    delta = delta_network.init(jax.random.key(0))
    same = replay(windows, delta)
    np.testing.assert_array_equal(replay(windows, None)[0], same[0])
    assert not np.any(same[2])
    delta["output.bias"] = jnp.asarray(push)
    pos, _, correction = replay(windows, delta)
    np.testing.assert_allclose(correction, np.broadcast_to(push, correction.shape))
    shifted = windows._replace(action_b=windows.action_b + push)
    np.testing.assert_allclose(pos, replay(shifted, None)[0], atol=1e-5)
