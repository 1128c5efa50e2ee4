"""The samples of a signal: known, in order of time, and of one flight."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.signals import median_step, signal
from eval.logs.columns import FlightLogError
from tests.support.imported import flight, write


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
    found, finding = signal(time, value, "log", "gyro")
    assert found is not None and finding is not None
    kept = np.delete(np.arange(40), [7, 20, 30])
    np.testing.assert_array_equal(found.time_s, kept)
    np.testing.assert_array_equal(found.value, kept[:, None])
    assert finding.text == "1 samples of 'gyro' whose time does not increase are left out"


def test_a_time_that_goes_back_often_is_refused_with_its_first_row():
    with pytest.raises(FlightLogError, match=r"row 2: .* 9 of 10 samples of 'gyro'"):
        signal(np.arange(10.0)[::-1], np.zeros((10, 3)), "log", "gyro")


def test_nothing_known_is_no_signal():
    assert signal(np.full(3, np.nan), np.zeros(3), "log", "gyro") == (None, None)


def test_the_median_step_is_that_of_most_samples():
    assert median_step(np.array([0.0, 0.5, 1.0, 9.0])) == 0.5
    assert median_step(np.zeros(1)) == np.inf
