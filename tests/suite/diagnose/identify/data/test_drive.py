"""Lag and delay of held commands, thrusts by command and voltage, and what drives flights."""

import numpy as np
import pytest

from suite.diagnose.identify.data.drive import (
    MotorGuess,
    delayed,
    drive_of,
    lagged,
    motor_thrusts,
    torque_of,
)
from suite.diagnose.identify.data.grid import STEP_S, FlightGrid
from tests.support.vehicles import PLAIN

TIME = STEP_S * np.arange(400)


def test_lag_and_delay_of_a_step():
    """A lag of 0.05 s has made 1 - 1/e of a step after 0.05 s, here after a delay of 0.02 s."""
    late = lagged(delayed((TIME >= 0.8).astype(float)[:, None], 0.02), 0.05)[:, 0]
    np.testing.assert_allclose(np.interp(0.87, TIME, late), 1.0 - np.exp(-1.0), atol=0.003)


def test_thrust_at_half_the_voltage():
    """v = 0.6 x 0.5 / 0.5 = 0.6: 2 N x (0.25 x 0.6 + 0.75 x 0.36) = 0.84 N."""
    signals = {"pwm": np.full((400, 4), 0.6), "voltage": np.full(400, 4.0)}
    guess = MotorGuess(size=2.0, curve=0.75, battery=1.0, usual=0.5, volts=8.0)
    thrust = motor_thrusts(FlightGrid("made", TIME, signals), guess, 0.03, 0.0)
    np.testing.assert_allclose(thrust, 0.84)


def test_each_rotor_turns_the_body_its_way():
    torque = torque_of(PLAIN, np.array([[1.0, 0.0, 0.0, 0.0]]))[0]
    x, y, _ = PLAIN.rotors.position[0]
    np.testing.assert_allclose(torque[:2], [y, -x])


def test_flights_that_share_no_drive_are_refused():
    one = FlightGrid("one", TIME, {"pwm": np.zeros((400, 4))})
    other = FlightGrid("other", TIME, {"rotor_speed": np.zeros((400, 4))})
    assert drive_of([one]) == "pwm"
    with pytest.raises(ValueError, match="share no drive"):
        drive_of([one, other])
