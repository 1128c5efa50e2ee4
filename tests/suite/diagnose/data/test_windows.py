"""Signals at rates of their own, steps between rows, and the windows that are cut of a log."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data import hold_out, sampling, steps
from suite.diagnose.data.noise import noise_of, rotor_noise
from suite.diagnose.data.windows import BURN_IN_S, LENGTH_S, SLICES, STEPS, cut, take
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tests.support.broken_logs import changed, on_the_ground, rows
from tests.support.diagnosis_flights import NOISE
from tests.support.vehicles import PLAIN, with_effects, with_lag


def on_rows(values, chosen):
    """Return `values` on every row that is `chosen`, and NaN on the others."""
    values = np.array(values)
    values[~chosen] = np.nan
    return values


@pytest.fixture(scope="module")
def row(log):
    return np.arange(len(log.time_s))


def test_a_slower_signal_is_joined_by_lines_a_command_is_held_and_a_hole_stays(log, row):
    assert sampling.on_every_row(log) is log
    hole = (log.time_s > 1.0) & (log.time_s < 1.3)
    sparse = replace(
        log,
        rate_b=on_rows(log.rate_b, (row % 2 == 0) & ~hole),
        thrust_cmd=on_rows(log.thrust_cmd, row % 3 == 0),
        quat_wxyz=on_rows(-log.quat_wxyz * np.where(row % 4, 1, -1)[:, None], row % 2 == 0),
    )
    whole = sampling.on_every_row(sparse)
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
    kept, (note,) = sampling.without_slow_rotors([log, slow])
    assert kept[0] is log and kept[1].rotor_speed is None
    assert "3.3 Hz" in note and "at least 10 Hz" in note
    # 500 rows a second, and rotor speeds that are read one after another.
    in_turn = np.where(row[:, None] % 4 == np.arange(4), log.rotor_speed, np.nan)
    rate_b = on_rows(log.rate_b, row % 3 == 1)
    sparse = replace(log, time_s=0.2 * log.time_s, rate_b=rate_b, rotor_speed=in_turn)
    (same,), notes = sampling.with_fewer_rows([sparse], Thresholds(most_rows=len(row)))
    assert same is sparse and notes == []
    half = Thresholds(most_rows=len(row) // 2)
    (few,), (note,) = sampling.with_fewer_rows([sparse], half)
    assert "every 3. row" in note
    position, turning = (np.isfinite(x).all(axis=1) for x in (few.pos_w, few.rate_b))
    np.testing.assert_array_equal(few.time_s[position], sparse.time_s[::3])
    # Rates are averaged, so that vibrations do not alias.
    own = log.rate_b[row % 3 == 1]
    averaged = [own[max(k - 1, 0) : k + 2].mean(axis=0) for k in range(0, len(own), 3)]
    np.testing.assert_allclose(few.rate_b[turning][1:-1], averaged[1:-1], atol=1e-6)
    # A command holds until the next row that stays, so it is the mean of those in between.
    held = [log.thrust_cmd[k : k + 3].mean() for k in range(0, len(row), 3)]
    np.testing.assert_allclose(few.thrust_cmd[position], held)
    for motor in range(4):
        kept_speed = few.rotor_speed[np.isfinite(few.rotor_speed[:, motor]), motor]
        np.testing.assert_array_equal(kept_speed, log.rotor_speed[row % 4 == motor, motor][::2])
    assert len(few.rotor_speed) == len(few.time_s) < len(row)
    # At 100 rows a second, every third row would leave too few for a window of torque.
    (few,), _ = sampling.with_fewer_rows([log], half)
    np.testing.assert_array_equal(few.time_s, log.time_s[::2])
    # Where signals miss a few rows each, all of them still keep the same rows.
    rng, gappy = np.random.default_rng(0), {}
    for name in ("pos_w", "vel_w", "quat_wxyz", "rate_b"):
        gappy[name] = on_rows(getattr(log, name), rng.random(len(row)) > 0.01)
    (few,), _ = sampling.with_fewer_rows([replace(log, **gappy)], half)
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
    assert np.isfinite(windows.start.rate_b).all() and np.isfinite(windows.burn_in_rate_b).all()
    # Rotor speeds have their own rows, whatever those of the rates are.
    assert windows.rotor_valid.sum(axis=1).min() > 90
    assert rotor_noise(windows) == pytest.approx(NOISE["motor"], rel=0.5)
    residual = 0.01 * np.random.default_rng(0).standard_normal(windows.valid.shape)
    np.testing.assert_allclose(noise_of(residual, windows)[SLICES["rates"]], 0.01, rtol=accuracy)


def test_rows_are_thinned_so_that_no_signal_is_lost():
    time_s = 0.001 * np.arange(1000)
    odd = np.arange(1000) % 2 == 1
    seen = np.stack([odd, ~odd, np.arange(1000) % 50 == 7], axis=1)
    kept = sampling.thinned(seen, time_s, 101)
    assert len(kept) <= 101 and (np.diff(kept) > 0).all()
    assert seen[kept].sum(axis=0).min() >= 18
    every_third = sampling.thinned(np.ones((250, 2), bool), time_s[:250], 101)
    np.testing.assert_array_equal(every_third, np.arange(0, 250, 3))


def test_a_slow_loop_samples_at_its_own_times_and_padding_adds_steps_of_no_length():
    grid = steps.step_grid(np.array([0.0, 0.01, 0.02]), 0.005)
    samples_s = grid.edge_s[:-1][grid.sample_s > 0]
    np.testing.assert_allclose(samples_s, [0.0, 0.005, 0.01, 0.015])
    assert np.diff(grid.edge_s).max() < 0.003
    np.testing.assert_allclose(grid.lead_s, 0.0, atol=1e-12)
    grid = steps.step_grid(np.array([0.0, 0.01, 0.02]), 0.002)
    for at_front, kept in ((False, slice(10)), (True, slice(6, None))):
        longer = steps.padded_grid(grid, 16, at_front)
        np.testing.assert_array_equal(longer.sample_s[kept], grid.sample_s)
        assert (np.diff(longer.edge_s) == 0.0).sum() == 6 == (longer.sample_s == 0.0).sum()


@pytest.mark.parametrize(
    ("row_s", "period_s", "lead_s"),
    [
        (0.01, 0.002, 0.0),
        # Rates held for a period are old by half of it on average, ours by half a step of 2 ms.
        (0.01, 0.001, 0.0005),
        (0.01, 0.0005, 0.00075),
        # Rows nearer than a step share one. The loop samples at every row, so its rates are old by
        # half a row.
        (0.001, 0.005, 0.0005),
    ],
)
def test_samples_of_a_fast_loop_are_taken_together(row_s, period_s, lead_s):
    grid = steps.step_grid(row_s * np.arange(round(0.04 / row_s) + 1), period_s)
    np.testing.assert_allclose(grid.edge_s, np.linspace(0.0, 0.04, 20 + 1), atol=1e-12)
    np.testing.assert_allclose(grid.sample_s, 0.002)
    np.testing.assert_allclose(grid.lead_s, lead_s, atol=1e-9)


def test_a_lost_row_is_put_in_on_a_line_and_jitter_is_none():
    rng = np.random.default_rng(0)
    time_s = np.arange(50) * 0.01 + rng.uniform(-0.0015, 0.0015, 50)
    command = np.stack([time_s**2, time_s], axis=1)
    kept_s, kept = steps.with_lost_rows(time_s, command)
    assert kept_s is time_s and kept is command
    some = np.delete(np.arange(50), [20, 30, 31])
    filled_s, filled = steps.with_lost_rows(time_s[some], command[some])
    assert len(filled_s) == 50 and np.diff(filled_s).min() > 0.0
    np.testing.assert_allclose(filled_s[20], time_s[[19, 21]].mean())
    np.testing.assert_allclose(filled[:, 1], filled_s, atol=1e-12)
    np.testing.assert_array_equal(filled[-1], command[-1])


def test_measurements_are_joined_across_holes_and_commands_held():
    time_s = np.array([0.0, 0.1, 0.2, 0.3])
    series = np.array([[0.0, np.nan], [np.nan, np.nan], [2.0, np.nan], [3.0, np.nan]])
    found = sampling.interpolate(np.array([0.1, 0.25]), time_s, series)
    np.testing.assert_allclose(found, [[1.0, 0.0], [2.5, 0.0]])
    held = sampling.hold(np.array([-1.0, 0.15, 0.2, 9.0]), time_s, series[:, :1])
    np.testing.assert_allclose(held[:, 0], [0.0, 0.0, 2.0, 3.0])
    assert np.isnan(sampling.hold(time_s, time_s, series)).all()


@pytest.mark.parametrize(("lag", "share"), [(0.0, 0.1), (0.01, 0.0143), (0.03, 0.0056)])
def test_a_rate_loop_between_rows_turns_less_than_the_rows_show(lag, share):
    """By hand: gain 20/s, rows of 10 ms; without a lag half of the fall, else a twelfth over it."""
    vehicle = with_lag(PLAIN, lag)
    np.testing.assert_allclose(steps.torque_between_rows(vehicle, 0.01)[0], share, rtol=0.01)
    assert not steps.torque_between_rows(vehicle, 0.002).any()  # as often as the loop samples
    assert steps.rows_show_torque(vehicle, 0.01) == (lag >= 0.01)


def test_torque_that_rows_do_not_show_is_added_about_its_axis_alone():
    wave = 2.0 * np.sin(np.arange(40) / 3.0)[:, None] * [1.0, 1.0, -1.0, -1.0]
    more = steps.with_hidden_torque(900.0 + wave, PLAIN, 0.01)
    np.testing.assert_allclose(more - 900.0, 1.1 * wave, atol=0.02)


def test_windows_hold_the_rows_and_commands_of_their_time(log):
    windows, warnings = cut([log], PLAIN, False)
    assert windows is not None and not warnings
    assert len(windows.flight) == 3 and np.diff(windows.start_s).min() >= LENGTH_S - 1e-9
    burn_in = windows.burn_in_rate_b.shape[1]
    np.testing.assert_allclose(windows.edge_s[:, [0, burn_in, -1]], [[-BURN_IN_S, 0, LENGTH_S]] * 3)
    assert windows.rotor_speed.shape[1] == STEPS[0]
    assert windows.edge_s.shape[1] == burn_in + STEPS[0] + 1
    assert np.diff(windows.edge_s).min() >= 0.0
    row = int(np.searchsorted(log.time_s, windows.start_s[1] - 1e-9))
    np.testing.assert_array_equal(windows.start.pos_w[1], log.pos_w[row])
    np.testing.assert_array_equal(windows.row.pos_w[1][7], log.pos_w[row + 7])
    now = int(np.searchsorted(windows.command_s[1], -1e-9))
    assert windows.command[1, now, 0] == log.thrust_cmd[row]
    held = np.diff(windows.command_s[1, now : now + 2]) * windows.command[1, now]
    np.testing.assert_allclose(np.diff(windows.command_sum[1, now : now + 2], axis=0)[0], held)
    np.testing.assert_array_equal(
        take(windows, windows.start_s > 1.0).start.pos_w, windows.start.pos_w[1:]
    )


@pytest.mark.parametrize("late_s", [0.018, -0.018])
def test_a_pose_from_before_the_start_or_after_the_end_is_not_compared(log, late_s):
    """A rollout has no pose from then; the vehicle file says how late the log has poses."""
    late = with_effects(PLAIN, clock_offset=(late_s,))
    (in_time, _), (windows, _) = (cut([log], vehicle, False) for vehicle in (PLAIN, late))
    pose = np.r_[SLICES["position"], SLICES["attitude"], SLICES["velocity"]]
    row_s = np.asarray(windows.row_s)
    is_outside = row_s < late_s if late_s > 0.0 else row_s > row_s[:, -1:] + late_s
    assert is_outside.sum(axis=1).min() >= 2 and in_time.valid[is_outside][:, pose].all()
    assert not windows.valid[is_outside][:, pose].any()
    assert windows.valid[is_outside][:, SLICES["rates"]].all()
    np.testing.assert_array_equal(windows.valid[~is_outside], in_time.valid[~is_outside])


def test_eulers_steps_are_those_that_a_log_states_or_periods_of_the_rate_loop(log):
    for about, step_s in (({"step_s": 0.0025}, 0.0025), ({}, 1.0 / PLAIN.controller.frequency)):
        windows, _ = cut([replace(log, about=about)], PLAIN, False, integrator="euler")
        length_s = np.diff(windows.edge_s)
        np.testing.assert_allclose(length_s[length_s > 0.0], step_s, rtol=1e-6)


@pytest.mark.parametrize("stated", [None, True, "0.002", -0.1, float("nan"), 0.002])
def test_times_of_commands_are_shifted_as_far_as_a_log_states(log, stated):
    jittery = replace(log, about={"command_jitter_s": stated})
    as_logged, shifted = (cut([jittery], PLAIN, False, jitter=on)[0] for on in (False, True))
    used = np.isfinite(as_logged.command_s)
    shift_s = (shifted.command_s - np.where(used, as_logged.command_s, 0.0))[used]
    assert np.std(shift_s) == pytest.approx(0.002 if stated == 0.002 else 0.0, rel=0.2)
    np.testing.assert_array_equal(shifted.command, as_logged.command)


def test_a_pause_of_commands_with_stated_times_is_no_lost_row(log):
    some = replace(log, thrust_cmd=np.where(np.arange(len(log.time_s)) % 9, log.thrust_cmd, np.nan))
    stated = replace(some, about={"command_jitter_s": 0.0})
    filled, held = (cut([one], PLAIN, False)[0] for one in (some, stated))
    counts = [np.isfinite(one.command_s).sum(axis=1) for one in (filled, held)]
    assert (counts[0] > counts[1] + 10).all()


def test_few_shapes_hold_rows_of_every_rate(log):
    few, many = (144 + 512 + 1, 192), (144 + 512 + 1, 1536)
    more = 704 - 512
    shapes = {50.0: few, 97.0: few, 140.0: (few[0] + more, few[1])}
    shapes |= {250.0: many, 310.0: (many[0] + more, many[1]), 400.0: many, 990.0: many}
    for rate_hz, shape in shapes.items():
        rows_s = np.arange(0.0, 1.9, 1.0 / rate_hz)
        near = np.clip(np.searchsorted(log.time_s, rows_s), 0, len(log.time_s) - 1)
        windows, _ = cut([replace(rows(log, near), time_s=rows_s)], PLAIN, False)
        assert (windows.edge_s.shape[1], windows.command_s.shape[1]) == shape, rate_hz


def test_what_is_an_input_or_derived_is_no_measurement(log):
    for rotor_input in (False, True):
        windows, _ = cut([replace(log, velocity_derived=True)], PLAIN, rotor_input)
        seen = windows.valid.any(axis=(0, 1))
        assert seen[SLICES["rotor speed"]].all() != rotor_input
        assert bool(windows.rotor_speed.any()) == rotor_input
        assert not seen[SLICES["velocity"]].any() and seen[SLICES["position"]].all()


def test_no_window_lies_over_a_hole_and_a_log_of_holes_is_named(log):
    holed = rows(log, (log.time_s < 0.8) | (log.time_s > 1.15))
    windows, _ = cut([holed], PLAIN, False)
    assert windows.start_s.min() > 1.15 + BURN_IN_S, "the rotors follow commands before it"
    none, (warning,) = cut([holed], PLAIN, False, limits=Thresholds(longest_hole_s=1e-3))
    assert none is None
    assert warning == f"{log.name}: no stretch of 1.3 s in flight without a hole"


@pytest.mark.parametrize("rotor_input", [False, True])
def test_no_window_has_rows_on_the_ground(log, rotor_input):
    rested = on_the_ground(log, 3.0, 2.5)
    windows, _ = cut([rested], PLAIN, rotor_input)
    margin = THRESHOLDS.ground_margin_s
    assert windows is not None and windows.start_s.min() > 3.0 + margin
    end_s = 3.0 + log.time_s[-1] - margin + THRESHOLDS.longest_hole_s
    assert (windows.start_s + LENGTH_S).max() < end_s
    # A short cut of the throttle in slow flight is no rest.
    cuts = np.where((log.time_s > 1.0) & (log.time_s < 1.4), 0.0, 1.0)
    names = ("vel_w", "rotor_speed", "thrust_cmd")
    slow = changed(log, **dict.fromkeys(names, lambda values: (values.T * cuts).T))
    for one, other in zip(cut([slow], PLAIN, False), cut([log], PLAIN, False), strict=True):
        assert np.array_equal(getattr(one, "start_s", 0), getattr(other, "start_s", 0))


@pytest.mark.parametrize("rotor_input", [False, True])
def test_no_window_lies_over_a_hole_of_its_input(log, rotor_input):
    name, kept = "rotor_speed" if rotor_input else "rate_cmd_b", np.abs(log.time_s - 0.975) > 0.175
    holed = replace(log, **{name: on_rows(getattr(log, name), kept)})
    own, other = (cut([holed], PLAIN, given)[0] for given in (rotor_input, not rotor_input))
    assert own.start_s.min() > 1.15 + BURN_IN_S and other.start_s.min() < 0.5


def test_of_many_windows_as_many_as_allowed_are_spread_over_the_flights(log):
    logs = [log, replace(log, name="other")]
    every, _ = cut(logs, PLAIN, False)
    some, (warning,) = cut(logs, PLAIN, False, limits=Thresholds(most_windows=4))
    assert warning == f"4 stretches of 1 s, evenly spread, are used of {len(every.flight)}"
    assert some.flight.tolist() == [0, 0, 1, 1]
    assert some.start_s[0] == every.start_s[0] and some.start_s[-1] == every.start_s[-1]
    second, _ = cut(logs, PLAIN, False, only=[1])
    assert set(second.flight.tolist()) == {1}
    one, _ = cut([log], PLAIN, True, limits=Thresholds(most_rotor_windows=1))
    assert len(one.flight) == 1, "windows under measured rotor speeds have a limit of their own"


def test_noise_is_estimated_under_a_models_error(log):
    windows, _ = cut([log], PLAIN, True)
    time_s, noise = np.asarray(windows.row_s)[..., None], np.random.default_rng(0)
    residual = 0.3 * time_s**2 + 0.002 * noise.standard_normal(windows.valid.shape)
    sigma = noise_of(residual, windows)
    np.testing.assert_allclose(sigma[:12], 0.002, rtol=0.15)
    assert np.isnan(sigma[12:]).all(), "of no measurement"
    # Motors without a lag move between rows, which counts as noise.
    assert rotor_noise(windows) == pytest.approx(NOISE["motor"], rel=0.5)


def test_what_one_flight_alone_identifies_is_fitted_and_of_a_single_one_the_end_held_out(log):
    logs = [replace(log, name=f"flight_{k}") for k in range(3)]
    windows, _ = cut(logs, PLAIN, False)
    information = np.ones((len(windows.flight), 2))
    information[windows.flight != 2, 1] = 1e-3
    fitted, names = hold_out.choose_held_out(logs, windows.flight, windows.start_s, information)
    assert names == ["flight_1"] and set(windows.flight[fitted]) == {0, 2}
    windows, _ = cut([log], PLAIN, False)
    alike = np.ones((len(windows.flight), 1))
    fitted, names = hold_out.choose_held_out([log], windows.flight, windows.start_s, alike)
    assert fitted.any() and not fitted[-1]
    assert names == [f"flight_0 from {windows.start_s[~fitted].min():.1f} s"]


@pytest.mark.parametrize("begin_s", [0.0, 45.0])
def test_windows_in_a_part_of_a_single_log_are_split_where_they_are(log, begin_s):
    start_s = begin_s + np.arange(0.0, 15.0, 0.5)
    long = replace(log, time_s=60.0 * np.linspace(0.0, 1.0, len(log.time_s)))
    fitted, _ = hold_out.choose_held_out([long], 0 * start_s, start_s, np.ones((len(start_s), 1)))
    assert fitted.mean() == pytest.approx(THRESHOLDS.lone_fitted_share, abs=0.05)


def test_the_windows_of_the_end_of_a_log_count_alone_for_the_largest_number(log):
    limits = Thresholds(most_windows=6)
    windows, _ = cut([log], PLAIN, False, stride_s=0.1, limits=limits, since_s=2.0)
    assert len(windows.flight) == 6 and windows.start_s.min() == pytest.approx(2.0, abs=0.02)
