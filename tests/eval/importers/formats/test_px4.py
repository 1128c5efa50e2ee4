"""PX4 logs, on small files of the true format made from a flight that is known exactly."""

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


def test_px4_equals_the_flight(tmp_path):
    log, findings = import_log(made.write_ulog(tmp_path / "log.ulg"), None, FULL)
    truth = known_flight.fly(log.time_s)
    # The file holds float32 and whole rpm.
    near(log.pos_w, truth.pos, 2e-6)
    near(log.vel_w, truth.vel, 2e-6)
    assert quat_off(log, truth) < 1e-6
    near(log.rate_b, truth.rate, 1e-6)
    near(log.acc_b, truth.acc, 1e-5)
    near(log.voltage, truth.voltage, 1e-5)
    near(log.rotor_speed, truth.motor, 0.1)
    # Rows stand at the positions, at 100 Hz, as the commands do.
    assert len(log.time_s) == 800
    near(log.thrust_cmd, truth.thrust, 1e-5)
    near(log.rate_cmd_b, truth.cmd_rate, 1e-6)
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


def test_px4_motors_follow_the_vehicles_hubs(tmp_path):
    path = made.write_ulog(tmp_path / "log.ulg")
    hubs = PLAIN.rotors.position
    turned = PLAIN.rotors.__class__(
        **{**PLAIN.rotors.__dict__, "position": (hubs[3], hubs[0], hubs[2], hubs[1])}
    )
    vehicle = PLAIN.__class__(**{**PLAIN.__dict__, "rotors": turned})
    log, _ = import_log(path, None, ImportOptions(vehicle=vehicle))
    near(log.rotor_speed, known_flight.fly(log.time_s).motor[:, [3, 0, 2, 1]], 0.1)


def test_px4_at_the_loggers_default_rates(tmp_path):
    """Position at 10 Hz, attitude at 20, gyro and commands at 50: rows at 20, nothing made up."""
    path = tmp_path / "log.ulg"
    made.write_ulog(path, (0, 12), 20.0, esc=False, pos_hz=10.0, gyro_hz=50.0, command_hz=50.0)
    log, findings = import_log(path, None, FULL)
    assert len(log.time_s) == pytest.approx(240, abs=3)
    assert {"position", "attitude"} <= {f.subject for f in findings if "Hz only" in f.text}
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
