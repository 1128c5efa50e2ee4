"""Findings that an import stored in a log, when the log is checked again."""

from dataclasses import replace

from eval.logs.faults.check import CheckContext, check_log
from eval.logs.faults.finding import Finding
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN


def test_a_stored_finding_on_another_vehicle_file_is_not_repeated_and_one_on_the_log_is():
    stored = [
        Finding("doubt", "motor map", "the file gives twice the thrust", "motor_map", fix="t1"),
        Finding("doubt", "voltage", "0 V", "voltage"),
    ]
    log = replace(
        fly(PLAIN, 0, duration_s=3.0), about={"findings": [one._asdict() for one in stored]}
    )

    def faults(context):
        return [one.fault for one in check_log(log, context)[0] if one.status == "doubt"]

    assert faults(CheckContext()) == ["motor_map", "voltage"]
    assert faults(CheckContext(PLAIN)) == ["voltage"]
