"""Faults of public logs, damaged files and other definitions: named or refused in one line."""

import os
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import mcap, px4
from eval.importers.options import ImportOptions
from eval.importers.signals import make_signal
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight, raw_logs
from tests.support.imported import flight, near, text, write
from tests.support.marks import more
from tests.support.vehicles import PLAIN


def test_a_size_beyond_the_end_is_no_circle(tmp_path):
    """Of a damaged kind, among the definitions: pyulog itself would never come to an end."""
    path = made.write_ulog(tmp_path / "log.ulg", span=(0, 3))
    # Back by two bytes and the 150 of which there are 49: to where the part before begins.
    part = struct.pack("<HB", 97, ord("I")) + bytes(97)
    path.write_bytes(path.read_bytes()[:16] + part + struct.pack("<HB", 150, 0) + bytes(49))
    code = (
        "from pathlib import Path\n"
        "from eval.importers.formats import px4\n"
        f"log = px4._load(Path({str(path)!r}))\n"
        "assert log.file_corruption and not log.data_list\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_message_without_a_length_is_no_circle(tmp_path, monkeypatch):
    """As damaged definitions make one: pymavlink itself would read it again for ever."""
    from pymavlink.DFReader import DFReader_binary

    path = raw_logs.write_bin(tmp_path / "log.bin", known_flight.fly(np.arange(0.0, 1.2, 0.01)))
    again = iter(range(1000))

    def parse(reader):
        next(again)
        return SimpleNamespace(get_type=lambda: "ATT")

    monkeypatch.setattr(DFReader_binary, "_parse_next", parse)
    with pytest.raises(FlightLogError, match="cannot be read .ValueError: a message of 0 bytes"):
        import_log(path)


def test_a_log_that_ends_within_a_message_has_a_note(tmp_path):
    ulog = made.write_ulog(tmp_path / "log.ulg", span=(0, 3))
    flown = known_flight.fly(np.arange(0.0, 3.0, 0.01))
    for path in (ulog, raw_logs.write_bin(tmp_path / "log.bin", flown, True)):
        whole = path.read_bytes()
        for data, is_cut in ((whole, False), (whole[:-5], True)):
            path.write_bytes(data)
            _, findings = import_log(path, None, FULL)
            assert ("it ends within a message" in text(findings, "file")) == is_cut


def test_dropouts_are_counted_and_their_time_is_in_seconds():
    lost: Any = [SimpleNamespace(duration=ms) for ms in (200, 300)]
    log = SimpleNamespace(is_cut=False, file_corruption=False, dropouts=lost, initial_parameters={})
    assert "2 dropouts, 0.5 s in all" in text(px4._check_file(log), "file")


@pytest.mark.parametrize("ending", ["ulg", "mcap", "bin"])
def test_what_a_reader_quotes_of_a_damaged_file_is_one_line(tmp_path, monkeypatch, ending):
    import mcap.reader
    import pymavlink.DFReader
    import pyulog

    def fail(*args, **kwargs):
        # As in a reader that looks at its map, which cannot be closed while someone does.
        view = memoryview(args[0].data_map) if hasattr(args[0], "data_map") else None
        raise KeyError("W\n\x1d\x1b[31m", *[view][:0])

    monkeypatch.setattr(pyulog, "ULog", fail)
    monkeypatch.setattr(mcap.reader, "make_reader", fail)
    monkeypatch.setattr(pymavlink.DFReader.DFReader_binary, "init_clock", fail)
    path, flown = tmp_path / f"log.{ending}", known_flight.fly(np.arange(0.0, 1.2, 0.01))
    if ending == "bin":
        raw_logs.write_bin(path, flown)
    else:
        {"ulg": made.write_ulog, "mcap": made.write_mcap}[ending](path, span=(0, 1.2))
    held = os.listdir("/proc/self/fd")
    with pytest.raises(FlightLogError, match="cannot be read .KeyError: ") as met:
        import_log(path)
    assert str(met.value).isprintable() and len(os.listdir("/proc/self/fd")) == len(held)


@pytest.mark.parametrize(
    "rate", ["missing", "no speeds", *(more(r) for r in ("three numbers", "a header"))]
)
def test_messages_of_another_definition_are_refused(tmp_path, monkeypatch, rate):
    """What was written under the true definition is read under the other one."""
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 0.5))
    from mcap_ros2.decoder import DecoderFactory

    kind = "actuator_msgs/Actuators" if rate == "no speeds" else "sensor_msgs/Imu"
    decoder_for = DecoderFactory.decoder_for

    class Odd:
        def __init__(self, message):
            self.header = message.header
            if rate not in ("missing", "no speeds"):
                self.angular_velocity = [0.0] * 3 if rate == "three numbers" else message.header

    def other(self, encoding, schema):
        decode: Any = decoder_for(self, encoding, schema)
        return (lambda data: Odd(decode(data))) if schema.name.endswith(kind[-3:]) else decode

    monkeypatch.setattr(DecoderFactory, "decoder_for", other)
    with pytest.raises(FlightLogError, match=f"differ from the definition of {kind}"):
        import_log(path)


@pytest.mark.parametrize(
    ("column", "factor"), [("time", 1e300), ("time", 1e-310), ("pos", 1e300), ("rate", 1e300)]
)
def test_numbers_beyond_any_unit_are_refused_without_a_warning(tmp_path, column, factor):
    columns = flight(end=3.0)
    columns[column] = columns[column] * factor
    with pytest.raises(FlightLogError, match="1e\\+20|does not increase"):
        import_log(write(tmp_path / "log.csv", columns))


FULL = ImportOptions(full_thrust=30.0)


def faults(findings, *statuses):
    return {
        f.fault for f in findings if f.fault and f.status in (statuses or ("corrected", "doubt"))
    }


@pytest.fixture
def px4_log(tmp_path, monkeypatch):
    """Import a ULog file after `damage` was done to its topics by name and to its parameters."""
    path, load = made.write_ulog(tmp_path / "log.ulg", span=(0, 4)), px4._load

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
    log, findings = px4_log(lambda topics, _: topics["battery_status"].data["timestamp"].fill(0))
    assert log.voltage is None and log.rotor_speed is not None
    (finding,) = (f for f in findings if f.fault == "time_stamps")
    assert (finding.signal, finding.status) == ("voltage", "corrected")
    with pytest.raises(FlightLogError, match="'rate'"):  # nothing flies without a gyro
        px4_log(lambda topics, _: topics["vehicle_angular_velocity"].data.update(
            timestamp_sample=np.zeros(800), timestamp=np.zeros(800)))  # fmt: skip


def test_a_topic_without_a_timestamp_is_left_out(px4_log):
    log, findings = px4_log(lambda topics, _: topics["esc_status"].data.pop("timestamp"))
    assert log.rotor_speed is None and "esc_status has no timestamp" in text(findings, "file")


@pytest.mark.parametrize("value", ["0.1", *(more(v) for v in (b"\xff", None, float("nan")))])
def test_a_parameter_that_is_no_number_is_as_one_that_is_missing(px4_log, value):
    odd = {"THR_MDL_FAC": value, "CA_ROTOR0_PX": value, "CA_ROTOR0_PY": value}
    _, findings = px4_log(lambda _, log: log.initial_parameters.update(odd))
    assert "quadrotor X" in text(findings, "motors")
    assert "THR_MDL_FAC is 0" in text(findings, "thrust")


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


def test_tables_of_other_programs_are_named(tmp_path):
    path = tmp_path / "log.csv"
    for first, advice in (
        ("FMT, 128, 89, FMT, BBnNZ, Type,Length,Name\nATT, 100, 1, 2, 3\n", "an ArduPilot text"),
        ("Format Version,1.23,Take Name,fly\n,,Quad,Quad\nFrame,Time,X,Y\n0,0,1,2\n", "Motive"),
        ("t,x,y\n0,1,2\n1,2,3\n", "describe the columns with --map. There are: t, x, y"),
    ):
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


def test_an_odometrys_twist_in_world_axes_is_found(tmp_path):
    def world(time):
        truth = known_flight.fly(time)
        # The writer turns it into the body; turned on by that, it is in the world there.
        return truth._replace(vel=np.einsum("tij,tj->ti", truth.rot, truth.vel))

    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 4), source=world)
    log, findings = import_log(path, None, FULL)
    assert "velocity_frame" in faults(findings, "corrected")
    near(log.vel_w, known_flight.fly(log.time_s).vel, 0.02)


def test_a_velocity_in_the_body_without_an_attitude_is_left_out(tmp_path, monkeypatch):
    none = property(lambda truth: np.zeros((len(truth.time), 4)))
    monkeypatch.setattr(known_flight.Truth, "quat", none)
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 4))
    log, _ = import_log(path, None, ImportOptions(partial=True))
    near(log.vel_w, known_flight.fly(log.time_s).vel, 0.1)
    assert log.velocity_derived


def test_a_height_alone_says_why_there_is_no_position(px4_log):
    with pytest.raises(FlightLogError, match="no position .xy_valid of vehicle_local_position"):
        px4_log(lambda topics, _: topics["vehicle_local_position"].data["xy_valid"].fill(0))


def test_the_crazyflie_clients_csv_has_a_time(tmp_path):
    truth, rpm = known_flight.fly(np.arange(0, 6, 0.01)), 60 / (2 * np.pi)
    names = [f"stateEstimate.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    names += ["gyro.x", "gyro.y", "gyro.z", "rpm.m1", "rpm.m2", "rpm.m3", "rpm.m4"]
    parts = (truth.pos, truth.quat, np.rad2deg(truth.rate), truth.motor * rpm)
    table = np.column_stack([5000 + 1000 * truth.time, *parts])
    header = ",".join(["Timestamp", *names])
    path = tmp_path / "client.csv"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    log, _ = import_log(path, None, ImportOptions(map=Path("crazyflie")))
    near(log.rate_b, truth.rate, 1e-5)


@pytest.mark.parametrize(
    ("rows", "advice"),
    [(np.arange(300)[::-1], "sort the rows"), (np.repeat(np.arange(150), 2), "repeated rows")],
)
def test_what_is_wrong_with_the_times_is_in_the_advice(rows, advice):
    with pytest.raises(FlightLogError, match=advice):
        make_signal(0.01 * rows, np.zeros((300, 3)), "log", "position")
