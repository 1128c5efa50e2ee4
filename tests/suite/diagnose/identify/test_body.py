"""Force and torque by what drives the flights, and which numbers are looked for."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.identify.body import (
    fit_force,
    fit_torque,
    force_unknowns,
    torque_unknowns,
)
from suite.diagnose.identify.drive import DrivenVehicle, log_inertia_ratio
from suite.diagnose.identify.fit import NoWholeWindow
from suite.diagnose.identify.grid import LEANING, ROTOR_NOISE, STEP_S, FlightGrid
from tests.support import identified as known
from tests.support.vehicles import PLAIN

LAGS = {"lag": 0.0, "late": 0.0}


def test_the_curve_and_the_battery_are_looked_for_under_motor_commands_only():
    names = [u.name for u in force_unknowns(DrivenVehicle(known.start(), "pwm", 0.5, 15.0), True)]
    assert names == ["thrust", "curve", "battery", "drag_x", "drag_y", "drag_z"]
    names = [u.name for u in force_unknowns(DrivenVehicle(PLAIN, "rates"), True)]
    assert names == ["thrust", "drag_x", "drag_y", "drag_z"]


def test_the_thrust_starts_from_the_scale_of_the_vehicle_file():
    (thrust, *_) = force_unknowns(DrivenVehicle(PLAIN, "rates"), False, scale=float(np.log(0.8)))
    assert thrust.name == "thrust" and np.exp(thrust.start) == pytest.approx(0.8)


def leaning(*, attitude, speed=0.0):
    """Two seconds of a constant pull of 2 m/s^2 along x under thrust, by rotors of 1000 rad/s."""
    time_s = STEP_S * np.arange(500)
    felt = np.hypot(9.81, 2.0)
    vel_w = np.outer(time_s, [2.0, 0.0, 0.0]) + [speed - 1.0, 0.0, 0.0]
    cos, sin = 9.81 / felt, 2.0 / felt
    rot_w = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    signals = {
        "vel_w": vel_w,
        "rotor_speed": np.full((500, 4), 1000.0),
        "rot_w" if attitude else LEANING: np.broadcast_to(rot_w, (500, 3, 3)),
    }
    return FlightGrid("made", time_s, signals), felt


@pytest.mark.parametrize("attitude", [True, False])
def test_the_thrust_is_what_path_and_gravity_make_up(attitude):
    flight, felt = leaning(attitude=attitude)
    driven = DrivenVehicle(PLAIN, "rotors")
    unknowns = force_unknowns(driven, False, leaning=not attitude)[:1]
    found = fit_force([flight], driven, unknowns, LAGS)
    by_rotors = 4e6 * PLAIN.rotors.thrust_coefficient / PLAIN.mass
    np.testing.assert_allclose(np.exp(found.value[0]), felt / by_rotors, rtol=1e-6)


def test_without_an_attitude_fast_windows_are_left_out():
    flight, _ = leaning(attitude=False, speed=6.0)
    driven = DrivenVehicle(PLAIN, "rotors")
    unknowns = force_unknowns(driven, False, leaning=True)[:1]
    with pytest.raises(NoWholeWindow):
        fit_force([flight], driven, unknowns, LAGS)


def test_without_an_attitude_only_the_drag_along_the_thrust_is_looked_for():
    names = [u.name for u in force_unknowns(DrivenVehicle(PLAIN, "rates"), True, leaning=True)]
    assert names == ["thrust", "drag_z"]


@pytest.mark.parametrize(
    ("drive", "names"),
    [
        ("rotors", ["inertia_x", "inertia_y", "inertia_z", "yaw"]),
        ("pwm", ["inertia_x", "inertia_y", "inertia_z", "yaw", "late", "lag"]),
        ("torques", ["inertia_x", "inertia_y", "inertia_z", "late", "lag"]),
    ],
)
def test_what_is_looked_for_of_the_torque(drive, names):
    assert [unknown.name for unknown in torque_unknowns(drive, 0.03, 0.0)] == names


def rolling(noise, seed=0):
    """A body of twice the inertia about x that rotors roll, whose speeds are logged with noise."""
    rng, count = np.random.default_rng(seed), 5000
    swing = np.convolve(rng.standard_normal(count), np.hanning(25), "same") / 3.0
    true = 1100.0 + 40.0 * swing[:, None] * np.sign(np.asarray(PLAIN.rotors.position)[:, 1])
    grid = FlightGrid("made", STEP_S * np.arange(count), {"rotor_speed": true})
    driven = DrivenVehicle(
        replace(PLAIN, inertia=(2.0 * PLAIN.inertia[0], *PLAIN.inertia[1:])), "rotors"
    )
    _, turn_b = driven.at(LAGS).accelerations(grid, grid.rows(False))
    rate_b = STEP_S * np.cumsum(turn_b, axis=0)
    rate_b = rate_b - 0.5 * STEP_S * turn_b
    drawn = noise * rng.standard_normal((2, count, 4))
    signals = {"rotor_speed": true + drawn[0], ROTOR_NOISE: drawn[1], "rate_b": rate_b}
    return grid._replace(signals=signals)


def rolled(noise, **limits):
    unknowns = [torque_unknowns("rotors", 0.0, 0.0)[0]._replace(**limits)]
    return fit_torque([rolling(noise)], DrivenVehicle(PLAIN, "rotors"), unknowns, LAGS)


@pytest.mark.parametrize(("noise", "half"), [(0.0, 0.015), (100.0, 0.16)])
def test_noise_of_the_rotor_speeds_makes_no_body_heavier_and_is_doubted_by_half(noise, half):
    """At 100 rad/s 15 % of the variance is noise, by which the inertia would seem larger."""
    found = rolled(noise)
    assert found.identifies("inertia_x") and abs(found.value[0] - np.log(2.0)) < 0.02
    assert found.half_width[0] == pytest.approx(half, rel=0.1)


def test_what_is_mostly_noise_or_at_its_limit_is_not_told():
    assert not rolled(300.0).identifies("inertia_x")
    assert not rolled(0.0, high=0.3).identifies("inertia_x")


def test_the_inertia_about_z_follows_the_others_but_for_its_own_ratio():
    np.testing.assert_allclose(log_inertia_ratio({"inertia_x": 0.2}), [0.2, 0.0, 0.1])
    numbers = {"inertia_x": 0.2, "inertia_y": 0.4, "inertia_z": -0.1}
    np.testing.assert_allclose(log_inertia_ratio(numbers), [0.2, 0.4, 0.2])
