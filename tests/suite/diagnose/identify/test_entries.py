"""Fitted numbers become entries of a vehicle file, and only told ones are put in."""

import numpy as np

from suite.diagnose.identify.data.drive import MotorGuess
from suite.diagnose.identify.entries import inertia_of, motors_of, put
from suite.diagnose.identify.numbers import Number
from tests.support.vehicles import PLAIN, with_effects


def test_motors_push_alike_at_any_nominal_voltage():
    guess = MotorGuess(size=2.0, curve=0.6, battery=1.3, usual=0.5, volts=8.0)
    for volts in (6.0, 8.0):
        first, second, power = motors_of(guess, {"thrust": 0.0}, volts)
        u = 0.4 * (7.0 / volts) ** power
        v = 0.4 * (7.0 / 8.0) ** 1.3 / 0.5
        np.testing.assert_allclose(first * u + second * u**2, 2.0 * (0.4 * v + 0.6 * v**2))


def test_the_inertia_about_z_follows_within_what_a_body_can_have():
    found = inertia_of(PLAIN, {"inertia_x": 0.2, "inertia_y": 0.0})
    np.testing.assert_allclose(found[2], PLAIN.inertia[2] * np.exp(0.1))
    assert np.all(found <= found.sum() - found + 1e-15)


def test_what_was_told_is_put_in_and_the_rest_stays():
    lag = Number("rotors.time_constant", "s", [0.05], [(0.04, 0.06)])
    assert put(PLAIN, lag).rotors.time_constant == 0.05
    assert put(PLAIN, lag._replace(ci95=[None])) == PLAIN
    drag = Number("effects.linear_drag.coefficient", "1/s", [0.3, -0.1, 0.0], [(0.2, 0.4)] * 3)
    assert put(PLAIN, drag).effects["linear_drag"].coefficient == (0.3, 0.0, 0.0)


def test_a_delay_that_flights_deny_goes():
    late = with_effects(PLAIN, command_delay=(0.03,), linear_drag=((0.1, 0.1, 0.1),))
    none = Number("effects.command_delay.delay", "s", [-0.001], [(-0.002, 0.0)])
    assert set(put(late, none).effects) == {"linear_drag"}
    assert put(late, none._replace(ci95=[None])) == late
