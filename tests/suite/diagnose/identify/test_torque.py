"""Which numbers of the torque are looked for, by what drives the flights."""

import numpy as np
import pytest

from suite.diagnose.identify.drive import delayed, lagged
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.torque import fit_rotor_lag, lag_and_delay, unknowns_of


@pytest.mark.parametrize(
    ("drive", "names"),
    [
        ("rotors", ["inertia_x", "inertia_y", "yaw"]),
        ("pwm", ["inertia_x", "inertia_y", "yaw", "late", "lag"]),
        ("torques", ["inertia_x", "inertia_y", "inertia_z", "late", "lag"]),
    ],
)
def test_what_is_looked_for(drive, names):
    assert [unknown.name for unknown in unknowns_of(drive, 0.03, 0.0)] == names


def test_rotors_behind_their_commands_tell_lag_and_delay():
    rng = np.random.default_rng(0)
    asked = np.repeat(1000.0 + 50.0 * rng.normal(size=(500, 4)), 5, axis=0)
    speed = lagged(delayed(asked, 0.012), 0.04) + rng.normal(size=asked.shape)
    time_s = STEP_S * np.arange(len(asked))
    flight = FlightGrid("made", time_s, {"rotor_speed": speed, "rotor_speed_cmd": asked})
    found = fit_rotor_lag([flight], lag_and_delay(0.02, 0.0))
    late, lag = found.value
    np.testing.assert_allclose([late - lag, lag], [0.012, 0.04], atol=0.001)
