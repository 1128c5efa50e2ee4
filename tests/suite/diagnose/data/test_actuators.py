"""Measured rotor speeds against commanded ones: lag, delay, scale, and the model's input."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.verdict.actuators import (
    actuator_mismatches,
    find_rotor_lag,
    flown_by_other_controller,
    rotors_are_input,
)
from tests.support.diagnosis_flights import NOISE, fly, fly_all
from tests.support.vehicles import PLAIN, REMEMBERING, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)


@pytest.fixture(scope="module")
def log():
    return fly(LAGGED, 0, duration_s=4.0, motors=True)


def with_speeds(log, speed):
    return replace(log, rotor_speed=speed)


@pytest.mark.parametrize(("lag", "delay"), [(0.03, 0.0), (0.05, 0.012)])
def test_lag_and_delay_are_estimated_separately(lag, delay):
    truth = with_effects(with_lag(PLAIN, lag), command_delay=(delay,))
    logs = fly_all([truth] * 2, range(2), duration_s=3.0, motors=True)
    (found,) = actuator_mismatches(logs, LAGGED)
    assert found.commanded_by == "nominal rate loop"
    accuracy = 2e-3 if delay else 1e-3
    assert found.time_constant == pytest.approx(lag, abs=accuracy)
    assert found.delay == pytest.approx(delay, abs=accuracy)
    if delay:
        assert found.rms > 2.0 * found.rms_fitted
    else:
        assert found.followed > 0.99 and found.rms < 1.3 * NOISE["motor"]
        assert abs(found.thrust[0]) < 0.02
        np.testing.assert_allclose(found.scale, 1.0, atol=1e-3)


def test_a_rotor_that_does_not_reach_its_speed_is_seen_also_by_logged_motor_commands(log):
    share = np.array([1.0, 0.97, 1.0, 1.0])
    (found,) = actuator_mismatches([with_speeds(log, log.rotor_speed * share)], LAGGED)
    np.testing.assert_allclose(found.scale, share, atol=2e-3)
    # A quarter of the thrust falls by 6 %.
    lost = (1.0 - 0.97**2) * log.thrust_cmd.mean() / 4.0
    assert found.thrust[0] == pytest.approx(-lost, rel=0.1)
    commanded = replace(log, rotor_speed_cmd=log.rotor_speed / 0.9)
    found = actuator_mismatches([commanded], with_lag(PLAIN, 0.0))
    logged = {one.commanded_by: one for one in found}["logged motor commands"]
    np.testing.assert_allclose(logged.scale, 0.9, atol=5e-3)


def test_logs_without_speeds_give_no_mismatch_and_speeds_of_another_controller_are_its_own(log):
    assert actuator_mismatches([with_speeds(log, None)], LAGGED) == []
    speed = np.array(log.rotor_speed)
    speed[::20] = np.nan
    speed[5:60] = np.nan
    assert len(actuator_mismatches([with_speeds(log, speed)], LAGGED)) <= 1
    assert actuator_mismatches([with_speeds(log, np.nan * speed)], LAGGED) == []
    other = with_speeds(log, np.roll(log.rotor_speed, 1, axis=1))
    assert flown_by_other_controller([other], LAGGED)
    assert not flown_by_other_controller([with_speeds(log, None)], LAGGED)
    moved = with_effects(LAGGED, com_offset=((0.006, -0.004, 0.0),))
    assert not flown_by_other_controller([fly(moved, 0, duration_s=2.0, motors=True)], LAGGED)


def test_columns_and_rate_loop_decide_what_can_be_the_input(log):
    no_motors = with_speeds(log, None)
    no_commands = replace(log, thrust_cmd=None, rate_cmd_b=None)
    assert not rotors_are_input([log], "auto", LAGGED)
    assert rotors_are_input([log], "motors", LAGGED)
    assert rotors_are_input([log, no_commands], "auto", LAGGED)
    assert rotors_are_input([log], "auto", REMEMBERING)
    for logs, drive, vehicle, message in (
        ([log, no_motors], "motors", LAGGED, "not every flight"),
        ([no_motors, no_commands], "auto", LAGGED, "diagnose each kind alone"),
        ([log], "wheels", LAGGED, "auto, commands, motors"),
        ([log], "commands", REMEMBERING, "state of its crazyflie rate loop"),
        ([no_motors], "auto", REMEMBERING, "state of its crazyflie rate loop"),
    ):
        with pytest.raises(ValueError, match=message):
            rotors_are_input(logs, drive, vehicle)


@pytest.fixture(scope="module")
def slow():
    truth = with_effects(LAGGED, motor_lag=(0.06,), linear_drag=((0.4, 0.4, 0.2),))
    return fly_all([truth] * 3, range(3), duration_s=4.0, motors=True)


def test_a_longer_rotor_lag_is_named_next_to_what_the_views_name(slow):
    found = diagnose(slow, LAGGED, by="views")
    written = diagnosis_json(found)
    effects = {effect["name"]: effect for effect in written["effects"]}
    assert {"motor_lag", "linear_drag"} <= set(effects)
    entry = effects["motor_lag"]["parameters"]["time_constant"]
    low, high = entry["ci95"]
    assert 0.056 < low < 0.06 < high < 0.064
    assert effects["motor_lag"]["gap_removed"] > 0.9 and effects["motor_lag"]["p_value"] < 0.01
    assert found.vehicle.effects["motor_lag"].time_constant == entry["value"]
    assert written["verdict"] in ("named", "partly") and "(motor_lag)" in written["headline"]


def test_a_lag_is_named_only_where_it_differs_and_flights_identify_it(slow):
    found = find_rotor_lag(slow, LAGGED)
    assert found is not None
    calm = fly_all([LAGGED], [7], duration_s=2.0, speed=0.3, motors=True)
    assert find_rotor_lag([*slow, *calm], LAGGED) == found, "its speeds hardly change"
    own = fly_all([LAGGED] * 3, range(3), duration_s=3.0, motors=True)
    rng = np.random.default_rng(0)
    noisy = [
        with_speeds(log, log.rotor_speed + 60.0 * rng.standard_normal(log.rotor_speed.shape))
        for log in slow
    ]
    for logs, vehicle, reason in (
        (own, LAGGED, "the file's lag"),
        (slow, with_effects(LAGGED, motor_lag=(0.06,)), "the lag of its effect"),
        (slow, with_lag(LAGGED, 0.06), "the lag of its rotors"),
        (slow[:2], LAGGED, "two flights"),
        ([with_speeds(log, None) for log in slow], LAGGED, "no speeds"),
        (slow, with_lag(REMEMBERING, 0.03), "a loop with a state"),
        (noisy, LAGGED, "speeds that the commands do not explain"),
    ):
        assert find_rotor_lag(logs, vehicle) is None, reason
