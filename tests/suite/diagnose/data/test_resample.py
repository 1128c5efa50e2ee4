"""Series at other times, with holes in them."""

import numpy as np

from suite.diagnose.data.sampling import follow_lag, hold, interpolate

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
