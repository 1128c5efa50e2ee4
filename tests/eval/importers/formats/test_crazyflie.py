"""Crazyflie logs, on small files of the true format made from a flight that is known exactly."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats.crazyflie import unpack_quaternion
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import levels, near, quat_off, text

FULL = ImportOptions(full_thrust=30.0)


@pytest.mark.parametrize("version", [1, 2])
def test_crazyflie_equals_the_flight(tmp_path, version):
    path = made.write_usd(tmp_path / "log00", version=version)
    log, findings = import_log(path, None, FULL)
    truth = known_flight.fly(log.time_s)
    for value, wanted in (
        (log.pos_w, truth.pos),
        (log.vel_w, truth.vel),
        (log.rate_b, truth.rate),
        (log.acc_b, truth.acc),
        (log.rate_cmd_b, truth.cmd_rate),
        (log.thrust_cmd, truth.thrust),
        (log.voltage, truth.voltage),
    ):
        near(value, wanted, 1e-5)
    near(log.rotor_speed, truth.motor, 0.1)
    assert quat_off(log, truth) < 1e-6
    assert "doubt" not in levels(findings).values()


def test_crazyflie_compressed_and_without_checksum(tmp_path):
    path = made.write_usd(tmp_path / "log00", compressed=True, crc=False)
    log, findings = import_log(path, "crazyflie", FULL)
    truth = known_flight.fly(log.time_s)
    near(log.pos_w, truth.pos, 6e-4)
    near(log.rate_b, truth.rate, 6e-4)
    assert quat_off(log, truth) < 1.5e-3
    assert levels(findings)["file"] == "doubt"


def test_quaternions_unpack_whichever_part_is_largest():
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(400, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    found = unpack_quaternion(np.array([made.pack_quaternion(q) for q in quat]))
    near(np.abs(np.sum(found * quat, axis=1)), 1.0, 3e-6)
    assert set(np.argmax(np.abs(quat), axis=1)) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: data[:3], "header is broken"),
        (lambda data: data[:60], "header is broken"),
        (lambda data: data.replace(b"stateEstimate.x(f)", b"stateEstimate.x(?)"), "header is"),
        (lambda data: data[:1] + b"\3" + data[2:], "version 3"),
        (lambda data: data[: data.index(b"pm.vbat(f)\0") + 11], "nothing was logged"),
        (lambda data: b"\0" + data[1:], "of no known format"),
        (lambda data: b"", "empty"),
    ],
)
def test_broken_crazyflie_logs_are_refused_by_name(tmp_path, change, reason):
    path = made.write_usd(tmp_path / "log00", span=(0, 2))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(FlightLogError, match=f"log00: .*{reason}"):
        import_log(path)


def test_a_crazyflie_log_is_read_up_to_where_it_breaks(tmp_path):
    path = made.write_usd(tmp_path / "log00", span=(0, 8))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + b"\xff" * 500)
    log, findings = import_log(path, None, FULL)
    assert 3.0 < log.duration_s < 4.2
    near(log.pos_w[:-1], known_flight.fly(log.time_s[:-1]).pos, 1e-5)
    assert "no known event" in text(findings, "file")
