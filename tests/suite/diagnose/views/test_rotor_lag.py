"""The rotors' lag beside the views: named where commands and rotor speeds tell of another one."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.verdict.actuators import find_rotor_lag
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN, REMEMBERING, with_effects, with_lag

GIVEN = with_lag(PLAIN, 0.03)


def logged(vehicle, count=3):
    return fly_all([vehicle] * count, range(count), duration_s=5.0, motors=True)


@pytest.fixture(scope="module")
def slow():
    return logged(with_effects(GIVEN, motor_lag=(0.06,), linear_drag=((0.4, 0.4, 0.2),)))


def test_slow_rotors_are_named_beside_what_the_views_name(slow):
    found = diagnose(slow, GIVEN, by="views")
    told = diagnosis_json(found)
    effects = {effect["name"]: effect for effect in told["effects"]}
    assert {"motor_lag", "linear_drag"} <= set(effects)
    entry = effects["motor_lag"]["parameters"]["time_constant"]
    low, high = entry["ci95"]
    assert low < 0.06 < high < 0.064 and low > 0.056
    assert effects["motor_lag"]["gap_removed"] > 0.9 and effects["motor_lag"]["p_value"] < 0.01
    assert found.vehicle.effects["motor_lag"].time_constant == entry["value"]
    assert told["verdict"] in ("named", "partly")
    assert "instead of 0.03 s" in told["headline"]


def test_a_lag_that_the_vehicle_has_is_not_named(slow):
    assert find_rotor_lag(logged(GIVEN), GIVEN) is None
    assert find_rotor_lag(slow, with_effects(GIVEN, motor_lag=(0.06,))) is None
    assert find_rotor_lag(slow, with_lag(GIVEN, 0.06)) is None


def test_flights_that_cannot_tell_are_left_alone(slow):
    assert find_rotor_lag(slow, GIVEN) is not None
    assert find_rotor_lag(slow[:2], GIVEN) is None, "two flights"
    calm = fly_all([GIVEN], [7], duration_s=3.0, speed=0.3, motors=True)
    assert find_rotor_lag([*slow, *calm], GIVEN) == find_rotor_lag(slow, GIVEN), (
        "speeds hardly change"
    )
    assert find_rotor_lag([replace(log, rotor_speed=None) for log in slow], GIVEN) is None
    assert find_rotor_lag(slow, with_lag(REMEMBERING, 0.03)) is None, "a loop that remembers"
    rng = np.random.default_rng(0)
    other = [
        replace(
            log, rotor_speed=log.rotor_speed + 60.0 * rng.standard_normal(log.rotor_speed.shape)
        )
        for log in slow
    ]
    assert find_rotor_lag(other, GIVEN) is None, "speeds that the commands do not explain"
