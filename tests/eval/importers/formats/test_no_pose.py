"""Logs without a pose: raw Blackbox, ArduPilot's .bin, PX4 and Crazyflie without a position."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import betaflight
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.raw_logs import write_bin, write_raw

PARTIAL = ImportOptions(partial=True, full_thrust=30.0)


def test_a_raw_blackbox_log_equals_the_flight(tmp_path):
    pytest.importorskip("betaflight_chirp_core")
    path = write_raw(tmp_path / "LOG00001.BFL", known_flight.fly(np.arange(0.0, 6.0, 0.002)))
    log, findings = import_log(path, None, PARTIAL)
    truth = known_flight.fly(log.time_s)
    assert log.partial == ("pos", "quat")
    np.testing.assert_allclose(log.rate_b, truth.rate, atol=0.02)
    np.testing.assert_allclose(log.acc_b, truth.acc, atol=0.2)
    np.testing.assert_allclose(log.rotor_speed, truth.motor, atol=4.0)
    np.testing.assert_allclose(log.voltage, truth.voltage, atol=0.01)
    np.testing.assert_allclose(log.pwm, truth.motor / 2100.0, atol=0.01)
    np.testing.assert_allclose(log.thrust_cmd, truth.thrust, atol=0.1)
    (asked,) = [f for f in findings if f.signal == "partial"]
    for words in ("this log has no pose", "inertia", "battery sag", "not identifiable", "wind"):
        assert words in asked.evidence
    assert log.about["firmware"].startswith("Betaflight 4.5")


def test_the_longest_log_of_a_raw_file_is_read(tmp_path, monkeypatch):
    pytest.importorskip("betaflight_chirp_core")
    short, long = (
        write_raw(tmp_path / f"{end}", known_flight.fly(np.arange(0.0, end, 0.004)))
        for end in (2.0, 4.0)
    )
    both = tmp_path / "both.bbl"
    both.write_bytes(short.read_bytes() + long.read_bytes())
    log, findings = import_log(both, None, PARTIAL)
    assert log.duration_s == pytest.approx(4.0, abs=0.1)
    assert any("holds 2 logs; the longest, number 2" in f.evidence for f in findings)
    monkeypatch.setitem(sys.modules, "betaflight_chirp_core", None)
    with pytest.raises(FlightLogError, match="pip install .*blackbox.*or decode it with black"):
        import_log(both, None, PARTIAL)
    monkeypatch.undo()
    both.write_bytes(short.read_bytes()[:600])
    with pytest.raises(FlightLogError, match="cannot be decoded"):
        import_log(both, None, PARTIAL)


@pytest.mark.parametrize("pose", [False, True])
def test_an_ardupilot_log_equals_the_flight(tmp_path, pose):
    pytest.importorskip("pymavlink")
    truth = known_flight.fly(np.arange(0.0, 8.0, 0.01))
    log, _ = import_log(write_bin(tmp_path / "00000001.BIN", truth, pose), None, PARTIAL)
    assert log.partial == (() if pose else ("pos", "quat"))
    truth = known_flight.fly(log.time_s)
    np.testing.assert_allclose(log.rate_b, truth.rate, atol=0.01)
    np.testing.assert_allclose(log.acc_b, truth.acc, atol=0.02)
    np.testing.assert_allclose(log.rate_cmd_b[:-1], truth.cmd_rate[:-1], atol=0.05)
    np.testing.assert_allclose(log.rotor_speed, truth.motor, atol=2.0)
    np.testing.assert_allclose(log.pwm[:-1], truth.motor[:-1] / 2100.0, atol=0.01)
    np.testing.assert_allclose(log.voltage, truth.voltage, atol=0.01)
    if pose:
        np.testing.assert_allclose(log.pos_w, truth.pos, atol=0.01)
        np.testing.assert_allclose(log.rot_w, truth.rot, atol=1e-3)


def test_px4_and_crazyflie_without_a_position_are_read(tmp_path):
    ulog = made.write_ulog(tmp_path / "log.ulg", span=(0, 6))
    usd = made.write_usd(tmp_path / "log00", span=(0, 6), crc=False)
    for path, known, lacks in (
        (ulog, b"vehicle_local_position", ("pos",)),
        (usd, b"stateEstimate.", ("pos", "quat")),
    ):
        path.write_bytes(path.read_bytes().replace(known, known[::-1]))
        with pytest.raises(FlightLogError, match="no position"):
            import_log(path)
        log, _ = import_log(path, None, PARTIAL)
        assert log.partial == lacks
        np.testing.assert_allclose(log.rate_b, known_flight.fly(log.time_s).rate, atol=0.1)


def test_rotors_without_a_turn_are_not_counted_and_speeds_are_of_the_poles():
    """Logs may have columns for eight rotors; 700 eRPM of 14 poles are 100 turns a minute."""
    columns = {f"eRPM[{k}]": np.full(3, 7.0 if k < 4 else 0.0) for k in range(8)}
    box: Any = SimpleNamespace(columns=columns, name="log")
    findings: list[Any] = []
    found = betaflight._motors(box, 14, findings)
    assert [finding.status for finding in findings] == ["note"]
    np.testing.assert_allclose(found["motor"], np.full((3, 4), 100.0 / 60.0 * 2.0 * np.pi))
    columns["eRPM[4]"][1] = 1.0
    betaflight._motors(box, 14, findings)
    assert "motor_count" in {finding.fault for finding in findings}


@pytest.mark.parametrize(
    ("numbers", "unit", "volts"),
    [
        ([16.13, 16.02], "", [16.13, 16.02]),
        ([1613.0, 1602.0], "", [16.13, 16.02]),
        ([16.13, 16.02], "V", [16.13, 16.02]),
        ([0.21, 0.22], "V", [0.21, 0.22]),
        ([161.3, 160.2], "V", [16.13, 16.02]),
        ([5.0, 4.0], "", [0.05, 0.04]),
    ],
)
def test_a_voltage_is_in_volts_whatever_wrote_it(numbers, unit, volts):
    """Whole numbers without a unit are in hundredths; others are volts, or ten times too much."""
    read = np.array(numbers) * betaflight._VOLT[unit]
    np.testing.assert_allclose(betaflight._volts(read, unit, True, []), volts)
