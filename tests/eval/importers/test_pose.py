"""Align the clocks of motion capture and flight controller."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.importers.pose import align
from eval.importers.signals import Signal
from eval.logs.columns import FlightLogError
from eval.logs.faults.reading import read_as
from tests.support import foreign_logs as made
from tests.support import known_flight


def _gyro(span, rate=500.0, bias=0.0, noise=0.0):
    truth = known_flight.fly(np.arange(span[0], span[1], 1 / rate))
    rng = np.random.default_rng(2)
    return Signal(truth.time, truth.rate + bias + noise * rng.normal(size=truth.rate.shape))


def _poses(span, rate, offset, drift, noise=0.0, turn=None):
    time = np.arange(span[0], span[1], 1 / rate)
    rot = Rotation.from_matrix(known_flight.fly(time).rot)
    rot = rot if turn is None else rot * turn
    rng = np.random.default_rng(3)
    rot = rot * Rotation.from_rotvec(noise * rng.normal(size=(len(time), 3)))
    return Signal((time - offset) / (1 + drift), rot.as_quat(scalar_first=True))


@pytest.mark.parametrize(
    ("offset", "drift", "rate"),
    [(0.0, 0.0, 240.0), (12.3456, 50e-6, 60.0), (-7.77, -200e-6, 240.0), (1.7e6, 30e-6, 60.0)],
)
def test_offset_and_drift_come_back(offset, drift, rate):
    found = align(_poses((5, 45), rate, offset, drift), _gyro((0, 60), bias=0.02), "pose")
    at = (np.array([5.0, 25.0, 45.0]) - offset) / (1 + drift)
    log_time = found.offset_s + (1 + found.drift) * at
    np.testing.assert_allclose(log_time, [5.0, 25.0, 45.0], atol=2e-4)
    assert found.correlation > 0.999


def test_a_long_flight_with_a_strong_drift():
    found = align(_poses((0, 300), 100.0, 3.0, 4e-4), _gyro((0, 300), rate=200.0), "pose")
    assert found.drift == pytest.approx(4e-4, abs=2e-6)


def test_noise_widens_the_reported_error():
    calm = align(_poses((1, 19), 120.0, 2.0, 0.0), _gyro((0, 20)), "pose")
    poses = _poses((1, 19), 120.0, 2.0, 0.0, noise=0.002)
    shaken = align(poses, _gyro((0, 20), noise=0.1), "pose")
    middle = 10.0 - 2.0
    error = abs(shaken.offset_s + (1 + shaken.drift) * middle - 10.0)
    assert calm.offset_sd_s < shaken.offset_sd_s < 5e-3
    assert error < 4 * shaken.offset_sd_s


def test_a_turn_between_the_bodies_is_found():
    turn = Rotation.from_rotvec([0.4, -0.8, 1.9])
    found = align(_poses((1, 19), 120.0, 2.0, 0.0, turn=turn), _gyro((0, 20)), "pose")
    np.testing.assert_allclose(found.rotation, turn.as_matrix(), atol=1e-3)


def _import(tmp_path, text=None, **options):
    log = made.write_blackbox(tmp_path / "log.csv", span=(0, 12), rate=250.0)
    pose = tmp_path / "pose.csv"
    if text is not None:
        pose.write_text(text)
    told = {"pose": pose, "full_thrust": 30.0, **options}
    return import_log(log, None, ImportOptions(**told))


def test_faults_of_the_poses_are_corrected(tmp_path):
    made.write_mocap(tmp_path / "pose.csv", span=(1.0003, 11), offset=4.0)
    lines = (tmp_path / "pose.csv").read_text().splitlines()
    # Time in us, the quaternion xyzw under the names of wxyz.
    rows = [lines[0]]
    for line in lines[1:]:
        t, x, y, z, qw, qx, qy, qz = line.split(",")
        rows.append(",".join([f"{float(t) * 1e6:.1f}", x, y, z, qx, qy, qz, qw]))
    log, findings = _import(tmp_path, "\n".join(rows))
    assert {"pose time", "pose attitude"} == {f.signal for f in findings if f.status == "corrected"}
    truth = known_flight.fly(log.time_s + 1.0003)
    np.testing.assert_allclose(log.pos_w, truth.pos, atol=2e-3)
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-5)


def test_a_turned_marker_body_is_corrected_only_where_allowed(tmp_path):
    turn = Rotation.from_euler("z", 90, degrees=True)
    made.write_mocap(tmp_path / "pose.csv", span=(1, 11), turn=turn)
    log, findings = _import(tmp_path)
    truth = known_flight.fly(log.time_s + 1.0)
    assert "pose axes" in {f.signal for f in findings if f.status == "corrected"}
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-5)
    _, findings = _import(tmp_path, fix=False)
    assert "pose axes" in {f.signal for f in findings if f.status == "doubt"}


@pytest.mark.parametrize("steps", ["-roll", "-pitch", "-yaw"])
def test_an_angle_of_the_wrong_sign_is_no_turned_body(tmp_path, steps):
    def source(time):
        truth = known_flight.fly(time)
        wrong = Rotation.from_quat(read_as("quat", truth.quat, steps), scalar_first=True)
        return truth._replace(rot=wrong.as_matrix())

    made.write_mocap(tmp_path / "pose.csv", span=(1.0003, 11), offset=4.0, source=source)
    _, findings = _import(tmp_path)
    assert {f.fault for f in findings if f.status == "corrected"} == {"attitude_sign"}


def test_a_mirrored_gyro_is_no_turned_body(tmp_path):
    def source(time):
        truth = known_flight.fly(time)
        return truth._replace(rate=truth.rate * [1.0, -1.0, 1.0])

    made.write_mocap(tmp_path / "pose.csv", span=(1, 11), offset=4.0)
    log = made.write_blackbox(tmp_path / "log.csv", span=(0, 12), rate=500.0, source=source)
    options = ImportOptions(pose=tmp_path / "pose.csv", full_thrust=30.0)
    _, findings = import_log(log, None, options)
    assert {"gyro_axes"} == {f.fault for f in findings if f.status == "corrected"}


def test_a_pose_clock_that_no_crystal_keeps_is_named(tmp_path):
    made.write_mocap(tmp_path / "pose.csv", span=(1, 11), offset=4.0, drift=1e-3)
    _, findings = _import(tmp_path)
    (drift,) = [f for f in findings if f.fault == "clock_drift"]
    assert drift.size == pytest.approx(1e-3, rel=0.05)


def test_poses_of_another_flight_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    time = np.arange(0, 10, 0.01)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(len(time), 3)), 0), 0)
    smooth /= np.abs(smooth).max() / 3
    quat = Rotation.from_rotvec(smooth).as_quat(scalar_first=True)
    names = "time,pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z\n"
    rows = "\n".join(
        ",".join(f"{v:.6f}" for v in (t, 0, 0, 1, *q)) for t, q in zip(time, quat, strict=True)
    )
    with pytest.raises(FlightLogError, match=r"pose\.csv.*cannot be aligned"):
        _import(tmp_path, names + rows)


def test_poses_without_an_attitude_or_too_short_are_refused(tmp_path):
    with pytest.raises(FlightLogError, match="holds no attitude; name its columns"):
        _import(tmp_path, "time,pos_x,pos_y,pos_z\n0,1,2,3\n1,2,3,4\n")
    made.write_mocap(tmp_path / "pose.csv", span=(1, 2))
    with pytest.raises(FlightLogError, match="less than 3 s"):
        _import(tmp_path)
