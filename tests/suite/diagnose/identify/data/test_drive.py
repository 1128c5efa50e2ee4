"""What drives flights: delayed commands, effects of the start, motors and their voltage."""

from dataclasses import replace

import numpy as np
import pytest

from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import MotorMap
from suite.diagnose.identify import drive
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.identify import identify
from tests.support import identified as known
from tests.support.vehicles import PLAIN, with_effects

TIME = STEP_S * np.arange(400)


def test_what_is_late_by_less_than_nothing_is_early():
    ramp = TIME[:, None].copy()
    np.testing.assert_allclose(drive.delayed(ramp, -0.01)[10:-10], ramp[10:-10] + 0.008, atol=1e-12)
    np.testing.assert_allclose(drive.delayed(ramp, 0.01)[10:-10], ramp[10:-10] - 0.012, atol=1e-12)


def test_effects_of_the_start_act_on_the_torque():
    moved = with_effects(PLAIN, com_offset=((0.01, 0.0, 0.0),))
    flight = FlightGrid("made", TIME, {"rotor_speed": np.full((400, 4), 1000.0)})
    _, turn_b = (
        drive.DrivenVehicle(moved, "rotors").at({}).accelerations(flight, flight.rows(False))
    )
    thrust = 4e6 * PLAIN.rotors.thrust_coefficient
    np.testing.assert_allclose(turn_b[0, 1], 0.01 * thrust / PLAIN.inertia[1], rtol=0.05)
    assert drive.unmodelled_effects(moved) == []


def test_motors_without_a_fit_are_those_of_the_file():
    begun = replace(PLAIN, motors=MotorMap((1.0, 6.0), 6.0, 1.3))
    found = drive.DrivenVehicle(begun, "pwm", 0.5, 8.0).motor_map({})
    np.testing.assert_allclose((*found.thrust, found.voltage_exponent), (1.0, 6.0, 1.3))


@pytest.mark.parametrize(
    ("begun", "with_volts", "without"),
    [
        # At full speed, and at the voltage of the flights if they have one.
        (None, ((0.0, PLAIN.rotors.thrust_max), 15.0, 1.0), None),
        # A nominal voltage counts only with an exponent.
        (((1.0, 4.0), 16.0, 0.0), ((1.0, 4.0), 15.0, 0.0), ((1.0, 4.0), 16.0, 0.0)),
        (((1.0, 4.0), 16.0, 1.2), ((1.0, 4.0), 16.0, 1.2), ((1.0, 4.0), 16.0, 1.2)),
    ],
)
def test_motors_begin_with_those_of_the_file_or_at_full_speed(begun, with_volts, without):
    vehicle = replace(PLAIN, motors=begun and MotorMap(*begun))
    pwm = {"pwm": np.full((400, 4), 0.5)}
    flight = FlightGrid("made", TIME, {**pwm, "voltage": np.full(400, 15.0)})
    assert drive.with_motor_map([flight], vehicle).motors == MotorMap(*with_volts)
    bare = drive.with_motor_map([FlightGrid("made", TIME, pwm)], vehicle).motors
    if without is None:
        assert bare.voltage_exponent == 0.0
    else:
        assert bare == MotorMap(*without)


def test_flights_without_a_common_drive_or_a_scale_that_cannot_hover_are_refused_before_the_work():
    one = FlightGrid("one", TIME, {"pwm": np.zeros((400, 4))})
    other = FlightGrid("other", TIME, {"rotor_speed": np.zeros((400, 4))})
    assert drive.common_drive([one]) == "pwm"
    with pytest.raises(ValueError, match="share no drive"):
        drive.common_drive([one, other])
    weak = with_effects(PLAIN, thrust_scale=(0.3,))
    slow = replace(weak, rotors=replace(weak.rotors, speed_max=1500.0))
    with pytest.raises(ValueError, match="plain with its thrust_scale: .*too weak to hover"):
        drive.with_merged_effects(slow, True)
    assert drive.with_merged_effects(slow, False) == slow


def test_effects_that_are_part_of_a_number_are_merged_and_the_vehicle_flies_as_before():
    before = with_effects(
        PLAIN,
        motor_lag=(0.05,),
        inertia_scale=((1.2, 0.9, 1.1),),
        rate_gain=((0.8, 1.0, 1.3),),
        thrust_scale=(0.9,),
        clock_offset=(0.01,),
    )
    after = drive.with_merged_effects(before, True)
    assert list(after.effects) == ["clock_offset"] == list(drive.unmodelled_effects(after))
    old, new = (make_plant(vehicle, 0.002).constants for vehicle in (before, after))
    names = ("inertia", "time_constant", "rate_gain", "thrust_coefficient", "torque_coefficient")
    for name in names:
        np.testing.assert_allclose(getattr(new, name), getattr(old, name))
    # A scale of the commanded thrust stays where no motor is known.
    assert "thrust_scale" in drive.with_merged_effects(before, False).effects


@pytest.mark.slow
def test_the_result_does_not_depend_on_how_the_start_gives_a_number():
    plain = known.start()
    same = with_effects(plain, inertia_scale=((0.9, 1.1, 1.0),))
    same = replace(same, inertia=tuple(np.divide(plain.inertia, (0.9, 1.1, 1.0)).tolist()))
    one, other = known.found("rotors").vehicle, identify(known.logs("rotors", 0)[::3], same).vehicle
    assert set(one.effects) == set(other.effects)
    np.testing.assert_allclose(other.inertia, one.inertia, rtol=1e-6)
