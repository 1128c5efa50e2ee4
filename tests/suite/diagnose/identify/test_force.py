"""The collective thrust of each drive, and which numbers are looked for."""

import numpy as np
import pytest

from suite.diagnose.identify.drive import MotorGuess
from suite.diagnose.identify.fit import NothingWhole
from suite.diagnose.identify.force import fit_force, force_of, unknowns_of
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


def test_the_thrust_starts_from_the_scale_of_the_vehicle_file():
    (thrust, *_) = unknowns_of("rates", NONE, False, [0.0, 0.0, 0.0], scale=np.log(0.8))
    assert thrust.name == "thrust" and np.exp(thrust.start) == pytest.approx(0.8)


def leaning(*, attitude, speed=0.0):
    """Two seconds of a constant pull of 2 m/s^2 along x under thrust, by rotors of 1000 rad/s."""
    time_s = STEP_S * np.arange(500)
    felt = np.hypot(9.81, 2.0)
    vel_w = np.outer(time_s, [2.0, 0.0, 0.0]) + [speed - 1.0, 0.0, 0.0]
    signals = {"vel_w": vel_w, "rotor_speed": np.full((500, 4), 1000.0)}
    if attitude:
        cos, sin = 9.81 / felt, 2.0 / felt
        rot_w = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        signals["rot_w"] = np.broadcast_to(rot_w, (500, 3, 3))
    return FlightGrid("made", time_s, signals), felt


@pytest.mark.parametrize("attitude", [True, False])
def test_the_thrust_is_what_path_and_gravity_make_up(attitude):
    flight, felt = leaning(attitude=attitude)
    unknowns = unknowns_of("rotors", NONE, False, [0.0, 0.0, 0.0], leaning=not attitude)[:1]
    found = fit_force([flight], PLAIN, "rotors", NONE, unknowns, 0.0, 0.0, {})
    by_rotors = 4e6 * PLAIN.rotors.thrust_coefficient / PLAIN.mass
    np.testing.assert_allclose(np.exp(found.value[0]), felt / by_rotors, rtol=1e-6)


def test_without_an_attitude_fast_windows_are_left_out():
    flight, _ = leaning(attitude=False, speed=6.0)
    unknowns = unknowns_of("rotors", NONE, False, [0.0, 0.0, 0.0], leaning=True)[:1]
    with pytest.raises(NothingWhole):
        fit_force([flight], PLAIN, "rotors", NONE, unknowns, 0.0, 0.0, {})


def test_without_an_attitude_only_the_drag_along_the_thrust_is_looked_for():
    names = [u.name for u in unknowns_of("rates", NONE, True, [0.0, 0.0, 0.0], leaning=True)]
    assert names == ["thrust", "drag_z"]
