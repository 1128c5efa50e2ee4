"""Faults of public logs and bug reports, each in a small file as the program writes it."""

from pathlib import Path

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import mcap, px4
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import near
from tests.support.vehicles import PLAIN

FULL = ImportOptions(full_thrust=30.0)


def faults(findings, *statuses):
    return {
        f.fault for f in findings if f.fault and f.status in (statuses or ("corrected", "doubt"))
    }


@pytest.fixture
def px4_log(tmp_path, monkeypatch):
    """Import a ULog file after `damage` was done to its topics by name and to its parameters."""
    path, load = made.write_ulog(tmp_path / "log.ulg", span=(0, 6)), px4._load

    def imported(damage, options=FULL):
        def damaged(path):
            log = load(path)
            damage({d.name: d for d in log.data_list}, log)
            return log

        monkeypatch.setattr(px4, "_load", damaged)
        return import_log(path, None, options)

    return imported


def test_a_battery_without_stamps_is_left_out_and_the_flight_is_read(px4_log):
    """PX4 wrote battery_status with time 0 for years."""

    def damage(topics, _):
        topics["battery_status"].data["timestamp"][:] = 0

    log, findings = px4_log(damage)
    assert log.voltage is None and log.rotor_speed is not None
    (finding,) = (f for f in findings if f.fault == "time_stamps")
    assert (finding.signal, finding.status) == ("voltage", "corrected")
    with pytest.raises(FlightLogError, match="'rate'"):  # nothing flies without a gyro
        px4_log(lambda topics, _: topics["vehicle_angular_velocity"].data.update(
            timestamp_sample=np.zeros(1200), timestamp=np.zeros(1200)))  # fmt: skip


def test_headers_without_a_stamp_do_not_mix_clocks(tmp_path, monkeypatch):
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 4))
    stamp = mcap._stamp
    monkeypatch.setattr(
        mcap, "_stamp", lambda m: 0 if hasattr(m, "angular_velocity") else stamp(m) - 10**15
    )
    log, findings = import_log(path, None, FULL)
    assert "time_stamps" in faults(findings, "corrected")
    near(log.rate_b, known_flight.fly(log.time_s).rate, 1e-6)


@pytest.mark.parametrize("how", ["parameter", "type", "motors"])
def test_what_is_no_quadrotor_is_not_read_as_one(px4_log, how):
    def damage(topics, log):
        if how == "parameter":
            log.initial_parameters["CA_ROTOR_COUNT"] = 6
        elif how == "type":
            log.initial_parameters["MAV_TYPE"] = 22  # a VTOL with four rotors
        else:
            topics["esc_status"].data |= {
                f"esc[{k}].esc_rpm": topics["esc_status"].data["esc[0].esc_rpm"] for k in (4, 5)
            }

    _, findings = px4_log(damage)
    (finding,) = (f for f in findings if f.fault == "motor_count")
    assert finding.is_open
    _, findings = px4_log(lambda *_: None)
    assert "motor_count" not in faults(findings)


@pytest.mark.parametrize("second", ["whole", "without stamps", None])
def test_an_impossible_battery_is_not_believed(px4_log, second):
    def damage(topics, log):
        first = topics["battery_status"]
        if second:
            other = type("Topic", (), {"name": first.name, "multi_id": 1})()
            other.data = {name: value.copy() for name, value in first.data.items()}
            if second == "without stamps":
                del other.data["timestamp"]
            log.data_list.append(other)
        first.data["voltage_v"][:] = 0.1

    log, findings = px4_log(damage, ImportOptions(vehicle=PLAIN))
    assert "voltage" in faults(findings, "corrected")
    if second == "whole":
        near(log.voltage[:-25], 16.0 - 0.05 * log.time_s[:-25], 0.01)
    else:
        assert log.voltage is None
    assert not any(f.status == "doubt" for f in findings if f.signal == "thrust")


def test_blackbox_in_physical_units_under_bare_names(tmp_path):
    """Volts and m/s^2 that look like the firmware's counts, and nothing scaled by them."""
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 10), rate=500.0)
    header, *lines = path.read_text().splitlines()
    names = [name.strip() for name in header.split(",")]
    rows = [line.split(",") for line in lines]
    for row in rows:
        for k in range(3):
            at = names.index(f"accSmooth[{k}]")
            row[at] = f"{float(row[at]) / 2048 * 9.81:.4f}"
        at = names.index("vbatLatest (V)")
        row[at] = f"{float(row[at]) + 0.013:.3f}"
    header = header.replace("vbatLatest (V)", "vbatLatest")
    path.write_text("\n".join([header, *(",".join(row) for row in rows)]) + "\n")
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 10))
    log, findings = import_log(path, None, ImportOptions(pose=pose))
    truth = known_flight.fly(log.time_s)
    assert {"accelerometer_unit", "voltage"} <= faults(findings, "corrected")
    near(log.acc_b, truth.acc, 0.02)
    near(log.voltage, truth.voltage, 0.1)
    near(log.thrust_cmd, truth.thrust, 0.2)


def test_lines_before_a_csvs_header_are_left_out(tmp_path):
    """Blackbox Explorer writes the firmware's settings first."""
    path = made.write_blackbox(tmp_path / "log.csv", span=(0, 8), rate=500.0)
    pose = made.write_mocap(tmp_path / "pose.csv", span=(0, 8))
    options = ImportOptions(pose=pose, full_thrust=30.0)
    wanted, _ = import_log(path, None, options)
    before = '"Product","Blackbox flight data recorder by Nicholas Sherlock"\n"minthrottle",1070\n'
    path.write_text(before + path.read_text())
    log, findings = import_log(path, None, options)
    np.testing.assert_array_equal(log.rate_b, wanted.rate_b)
    assert any("2 lines before the header" in f.evidence for f in findings)


@pytest.mark.parametrize(
    ("first", "advice"),
    [
        (
            "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name\nATT, 100, 1, 2, 3\n",
            "an ArduPilot text log",
        ),
        ("Format Version,1.23,Take Name,fly\n,,Quad,Quad\nFrame,Time,X,Y\n0,0,1,2\n", "Motive"),
    ],
)
def test_tables_of_other_programs_are_named(tmp_path, first, advice):
    path = tmp_path / "log.csv"
    path.write_text(first)
    with pytest.raises(FlightLogError, match=advice):
        import_log(path)


def test_a_cut_usd_log_keeps_no_garbage_and_thrust_is_no_tiny_number(tmp_path):
    path = made.write_usd(tmp_path / "log00", crc=False)
    whole = path.read_bytes()
    event = len(made.write_usd(tmp_path / "one", span=(0, 0.02), crc=False).read_bytes())
    event -= len(made.write_usd(tmp_path / "two", span=(0, 0.01), crc=False).read_bytes())
    old = bytearray(whole[-3 * event :])
    old[2:10] = b"\x11\x22\x33\x44\x55\x66\x07\x00"  # the card's old content: another day
    for k in range(12, event, 4):
        old[k : k + 4] = b"\x7a\x99\x99\x7f"
    path.write_bytes(whole[: -event // 2] + bytes(old[: event // 2]) + bytes(old))
    log, findings = import_log(path, None, ImportOptions())
    truth = known_flight.fly(log.time_s)
    near(log.pos_w, truth.pos, 1e-5)
    near(log.thrust_cmd, truth.thrust, 0.2)
    assert any("checksum" in f.evidence for f in findings)


def test_a_full_throttle_that_none_gives_is_refused(tmp_path):
    path = made.write_usd(tmp_path / "log00", full_thrust=400.0)
    _, findings = import_log(path, None, ImportOptions(partial=True))
    (finding,) = (f for f in findings if f.signal == "thrust" and f.status == "doubt")
    assert "full throttle would be 400 m/s^2" in finding.evidence and finding.is_open


@pytest.mark.parametrize("frame", ["world", "body"])
def test_an_odometrys_twist_in_world_axes_is_found(tmp_path, monkeypatch, frame):
    if frame == "world":
        fly = known_flight.fly

        def world(time):
            truth = fly(time)
            # The writer turns it into the body; turned on by that, it is in the world there.
            return truth._replace(vel=np.einsum("tij,tj->ti", truth.rot, truth.vel))

        path = made.write_mcap(tmp_path / "log.mcap", span=(0, 8), source=world)
    else:
        path = made.write_mcap(tmp_path / "log.mcap", span=(0, 8))
    log, findings = import_log(path, None, FULL)
    assert ("velocity_frame" in faults(findings, "corrected")) == (frame == "world")
    near(log.vel_w, known_flight.fly(log.time_s).vel, 0.02)


def test_a_height_alone_says_why_there_is_no_position(px4_log):
    def damage(topics, _):
        topics["vehicle_local_position"].data["xy_valid"][:] = 0

    with pytest.raises(FlightLogError, match="no position .xy_valid of vehicle_local_position"):
        px4_log(damage)


def test_the_crazyflie_clients_csv_has_a_time(tmp_path):
    truth = known_flight.fly(np.arange(0, 6, 0.01))
    names = ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"]
    names += ["stateEstimate.qw", "stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz"]
    names += ["gyro.x", "gyro.y", "gyro.z", "rpm.m1", "rpm.m2", "rpm.m3", "rpm.m4"]
    rpm = 60 / (2 * np.pi)
    parts = (truth.pos, truth.quat, np.rad2deg(truth.rate), truth.motor * rpm)
    table = np.column_stack([5000 + 1000 * truth.time, *parts])
    header = ",".join(["Timestamp", *names])
    path = tmp_path / "client.csv"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    log, _ = import_log(path, None, ImportOptions(map=Path("crazyflie")))
    near(log.rate_b, truth.rate, 1e-5)
