"""Each importer, on a small file of the true format made from a flight that is known exactly."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import FORMATS
from eval.importers.formats.crazyflie import unpack_quaternion
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from eval.logs.flight_log import read_flight, write_flight
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.vehicles import PLAIN

FULL = ImportOptions(full_thrust=30.0)


def _levels(findings):
    return {finding.subject: finding.level for finding in findings}


def _text(findings, subject):
    return " ".join(finding.text for finding in findings if finding.subject == subject)


def _quat_off(log, truth):
    sign = np.sign(np.sum(log.quat_wxyz * truth.quat, axis=1, keepdims=True))
    return np.abs(log.quat_wxyz * sign - truth.quat).max()


def _near(value, wanted, tolerance):
    # Signals that are slower than the rows end before them.
    value, wanted = np.asarray(value), np.asarray(wanted)
    known = np.isfinite(value)
    assert known.mean() > 0.97
    value, wanted = value[known], np.broadcast_to(wanted, known.shape)[known]
    np.testing.assert_allclose(value, wanted, rtol=0, atol=tolerance)


def test_px4_equals_the_flight(tmp_path):
    log, findings = import_log(made.write_ulog(tmp_path / "log.ulg"), None, FULL)
    truth = known_flight.fly(log.time_s)
    # The file holds float32 and whole rpm.
    _near(log.pos_w, truth.pos, 2e-6)
    _near(log.vel_w, truth.vel, 2e-6)
    assert _quat_off(log, truth) < 1e-6
    _near(log.rate_b, truth.rate, 1e-6)
    _near(log.acc_b, truth.acc, 1e-5)
    _near(log.voltage, truth.voltage, 1e-5)
    _near(log.rotor_speed, truth.motor, 0.1)
    # Rows stand at the positions, at 100 Hz, as the commands do.
    assert len(log.time_s) == 800
    _near(log.thrust_cmd, truth.thrust, 1e-5)
    _near(log.rate_cmd_b, truth.cmd_rate, 1e-6)
    assert {"corrected", "doubt"}.isdisjoint(_levels(findings).values())
    assert log.about["source"] == "px4" and not log.velocity_derived


def test_px4_without_escs_or_a_thrust_scale_takes_the_accelerometer(tmp_path):
    path = made.write_ulog(tmp_path / "log.ulg", esc=False)
    log, findings = import_log(path)
    truth = known_flight.fly(log.time_s)
    assert log.rotor_speed is None
    _near(log.thrust_cmd, truth.thrust, 0.05)
    assert "accelerometer" in _text(findings, "thrust")
    of_vehicle = import_log(path, "px4", ImportOptions(vehicle=PLAIN))
    full = 4 * PLAIN.rotors.thrust_coefficient * PLAIN.rotors.speed_max**2 / PLAIN.mass
    _near(of_vehicle.log.thrust_cmd, truth.thrust / 30.0 * full, 1e-5)


def test_px4_motors_follow_the_vehicles_hubs(tmp_path):
    path = made.write_ulog(tmp_path / "log.ulg")
    hubs = PLAIN.rotors.position
    turned = PLAIN.rotors.__class__(
        **{**PLAIN.rotors.__dict__, "position": (hubs[3], hubs[0], hubs[2], hubs[1])}
    )
    vehicle = PLAIN.__class__(**{**PLAIN.__dict__, "rotors": turned})
    log, _ = import_log(path, None, ImportOptions(vehicle=vehicle))
    _near(log.rotor_speed, known_flight.fly(log.time_s).motor[:, [3, 0, 2, 1]], 0.1)


def test_px4_at_the_loggers_default_rates(tmp_path):
    """Position at 10 Hz, attitude at 20, gyro and commands at 50: rows at 20, nothing made up."""
    path = tmp_path / "log.ulg"
    made.write_ulog(path, (0, 12), 20.0, esc=False, pos_hz=10.0, gyro_hz=50.0, command_hz=50.0)
    log, findings = import_log(path, None, FULL)
    assert len(log.time_s) == pytest.approx(240, abs=3)
    assert {"position", "attitude"} <= {f.subject for f in findings if "Hz only" in f.text}
    assert np.isnan(log.pos_w[1::2]).all() and np.isnan(log.vel_w[1::2]).all()
    _near(log.pos_w[::2], known_flight.fly(log.time_s[::2]).pos, 1e-5)
    assert log.whole.mean() > 0.48
    assert "doubt" not in _levels(findings).values()


@pytest.mark.parametrize("frame", [(True, 1), (True, 3), (False, 0), (False, 3)])
def test_px4_odometry_in_each_frame_of_its_velocity(tmp_path, frame):
    log, findings = import_log(made.write_ulog(tmp_path / "log.ulg", odometry=frame), None, FULL)
    truth = known_flight.fly(log.time_s)
    assert not log.velocity_derived
    _near(log.pos_w, truth.pos, 2e-6)
    _near(log.vel_w, truth.vel, 2e-6)
    assert {"corrected", "doubt"}.isdisjoint(_levels(findings).values())


@pytest.mark.parametrize("frame", [(True, 2), (True, 0), (False, 2)])
def test_px4_odometry_in_another_frame_leaves_the_velocity_out(tmp_path, frame):
    log, _ = import_log(made.write_ulog(tmp_path / "log.ulg", odometry=frame), None, FULL)
    assert log.velocity_derived
    _near(log.vel_w, known_flight.fly(log.time_s).vel, 0.1)


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
    _near(log.pos_w, truth.pos, 2e-3)
    assert _quat_off(log, truth) < 1e-3
    # Whole degrees per second, at 1 kHz smoothed to the poses' 120 Hz.
    _near(log.rate_b, truth.rate, 0.02)
    _near(log.acc_b, truth.acc, 0.02)
    _near(log.thrust_cmd, truth.thrust, 0.1)
    _near(log.rate_cmd_b, truth.cmd_rate, 0.04)
    _near(log.rotor_speed, truth.motor, 2.0)
    assert log.velocity_derived
    assert any(f"+{ppm} ppm" in _text(findings, "pose clock") for ppm in range(57, 64))


@pytest.mark.parametrize("fix", [True, False])
def test_betaflights_tenfold_values_are_found(tmp_path, fix):
    """blackbox_high_resolution multiplies rates by ten, blackbox_decode the voltage."""
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 10), gain=10, tenfold=10)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 10), offset=0.4)
    options = ImportOptions(pose=pose, full_thrust=30.0, fix=fix)
    log, findings = import_log(path, None, options)
    level = {f.subject for f in findings if f.level == ("corrected" if fix else "doubt")}
    assert {"units", "voltage"} <= level
    assert "blackbox_high_resolution" in _text(findings, "units")
    truth, tenfold = known_flight.fly(log.time_s), 1 if fix else 10
    _near(log.rate_b, tenfold * truth.rate, 0.02 * tenfold)
    _near(log.rate_cmd_b, tenfold * truth.cmd_rate, 0.04 * tenfold)
    _near(log.voltage, tenfold * truth.voltage, 0.1 * tenfold)
    if fix:
        assert level == {"units", "voltage"}


def test_betaflight_counts_the_motors_poles(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 8), poles=12)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 8))
    log, _ = import_log(path, None, ImportOptions(pose=pose, motor_poles=12, full_thrust=30.0))
    _near(log.rotor_speed, known_flight.fly(log.time_s).motor, 2.0)
    with pytest.raises(FlightLogError, match="motor_poles is 7"):
        import_log(path, None, ImportOptions(pose=pose, motor_poles=7))


def test_betaflight_alone_asks_for_a_pose(tmp_path):
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 2))
    with pytest.raises(FlightLogError, match="no position and no attitude; --pose"):
        import_log(path)
    raw = tmp_path / "LOG00001.BFL"
    raw.write_bytes(b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n\0\1")
    with pytest.raises(FlightLogError, match="run blackbox_decode"):
        import_log(raw)


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
        _near(value, wanted, 1e-5)
    _near(log.rotor_speed, truth.motor, 0.1)
    assert _quat_off(log, truth) < 1e-6
    assert "doubt" not in _levels(findings).values()


def test_crazyflie_compressed_and_without_checksum(tmp_path):
    path = made.write_usd(tmp_path / "log00", compressed=True, crc=False)
    log, findings = import_log(path, "crazyflie", FULL)
    truth = known_flight.fly(log.time_s)
    _near(log.pos_w, truth.pos, 6e-4)
    _near(log.rate_b, truth.rate, 6e-4)
    assert _quat_off(log, truth) < 1.5e-3
    assert _levels(findings)["file"] == "doubt"


def test_quaternions_unpack_whichever_part_is_largest():
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(400, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    found = unpack_quaternion(np.array([made.pack_quaternion(q) for q in quat]))
    _near(np.abs(np.sum(found * quat, axis=1)), 1.0, 3e-6)
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
    _near(log.pos_w[:-1], known_flight.fly(log.time_s[:-1]).pos, 1e-5)
    assert "no known event" in _text(findings, "file")


def test_mcap_equals_the_flight(tmp_path):
    log, findings = import_log(made.write_mcap(tmp_path / "log.mcap"), None, FULL)
    truth = known_flight.fly(log.time_s)
    _near(log.pos_w, truth.pos, 1e-6)
    _near(log.vel_w, truth.vel, 1e-6)
    assert _quat_off(log, truth) < 1e-6
    _near(log.rate_b, truth.rate, 1e-9)
    _near(log.acc_b, truth.acc, 1e-9)
    _near(np.asarray(log.rate_cmd_b)[::2], truth.cmd_rate[::2], 1e-9)
    _near(np.asarray(log.thrust_cmd)[::2], truth.thrust[::2], 1e-5)
    assert "/odom_slow" in _text(findings, "topics")
    assert {"corrected", "doubt"}.isdisjoint(_levels(findings).values())


def test_mcap_topics_are_chosen_by_a_map(tmp_path):
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 4))
    chosen = tmp_path / "map.toml"
    chosen.write_text('[topics]\nodometry = "/odom_slow"\n')
    log, findings = import_log(path, None, ImportOptions(map=chosen, full_thrust=30.0))
    assert "10 Hz" in _text(findings, "position")
    # Rows at twice the rate of the slow poses: every other one has a pose, and that is exact.
    assert np.isnan(log.pos_w[1::2]).all() and np.isfinite(log.rate_b).all()
    _near(log.pos_w[::2], known_flight.fly(log.time_s[::2]).pos, 1e-6)
    chosen.write_text('[topics]\nodometry = "/imu"\n')
    with pytest.raises(FlightLogError, match="'/imu' has no nav_msgs/Odometry"):
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


def test_an_import_can_be_written_and_read_back(tmp_path):
    log, _ = import_log(made.write_usd(tmp_path / "log00"), None, FULL)
    again = read_flight(write_flight(tmp_path / "flight.parquet", log))
    np.testing.assert_array_equal(again.pos_w, log.pos_w)
    assert again.about["imported_from"] == "log00" and again.about["findings"]


def test_start_and_end_cut_the_flight(tmp_path):
    path = made.write_usd(tmp_path / "log00")
    log, _ = import_log(path, None, ImportOptions(full_thrust=30.0, start_s=2.0, end_s=5.0))
    assert log.duration_s == pytest.approx(3.0, abs=0.02)
    _near(log.pos_w, known_flight.fly(log.time_s + 2.0).pos, 1e-5)
    with pytest.raises(FlightLogError, match="no time at which"):
        import_log(path, None, ImportOptions(start_s=50.0))


def test_unknown_formats_and_files(tmp_path):
    with pytest.raises(ValueError, match="Did you mean 'px4'"):
        import_log(tmp_path / "x", "px")
    with pytest.raises(FlightLogError, match="cannot be read"):
        import_log(tmp_path / "none.ulg")
    noise = tmp_path / "noise.bin"
    noise.write_bytes(bytes(range(256)) * 40)
    for name in (None, *FORMATS):
        with pytest.raises(FlightLogError, match=r"noise\.bin"):
            import_log(noise, name)


def test_any_bytes_are_refused_without_a_crash(tmp_path):
    rng = np.random.default_rng(3)
    heads = [b"ULog\x01\x12\x35\x01", b"\xbc\x02\x00\x01\x00", b"\x89MCAP0\r\n", b"PAR1", b"time,"]
    for k in range(40):
        path = tmp_path / f"file{k}"
        path.write_bytes(heads[k % len(heads)] + rng.bytes(int(rng.integers(0, 400))))
        with pytest.raises(FlightLogError, match=path.name):
            import_log(path)
