"""Rotor speeds against what was asked for: lag, delay and scale are known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.verdict.actuators import actuator_mismatches
from tests.support.diagnosis_flights import NOISE, fly, fly_all
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)


def apart(truth, given=LAGGED):
    logs = fly_all([truth] * 2, range(2), duration_s=4.0, motors=True)
    (found,) = actuator_mismatches(logs, given)
    return found


def test_the_nominal_loop_leaves_noise_only():
    found = apart(LAGGED)
    assert found.commanded_by == "nominal rate loop" and found.followed > 0.99
    assert found.rms < 1.3 * NOISE["motor"]
    assert found.time_constant == pytest.approx(0.03, abs=1e-3)
    assert found.delay == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(found.scale, 1.0, atol=1e-3)
    assert abs(found.thrust[0]) < 0.02


def test_lag_and_delay_are_told_apart():
    found = apart(with_effects(with_lag(PLAIN, 0.05), command_delay=(0.012,)))
    assert found.time_constant == pytest.approx(0.05, abs=2e-3)
    assert found.delay == pytest.approx(0.012, abs=2e-3)
    assert found.rms > 2.0 * found.rms_fitted


def test_a_rotor_that_does_not_reach_its_speed_is_seen():
    logs = fly_all([LAGGED] * 2, range(2), duration_s=4.0, motors=True)
    pairs = [(log, log.rotor_speed, log.thrust_cmd) for log in logs]
    slow = [
        replace(log, rotor_speed=speed * [1.0, 0.97, 1.0, 1.0])
        for log, speed, _ in pairs
        if speed is not None
    ]
    assert len(slow) == len(logs)
    (found,) = actuator_mismatches(slow, LAGGED)
    np.testing.assert_allclose(found.scale, [1.0, 0.97, 1.0, 1.0], atol=2e-3)
    # A quarter of the thrust falls by 6 %.
    mean = np.mean([thrust.mean() for *_, thrust in pairs if thrust is not None])
    assert found.thrust[0] == pytest.approx(-(1.0 - 0.97**2) * mean / 4.0, rel=0.1)


def test_logged_motor_commands_are_held_against_the_speeds_too():
    log = fly(LAGGED, 0, duration_s=4.0, motors=True)
    assert log.rotor_speed is not None
    asked = replace(log, rotor_speed_cmd=log.rotor_speed / 0.9)
    loop, logged = actuator_mismatches([asked], with_lag(PLAIN, 0.0))
    assert (loop.commanded_by, logged.commanded_by) == (
        "nominal rate loop",
        "logged motor commands",
    )
    np.testing.assert_allclose(logged.scale, 0.9, atol=5e-3)


def test_logs_without_speeds_or_with_holes_say_nothing():
    log = fly(LAGGED, 0, duration_s=2.0, motors=True)
    assert actuator_mismatches([replace(log, rotor_speed=None)], LAGGED) == []
    assert log.rotor_speed is not None
    log.rotor_speed[::20] = np.nan
    log.rotor_speed[5:60] = np.nan
    assert len(actuator_mismatches([log], LAGGED)) <= 1
    log.rotor_speed[:] = np.nan
    assert actuator_mismatches([log], LAGGED) == []
