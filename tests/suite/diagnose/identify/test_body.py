"""Force and torque of made flights: thrust without an attitude, inertia under noisy rotors."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.identify.body import fit_force, fit_torque, force_unknowns, torque_unknowns
from suite.diagnose.identify.drive import DrivenVehicle
from suite.diagnose.identify.fit import NoWholeWindow
from suite.diagnose.identify.grid import LEANING, ROTOR_NOISE, STEP_S, FlightGrid
from tests.support.vehicles import PLAIN

LAGS = {"lag": 0.0, "late": 0.0}


def leaning(*, attitude, speed=0.0):
    """Return a flight that accelerates by 2 m/s^2 along x, its rotors at 1000 rad/s."""
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
    flight, driven = FlightGrid("made", time_s, signals), DrivenVehicle(PLAIN, "rotors")
    unknowns = force_unknowns(driven, False, leaning=not attitude)[:1]
    return fit_force([flight], driven, unknowns, LAGS), felt


def test_the_thrust_is_what_path_and_gravity_need_in_fast_windows_with_an_attitude_alone():
    by_rotors = 4e6 * PLAIN.rotors.thrust_coefficient / PLAIN.mass
    for attitude in (True, False):
        found, felt = leaning(attitude=attitude)
        np.testing.assert_allclose(np.exp(found.value[0]), felt / by_rotors, rtol=1e-6)
    with pytest.raises(NoWholeWindow):
        leaning(attitude=False, speed=6.0)


def rolling(noise, seed=0):
    """Return a flight with twice the inertia about x; its rotor speeds have noise."""
    rng, count = np.random.default_rng(seed), 5000
    swing = np.convolve(rng.standard_normal(count), np.hanning(25), "same") / 3.0
    true = 1100.0 + 40.0 * swing[:, None] * np.sign(np.asarray(PLAIN.rotors.position)[:, 1])
    grid = FlightGrid("made", STEP_S * np.arange(count), {"rotor_speed": true})
    true_inertia = (2.0 * PLAIN.inertia[0], *PLAIN.inertia[1:])
    driven = DrivenVehicle(replace(PLAIN, inertia=true_inertia), "rotors")
    _, turn_b = driven.at(LAGS).accelerations(grid, grid.rows(False))
    rate_b = STEP_S * np.cumsum(turn_b, axis=0)
    rate_b = rate_b - 0.5 * STEP_S * turn_b
    drawn = noise * rng.standard_normal((2, count, 4))
    signals = {"rotor_speed": true + drawn[0], ROTOR_NOISE: drawn[1], "rate_b": rate_b}
    return grid._replace(signals=signals)


def rolled(noise, **limits):
    unknowns = [torque_unknowns("rotors", 0.0, 0.0)[0]._replace(**limits)]
    return fit_torque([rolling(noise)], DrivenVehicle(PLAIN, "rotors"), unknowns, LAGS)


def test_noise_of_the_rotor_speeds_widens_the_interval_and_makes_no_body_heavier():
    """At 100 rad/s 15 % of the variance is noise, by which the inertia would seem larger."""
    for noise, half in ((0.0, 0.015), (100.0, 0.16)):
        found = rolled(noise)
        assert found.identifies("inertia_x") and abs(found.value[0] - np.log(2.0)) < 0.02
        assert found.half_width[0] == pytest.approx(half, rel=0.1)
    # What is mostly noise, or at its limit, is not identified.
    assert not rolled(300.0).identifies("inertia_x")
    assert not rolled(0.0, high=0.3).identifies("inertia_x")
