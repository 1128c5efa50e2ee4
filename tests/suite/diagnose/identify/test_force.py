"""The collective thrust of each drive, and which numbers are looked for."""

import numpy as np

from suite.diagnose.identify.drive import MotorGuess
from suite.diagnose.identify.force import force_of, unknowns_of
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from tests.support.vehicles import PLAIN

NONE = MotorGuess(0.0, 0.0, 0.0, 1.0, 1.0)


def test_commands_scale_and_rotor_speeds_push_by_their_squares():
    signals = {"thrust_cmd": np.full(300, 9.0), "rotor_speed": np.full((300, 4), 1000.0)}
    flight = FlightGrid("made", STEP_S * np.arange(300), signals)
    told = {"thrust": np.log(1.1)}
    np.testing.assert_allclose(force_of(flight, PLAIN, "rates", NONE, told, 0.03, 0.01), 9.9)
    by_rotors = 1.1 * 4e6 * PLAIN.rotors.thrust_coefficient / PLAIN.mass
    np.testing.assert_allclose(force_of(flight, PLAIN, "rotors", NONE, told, 0.0, 0.0), by_rotors)


def test_the_curve_and_the_battery_are_looked_for_under_motor_commands_only():
    names = [u.name for u in unknowns_of("pwm", NONE, True, [0.0, 0.0, 0.0])]
    assert names == ["thrust", "curve", "battery", "drag_x", "drag_y", "drag_z"]
    names = [u.name for u in unknowns_of("rates", NONE, True, [0.0, 0.0, 0.0])]
    assert names == ["thrust", "drag_x", "drag_y", "drag_z"]
