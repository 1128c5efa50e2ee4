"""A diagnosis of two effects by views, made once."""

import pytest

from suite.diagnose.diagnose import diagnose
from tests.support.real_flights import VEHICLE, flights


@pytest.fixture(scope="session")
def by_views():
    hidden = {"linear_drag": ((0.4, 0.3, 0.2),), "angular_damping": ((6.0, 6.0, 4.0),)}
    return diagnose(flights(4, hidden=hidden), VEHICLE, by="views")
