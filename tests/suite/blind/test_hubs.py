"""The damping by moving hubs, against hubs that are moved."""

import numpy as np
import pytest

from suite.blind.rotorpy_flight import damping_of_hubs
from tests.support.vehicles import PLAIN

K = 2e-6


@pytest.mark.parametrize(
    ("name", "plane"), [("rotor_drag", (1.0, 1.0, 0.0)), ("inflow", (0.0, 0.0, 1.0))]
)
def test_torque_of_hubs_in_a_turning_body(name, plane):
    place = np.asarray(PLAIN.rotors.position)
    speed = np.sqrt(PLAIN.mass * 9.81 / 4 / PLAIN.rotors.thrust_coefficient)
    rate_b = np.array([0.7, -1.1, 2.0])
    force = -K * speed * np.cross(rate_b, place) * plane
    torque = np.cross(place, force).sum(axis=0)
    found = damping_of_hubs([{"name": name, "parameters": {"coefficient": K}}], PLAIN)
    np.testing.assert_allclose(-found * rate_b * PLAIN.inertia, torque, rtol=1e-3, atol=1e-9)
