"""Attitude set points become rates by the vehicle's gains, within its limits."""

import numpy as np

from eval.importers.commands import rates_wanted
from tests.support.vehicles import PLAIN


def rows(angle):
    half = 0.5 * angle
    return {
        "quat": np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        "cmd_quat": np.tile([np.cos(half), 0.0, np.sin(half), 0.0], (2, 1)),
    }


def test_the_error_times_the_gain_within_the_limit():
    given = rows(0.1)
    rates_wanted(given, PLAIN)
    gain = PLAIN.controller.attitude_gain[1]
    np.testing.assert_allclose(given["cmd_rate"], [[0.0, 0.1 * gain, 0.0]] * 2)
    given = rows(3.0)
    rates_wanted(given, PLAIN)
    np.testing.assert_allclose(given["cmd_rate"][0, 1], PLAIN.controller.rate_max[1])


def test_without_a_vehicle_they_are_left_out():
    given = rows(0.1)
    assert rates_wanted(given, None)[0].level == "doubt"
    assert set(given) == {"quat"}
