"""The torque of moving air, identified once all else is known."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.identify.drive import DrivenVehicle
from suite.diagnose.identify.fit import Fitted, Unknown
from suite.diagnose.identify.flapping import flapping_of, perturbed_vehicles
from tests.support import identified as known
from tests.support.real_flights import VEHICLE, flights

TRUE = 4e-7


@pytest.fixture(scope="module")
def blown():
    return flights(3, 5, 5.0, blade_flapping=(TRUE,))


def test_flapping_is_within_its_interval_and_none_without_what_it_needs(blown):
    entry = flapping_of(blown, VEHICLE)
    assert entry is not None and entry.key == "effects.blade_flapping.coefficient"
    span, (value,) = entry.ci95[0], entry.value
    low, high = span
    assert value == pytest.approx(TRUE, rel=0.1)
    assert low - 0.5 * (high - low) < TRUE < high + 0.5 * (high - low)
    level = [replace(log, quat_wxyz=np.full_like(log.quat_wxyz, np.nan)) for log in blown]
    assert flapping_of(level, VEHICLE) is None
    hover = np.full(len(blown[0].time_s), 9.81)
    bare = [replace(log, rotor_speed=None, thrust_cmd=hover) for log in blown]
    assert flapping_of(bare, VEHICLE) is None
    still = flights(3, 6, 3.0)
    assert flapping_of(still, VEHICLE) is None, "of a vehicle without flapping"


def fit_of(names, covariance):
    unknowns = tuple(Unknown(name, 0.0, -1.0, 1.0, 1.0, 1e-3) for name in names)
    half = 1.96 * np.sqrt(np.diag(covariance))
    return Fitted(unknowns, np.zeros(len(names)), half, np.asarray(covariance))


FORCE = fit_of(("thrust", "drag_x", "curve"), [[4e-4, 0, -1e-4], [0, 0.1, 0], [-1e-4, 0, 9e-4]])
TORQUE = fit_of(("inertia_x", "inertia_y"), np.diag([0.01, 0.0004]))


def test_motors_are_off_by_their_covariance_and_inertia_by_its_own():
    start = known.start()
    driven = DrivenVehicle(start, "pwm", usual_command=0.5, usual_volts=15.0)
    found = perturbed_vehicles(start, driven, FORCE, TORQUE)
    assert len(found) == 4
    hover = [v.motors.thrust[0] * 0.5 + v.motors.thrust[1] * 0.25 for v in found[:2] if v.motors]
    np.testing.assert_allclose(
        np.linalg.norm(np.log(np.array(hover) / sum(driven.usual_thrust))), 0.02, rtol=0.05
    )
    off = np.log([np.asarray(v.inertia) / start.inertia for v in found[2:]])
    np.testing.assert_allclose(np.linalg.norm(off, axis=0)[:2], [0.1, 0.02], rtol=1e-6)
    assert all(v.motors == start.motors for v in found[2:])
