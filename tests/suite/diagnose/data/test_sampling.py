"""Signals at rates of their own: what lies between rows, what is left out, what is thinned."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.noise import noise_of, rotor_noise
from suite.diagnose.data.sampling import on_every_row, thinned, with_fewer_rows, without_slow_rotors
from suite.diagnose.data.windows import SLICES, cut
from suite.diagnose.thresholds import Thresholds
from tests.support.diagnosis_flights import NOISE
from tests.support.vehicles import PLAIN


def on_rows(values, chosen):
    """Return `values` on every row that is `chosen`, and NaN on the others."""
    values = np.array(values)
    values[~chosen] = np.nan
    return values


@pytest.fixture(scope="module")
def row(log):
    return np.arange(len(log.time_s))


def test_a_slower_signal_is_joined_by_lines_a_command_is_held_and_a_hole_stays(log, row):
    assert on_every_row(log) is log
    hole = (log.time_s > 1.0) & (log.time_s < 1.3)
    sparse = replace(
        log,
        rate_b=on_rows(log.rate_b, (row % 2 == 0) & ~hole),
        thrust_cmd=on_rows(log.thrust_cmd, row % 3 == 0),
        quat_wxyz=on_rows(-log.quat_wxyz * np.where(row % 4, 1, -1)[:, None], row % 2 == 0),
    )
    whole = on_every_row(sparse)
    inside = np.flatnonzero((row % 2 == 1) & ~hole & (row < row[-1]))[2:20]
    middle = 0.5 * (log.rate_b[inside - 1] + log.rate_b[inside + 1])
    np.testing.assert_allclose(whole.rate_b[inside], middle, atol=0.05)
    assert np.isnan(whole.rate_b[hole][2:-2]).all()
    np.testing.assert_array_equal(whole.thrust_cmd[4:6], log.thrust_cmd[3])
    # Quaternions of either sign are one attitude: halfway between two is near both.
    near = np.abs((whole.quat_wxyz[inside] * log.quat_wxyz[inside]).sum(axis=1))
    assert near.min() > 0.999


def test_slow_rotor_speeds_are_left_out_and_of_too_many_rows_a_share_of_each_signal_stays(log, row):
    slow = replace(log, rotor_speed=on_rows(log.rotor_speed, row % 30 == 0))
    kept, (note,) = without_slow_rotors([log, slow])
    assert kept[0] is log and kept[1].rotor_speed is None
    assert "3.3 Hz" in note and "at least 10 Hz" in note
    # 500 rows a second, and rotor speeds that are read one after another.
    in_turn = np.where(row[:, None] % 4 == np.arange(4), log.rotor_speed, np.nan)
    rate_b = on_rows(log.rate_b, row % 3 == 1)
    sparse = replace(log, time_s=0.2 * log.time_s, rate_b=rate_b, rotor_speed=in_turn)
    (same,), notes = with_fewer_rows([sparse], Thresholds(most_rows=len(row)))
    assert same is sparse and notes == []
    (few,), (note,) = with_fewer_rows([sparse], Thresholds(most_rows=len(row) // 2))
    assert "every 3. row" in note
    position = np.isfinite(few.pos_w).all(axis=1)
    np.testing.assert_array_equal(few.time_s[position], sparse.time_s[::3])
    turning = np.isfinite(few.rate_b).all(axis=1)
    # Rates are averaged, so that vibrations do not alias.
    own = log.rate_b[row % 3 == 1]
    averaged = [own[max(k - 1, 0) : k + 2].mean(axis=0) for k in range(0, len(own), 3)]
    np.testing.assert_allclose(few.rate_b[turning][1:-1], averaged[1:-1], atol=1e-6)
    for motor in range(4):
        kept_speed = few.rotor_speed[np.isfinite(few.rotor_speed[:, motor]), motor]
        np.testing.assert_array_equal(kept_speed, log.rotor_speed[row % 4 == motor, motor][::2])
    assert len(few.rotor_speed) == len(few.time_s) < len(row)
    # At 100 rows a second, every third row would leave too few for a window of torque.
    (few,), _ = with_fewer_rows([log], Thresholds(most_rows=len(row) // 2))
    np.testing.assert_array_equal(few.time_s, log.time_s[::2])
    # Where signals miss a few rows each, all of them still keep the same rows.
    rng = np.random.default_rng(0)
    gappy = {
        name: on_rows(getattr(log, name), rng.random(len(row)) > 0.01)
        for name in ("pos_w", "vel_w", "quat_wxyz", "rate_b")
    }
    (few,), _ = with_fewer_rows([replace(log, **gappy)], Thresholds(most_rows=len(row) // 2))
    assert len(few.time_s) < 0.55 * len(row)


@pytest.mark.parametrize(
    ("every", "accuracy"), [(2, 0.4), pytest.param(25, 0.5, id="too few rows for a polynomial")]
)
def test_windows_take_each_signal_by_its_own_rows(log, row, every, accuracy):
    sparse = replace(log, rate_b=on_rows(log.rate_b, row % every == 0))
    windows, warnings = cut([sparse], PLAIN, True)
    assert windows is not None and not warnings
    seen = windows.valid.sum(axis=1)
    assert (seen[:, SLICES["rates"]] <= 101 // every + 1).all() and (seen[:, 0] > 90).all()
    assert np.isfinite(windows.rate_b).all() and np.isfinite(windows.burn_in_rate_b).all()
    # Rotor speeds have their own rows, whatever those of the rates are.
    assert windows.rotor_valid.sum(axis=1).min() > 90
    assert rotor_noise(windows) == pytest.approx(NOISE["motor"], rel=0.5)
    residual = 0.01 * np.random.default_rng(0).standard_normal(windows.valid.shape)
    np.testing.assert_allclose(noise_of(residual, windows)[SLICES["rates"]], 0.01, rtol=accuracy)


def test_rows_are_thinned_so_that_no_signal_is_lost():
    time_s = 0.001 * np.arange(1000)
    odd = np.arange(1000) % 2 == 1
    seen = np.stack([odd, ~odd, np.arange(1000) % 50 == 7], axis=1)
    kept = thinned(seen, time_s, 101)
    assert len(kept) <= 101 and (np.diff(kept) > 0).all()
    assert seen[kept].sum(axis=0).min() >= 18
    every_third = thinned(np.ones((250, 2), bool), time_s[:250], 101)
    np.testing.assert_array_equal(every_third, np.arange(0, 250, 3))
