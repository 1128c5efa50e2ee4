"""Steps between rows: where they end, when the loop samples, and what lies between rows."""

import numpy as np
import pytest

from suite.diagnose.data.sampling import hold, interpolate
from suite.diagnose.data.steps import (
    padded_grid,
    rows_show_torque,
    step_grid,
    torque_between_rows,
    with_hidden_torque,
    with_lost_rows,
)
from tests.support.vehicles import PLAIN, with_lag


def test_a_slow_loop_samples_at_its_own_times_and_padding_adds_steps_of_no_length():
    grid = step_grid(np.array([0.0, 0.01, 0.02]), 0.005)
    samples_s = grid.edge_s[:-1][grid.sample_s > 0]
    np.testing.assert_allclose(samples_s, [0.0, 0.005, 0.01, 0.015])
    assert np.diff(grid.edge_s).max() < 0.003
    np.testing.assert_allclose(grid.lead_s, 0.0, atol=1e-12)
    grid = step_grid(np.array([0.0, 0.01, 0.02]), 0.002)
    for at_front, steps in ((False, slice(10)), (True, slice(6, None))):
        longer = padded_grid(grid, 16, at_front)
        np.testing.assert_array_equal(longer.sample_s[steps], grid.sample_s)
        assert (np.diff(longer.edge_s) == 0.0).sum() == 6 == (longer.sample_s == 0.0).sum()


@pytest.mark.parametrize(
    ("row_s", "period_s", "steps", "lead_s"),
    [
        (0.01, 0.002, 20, 0.0),
        # Rates held for a period are old by half of it on average, ours by half a step of 2 ms.
        (0.01, 0.001, 20, 0.0005),
        (0.01, 0.0005, 20, 0.00075),
        # Rows nearer than a step share one. The loop samples at every row, so its rates are old by
        # half a row.
        (0.001, 0.005, 20, 0.0005),
    ],
)
def test_samples_of_a_fast_loop_are_taken_together(row_s, period_s, steps, lead_s):
    grid = step_grid(row_s * np.arange(round(0.04 / row_s) + 1), period_s)
    np.testing.assert_allclose(grid.edge_s, np.linspace(0.0, 0.04, steps + 1), atol=1e-12)
    np.testing.assert_allclose(grid.sample_s, 0.002)
    np.testing.assert_allclose(grid.lead_s, lead_s, atol=1e-9)


def test_a_lost_row_is_put_in_on_a_line_and_jitter_is_none():
    rng = np.random.default_rng(0)
    time_s = np.arange(50) * 0.01 + rng.uniform(-0.0015, 0.0015, 50)
    command = np.stack([time_s**2, time_s], axis=1)
    kept_s, kept = with_lost_rows(time_s, command)
    assert kept_s is time_s and kept is command
    some = np.delete(np.arange(50), [20, 30, 31])
    filled_s, filled = with_lost_rows(time_s[some], command[some])
    assert len(filled_s) == 50 and np.diff(filled_s).min() > 0.0
    np.testing.assert_allclose(filled_s[20], time_s[[19, 21]].mean())
    np.testing.assert_allclose(filled[:, 1], filled_s, atol=1e-12)
    np.testing.assert_array_equal(filled[-1], command[-1])


def test_measurements_are_joined_across_holes_and_commands_held():
    time_s = np.array([0.0, 0.1, 0.2, 0.3])
    series = np.array([[0.0, np.nan], [np.nan, np.nan], [2.0, np.nan], [3.0, np.nan]])
    found = interpolate(np.array([0.1, 0.25]), time_s, series)
    np.testing.assert_allclose(found, [[1.0, 0.0], [2.5, 0.0]])
    held = hold(np.array([-1.0, 0.15, 0.2, 9.0]), time_s, series[:, :1])
    np.testing.assert_allclose(held[:, 0], [0.0, 0.0, 2.0, 3.0])
    assert np.isnan(hold(time_s, time_s, series)).all()


@pytest.mark.parametrize(("lag", "share"), [(0.0, 0.1), (0.01, 0.0143), (0.03, 0.0056)])
def test_a_rate_loop_between_rows_turns_less_than_the_rows_show(lag, share):
    """By hand: gain 20/s, rows of 10 ms; without a lag half of the fall, else a twelfth over it."""
    vehicle = with_lag(PLAIN, lag)
    np.testing.assert_allclose(torque_between_rows(vehicle, 0.01)[0], share, rtol=0.01)
    assert not torque_between_rows(vehicle, 0.002).any()  # as often as the loop samples
    assert rows_show_torque(vehicle, 0.01) == (lag >= 0.01)


def test_torque_that_rows_do_not_show_is_added_about_its_axis_alone():
    wave = 2.0 * np.sin(np.arange(40) / 3.0)[:, None] * [1.0, 1.0, -1.0, -1.0]
    more = with_hidden_torque(900.0 + wave, PLAIN, 0.01)
    np.testing.assert_allclose(more - 900.0, 1.1 * wave, atol=0.02)
