"""Signals are known and in order of time, and come onto the rows of one log."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.importers.pose import grid
from eval.importers.rows import averaged, row_times, smoothed
from eval.importers.signals import Recording, make_signal, median_step
from eval.logs.columns import FlightLogError
from tests.support import known_flight
from tests.support.imported import flight, of, write


def test_differing_rates_jitter_and_holes(tmp_path):
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.003, 0.007, 1600))
    truth = known_flight.fly(time)
    parts = {"time": time, "pos": truth.pos, "quat": truth.quat, "rate": truth.rate}
    parts |= {"cmd_thrust": truth.thrust[:, None], "cmd_rate": truth.cmd_rate}
    every = np.arange(len(time))
    hole = (time > 3.0) & (time < 3.6)
    keep = {
        "pos": (every % 4 == 0) & ~hole,
        "quat": every % 2 == 0,
        "cmd_rate": every % 5 == 0,
        "cmd_thrust": every % 5 == 0,
    }
    log, findings = import_log(write(tmp_path / "log.csv", parts, keep))
    assert {"position", "rows"} <= of(findings, "note")
    at = log.time_s + time[0]
    np.testing.assert_allclose(at, time[keep["pos"]], atol=1e-9)
    found = known_flight.fly(at)
    np.testing.assert_allclose(log.pos_w, found.pos, atol=1e-9)
    np.testing.assert_allclose(log.rate_b, found.rate, atol=2e-3)
    # A derived velocity is not there beside the hole.
    assert log.velocity_derived
    clear = (at < 2.9) | (at > 3.8)
    np.testing.assert_allclose(log.vel_w[clear], found.vel[clear], atol=0.1)


@pytest.mark.parametrize(("pos", "quat", "vel"), [(4, 1, 8), (10, 5, 10), (2, 3, 2)])
def test_a_measurement_is_in_one_row_only(tmp_path, pos, quat, vel):
    """Values copied to rows between them would look like less noise than there is."""
    good = flight(noise=1.0)
    every = np.arange(len(good["time"]))
    keep = {"pos": every % pos == 0, "quat": every % quat == 1 % quat, "vel": every % vel == 0}
    log, _ = import_log(write(tmp_path / "log.csv", good, keep))
    for name, value in (("pos", log.pos_w), ("quat", log.quat_wxyz), ("vel", log.vel_w)):
        count = np.isfinite(value[:, 0]).sum()
        assert count <= keep[name].sum() and count > 0.9 * min(keep[name].sum(), len(value))
    both = (every % np.lcm(pos, vel) == 0).sum()
    assert log.whole.sum() > 0.9 * min(both, len(log.time_s))
    # Slower than 20 Hz only with rows between.
    assert 1 / np.median(np.diff(log.time_s)) > 19.0


def test_faster_signals_are_smoothed_and_commands_hold_their_mean(tmp_path):
    parts = flight(hz=1000.0, end=6.0)
    shake = 5.0 * np.sin(2 * np.pi * 240.0 * parts["time"])[:, None]
    parts["rate"] = parts["rate"] + shake
    path = write(tmp_path / "log.csv", parts)
    log, _ = import_log(path, None, ImportOptions(rate_hz=50.0))
    truth = known_flight.fly(log.time_s)
    assert len(log.time_s) == 300
    assert np.abs(log.rate_b - truth.rate)[2:-2].max() < 1.0
    middle = known_flight.fly(log.time_s + 0.0095).cmd_rate
    np.testing.assert_allclose(np.asarray(log.rate_cmd_b)[:-1], middle[:-1], atol=0.01)


def test_smoothing_does_not_flatten_what_is_curved():
    t = np.arange(0.0, 2.0, 0.001)
    wave = np.sin(2 * np.pi * 8.0 * t)[:, None]
    at = np.arange(0.1, 1.9, 0.01)
    exact = np.sin(2 * np.pi * 8.0 * at)[:, None]
    assert np.abs(smoothed(t, wave, at, 0.01) - exact).max() < 5e-4
    assert np.abs(averaged(t, wave, at, 0.01) - exact).max() > 5e-3
    noise = np.random.default_rng(0).normal(size=wave.shape)
    assert np.std(smoothed(t, noise, at, 0.01)) < 0.55


def test_a_command_that_stops_is_not_held_for_long(tmp_path):
    good = flight()
    before = good["time"] < 5.0
    path = write(tmp_path / "log.csv", good, {"cmd_rate": before, "cmd_thrust": before})
    log, _ = import_log(path)
    missing = np.isnan(np.asarray(log.thrust_cmd))
    assert missing[log.time_s > 5.6].all() and not missing[log.time_s < 5.4].any()


def test_samples_that_are_ages_apart_are_no_rows():
    """Of a damaged clock: rows between them would fill any memory."""
    time = 1e7 * np.arange(200.0)
    pose, _ = make_signal(time, np.zeros((200, 3)), "log", "position")
    assert pose is not None
    with pytest.raises(FlightLogError, match=r"1e\+07 s apart.* at most 4,000,000: is its clock"):
        row_times(Recording("log", {"pos": pose}), 100.0, 0.0, None)
    with pytest.raises(FlightLogError, match=r"1\.99e\+09 s, allowed are .* to align clocks by"):
        grid(time, "log")


def test_two_flights_in_one_file_are_refused(tmp_path):
    good = flight(end=3.0)
    twice = {name: np.concatenate([value, value]) for name, value in good.items()}
    with pytest.raises(FlightLogError, match="cut the file to one flight"):
        import_log(write(tmp_path / "log.csv", twice))


def test_unknown_samples_and_a_step_back_are_left_out():
    time = np.arange(40.0)
    time[7] = 5.5  # goes back once
    value = np.arange(40.0)
    value[20], time[30] = np.nan, np.nan
    found, finding = make_signal(time, value, "log", "gyro")
    assert found is not None and finding is not None
    kept = np.delete(np.arange(40), [7, 20, 30])
    np.testing.assert_array_equal(found.time_s, kept)
    np.testing.assert_array_equal(found.value, kept[:, None])
    assert finding.evidence == "1 samples of 'gyro' whose time does not increase are left out"


def test_a_time_that_goes_back_often_is_refused_with_its_first_row():
    with pytest.raises(FlightLogError, match=r"row 2: .* 9 of 10 samples of 'gyro'"):
        make_signal(np.arange(10.0)[::-1], np.zeros((10, 3)), "log", "gyro")


def test_nothing_known_is_no_signal():
    assert make_signal(np.full(3, np.nan), np.zeros(3), "log", "gyro") == (None, None)


def test_the_median_step_is_that_of_most_samples():
    assert median_step(np.array([0.0, 0.5, 1.0, 9.0])) == 0.5
    assert median_step(np.zeros(1)) == np.inf
