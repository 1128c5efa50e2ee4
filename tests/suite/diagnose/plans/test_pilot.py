"""The pilot of commanded trajectories stays on them."""

import numpy as np
import pytest

from tests.support.ways import CIRCLE, EIGHT, bare_flights


@pytest.fixture(scope="module")
def flights():
    return bare_flights()


def test_the_pilot_stays_on_the_trajectory(flights):
    for way, flight in zip((EIGHT, CIRCLE), flights, strict=True):
        off = np.linalg.norm(way.reference(flight.time_s).pos_w - flight.motion.pos_w, axis=1)
        assert off.max() < 0.5
