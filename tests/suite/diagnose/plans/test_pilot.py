"""The pilot of commanded trajectories stays on them."""

import numpy as np
import pytest

from suite.blind.oracle.strength import given_vehicle
from suite.diagnose.plans.simulate import fly
from suite.diagnose.plans.trajectory import Trajectory

EIGHT = Trajectory("figure_eight", duration_s=2.5, speed=4.0, size=2.0, turn="wobble")
CIRCLE = Trajectory("circle", duration_s=2.5, speed=3.0, size=3.0)
BARE = given_vehicle("bare")


@pytest.fixture(scope="module")
def flights():
    return fly(BARE, BARE, [EIGHT, CIRCLE])


def test_the_pilot_stays_on_the_trajectory(flights):
    for way, flight in zip((EIGHT, CIRCLE), flights, strict=True):
        off = np.linalg.norm(way.reference(flight.time_s).pos_w - flight.motion.pos_w, axis=1)
        assert off.max() < 0.5
