"""Fleets of drawn numbers: their logs hold what the numbers say, and errors that last."""

from dataclasses import replace

import numpy as np
import pytest

from eval.flights.trajectory import Trajectory
from suite.diagnose.identify.drive import DrivenVehicle
from suite.diagnose.identify.grid import grid_of
from tests.support.fleets import (
    DELAY,
    SENSORS,
    Fleet,
    Slow,
    drawn,
    logs_of,
    recordings_of,
    start,
    torque_of,
    truths,
)

QUIET = replace(SENSORS, pos=0.0, attitude=0.0, gyro=0.0, vel=1e-9, rotor=1e-6, voltage=1e-9)


@pytest.fixture(scope="module")
def flown():
    fleet = drawn(np.random.default_rng(3))
    fleet = Fleet(fleet.truth, (Trajectory("chirp", 3.0, 0.8),), fleet.scale)
    return fleet, recordings_of(fleet)


def test_motor_commands_make_the_rotors_turn_as_they_did(flown):
    fleet, recordings = flown
    (log,) = logs_of(fleet, recordings, "pwm", np.random.default_rng(0), sensors=QUIET)
    (rotors,) = logs_of(fleet, recordings, "rotors", np.random.default_rng(0), sensors=QUIET)
    true = fleet.truth
    lag_s, delay_s = true.rotors.time_constant, true.effects[DELAY].delay
    numbers = {"lag": lag_s, "late": lag_s + delay_s}
    speed = DrivenVehicle(true, "pwm", 1.0, 16.0).rotor_speed(grid_of(log), numbers)[100:]
    thrust = true.rotors.thrust_coefficient * speed**2
    wanted = true.rotors.thrust_coefficient * grid_of(rotors).signals["rotor_speed"][100:] ** 2
    assert np.abs(thrust - wanted).max() < 0.02 * wanted.mean()
    assert log.thrust_cmd is None and log.rotor_speed is None


def test_commanded_torques_and_thrust_are_those_of_the_commanded_rotors(flown):
    fleet, recordings = flown
    (log,) = logs_of(fleet, recordings, "torques", np.random.default_rng(0), sensors=QUIET)
    (rotors,) = logs_of(fleet, recordings, "rotors", np.random.default_rng(0), sensors=QUIET)
    assert rotors.rotor_speed_cmd is not None and log.torque_cmd_b is not None
    thrust = fleet.truth.rotors.thrust_coefficient * rotors.rotor_speed_cmd**2
    # Both are means over a row.
    np.testing.assert_allclose(log.torque_cmd_b, torque_of(fleet.truth, thrust), atol=2e-3)
    given = fleet.scale * log.thrust_cmd * fleet.truth.mass
    np.testing.assert_allclose(given, thrust.sum(axis=1), rtol=2e-3)
    (rates,) = logs_of(fleet, recordings, "rates", np.random.default_rng(0), sensors=QUIET)
    np.testing.assert_allclose(fleet.scale * rates.thrust_cmd, recordings[0].command.thrust[::2])


def test_slow_errors_are_as_large_and_last_as_long_as_they_say():
    fleet = drawn(np.random.default_rng(3))
    fleet = Fleet(fleet.truth, (Trajectory("hover", 20.0),), 1.0)
    recordings = recordings_of(fleet, 100.0)
    slow = Slow(pos=(0.05, 0.2), vel=(0.0, 1.0), attitude=(0.0, 1.0), gyro=(0.0, 1.0))
    rate = replace(QUIET, rate_hz=100.0)
    (log,) = logs_of(fleet, recordings, "rates", np.random.default_rng(0), slow, rate)
    (true,) = logs_of(fleet, recordings, "rates", np.random.default_rng(0), None, rate)
    off = log.pos_w - true.pos_w
    np.testing.assert_allclose(off.std(), 0.05, rtol=0.15)
    alike = np.mean(off[20:] * off[:-20]) / np.mean(off**2)
    np.testing.assert_allclose(alike, np.exp(-1.0), atol=0.12)
    np.testing.assert_allclose(log.quat_wxyz, true.quat_wxyz, atol=1e-12)


def test_numbers_are_drawn_apart_from_the_start_and_each_has_a_truth():
    one, other = (drawn(np.random.default_rng(seed)) for seed in (0, 1))
    assert truths(one, "pwm") != truths(other, "pwm")
    assert set(truths(one, "pwm")) >= {"inertia", "motors.thrust", "controller.rate_gain"}
    assert one.truth.mass == start().mass
    assert one.truth.rotors.position == start().rotors.position
    jx, jy, jz = one.truth.inertia
    assert jx < jy + jz and jy < jx + jz and jz < jx + jy


def test_what_yaws_is_true_beside_what_else_is_in_the_file():
    """By hand: with inertias 1.1, 1.2 and 1.5 times the start's and a thrust coefficient of 0.8."""
    begun = start()
    x, y, z = begun.inertia
    fleet = drawn(np.random.default_rng(0))
    rotors = replace(begun.rotors, thrust_coefficient=0.8 * begun.rotors.thrust_coefficient)
    true = replace(fleet.truth, inertia=(1.1 * x, 1.2 * y, 1.5 * z), rotors=rotors)
    fleet = replace(fleet, truth=true)
    per = {
        (drive, told): truths(fleet, drive, told)["rotors.torque_coefficient"][0]
        / begun.rotors.torque_coefficient
        for drive in ("rotors", "pwm")
        for told in ("xyz", "xy", "")
    }
    np.testing.assert_allclose(per["rotors", "xyz"], 1.0)
    np.testing.assert_allclose(per["rotors", "xy"], np.sqrt(1.1 * 1.2) / 1.5)
    np.testing.assert_allclose(per["rotors", ""], 1.0 / 1.5)
    np.testing.assert_allclose(per["pwm", "xyz"], 1.0 / 0.8)
