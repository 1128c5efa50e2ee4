"""Flights of the vehicle that is given: without noise, and with signals at rates of their own."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", [PLAIN, LAGGED], ids=["at once", "lagged"])
def test_without_noise_the_models_own_error_is_no_finding(vehicle):
    logs = fly_all([vehicle] * 3, range(3), duration_s=5.0, noise=0.0, motors=True)
    found = diagnosis_json(diagnose(logs, vehicle, drive="commands"))
    assert (found["verdict"], found["effects"]) == ("no_gap", [])
    assert all(not one["relevant"] for one in found["negligible"])


@pytest.mark.slow
def test_a_gyro_of_half_the_rate_and_no_commands_end_in_a_verdict():
    logs = []
    for log in fly_all([LAGGED] * 3, range(3), duration_s=5.0, motors=True):
        rate_b = np.array(log.rate_b)
        rate_b[1::2] = np.nan
        logs.append(replace(log, rate_b=rate_b, thrust_cmd=None, rate_cmd_b=None))
    found = diagnosis_json(diagnose(logs, LAGGED))
    assert (found["verdict"], found["effects"]) == ("no_gap", [])


@pytest.mark.slow
def test_how_rotor_speeds_run_between_rows_is_no_finding():
    """At 100 rows a second it looks like 0.5 % less inertia, and 2 % with every second row."""
    logs = fly_all([LAGGED] * 3, range(3), duration_s=6.0, noise=0.0, motors=True)
    found = diagnosis_json(diagnose(logs, LAGGED, drive="motors"))
    assert (found["verdict"], found["effects"]) == ("no_gap", [])
    assert [one["name"] for one in found["negligible"]] == ["inertia_scale"]


@pytest.mark.slow
def test_what_a_rate_loop_does_between_rows_is_no_inertia_beside_a_drag():
    """Without a lag rows of 100 Hz look like 8 % less inertia, on three stretches."""
    true = with_effects(PLAIN, linear_drag=((0.3, 0.3, 0.1),))
    (log,) = fly_all([true], [0], duration_s=6.0, noise=0.1, motors=True)
    found = diagnose([replace(log, thrust_cmd=None, rate_cmd_b=None)], PLAIN)
    assert [name.candidate.name for _, name in found.named] == ["linear_drag"]
    assert any("no larger than the model's own error" in line for line in found.warnings)
