"""Lag and delay of held commands, thrusts by command and voltage, and what drives flights."""

from dataclasses import replace

import numpy as np
import pytest

from eval.vehicles.vehicle import MotorMap
from suite.diagnose.identify.drive import (
    MotorGuess,
    delayed,
    drive_of,
    lagged,
    motor_thrusts,
    torque_of,
    with_battery,
    with_motors,
)
from suite.diagnose.identify.grid import STEP_S, FlightGrid
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


def flown(name, volts=None):
    signals: dict[str, np.ndarray] = {"pwm": np.full((400, 4), 0.5)}
    if volts is not None:
        signals["voltage"] = np.full(400, volts)
    return FlightGrid(name, TIME, signals)


def test_motors_begin_at_full_speed_and_at_the_voltage_that_the_flights_have_if_any():
    found = with_motors([flown("one", 15.0)], PLAIN).motors
    assert found == MotorMap((0.0, PLAIN.rotors.thrust_max), 15.0, 1.0)
    bare = with_motors([flown("one")], PLAIN)
    assert bare.motors is not None and bare.motors.voltage_exponent == 0.0


def test_a_nominal_voltage_counts_only_with_an_exponent():
    for exponent, voltage in ((0.0, 15.0), (1.2, 16.0)):
        begun = replace(PLAIN, motors=MotorMap((1.0, 4.0), 16.0, exponent))
        found = with_motors([flown("one", 15.0)], begun).motors
        assert found == MotorMap((1.0, 4.0), voltage, exponent)
        assert with_motors([flown("one")], begun) == begun


def test_where_some_flights_have_a_voltage_the_others_say_nothing_of_what_motors_give():
    with_it, without = flown("one", 15.0), flown("other")
    assert [flight.name for flight in with_battery([with_it, without], "pwm")] == ["one"]
    assert len(with_battery([without, without], "pwm")) == 2
    assert len(with_battery([with_it, without], "rotors")) == 2


def test_flights_that_share_no_drive_are_refused():
    one = FlightGrid("one", TIME, {"pwm": np.zeros((400, 4))})
    other = FlightGrid("other", TIME, {"rotor_speed": np.zeros((400, 4))})
    assert drive_of([one]) == "pwm"
    with pytest.raises(ValueError, match="share no drive"):
        drive_of([one, other])
