"""The torque of moving air, told once all else is known."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.identify.flapping import flapping_of
from tests.support.real_flights import VEHICLE, flights

TRUE = 4e-7


@pytest.fixture(scope="module")
def blown():
    return flights(3, seed=5, blade_flapping=(TRUE,))


def test_flapping_is_within_its_interval(blown):
    entry = flapping_of(blown, VEHICLE)
    assert entry is not None and entry.key == "effects.blade_flapping.coefficient"
    span, (value,) = entry.ci95[0], entry.value
    assert span is not None
    low, high = span
    assert value == pytest.approx(TRUE, rel=0.1)
    assert low - 0.5 * (high - low) < TRUE < high + 0.5 * (high - low)


def test_a_vehicle_that_has_it_asks_for_none():
    assert flapping_of(flights(3, seed=6), VEHICLE) is None


def test_logs_without_attitude_or_rotors_tell_none(blown):
    level = [replace(log, quat_wxyz=np.full_like(log.quat_wxyz, np.nan)) for log in blown]
    assert flapping_of(level, VEHICLE) is None
    hover = np.full(len(blown[0].time_s), 9.81)
    bare = [replace(log, rotor_speed=None, thrust_cmd=hover) for log in blown]
    assert flapping_of(bare, VEHICLE) is None
