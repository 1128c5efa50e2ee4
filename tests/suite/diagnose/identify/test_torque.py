"""Which numbers of the torque are looked for, by what drives the flights."""

import numpy as np
import pytest

from suite.diagnose.identify.drive import delayed, lagged
from suite.diagnose.identify.fit import Fitted
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.torque import (
    fit_rotor_lag,
    inertia_ratio,
    lag_and_delay,
    undiluted,
    unknowns_of,
)


@pytest.mark.parametrize(
    ("drive", "names"),
    [
        ("rotors", ["inertia_x", "inertia_y", "inertia_z", "yaw"]),
        ("pwm", ["inertia_x", "inertia_y", "inertia_z", "yaw", "late", "lag"]),
        ("torques", ["inertia_x", "inertia_y", "inertia_z", "late", "lag"]),
    ],
)
def test_what_is_looked_for(drive, names):
    assert [unknown.name for unknown in unknowns_of(drive, 0.03, 0.0)] == names


def _found(value, held=()):
    unknowns = [u for u in unknowns_of("rotors", 0.03, 0.0) if u.name in ("inertia_x", "yaw")]
    half = np.array([np.nan if u.name in held else 0.1 for u in unknowns])
    return Fitted(tuple(unknowns), np.array(value), half, 0.0025 * np.eye(2), tuple(held))


def test_the_share_of_noise_is_taken_off_and_doubted_by_half():
    found = undiluted(lambda held: _found([0.5, -0.2], held), lambda _: np.array([0.2, 0, 0.1]), [])
    np.testing.assert_allclose(found.value, [0.5 + np.log(0.8), -0.2 - np.log(0.9)])
    doubt = 0.5 * np.log([0.8, 0.9])
    np.testing.assert_allclose(found.half_width, np.hypot(0.1, 1.96 * doubt))
    np.testing.assert_allclose(np.diag(found.covariance), 0.0025 + doubt**2)


@pytest.mark.parametrize(("value", "noise"), [(2.0, 0.0), (0.5, 0.5), (0.5, 1.0)])
def test_what_is_at_its_limit_or_mostly_noise_is_not_told(value, noise):
    shares = np.array([noise, 0.0, 0.0])
    found = undiluted(lambda held: _found([value, -0.2], held), lambda _: shares, [])
    assert found.untold == ("inertia_x",) and found.has("yaw")


def test_rotors_behind_their_commands_tell_lag_and_delay():
    rng = np.random.default_rng(0)
    asked = np.repeat(1000.0 + 50.0 * rng.normal(size=(500, 4)), 5, axis=0)
    speed = lagged(delayed(asked, 0.012), 0.04) + rng.normal(size=asked.shape)
    time_s = STEP_S * np.arange(len(asked))
    flight = FlightGrid("made", time_s, {"rotor_speed": speed, "rotor_speed_cmd": asked})
    found = fit_rotor_lag([flight], lag_and_delay(0.02, 0.0))
    late, lag = found.value
    np.testing.assert_allclose([late - lag, lag], [0.012, 0.04], atol=0.001)


def test_the_inertia_about_z_follows_the_others_but_for_its_own_ratio():
    np.testing.assert_allclose(inertia_ratio({"inertia_x": 0.2}), [0.2, 0.0, 0.1])
    told = {"inertia_x": 0.2, "inertia_y": 0.4, "inertia_z": -0.1}
    np.testing.assert_allclose(inertia_ratio(told), [0.2, 0.4, 0.2])
