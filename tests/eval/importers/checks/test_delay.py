"""A late pose is found within its error and moved; one on time is left where it is."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers.checks.attitude import READINGS, as_read
from eval.importers.checks.delay import check_delay, delay_of
from eval.importers.frames import HALF_TURN
from eval.importers.signals import Recording, Signal
from tests.support import known_flight


def recording(late_s, noise=1e-3, seed=0):
    rng = np.random.default_rng(seed)
    truth = known_flight.fly(np.arange(0, 12, 0.01))
    quat = truth.quat + noise * rng.normal(size=truth.quat.shape)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return Recording(
        "log",
        {
            "quat": Signal(truth.time + late_s, quat),
            "pos": Signal(truth.time + late_s, truth.pos),
            "rate": Signal(truth.time, truth.rate + 0.02 * rng.normal(size=truth.rate.shape)),
        },
    )


@pytest.mark.parametrize("late_s", [0.02, -0.013])
def test_a_late_pose_is_moved_with_its_position(late_s):
    late = recording(late_s)
    moved, findings = check_delay(late, True)
    assert findings[0].level == "corrected"
    for name in ("quat", "pos"):
        error = moved.signals[name].time_s[0] - 0.0
        assert abs(error) < 1e-3
    np.testing.assert_array_equal(moved.signals["rate"].time_s, late.signals["rate"].time_s)
    kept, findings = check_delay(late, False)
    assert findings[0].level == "doubt"
    assert kept is late


def test_a_pose_on_time_is_left_alone():
    here = recording(0.0)
    kept, findings = check_delay(here, True)
    assert kept is here
    assert findings[0].level == "ok"


def test_the_standard_error_is_that_of_the_delay():
    off = []
    for seed in range(12):
        found = delay_of(*(recording(0.01, 0.004, seed).signals[n] for n in ("quat", "rate")))
        assert found is not None
        off.append((found[0] - 0.01) / found[1])
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 2.0


@pytest.mark.parametrize("reading", READINGS[1:])
def test_a_late_pose_is_moved_however_its_attitude_is_written(reading):
    order, inverse, turned = reading
    late = recording(0.03)
    quat, rate = late.signals["quat"], late.signals["rate"]
    value = as_read(quat.value, "wxyz", inverse)
    value = value[:, [1, 2, 3, 0]] if order == "xyzw" else value
    gyro = rate.value * HALF_TURN if turned else rate.value
    written = {"quat": quat._replace(value=value), "rate": rate._replace(value=gyro)}
    moved, findings = check_delay(replace(late, signals={**late.signals, **written}), True)
    assert findings[0].level == "corrected"
    assert abs(moved.signals["pos"].time_s[0]) < 1e-3
