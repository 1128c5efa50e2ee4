"""A recorded flight's arrays are what a flight log is made of."""

import numpy as np

from eval.logs.flight import Flight
from eval.logs.flight_log import log_from_flight
from tests.support.flights import small_track, smooth_flight


def test_a_flights_arrays_stand_in_its_log_unchanged():
    flight = smooth_flight(small_track())
    assert isinstance(flight, Flight)
    log = log_from_flight(flight)
    for name in ("time_s", "pos_w", "quat_wxyz", "vel_w", "rate_b"):
        np.testing.assert_array_equal(getattr(log, name), getattr(flight, name), err_msg=name)
