"""Lag and delay of held commands, thrusts by command and voltage, and what drives flights."""

from dataclasses import replace

import numpy as np
import pytest

from eval.vehicles.vehicle import MotorMap
from suite.diagnose.identify.drive import (
    DrivenVehicle,
    after_delay_and_lag,
    common_drive,
    delayed,
    unmodelled_effects,
    with_known_thrust,
    with_motor_map,
)
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from tests.support.vehicles import PLAIN, with_effects

TIME = STEP_S * np.arange(400)


def test_lag_and_delay_of_a_step():
    """A lag of 0.05 s has made 1 - 1/e of a step after 0.05 s, here after a delay of 0.02 s."""
    step = (TIME >= 0.8).astype(float)[:, None]
    late = after_delay_and_lag(step, {"lag": 0.05, "late": 0.07})[:, 0]
    np.testing.assert_allclose(np.interp(0.87, TIME, late), 1.0 - np.exp(-1.0), atol=0.003)


def test_what_is_late_by_less_than_nothing_is_early():
    ramp = TIME[:, None].copy()
    np.testing.assert_allclose(delayed(ramp, -0.01)[10:-10], ramp[10:-10] + 0.008, atol=1e-12)
    np.testing.assert_allclose(delayed(ramp, 0.01)[10:-10], ramp[10:-10] - 0.012, atol=1e-12)


def driven(**signals):
    """Rows of 1000 rad/s or of what else is known, still and level."""
    known = {name: np.full((400, 4) if name != "thrust_cmd" else 400, value)
             for name, value in signals.items() if name != "voltage"}  # fmt: skip
    if "voltage" in signals:
        known["voltage"] = np.full(400, signals["voltage"])
    return FlightGrid("made", TIME, known)


def test_thrust_at_half_the_voltage():
    """v = 0.6 x 0.5 / 0.5 = 0.6: 2 N x (0.25 x 0.6 + 0.75 x 0.36) = 0.84 N."""
    begun = replace(PLAIN, motors=MotorMap((1.0, 6.0), 8.0, 1.0))  # 0.5 N + 1.5 N at 0.5
    flight, start = driven(pwm=0.6, voltage=4.0), DrivenVehicle(begun, "pwm", 0.5, 8.0)
    acc_w, _ = start.at({"lag": 0.03, "late": 0.03}).accelerations(flight, flight.rows(True))
    np.testing.assert_allclose(acc_w[:, 2], 4.0 * 0.84 / PLAIN.mass - 9.81)


def test_motors_push_alike_at_any_nominal_voltage():
    for volts in (6.0, 8.0):
        begun = replace(PLAIN, motors=MotorMap((1.0, 6.0), volts, 1.0))
        start = DrivenVehicle(begun, "pwm", 0.5, 8.0)
        found = start.motor_map({"thrust": np.log(1.5), "curve": 0.6, "battery": 1.3})
        u, v = 0.4 * (7.0 / volts) ** 1.3, 0.4 * (7.0 / 8.0) ** 1.3 / 0.5
        wanted = 1.5 * sum(start.usual_thrust) * (0.4 * v + 0.6 * v**2)
        np.testing.assert_allclose(found.thrust[0] * u + found.thrust[1] * u**2, wanted)


def test_commands_scale_and_rotor_speeds_push_by_their_squares():
    numbers = {"thrust": np.log(1.1), "lag": 0.03, "late": 0.04}
    flight = driven(thrust_cmd=9.0, rotor_speed=1000.0)
    rows = flight.rows(True)
    acc_w, _ = DrivenVehicle(PLAIN, "rates").at(numbers).accelerations(flight, rows)
    np.testing.assert_allclose(acc_w[:, 2], 9.9 - 9.81, atol=1e-12)
    acc_w, _ = DrivenVehicle(PLAIN, "rotors").at(numbers).accelerations(flight, rows)
    by_rotors = 1.1 * 4e6 * PLAIN.rotors.thrust_coefficient / PLAIN.mass
    np.testing.assert_allclose(acc_w[:, 2], by_rotors - 9.81)


def test_effects_of_the_start_act_on_force_and_torque():
    moved = with_effects(PLAIN, com_offset=((0.01, 0.0, 0.0),))
    flight = driven(rotor_speed=1000.0)
    _, turn_b = DrivenVehicle(moved, "rotors").at({}).accelerations(flight, flight.rows(False))
    thrust = 4e6 * PLAIN.rotors.thrust_coefficient
    np.testing.assert_allclose(turn_b[0, 1], 0.01 * thrust / PLAIN.inertia[1], rtol=0.05)
    assert unmodelled_effects(moved) == []


def flown(name, volts=None):
    signals: dict[str, np.ndarray] = {"pwm": np.full((400, 4), 0.5)}
    if volts is not None:
        signals["voltage"] = np.full(400, volts)
    return FlightGrid(name, TIME, signals)


def test_motors_begin_at_full_speed_and_at_the_voltage_that_the_flights_have_if_any():
    found = with_motor_map([flown("one", 15.0)], PLAIN).motors
    assert found == MotorMap((0.0, PLAIN.rotors.thrust_max), 15.0, 1.0)
    bare = with_motor_map([flown("one")], PLAIN)
    assert bare.motors is not None and bare.motors.voltage_exponent == 0.0


def test_a_nominal_voltage_counts_only_with_an_exponent():
    for exponent, voltage in ((0.0, 15.0), (1.2, 16.0)):
        begun = replace(PLAIN, motors=MotorMap((1.0, 4.0), 16.0, exponent))
        found = with_motor_map([flown("one", 15.0)], begun).motors
        assert found == MotorMap((1.0, 4.0), voltage, exponent)
        assert with_motor_map([flown("one")], begun) == begun


def test_where_some_flights_have_a_voltage_the_others_say_nothing_of_what_motors_give():
    with_it, without = flown("one", 15.0), flown("other")
    assert [flight.name for flight in with_known_thrust([with_it, without], "pwm")] == ["one"]
    assert len(with_known_thrust([without, without], "pwm")) == 2
    assert len(with_known_thrust([with_it, without], "rotors")) == 2


def test_flights_that_share_no_drive_are_refused():
    one = FlightGrid("one", TIME, {"pwm": np.zeros((400, 4))})
    other = FlightGrid("other", TIME, {"rotor_speed": np.zeros((400, 4))})
    assert common_drive([one]) == "pwm"
    with pytest.raises(ValueError, match="share no drive"):
        common_drive([one, other])
