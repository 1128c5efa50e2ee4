"""The size of an effect on flights, from the shift of the simulated values."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.data.windows import SLICES
from suite.diagnose.estimate.gauss_newton import Intervals
from suite.diagnose.sources.source import TOGETHER, sizes_by_effect
from suite.diagnose.sources.view_source import ViewSource
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict import gap as gaps


def windows(until_s=1.0, without=()):
    """Return three windows of 101 rows; those up to a time have all but some channel groups."""
    row_s = np.tile(np.linspace(0.0, 1.0, 101), (3, 1))
    seen = np.ones((3, 101, 19), bool) & (row_s <= until_s)[..., None]
    for group in without:
        seen[..., SLICES[group]] = False
    found: Any = SimpleNamespace(row_s=row_s, valid=seen)
    return found


def pushed(acc=0.0, turn=0.0):
    """Return the shift by a constant acceleration along x and angular acceleration about y."""
    time = np.linspace(0.0, 1.0, 101)
    moved = np.zeros((3, 101, 19))
    moved[..., 0], moved[..., 6], moved[..., 10] = 0.5 * acc * time**2, acc * time, turn * time
    return moved


@pytest.mark.parametrize(("until_s", "without"), [(1.0, ()), (0.25, ()), (0.25, ("velocity",))])
def test_a_constant_push_has_its_own_size_however_long_a_stretch_is_trusted(until_s, without):
    seen = windows(until_s, (*without, "accelerometer"))
    size = gaps.rollout_size(pushed(0.08, 0.7), seen, False)
    assert size.force == pytest.approx(0.08) and size.torque == pytest.approx(0.7)
    assert size.drift == pytest.approx(0.04)


def test_with_measured_rotor_speeds_a_rotation_is_no_force_and_no_drift():
    """Without a rate loop 0.4 rad/s² tilts the thrust, which moves the drone by 0.16 m."""
    time = np.linspace(0.0, 1.0, 101)
    moved = pushed(0.02, 0.4)
    moved[..., 0] += 9.81 * 0.4 * time**4 / 24.0
    moved[..., 6] += 9.81 * 0.4 * time**3 / 6.0
    seen = windows(without=("accelerometer",))
    open_loop, closed_loop = (gaps.rollout_size(moved, seen, by) for by in (True, False))
    assert not open_loop.relevant(THRESHOLDS) and open_loop.drift is None
    assert open_loop.torque == pytest.approx(0.4) and open_loop.force < 0.05
    assert closed_loop.relevant(THRESHOLDS)


def test_a_signal_slower_than_the_horizon_has_the_size_at_its_first_row():
    seen = windows(without=("accelerometer",))
    seen.valid[..., SLICES["velocity"]] = False
    seen.valid[:, 40::40, SLICES["velocity"]] = True
    assert gaps.rollout_size(pushed(0.08), seen, True).force == pytest.approx(0.08)


def test_a_bias_of_the_accelerometer_counts_as_a_force_and_a_views_size_is_in_its_own_unit():
    moved = np.zeros((3, 101, 19))
    moved[..., 12] = 0.06
    assert size_of(moved).force == pytest.approx(0.06)
    assert gaps.rollout_size(moved, windows(without=("accelerometer",)), False).force == 0.0
    moved = np.tile([0.3, 0.0, 0.4], (5, 1))
    views: list[Any] = [SimpleNamespace(view=SimpleNamespace(in_world=w)) for w in (True, False)]
    force, torque = (ViewSource.size_of(view, gaps.rms_length(moved)) for view in views)
    assert force == gaps.EffectSize(pytest.approx(0.5), 0.0, None)
    assert torque == gaps.EffectSize(0.0, pytest.approx(0.5), None)


def size_of(moved, z=0.0):
    return gaps.rollout_size(moved, windows(), False, z)


def test_the_upper_end_of_a_size_holds_what_the_interval_allows():
    slope = pushed(1.0)[..., None]
    upper = gaps.upper_size(slope, np.array([0.03]), np.array([[0.01]]), size_of)
    assert upper.force == pytest.approx(0.04) and not upper.relevant(THRESHOLDS)
    unsure = gaps.upper_size(slope, np.array([0.03]), np.array([[0.03]]), size_of)
    assert unsure.relevant(THRESHOLDS), "a small effect that may be large is no finding of none"
    slope[0] *= 2.0
    assert gaps.upper_size(slope, np.array([0.03]), np.array([[0.01]]), size_of).force > 0.06


def test_parameters_that_cancel_have_the_size_of_their_sum():
    """Two drags may have wide intervals, though the flights determine their sum."""
    slope, change = np.repeat(pushed(1.0)[..., None], 2, axis=-1), np.array([0.5, -0.47])
    for correlation, size in ((-1.0, 0.03), (0.0, 0.03 + 0.2 * 2**0.5), (1.0, 0.43)):
        by_stretch = 7.0 * np.array([[1.0, correlation], [correlation, 1.0]])
        intervals = Intervals(np.array([0.2, 0.2]), by_stretch, by_stretch)
        factor = intervals.factor()
        assert np.linalg.norm(factor, axis=1) == pytest.approx(intervals.half_width)
        assert gaps.upper_size(slope, change, factor, size_of).force == pytest.approx(size)


def test_an_effect_that_the_models_own_error_may_be_has_no_size_for_certain():
    """A wide interval is no reason to name it: the effect may be zero."""
    change, width, slope = np.array([0.05]), np.array([0.03]), pushed(1.0)[..., None]
    space = SimpleNamespace(entries=[SimpleNamespace(effect="clock_offset")])
    named = [SimpleNamespace(candidate=SimpleNamespace(name="clock_offset"))]
    last = SimpleNamespace(evidence=SimpleNamespace(space=space))
    judged = SimpleNamespace(intervals=lambda _: Intervals(width, np.eye(1), np.eye(1)))
    found: Any = SimpleNamespace(named=named, last=last, indices=[0], judged=judged)
    found.estimate, found.start = (SimpleNamespace(theta=t) for t in (change, 0.0 * change))

    def upper(error):
        sizes = sizes_by_effect(found, slope, size_of, np.array([error]))
        size, upper = sizes["clock_offset"]
        assert size.force == pytest.approx(0.05) and sizes[TOGETHER] == (size, upper)
        return upper

    assert upper(0.0).force == pytest.approx(0.08)
    assert upper(0.01).force == pytest.approx(0.07)
    assert upper(0.04) == gaps.EffectSize(0.0, 0.0, 0.0)


def test_one_parameter_beyond_the_models_error_is_enough():
    change, width = np.array([0.13, -0.12, 0.06]), np.array([0.03, 0.04, 0.05])
    assert not gaps.beyond_error(change, np.array([0.20, 0.10, 0.12]), width)
    assert gaps.beyond_error(change, np.array([0.20, 0.07, 0.12]), width)
    # Only all parameters together are significant: the error must explain each of them.
    assert gaps.beyond_error(change, np.array([0.20, 0.10, 0.12]), 5.0 * width)
    assert not gaps.beyond_error(change, np.array([0.20, 0.13, 0.12]), 5.0 * width)


@pytest.mark.parametrize(
    "size",
    [gaps.EffectSize(0.05, 0, 0), gaps.EffectSize(0, 0.5, None), gaps.EffectSize(0, 0, 0.025)],
)
def test_one_threshold_is_enough_and_none_at_all_keeps_everything(size):
    assert size.relevant(THRESHOLDS)
    below = gaps.EffectSize(*(0.99 * (value or 0.0) for value in size))
    assert not below.relevant(THRESHOLDS) and below.relevant(Thresholds(relevance=(0.0, 0.0, 0.0)))
