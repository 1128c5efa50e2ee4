"""Flights of the point mass cut into windows and flown again."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import delta_network
from suite.delta.replay import Plant, nominal_plant, replay
from suite.delta.run import split
from suite.delta.windows import cut_windows
from suite.train.config import PointMassConfig
from tests.support.point_mass_flights import fly


def errors(plant, windows, delta=None):
    pos, vel, _ = jax.jit(replay)(plant, windows, delta)
    return np.abs(pos - windows.pos_w[:, 1:]).max(), np.abs(vel - windows.vel_w[:, 1:]).max()


@pytest.mark.parametrize("delay", [0.0, 0.6, 1.7])
def test_flights_of_the_point_mass_replay_as_they_were_flown(delay):
    """Rounding in float32 and the start's acceleration from velocities 1 ms apart."""
    plant = Plant(np.float32(10.0), np.zeros(3, np.float32), np.float32(delay))
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
    plant = Plant(np.float32(10.0), np.array([0.3, 0.4, 0.5], np.float32), np.float32(0.5))
    windows = cut_windows(fly(plant), 1.0, 0.2)
    pos, vel = errors(plant, windows)
    assert pos < 0.03 and vel < 0.03
    without = errors(plant._replace(drag=np.zeros(3, np.float32)), windows)
    assert without[0] > 0.2


def test_the_nose_of_a_rolled_and_pitched_flight_is_recovered():
    """The heading is level and square to body y; body x laid flat is not, once rolled."""
    plant = Plant(np.float32(10.0), np.zeros(3, np.float32), np.float32(0.0))
    logs = fly(plant)
    windows = cut_windows(logs, 1.0, 0.2)
    rot, heading = windows.rot_w, windows.heading_w[:, 0]
    assert np.degrees(np.arccos(rot[:, 2, 2])).max() > 20
    np.testing.assert_allclose(heading[:, 2], 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(heading, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose((heading * rot[:, :, 1]).sum(-1), 0, atol=1e-6)
    assert np.all((heading * rot[:, :, 0]).sum(-1) > 0)


def test_a_fresh_delta_changes_nothing_and_a_constant_one_acts_as_the_action():
    plant = nominal_plant(PointMassConfig())
    windows = cut_windows(fly(plant), 0.5, 0.3)
    delta = delta_network.init(jax.random.key(0))
    plain = jax.jit(replay)(plant, windows, None)
    same = jax.jit(replay)(plant, windows, delta)
    np.testing.assert_array_equal(plain[0], same[0])
    assert not np.any(same[2])
    delta["output.bias"] = jnp.asarray([1.0, -0.5, 0.2])
    shifted = windows._replace(action_b=windows.action_b + np.array([1.0, -0.5, 0.2], np.float32))
    pos, _, correction = jax.jit(replay)(plant, windows, delta)
    np.testing.assert_allclose(correction[:, 0], np.tile([1.0, -0.5, 0.2], (len(pos), 1)))
    np.testing.assert_allclose(pos, jax.jit(replay)(plant, shifted, None)[0], atol=1e-5)


def test_windows_leave_out_what_is_missing():
    plant = nominal_plant(PointMassConfig())
    log = fly(plant, 1)[0]
    whole = cut_windows([log], 0.5, 0.1)
    holed = replace(
        log, pos_w=np.where(np.arange(len(log.time_s))[:, None] == 90, np.nan, log.pos_w)
    )
    some = cut_windows([holed], 0.5, 0.1)
    assert 0 < len(some.acc_w) < len(whole.acc_w) and np.all(np.isfinite(some.pos_w))
    with pytest.raises(ValueError, match="no window of 5.0 s in 1 flights \\(flight 0"):
        cut_windows([log], 5.0, 0.1)
    with pytest.raises(ValueError, match="flight 0: columns action_x"):
        cut_windows([replace(log, extra={})], 0.5, 0.1)


@pytest.mark.parametrize("share", [0.01, 0.25, 0.5, 0.99])
def test_a_split_has_no_overlap_and_leaves_nobody_out(share):
    logs = fly(nominal_plant(PointMassConfig()), 7, seconds=1.5)
    for seed in range(5):
        known, held = split(logs, share, seed)
        names = [log.name for log in (*known, *held)]
        assert sorted(names) == sorted(log.name for log in logs) and len(set(names)) == 7
        assert known and len(held) == min(6, max(1, round(share * 7)))
    assert [log.name for log in split(logs, 0.5, 0)[1]] != [
        log.name for log in split(logs, 0.5, 1)[1]
    ]


def test_what_cannot_be_split_is_refused():
    log = fly(nominal_plant(PointMassConfig()), 1, seconds=1.5)
    with pytest.raises(ValueError, match="1 flight given, at least 2"):
        split(log, 0.25, 0)
    for share in (0.0, 1.0, float("nan")):
        with pytest.raises(ValueError, match=f"held_out is {share}"):
            split(log * 2, share, 0)
