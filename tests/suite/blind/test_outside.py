"""Physics outside the catalogue acts, and with the force that it says."""

import numpy as np
import pytest

from suite.blind.oracle.strength import given_vehicle
from suite.blind.outside import KINDS as OUTSIDE
from suite.blind.outside import make_outside
from suite.diagnose.plans.simulate import fly
from suite.diagnose.plans.trajectory import Trajectory

BARE = given_vehicle("bare")


@pytest.mark.parametrize("name", OUTSIDE)
def test_physics_outside_the_catalogue_moves_the_vehicle(name):
    way = Trajectory("climb", duration_s=2.0, speed=3.0, size=1.0)
    plain = fly(BARE, BARE, [way])[0]
    moved = fly(BARE, BARE, [way], extra=make_outside(name, OUTSIDE[name].usual, BARE.mass))[0]
    pushed = (
        np.abs(moved.extra.force_b).max() + np.abs(moved.acting.thrust - moved.command.thrust).max()
    )
    assert pushed > 0.0 and np.abs(moved.motion.pos_w - plain.motion.pos_w).max() > 1e-5


def test_a_hanging_load_weighs_what_it_weighs():
    flight = fly(
        BARE, BARE, [Trajectory("hover", 1.0)], extra=make_outside("slung_load", 0.03, BARE.mass)
    )[0]
    assert flight.extra.force_b[0, 2] == pytest.approx(-0.03 * 9.81, rel=1e-6)
