"""Logs cut into windows: what they hold, what a hole does, their noise, and which are held out."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.hold_out import choose_held_out
from suite.diagnose.data.noise import noise_of, rotor_noise
from suite.diagnose.data.windows import BURN_IN_S, LENGTH_S, SLICES, STEPS, cut, take
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tests.support.broken_logs import on_the_ground, rows
from tests.support.diagnosis_flights import NOISE
from tests.support.vehicles import PLAIN, with_effects


def test_windows_hold_the_rows_and_commands_of_their_time(log):
    windows, warnings = cut([log], PLAIN, False)
    assert windows is not None and not warnings
    assert len(windows.flight) == 3 and np.diff(windows.start_s).min() >= LENGTH_S - 1e-9
    burn_in = windows.burn_in_rate_b.shape[1]
    np.testing.assert_allclose(windows.edge_s[:, [0, burn_in, -1]], [[-BURN_IN_S, 0, LENGTH_S]] * 3)
    steps = windows.rotor_speed.shape[1]
    assert steps == STEPS[0] and windows.edge_s.shape[1] == burn_in + steps + 1
    assert np.diff(windows.edge_s).min() >= 0.0
    row = int(np.searchsorted(log.time_s, windows.start_s[1] - 1e-9))
    np.testing.assert_array_equal(windows.pos_w[1], log.pos_w[row])
    np.testing.assert_array_equal(windows.row_pos_w[1][7], log.pos_w[row + 7])
    now = int(np.searchsorted(windows.command_s[1], -1e-9))
    assert windows.command[1, now, 0] == log.thrust_cmd[row]
    held = np.diff(windows.command_s[1, now : now + 2]) * windows.command[1, now]
    np.testing.assert_allclose(np.diff(windows.command_sum[1, now : now + 2], axis=0)[0], held)
    chosen = take(windows, windows.start_s > 1.0)
    np.testing.assert_array_equal(chosen.pos_w, windows.pos_w[1:])


def test_a_pose_from_before_the_start_is_not_compared(log):
    """A rollout has no pose from then; the vehicle file says how late the log has poses."""
    late = with_effects(PLAIN, clock_offset=(0.018,))
    (in_time, _), (windows, _) = (cut([log], vehicle, False) for vehicle in (PLAIN, late))
    pose = np.r_[SLICES["position"], SLICES["attitude"], SLICES["velocity"]]
    is_before = np.asarray(windows.row_s) < 0.018
    assert is_before.sum(axis=1).min() >= 2 and in_time.valid[is_before][:, pose].all()
    assert not windows.valid[is_before][:, pose].any()
    assert windows.valid[is_before][:, SLICES["rates"]].all()
    np.testing.assert_array_equal(windows.valid[~is_before], in_time.valid[~is_before])


def test_few_shapes_hold_rows_of_every_rate(log):
    shapes = {}
    for rate_hz in (50.0, 97.0, 140.0, 250.0, 310.0, 400.0, 990.0):
        rows_s = np.arange(0.0, 1.9, 1.0 / rate_hz)
        near = np.clip(np.searchsorted(log.time_s, rows_s), 0, len(log.time_s) - 1)
        windows, _ = cut([replace(rows(log, near), time_s=rows_s)], PLAIN, False)
        shape = (windows.edge_s.shape[1], windows.command_s.shape[1])
        shapes.setdefault(shape, []).append(rate_hz)
    assert shapes == {
        (144 + 512 + 1, 192): [50.0, 97.0],
        (144 + 704 + 1, 192): [140.0],
        (144 + 512 + 1, 1536): [250.0, 400.0, 990.0],
        (144 + 704 + 1, 1536): [310.0],
    }


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
    none, warnings = cut([holed], PLAIN, False, limits=Thresholds(longest_hole_s=1e-3))
    assert none is None and warnings == [
        f"{log.name}: no stretch of 1.3 s in flight without a hole"
    ]


@pytest.mark.parametrize("rotor_input", [False, True])
def test_no_window_has_rows_on_the_ground(log, rotor_input):
    rested = on_the_ground(log, 3.0, 2.5)
    windows, _ = cut([rested], PLAIN, rotor_input)
    flown_s = 3.0 + THRESHOLDS.ground_margin_s, 3.0 + log.time_s[-1] - THRESHOLDS.ground_margin_s
    assert windows is not None and windows.start_s.min() > flown_s[0]
    assert (windows.start_s + LENGTH_S).max() < flown_s[1] + THRESHOLDS.longest_hole_s
    # A short cut of the throttle in slow flight is no rest.
    short = np.where((log.time_s > 1.0) & (log.time_s < 1.4), 0.0, 1.0)[:, None]
    slow = replace(log, vel_w=short * log.vel_w, rotor_speed=short * log.rotor_speed,
                   thrust_cmd=short[:, 0] * log.thrust_cmd)  # fmt: skip
    for one, other in zip(cut([slow], PLAIN, False), cut([log], PLAIN, False), strict=True):
        assert np.array_equal(getattr(one, "start_s", 0), getattr(other, "start_s", 0))


@pytest.mark.parametrize("rotor_input", [False, True])
def test_no_window_lies_over_a_hole_of_its_input(log, rotor_input):
    name = "rotor_speed" if rotor_input else "rate_cmd_b"
    lost = np.array(getattr(log, name))
    lost[(log.time_s > 0.8) & (log.time_s < 1.15)] = np.nan
    windows, _ = cut([replace(log, **{name: lost})], PLAIN, rotor_input)
    assert windows is not None and windows.start_s.min() > 1.15 + BURN_IN_S
    other = cut([replace(log, **{name: lost})], PLAIN, not rotor_input)[0]
    assert other is not None and other.start_s.min() < 0.5


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
    rng = np.random.default_rng(0)
    time_s = np.asarray(windows.row_s)[..., None]
    residual = 0.3 * time_s**2 + 0.002 * rng.standard_normal(windows.valid.shape)
    sigma = noise_of(residual, windows)
    np.testing.assert_allclose(sigma[:12], 0.002, rtol=0.15)
    assert np.isnan(sigma[12:]).all(), "of no measurement"
    # Motors without a lag move between rows, which counts as noise.
    assert rotor_noise(windows) == pytest.approx(NOISE["motor"], rel=0.5)


def test_a_flight_that_alone_identifies_something_is_fitted_and_of_a_single_one_the_end_held_out(
    log,
):
    logs = [replace(log, name=f"flight_{k}") for k in range(3)]
    windows, _ = cut(logs, PLAIN, False)
    information = np.ones((len(windows.flight), 2))
    information[windows.flight != 2, 1] = 1e-3
    fitted, names = choose_held_out(logs, windows.flight, windows.start_s, information)
    assert names == ["flight_1"] and set(windows.flight[fitted]) == {0, 2}
    windows, _ = cut([log], PLAIN, False)
    information = np.ones((len(windows.flight), 1))
    fitted, names = choose_held_out([log], windows.flight, windows.start_s, information)
    assert fitted.any() and not fitted[-1]
    assert names == [f"flight_0 from {windows.start_s[~fitted].min():.1f} s"]


@pytest.mark.parametrize("begin_s", [0.0, 45.0])
def test_windows_in_a_part_of_a_single_log_are_split_where_they_are(log, begin_s):
    start_s = begin_s + np.arange(0.0, 15.0, 0.5)
    long = replace(log, time_s=60.0 * np.linspace(0.0, 1.0, len(log.time_s)))
    fitted, _ = choose_held_out([long], 0 * start_s, start_s, np.ones((len(start_s), 1)))
    assert fitted.mean() == pytest.approx(THRESHOLDS.lone_fitted_share, abs=0.05)


def test_the_windows_of_the_end_of_a_log_count_alone_for_the_largest_number(log):
    limits = Thresholds(most_windows=6)
    windows, _ = cut([log], PLAIN, False, stride_s=0.1, limits=limits, since_s=2.0)
    assert len(windows.flight) == 6 and windows.start_s.min() == pytest.approx(2.0, abs=0.02)
