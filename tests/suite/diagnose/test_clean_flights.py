"""Flights of the vehicle that is given: without noise, and with signals at rates of their own."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN, with_lag

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
