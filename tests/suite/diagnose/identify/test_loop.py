"""The nominal rate loop under its commands alone."""

from dataclasses import replace

import numpy as np

from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.loop import followed
from tests.support.vehicles import PLAIN


def test_a_step_is_followed_by_one_over_the_gain():
    """Without a lag the loop has made 1 - 1/e of a step 1/K after it began to act."""
    time_s = STEP_S * np.arange(600)
    command = (time_s >= 0.8).astype(float)[:, None] * [1.0, 0.0, 0.0]
    flight = FlightGrid("made", time_s, {"rate_cmd_b": command})
    gain = PLAIN.controller.rate_gain[0]
    fast = replace(PLAIN, controller=replace(PLAIN.controller, frequency=10_000.0))
    rate = followed(flight, fast, {"lag": 0.0, "late": 0.02})[:, 0]
    reached = np.interp(0.82 + 1.0 / gain, time_s, rate)
    np.testing.assert_allclose(reached, 1.0 - np.exp(-1.0), atol=0.01)
    np.testing.assert_allclose(rate[-1], 1.0, atol=1e-3)
