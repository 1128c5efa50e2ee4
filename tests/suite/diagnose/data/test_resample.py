"""Series at other times, with holes in them."""

import numpy as np
import pytest

from suite.diagnose.data.sampling import follow_lag, hold, interpolate
from suite.diagnose.data.steps import rows_show_torque, torque_between_rows, with_hidden_torque
from tests.support.vehicles import PLAIN, with_lag

TIME = np.array([0.0, 0.1, 0.2, 0.3])


def test_holes_are_bridged_by_a_line():
    series = np.array([[0.0, np.nan], [np.nan, np.nan], [2.0, np.nan], [3.0, np.nan]])
    found = interpolate(np.array([0.1, 0.25]), TIME, series)
    np.testing.assert_allclose(found, [[1.0, 0.0], [2.5, 0.0]])


def test_the_last_whole_row_is_held():
    series = np.array([[1.0, 1.0], [2.0, np.nan], [3.0, 3.0], [4.0, 4.0]])
    found = hold(np.array([-1.0, 0.15, 0.2, 9.0]), TIME, series)
    np.testing.assert_allclose(found[:, 0], [1.0, 1.0, 3.0, 4.0])
    assert np.isnan(hold(TIME, TIME, np.full((4, 2), np.nan))).all()


def test_speeds_follow_with_the_time_constant():
    wanted = np.vstack([np.zeros((1, 4)), np.full((100, 4), 10.0)])
    speed = follow_lag(wanted, 0.01, 0.05)
    np.testing.assert_allclose(speed[5], 10.0 * (1.0 - np.exp(-1.0)), rtol=1e-12)
    np.testing.assert_array_equal(follow_lag(wanted, 0.01, 0.0), wanted)


@pytest.mark.parametrize(("lag", "share"), [(0.0, 0.1), (0.01, 0.0143), (0.03, 0.0056)])
def test_a_rate_loop_between_rows_turns_less_than_the_rows_show(lag, share):
    """By hand: gain 20/s, rows of 10 ms; without a lag half of the fall, else a twelfth over it."""
    vehicle = with_lag(PLAIN, lag)
    np.testing.assert_allclose(torque_between_rows(vehicle, 0.01)[0], share, rtol=0.01)
    assert not torque_between_rows(vehicle, 0.002).any()  # as often as the loop samples
    assert rows_show_torque(vehicle, 0.01) == (lag >= 0.01)


def test_a_hidden_torque_turns_more_about_its_axis_and_lifts_no_more():
    wave = np.sin(np.arange(40) / 3.0)[:, None] * [1.0, 1.0, -1.0, -1.0]
    speed = 900.0 + 2.0 * wave
    more = with_hidden_torque(speed, PLAIN, 0.01)
    np.testing.assert_allclose(more - 900.0, (1.0 + 0.1) * (speed - 900.0), atol=0.02)
    assert with_hidden_torque(speed, with_lag(PLAIN, 0.03), 0.01) is speed
