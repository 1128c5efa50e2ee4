"""Vehicles one standard deviation off add up to what a fit leaves open."""

import numpy as np

from suite.diagnose.identify.drive import Driven
from suite.diagnose.identify.fit import Fitted, Unknown
from suite.diagnose.identify.flapping import doubted, one_off
from tests.support import identified as known


def fit_of(names, covariance):
    unknowns = tuple(Unknown(name, 0.0, -1.0, 1.0, 1.0, 1e-3) for name in names)
    half = 1.96 * np.sqrt(np.diag(covariance))
    return Fitted(unknowns, np.zeros(len(names)), half, np.asarray(covariance))


FORCE = fit_of(("thrust", "drag_x", "curve"), [[4e-4, 0, -1e-4], [0, 0.1, 0], [-1e-4, 0, 9e-4]])
TORQUE = fit_of(("inertia_x", "inertia_y"), np.diag([0.01, 0.0004]))


def test_what_is_off_has_the_covariance_of_the_fit_and_no_other_number():
    moves = np.array([one.value for one in one_off(FORCE, ("thrust", "curve"))])
    np.testing.assert_allclose(moves.T @ moves, FORCE.covariance * [1, 0, 1], atol=1e-15)
    assert one_off(FORCE, ("battery",)) == []


def test_motors_are_off_as_they_were_told_and_inertia_by_its_own_doubt():
    start = known.start()
    driven = Driven(start, "pwm", command=0.5, volts=15.0)
    found = doubted(start, driven, FORCE, TORQUE)
    assert len(found) == 4
    hover = [v.motors.thrust[0] * 0.5 + v.motors.thrust[1] * 0.25 for v in found[:2] if v.motors]
    np.testing.assert_allclose(
        np.linalg.norm(np.log(np.array(hover) / sum(driven.usual_thrust))), 0.02, rtol=0.05
    )
    off = np.log([np.asarray(v.inertia) / start.inertia for v in found[2:]])
    np.testing.assert_allclose(np.linalg.norm(off, axis=0)[:2], [0.1, 0.02], rtol=1e-6)
    assert all(v.motors == start.motors for v in found[2:])
