"""Rotor speeds that are copied, drop out, are held or late, and a velocity of the air."""

from dataclasses import replace

import numpy as np
import pytest

from eval.logs.faults.check import CheckContext, check_log
from tests.support.diagnosis_flights import without_fault
from tests.support.vehicles import PLAIN


@pytest.fixture(scope="module")
def log():
    return without_fault()


def opened(log):
    found, _ = check_log(log, CheckContext(PLAIN))
    return [finding for finding in found if finding.is_open]


def held(speed):
    return speed[np.arange(len(speed)) // 10 * 10]


def dropped(speed):
    return np.where(np.random.default_rng(3).random(speed.shape) < 0.03, 0.0, speed)


def stuck(speed):
    return np.stack([*speed[:, :2].T, np.full(len(speed), speed[:, 2].mean()), speed[:, 3]], axis=1)


@pytest.mark.parametrize(
    ("change", "evidence"),
    [
        (held, "90 % of the rows repeat the one before: samples are 0.1 s apart"),
        (dropped, "a rotor that stands still for one row"),
        (stuck, "motors 3 of 4 never change"),
        (lambda speed: speed[:, [0, 1, 2, 2]], "motors 3 and 4 have the same values"),
    ],
)
def test_bad_telemetry_of_the_rotors_is_the_only_finding(log, change, evidence):
    (found,) = opened(replace(log, rotor_speed=change(log.rotor_speed)))
    assert found.fault == "motor_telemetry" and evidence in found.evidence


def test_speeds_in_every_row_every_second_row_and_rows_without_a_sample_are_fine(log):
    speed = log.rotor_speed
    every_second = speed[np.arange(len(speed)) // 2 * 2]
    empty = np.where((np.arange(len(speed)) % 10 == 0)[:, None], speed, np.nan)
    for fine in (speed, every_second, empty):
        assert not [f for f in opened(replace(log, rotor_speed=fine)) if "telemetry" in f.fault]


def late(log, late_s):
    """Return the log with the rotor speeds of `late_s` before."""
    time_s = log.time_s - late_s
    speed = [np.interp(time_s, log.time_s, one) for one in log.rotor_speed.T]
    return replace(log, rotor_speed=np.stack(speed, axis=1))


@pytest.mark.parametrize("late_s", [-0.03, 0.02, 0.09, 0.3])
def test_late_rotor_speeds_and_commands_in_their_place_are_the_only_finding(log, late_s):
    (found,) = opened(late(log, late_s))
    assert found.fault == "motor_telemetry" and found.size == pytest.approx(late_s, abs=0.003)
    assert ("early against the gyro, as commands are" in found.evidence) == (late_s < 0.0)


def test_motors_in_another_order_are_not_late_and_a_late_gyro_does_not_make_them_early(log):
    assert not opened(late(log, 0.008))
    (found,) = opened(replace(log, rotor_speed=log.rotor_speed[:, [1, 0, 3, 2]]))
    assert found.fault == "motor_order"
    gyro = np.stack([np.interp(log.time_s - 0.05, log.time_s, x) for x in log.rate_b.T], axis=1)
    (found,) = opened(replace(log, rate_b=gyro))
    assert found.fault == "clock_offset"


def test_an_air_speed_is_not_the_velocity_of_the_path(log):
    (found,) = opened(replace(log, vel_w=log.vel_w + [3.0, 0.0, 0.0]))
    assert found.fault == "velocity_mean" and found.size == pytest.approx(3.0, abs=0.1)
    assert found.fix == "--read vel=drop"
    assert not opened(replace(log, vel_w=log.vel_w + [0.1, 0.0, 0.0]))
