"""Logs of PX4, Betaflight, ArduPilot, Crazyflie and ROS 2, made from a flight that is known."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import ardupilot, betaflight, px4
from eval.importers.formats.crazyflie import unpack_quaternion
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from eval.logs.faults.check import CheckContext, check_log
from eval.vehicles.vehicle import MotorMap
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import TRUE, levels, near, same_flight, text
from tests.support.marks import more
from tests.support.raw_logs import write_bin, write_raw
from tests.support.vehicles import PLAIN

FULL = ImportOptions(full_thrust=30.0)


def test_px4_equals_the_flight(tmp_path):
    log, findings = import_log(made.write_ulog(tmp_path / "log.ulg"), None, FULL)
    truth = known_flight.fly(log.time_s)
    # The file holds float32 and whole rpm. Rows stand at the positions, at 100 Hz; between the
    # ESCs' samples, at 50 Hz, are lines.
    same_flight(
        log, truth, 1e-6, pos_w=2e-6, vel_w=2e-6, rate_b=1e-6, acc_b=1e-5, voltage=1e-5,
        rotor_speed=0.25, thrust_cmd=1e-5, rate_cmd_b=1e-6,
    )  # fmt: skip
    assert len(log.time_s) == 800
    assert {"corrected", "doubt"}.isdisjoint(levels(findings).values())
    assert log.about["source"] == "px4" and not log.velocity_derived


def test_px4_at_the_loggers_default_rates(tmp_path):
    """Position at 10 Hz, attitude at 20, gyro and commands at 50: rows at 20, nothing made up."""
    path = tmp_path / "log.ulg"
    made.write_ulog(path, (0, 12), 20.0, esc=False, pos_hz=10.0, gyro_hz=50.0, command_hz=50.0)
    log, findings = import_log(path, None, FULL)
    assert len(log.time_s) == pytest.approx(240, abs=3)
    assert {"position", "attitude"} <= {f.signal for f in findings if "Hz only" in f.evidence}
    assert np.isnan(log.pos_w[1::2]).all() and np.isnan(log.vel_w[1::2]).all()
    near(log.pos_w[::2], known_flight.fly(log.time_s[::2]).pos, 1e-5)
    assert log.whole.mean() > 0.48
    assert "doubt" not in levels(findings).values()


@pytest.mark.parametrize(
    ("new", "frame", "known"),
    [
        (True, 0, False),
        (True, 3, True),
        (False, 3, True),
        *(more(True, k, k == 1) for k in (1, 2)),
        *(more(False, k, k == 0) for k in (0, 2)),
    ],
)
def test_px4_odometry_has_a_velocity_in_frames_that_are_known(tmp_path, new, frame, known):
    path = made.write_ulog(tmp_path / "log.ulg", (0, 4), odometry=(new, frame))
    log, findings = import_log(path, None, FULL)
    truth = known_flight.fly(log.time_s)
    assert log.velocity_derived is not known
    near(log.pos_w, truth.pos, 2e-6)
    near(log.vel_w, truth.vel, 2e-6 if known else 0.1)
    assert {"corrected", "doubt"}.isdisjoint(levels(findings).values())


def test_betaflight_with_motion_capture_equals_the_flight(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv")
    pose = made.write_mocap(tmp_path / "pose.csv", span=(1.0005, 19.0), offset=-3.21, drift=60e-6)
    log, findings = import_log(path, None, ImportOptions(pose=pose, full_thrust=30.0))
    truth = known_flight.fly(log.time_s + 1.0005)
    late = float(np.sum((log.pos_w - truth.pos) * truth.vel) / np.sum(truth.vel**2))
    assert abs(late) < 2e-4
    # Whole degrees per second, at 1 kHz smoothed to the poses' 120 Hz.
    same_flight(
        log, truth, 1e-3, pos_w=2e-3, rate_b=0.02, acc_b=0.02, thrust_cmd=0.1, rate_cmd_b=0.04,
        rotor_speed=2.0,
    )  # fmt: skip
    assert log.velocity_derived
    assert any(f"+{ppm} ppm" in text(findings, "pose clock") for ppm in range(57, 64))


@pytest.mark.parametrize(("status", "tenfold"), [("corrected", 1), more("doubt", 10)])
def test_betaflights_tenfold_values_are_found(tmp_path, status, tenfold):
    """blackbox_high_resolution multiplies rates by ten, blackbox_decode the voltage."""
    path = made.write_blackbox(tmp_path / "log.csv", (0, 10), gain=10, tenfold=10)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 10), offset=0.4)
    options = ImportOptions(pose=pose, full_thrust=30.0, fix=tenfold == 1)
    log, findings = import_log(path, None, options)
    level = {f.signal for f in findings if f.status == status}
    assert level >= {"gyro", "voltage"} and "high_resolution" in text(findings, "gyro")
    truth = known_flight.fly(log.time_s)
    near(log.rate_b, tenfold * truth.rate, 0.02 * tenfold)
    near(log.rate_cmd_b, tenfold * truth.cmd_rate, 0.04 * tenfold)
    near(log.voltage, tenfold * truth.voltage, 0.1 * tenfold)
    assert tenfold == 10 or level == {"gyro", "rate command", "voltage"}


def test_motors_are_where_each_firmware_has_them():
    """Of a quadrotor X, by their numbers; (forward, left)."""
    front, rear, left, right = 1, -1, 1, -1
    assert betaflight.MOTOR_SIDE == ((rear, right), (front, right), (rear, left), (front, left))
    x = ((front, right), (rear, left), (front, left), (rear, right))
    assert px4.QUAD_X == ardupilot.QUAD_X == x
    assert ardupilot.QUAD_PLUS == ((0, right), (0, left), (front, 0), (rear, 0))
    assert ardupilot.MOTOR_SIDES[18] == ardupilot.MOTOR_SIDES[12] == betaflight.MOTOR_SIDE
    anticlockwise = ((front, right), (front, left), (rear, left), (rear, right))
    assert ardupilot.MOTOR_SIDES[13] == anticlockwise
    assert ardupilot.MOTOR_SIDES[14] == (anticlockwise[0], *anticlockwise[:0:-1])


@pytest.mark.parametrize(
    ("frame_type", "told"), [(14, "the file's 1, 2, 3, 4"), (19, "TYPE 19 is")]
)
def test_the_type_of_an_ardupilot_frame_orders_its_motors(tmp_path, frame_type, told):
    truth = known_flight.fly(np.arange(0.0, 1.5, 0.01))
    path = write_bin(tmp_path / "log.bin", truth, frame_type=frame_type)
    assert told in text(import_log(path, None, PARTIAL)[1], "motors")


def test_a_map_of_columns_and_an_odd_number_of_poles_are_not_for_betaflight(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 2), rate=500.0)
    with pytest.raises(FlightLogError, match="motor_poles is 7"):
        import_log(path, None, ImportOptions(partial=True, motor_poles=7))
    with pytest.raises(ValueError, match="read as 'betaflight', .* leave --map out, or give"):
        import_log(path, None, ImportOptions(map=tmp_path / "mine.toml", partial=True))


@pytest.mark.parametrize(
    "how", [more({"version": 1}), {"version": 2}, {"compressed": True, "crc": 0}]
)
def test_crazyflie_equals_the_flight(tmp_path, how):
    log, findings = import_log(made.write_usd(tmp_path / "log00", **how), None, FULL)
    truth = known_flight.fly(log.time_s)
    if "compressed" in how:
        same_flight(log, truth, 1.5e-3, pos_w=6e-4, rate_b=6e-4)
        assert levels(findings)["file"] == "doubt"
    else:
        same_flight(log, truth, 1e-6, **{**dict.fromkeys(TRUE, 1e-5), "rotor_speed": 0.1})
        assert "doubt" not in levels(findings).values()


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
        (lambda data: data.replace(b"stateEstimate.x(f)", b"stateEstimate.x(?)"), "header is"),
        (lambda data: data.replace(b"gyro.x(", b"("), "header is broken .*no name or a repeated"),
        (lambda data: data.replace(b"gyro.x(", b"gyro.y("), "header is broken .*or a repeated one"),
        (lambda data: data.replace(b"gyro.x(", b"timestamp("), "header is broken .*or a repeated"),
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


def test_columns_of_one_signal_in_two_kinds_of_events_are_refused(tmp_path):
    map_file = tmp_path / "split.toml"
    map_file.write_text('[rate]\ncolumns = ["gyro.x", "gyro.y", "pm.vbat"]\n')
    path = made.write_usd(tmp_path / "log00", span=(0, 2))
    with pytest.raises(FlightLogError, match="gyro.x: not in one kind of event with gyro.y, pm.vb"):
        import_log(path, None, ImportOptions(map=map_file))


def test_a_crazyflie_log_is_read_up_to_where_it_breaks(tmp_path):
    path = made.write_usd(tmp_path / "log00", span=(0, 8))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + b"\xff" * 500)
    log, findings = import_log(path, None, FULL)
    assert 3.0 < log.duration_s < 4.2
    near(log.pos_w[:-1], known_flight.fly(log.time_s[:-1]).pos, 1e-5)
    assert "no known event" in text(findings, "file")


def test_mcap_equals_the_flight(tmp_path):
    log, findings = import_log(made.write_mcap(tmp_path / "log.mcap"), None, FULL)
    truth = known_flight.fly(log.time_s)
    same_flight(log, truth, 1e-6, pos_w=1e-6, vel_w=1e-6, rate_b=1e-9, acc_b=1e-9)
    near(np.asarray(log.rate_cmd_b)[::2], truth.cmd_rate[::2], 1e-9)
    near(np.asarray(log.thrust_cmd)[::2], truth.thrust[::2], 1e-5)
    (note,) = (finding.evidence for finding in findings if finding.signal == "topics")
    assert note.startswith("odometry from /odom; also there: /odom_slow.")
    assert {"corrected", "doubt"}.isdisjoint(levels(findings).values())


def test_what_an_attitude_target_says_to_ignore_is_no_command(tmp_path):
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 1.5), mask=7)
    log, _ = import_log(path, None, FULL)
    assert log.rate_cmd_b is None and log.rotor_speed is not None
    log, _ = import_log(path, None, ImportOptions(full_thrust=30.0, vehicle=PLAIN))
    assert log.rate_cmd_b is not None and log.thrust_cmd is not None
    whole = made.write_mcap(tmp_path / "none.mcap", span=(0, 1.5), mask=7 + 64 + 128)
    log, _ = import_log(whole, None, FULL)
    assert log.rate_cmd_b is None and log.thrust_cmd is None


def test_mcap_topics_are_chosen_by_a_map(tmp_path):
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 4))
    chosen = tmp_path / "map.toml"
    chosen.write_text('[topics]\nodometry = "/odom_slow"\n')
    log, findings = import_log(path, None, ImportOptions(map=chosen, full_thrust=30.0))
    assert "10 Hz" in text(findings, "position") and not text(findings, "topics")
    # Rows at twice the rate of the slow poses: every other one has a pose, and that is exact.
    assert np.isnan(log.pos_w[1::2]).all() and np.isfinite(log.rate_b).all()
    near(log.pos_w[::2], known_flight.fly(log.time_s[::2]).pos, 1e-6)
    path = made.write_mcap(tmp_path / "both.mcap", span=(0, 2), pose=120.0)
    chosen.write_text('[topics]\npose = "/pose"\n')
    log, findings = import_log(path, None, ImportOptions(map=chosen, full_thrust=30.0))
    assert "120 Hz" in text(findings, "rows") and log.velocity_derived
    chosen.write_text('[topics]\nodometry = "/imu"\n')
    with pytest.raises(FlightLogError, match="'/imu' has no nav_msgs/Odometry"):
        import_log(path, None, ImportOptions(map=chosen))
    with pytest.raises(ValueError, match=r"mappings/crazyswarm2\.toml: .* unknown"):
        import_log(path, None, ImportOptions(map=Path("crazyswarm2")))


def test_mcap_motors_are_put_in_order_by_a_map(tmp_path):
    path, chosen = made.write_mcap(tmp_path / "log.mcap", span=(0, 4)), tmp_path / "map.toml"
    plain, _ = import_log(path, None, FULL)
    near(np.asarray(plain.rotor_speed)[::4], known_flight.fly(plain.time_s[::4]).motor, 1e-6)
    # The file's motors 1 to 4: front left, rear left, rear right, front right.
    chosen.write_text("[frames]\nmotors = [[1, 1], [-1, 1], [-1, -1], [1, -1]]\n")
    asked = ImportOptions(map=chosen, full_thrust=30.0, fix=False)
    log, findings = import_log(path, None, asked)
    turned = np.asarray(plain.rotor_speed)[:, ::-1]
    assert np.array_equal(np.asarray(log.rotor_speed), turned, equal_nan=True)
    assert "the file's 4, 3, 2, 1" in text(findings, "motors")
    # That is not how they turn the body.
    assert "motor_order" in {f.fault for f in findings if f.status == "doubt"}
    chosen.write_text('[frames]\nworld = "ned"\n')
    with pytest.raises(ValueError, match=r"'world' in \[frames\] is unknown"):
        import_log(path, None, ImportOptions(map=chosen))


PARTIAL = ImportOptions(partial=True, full_thrust=30.0)


def test_a_raw_blackbox_log_equals_the_flight(tmp_path):
    path = write_raw(tmp_path / "LOG00001.BFL", known_flight.fly(np.arange(0.0, 6.0, 0.002)))
    log, findings = import_log(path, None, replace(PARTIAL, motor_poles=14))
    motor = known_flight.fly(log.time_s).motor
    np.testing.assert_allclose(log.rotor_speed * 14 / 12, motor, atol=5.0)
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
    with pytest.raises(FlightLogError, match="a Blackbox log that cannot be read .*; copy it"):
        import_log(both, None, PARTIAL)


@pytest.mark.parametrize("pose", [more(False), True])
def test_an_ardupilot_log_equals_the_flight(tmp_path, pose):
    truth = known_flight.fly(np.arange(0.0, 8.0, 0.01))
    path = write_bin(tmp_path / "00000001.BIN", truth, pose, lowest=int(pose))
    log, _ = import_log(path, None, PARTIAL)
    assert log.partial == (() if pose else ("pos", "quat"))
    truth = known_flight.fly(log.time_s)
    np.testing.assert_allclose(log.rate_b, truth.rate, atol=0.01)
    np.testing.assert_allclose(log.acc_b, truth.acc, atol=0.02)
    np.testing.assert_allclose(log.rate_cmd_b[:-1], truth.cmd_rate[:-1], atol=0.05)
    np.testing.assert_allclose(log.rotor_speed, truth.motor, atol=2.0)
    np.testing.assert_allclose(log.pwm[:-1], truth.motor[:-1] / 2100.0, atol=0.01)
    np.testing.assert_allclose(log.thrust_cmd[:-1], truth.thrust[:-1], atol=0.05)
    np.testing.assert_allclose(log.voltage, truth.voltage, atol=0.01)
    if pose:
        np.testing.assert_allclose(log.pos_w, truth.pos, atol=0.01)
        np.testing.assert_allclose(log.rot_w, truth.rot, atol=1e-3)


def test_the_thrust_of_ardupilot_is_no_throttle_of_the_motors(tmp_path):
    """A vehicle file's [motors] are of the pulses; ArduPilot has undone their curve in ThO."""
    truth = known_flight.fly(np.arange(0.0, 8.0, 0.01))
    path = write_bin(tmp_path / "00000001.BIN", truth, pose=True)
    full = 30.0 * PLAIN.mass / 4.0
    rotors = replace(PLAIN.rotors, thrust_coefficient=full / PLAIN.rotors.speed_max**2)
    vehicle = replace(PLAIN, rotors=rotors, motors=MotorMap((0.0, full), 16.0, 0.0))
    log, findings = import_log(path, None, ImportOptions(vehicle=vehicle))
    truth = known_flight.fly(log.time_s)
    np.testing.assert_allclose(log.thrust_cmd[:-1], truth.thrust[:-1], atol=0.05)
    assert "throttle_curve" not in {f.fault for f in findings if f.status == "doubt"}
    found, _ = check_log(log, CheckContext(vehicle))
    assert "throttle_curve" not in {f.fault for f in found if f.status == "doubt"}


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
    box: Any = SimpleNamespace(columns=columns, name="log", findings=[])
    found = betaflight._motors(box, 14)
    assert [finding.status for finding in box.findings] == ["note"]
    np.testing.assert_allclose(found["motor"], np.full((3, 4), 100.0 / 60.0 * 2.0 * np.pi))
    slower = betaflight._motors(box, 28)
    np.testing.assert_allclose(slower["motor"], 0.5 * found["motor"])
    columns["eRPM[4]"][1] = 1.0
    betaflight._motors(box, 14)
    assert "motor_count" in {finding.fault for finding in box.findings}


def test_a_hexacopter_is_counted_by_its_outputs_where_it_logs_no_speeds(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 2), rate=250.0)
    path.write_text(path.read_text().replace("eRPM[0], eRPM[1]", "motor[4], motor[5]"))
    path.write_text(path.read_text().replace("eRPM[", "other["))
    assert "6 motors of the log turn" in text(import_log(path, None, PARTIAL)[1], "motors")


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
