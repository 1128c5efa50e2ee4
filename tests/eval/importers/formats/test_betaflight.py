"""Betaflight logs, on small files of the true format made from a flight that is known exactly."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import near, quat_off, text


def test_betaflight_with_motion_capture_equals_the_flight(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv")
    pose = made.write_mocap(tmp_path / "pose.csv", span=(1.0005, 19.0), offset=-3.21, drift=60e-6)
    log, findings = import_log(path, None, ImportOptions(pose=pose, full_thrust=30.0))
    truth = known_flight.fly(log.time_s + 1.0005)
    late = float(np.sum((log.pos_w - truth.pos) * truth.vel) / np.sum(truth.vel**2))
    assert abs(late) < 2e-4
    near(log.pos_w, truth.pos, 2e-3)
    assert quat_off(log, truth) < 1e-3
    # Whole degrees per second, at 1 kHz smoothed to the poses' 120 Hz.
    near(log.rate_b, truth.rate, 0.02)
    near(log.acc_b, truth.acc, 0.02)
    near(log.thrust_cmd, truth.thrust, 0.1)
    near(log.rate_cmd_b, truth.cmd_rate, 0.04)
    near(log.rotor_speed, truth.motor, 2.0)
    assert log.velocity_derived
    assert any(f"+{ppm} ppm" in text(findings, "pose clock") for ppm in range(57, 64))


@pytest.mark.parametrize("fix", [True, False])
def test_betaflights_tenfold_values_are_found(tmp_path, fix):
    """blackbox_high_resolution multiplies rates by ten, blackbox_decode the voltage."""
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 10), gain=10, tenfold=10)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 10), offset=0.4)
    options = ImportOptions(pose=pose, full_thrust=30.0, fix=fix)
    log, findings = import_log(path, None, options)
    level = {f.subject for f in findings if f.level == ("corrected" if fix else "doubt")}
    assert {"units", "voltage"} <= level
    assert "blackbox_high_resolution" in text(findings, "units")
    truth, tenfold = known_flight.fly(log.time_s), 1 if fix else 10
    near(log.rate_b, tenfold * truth.rate, 0.02 * tenfold)
    near(log.rate_cmd_b, tenfold * truth.cmd_rate, 0.04 * tenfold)
    near(log.voltage, tenfold * truth.voltage, 0.1 * tenfold)
    if fix:
        assert level == {"units", "voltage"}


def test_betaflight_counts_the_motors_poles(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 8), poles=12)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 8))
    log, _ = import_log(path, None, ImportOptions(pose=pose, motor_poles=12, full_thrust=30.0))
    near(log.rotor_speed, known_flight.fly(log.time_s).motor, 2.0)
    with pytest.raises(FlightLogError, match="motor_poles is 7"):
        import_log(path, None, ImportOptions(pose=pose, motor_poles=7))


def test_betaflight_alone_asks_for_a_pose(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 2))
    with pytest.raises(FlightLogError, match="no position and no attitude; --pose"):
        import_log(path)
    with pytest.raises(ValueError, match="read as 'betaflight', .* leave --map out, or say --form"):
        import_log(path, None, ImportOptions(map=tmp_path / "mine.toml", partial=True))
    raw = tmp_path / "LOG00001.BFL"
    raw.write_bytes(b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n\0\1")
    with pytest.raises(FlightLogError, match="run blackbox_decode"):
        import_log(raw)
