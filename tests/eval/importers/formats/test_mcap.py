"""MCAP logs, on small files of the true format made from a flight that is known exactly."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import levels, near, quat_off, text
from tests.support.vehicles import PLAIN

FULL = ImportOptions(full_thrust=30.0)


def test_mcap_equals_the_flight(tmp_path):
    log, findings = import_log(made.write_mcap(tmp_path / "log.mcap"), None, FULL)
    truth = known_flight.fly(log.time_s)
    near(log.pos_w, truth.pos, 1e-6)
    near(log.vel_w, truth.vel, 1e-6)
    assert quat_off(log, truth) < 1e-6
    near(log.rate_b, truth.rate, 1e-9)
    near(log.acc_b, truth.acc, 1e-9)
    near(np.asarray(log.rate_cmd_b)[::2], truth.cmd_rate[::2], 1e-9)
    near(np.asarray(log.thrust_cmd)[::2], truth.thrust[::2], 1e-5)
    assert "/odom_slow" in text(findings, "topics")
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
    assert "10 Hz" in text(findings, "position")
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
    log, findings = import_log(path, None, ImportOptions(map=chosen, full_thrust=30.0))
    turned = np.asarray(plain.rotor_speed)[:, ::-1]
    assert np.array_equal(np.asarray(log.rotor_speed), turned, equal_nan=True)
    assert "the file's 4, 3, 2, 1" in text(findings, "motors")
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
