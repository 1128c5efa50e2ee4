"""Steps between rows: where they end, when the loop looks, and what a lost row is worth."""

import numpy as np
import pytest

from suite.diagnose.data.steps import padded_grid, step_grid, with_lost_rows


def test_steps_on_a_grid_are_the_loops_periods():
    grid = step_grid(np.arange(11) * 0.01, 0.002)
    np.testing.assert_allclose(grid.edge_s, np.arange(51) * 0.002, atol=1e-12)
    np.testing.assert_allclose(grid.sample_s, 0.002)
    np.testing.assert_allclose(grid.lead_s, 0.0, atol=1e-12)


def test_a_row_off_the_grid_ends_a_step():
    rows = np.array([0.0, 0.0093, 0.0211, 0.03])
    grid = step_grid(rows, 0.002)
    for row in rows:
        assert np.abs(grid.edge_s - row).min() < 1e-12
    assert 0.0015 < np.diff(grid.edge_s).min() and np.diff(grid.edge_s).max() < 0.0025


def test_a_slow_loop_looks_at_its_own_times_and_steps_between():
    grid = step_grid(np.array([0.0, 0.01, 0.02]), 0.005)
    looks = grid.edge_s[:-1][grid.sample_s > 0]
    np.testing.assert_allclose(looks, [0.0, 0.005, 0.01, 0.015])
    assert np.diff(grid.edge_s).max() < 0.003
    np.testing.assert_allclose(grid.lead_s, 0.0, atol=1e-12)


@pytest.mark.parametrize(("period", "lead"), [(0.001, 0.0005), (0.0005, 0.00075)])
def test_looks_of_a_fast_loop_are_taken_together(period, lead):
    """Rates held for a period are old by half of one on average, ours by half a step of 2 ms."""
    grid = step_grid(np.arange(5) * 0.01, period)
    assert len(grid.sample_s) == 20
    np.testing.assert_allclose(grid.lead_s, lead, atol=1e-12)


def test_rows_nearer_than_a_step_share_one_and_start_the_loop_anew():
    grid = step_grid(np.arange(101) * 0.001, 0.005)
    assert len(grid.sample_s) == 50
    # The loop looks at every row, so that what it knows is old by half a row.
    np.testing.assert_allclose(grid.lead_s, 0.0005, atol=1e-9)


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


def test_padding_moves_nothing():
    grid = step_grid(np.array([0.0, 0.01, 0.02]), 0.002)
    for at_front in (False, True):
        longer = padded_grid(grid, 16, at_front)
        assert len(longer.sample_s) == 16 and len(longer.edge_s) == 17
        assert (np.diff(longer.edge_s) == 0.0).sum() == 6
        assert longer.edge_s[0] == 0.0 and longer.edge_s[-1] == 0.02
        assert (longer.sample_s > 0.0).sum() == 10
