"""Logs of PX4, Betaflight, Crazyflie and ROS 2: true formats, made from a flight that is known."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import ardupilot, betaflight, px4
from eval.importers.formats.crazyflie import unpack_quaternion
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import TRUE, levels, near, same_flight, text
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


def test_px4_without_escs_or_a_thrust_scale_takes_the_accelerometer(tmp_path):
    path = made.write_ulog(tmp_path / "log.ulg", esc=False)
    log, findings = import_log(path)
    truth = known_flight.fly(log.time_s)
    assert log.rotor_speed is None
    near(log.thrust_cmd, truth.thrust, 0.05)
    assert "accelerometer" in text(findings, "thrust")
    of_vehicle = import_log(path, "px4", ImportOptions(vehicle=PLAIN))
    full = 4 * PLAIN.rotors.thrust_coefficient * PLAIN.rotors.speed_max**2 / PLAIN.mass
    near(of_vehicle.log.thrust_cmd, truth.thrust / 30.0 * full, 1e-5)


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


@pytest.mark.parametrize("frame", [(True, 1), (True, 3), (False, 0), (False, 3)])
def test_px4_odometry_in_each_frame_of_its_velocity(tmp_path, frame):
    log, findings = import_log(made.write_ulog(tmp_path / "log.ulg", odometry=frame), None, FULL)
    truth = known_flight.fly(log.time_s)
    assert not log.velocity_derived
    near(log.pos_w, truth.pos, 2e-6)
    near(log.vel_w, truth.vel, 2e-6)
    assert {"corrected", "doubt"}.isdisjoint(levels(findings).values())


@pytest.mark.parametrize("frame", [(True, 2), (True, 0), (False, 2)])
def test_px4_odometry_in_another_frame_leaves_the_velocity_out(tmp_path, frame):
    log, _ = import_log(made.write_ulog(tmp_path / "log.ulg", odometry=frame), None, FULL)
    assert log.velocity_derived
    near(log.vel_w, known_flight.fly(log.time_s).vel, 0.1)


@pytest.mark.parametrize("cut", [20, 400, 3000])
def test_a_cut_ulog_is_refused_or_read_as_far_as_it_goes(tmp_path, cut):
    path = made.write_ulog(tmp_path / "log.ulg", span=(0, 3))
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(FlightLogError, match=r"log\.ulg"):
        import_log(path)


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


@pytest.mark.parametrize("fix", [True, False])
def test_betaflights_tenfold_values_are_found(tmp_path, fix):
    """blackbox_high_resolution multiplies rates by ten, blackbox_decode the voltage."""
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 10), gain=10, tenfold=10)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 10), offset=0.4)
    options = ImportOptions(pose=pose, full_thrust=30.0, fix=fix)
    log, findings = import_log(path, None, options)
    level = {f.signal for f in findings if f.status == ("corrected" if fix else "doubt")}
    assert {"gyro", "voltage"} <= level
    assert "blackbox_high_resolution" in text(findings, "gyro")
    truth, tenfold = known_flight.fly(log.time_s), 1 if fix else 10
    near(log.rate_b, tenfold * truth.rate, 0.02 * tenfold)
    near(log.rate_cmd_b, tenfold * truth.cmd_rate, 0.04 * tenfold)
    near(log.voltage, tenfold * truth.voltage, 0.1 * tenfold)
    if fix:
        assert level == {"gyro", "rate command", "voltage"}


def test_motors_are_where_each_firmware_has_them():
    """Of a quadrotor X, by their numbers; (forward, left)."""
    front, rear, left, right = 1, -1, 1, -1
    assert betaflight.MOTOR_SIDE == ((rear, right), (front, right), (rear, left), (front, left))
    x = ((front, right), (rear, left), (front, left), (rear, right))
    assert px4.QUAD_X == ardupilot.QUAD_X == x
    assert ardupilot.QUAD_PLUS == ((0, right), (0, left), (front, 0), (rear, 0))


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
    with pytest.raises(ValueError, match="read as 'betaflight', .* leave --map out, or give"):
        import_log(path, None, ImportOptions(map=tmp_path / "mine.toml", partial=True))


@pytest.mark.parametrize("version", [1, 2])
def test_crazyflie_equals_the_flight(tmp_path, version):
    path = made.write_usd(tmp_path / "log00", version=version)
    log, findings = import_log(path, None, FULL)
    truth = known_flight.fly(log.time_s)
    same_flight(log, truth, 1e-6, **{**dict.fromkeys(TRUE, 1e-5), "rotor_speed": 0.1})
    assert "doubt" not in levels(findings).values()


def test_crazyflie_compressed_and_without_checksum(tmp_path):
    path = made.write_usd(tmp_path / "log00", compressed=True, crc=False)
    log, findings = import_log(path, "crazyflie", FULL)
    truth = known_flight.fly(log.time_s)
    same_flight(log, truth, 1.5e-3, pos_w=6e-4, rate_b=6e-4)
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
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 4), mask=7)
    log, _ = import_log(path, None, FULL)
    assert log.rate_cmd_b is None and log.rotor_speed is not None
    log, _ = import_log(path, None, ImportOptions(full_thrust=30.0, vehicle=PLAIN))
    assert log.rate_cmd_b is not None and log.thrust_cmd is not None
    whole = made.write_mcap(tmp_path / "none.mcap", span=(0, 4), mask=7 + 64 + 128)
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
    chosen.write_text('[topics]\nodometry = "/imu"\n')
    with pytest.raises(FlightLogError, match="'/imu' has no nav_msgs/Odometry"):
        import_log(path, None, ImportOptions(map=chosen))


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


def test_mcap_that_is_cut_or_lacks_motion(tmp_path):
    whole = made.write_mcap(tmp_path / "log.mcap", span=(0, 2))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:3000])
    with pytest.raises(FlightLogError, match=r"cut\.mcap"):
        import_log(cut)
    still = made.write_mcap(tmp_path / "imu.mcap", span=(0, 2), motion=False)
    with pytest.raises(FlightLogError, match="no position and no attitude"):
        import_log(still)
