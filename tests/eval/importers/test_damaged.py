"""Logs that are damaged, or of other definitions than their format's: one line, no traceback."""

import io
import os
import struct
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from eval.importers import import_log
from eval.importers.formats import px4
from eval.importers.options import ImportOptions
from eval.importers.signals import make_signal
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support import known_flight, raw_logs, ros_messages
from tests.support.imported import flight, text, write


@pytest.fixture
def ulog(tmp_path, monkeypatch):
    """Return a function that imports a ULog file after `damage` was done to what pyulog read."""
    path, load = made.write_ulog(tmp_path / "log.ulg", span=(0, 3)), px4._load

    def imported(damage):
        def damaged(path):
            log = load(path)
            damage(log)
            return log

        monkeypatch.setattr(px4, "_load", damaged)
        return import_log(path, None, ImportOptions(full_thrust=30.0))

    return imported


def test_a_topic_without_a_timestamp_is_left_out(ulog):
    def damage(log):
        (topic,) = (each for each in log.data_list if each.name == "esc_status")
        topic.data["timestamq"] = topic.data.pop("timestamp")

    log, findings = ulog(damage)
    assert log.rotor_speed is None and "esc_status has no timestamp" in text(findings, "file")


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


def test_dropouts_are_counted_and_their_time_is_in_seconds():
    lost: Any = [SimpleNamespace(duration=ms) for ms in (200, 300)]
    log = SimpleNamespace(file_corruption=False, dropouts=lost, initial_parameters={})
    assert "2 dropouts, 0.5 s in all" in text(px4._check_file(log), "file")


def test_only_a_step_back_over_a_cut_body_is_shortened():
    file = px4._TruncationSafeReader(io.BytesIO(bytes(10)))  # type: ignore[arg-type]
    file.read(20)
    assert file.seek(-20, 1) == 0
    file.seek(8)
    file.read(4)
    assert file.seek(0, 1) == 10 and file.seek(-1, 1) == 9


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


@pytest.mark.parametrize("value", ["0.1", b"\xff", None, float("nan")])
def test_a_parameter_that_is_no_number_is_as_one_that_is_missing(ulog, value):
    odd = {"THR_MDL_FAC": value, "CA_ROTOR0_PX": value, "CA_ROTOR0_PY": value}
    _, findings = ulog(lambda log: log.initial_parameters.update(odd))
    assert "quadrotor X" in text(findings, "motors")
    assert "THR_MDL_FAC is 0" in text(findings, "thrust")


def test_motors_of_a_small_quadrotor_are_where_its_log_says():
    """PX4's y is to the right."""
    places = ((0.03, -0.04), (-0.03, 0.04), (0.03, 0.04), (-0.03, -0.04))
    said = {
        f"CA_ROTOR{k}_P{a}": v for k, at in enumerate(places) for a, v in zip("XY", at, strict=True)
    }
    assert px4._motor_side(said) == (tuple((x, -y) for x, y in places), [])


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("geometry_msgs/Vector3 angular_velocity\n", "geometry_msgs/Vector3 angular_speed\n"),
        ("geometry_msgs/Vector3 angular_velocity\n", "float64[3] angular_velocity\n"),
        ("geometry_msgs/Vector3 angular_velocity\n", "std_msgs/Header angular_velocity\n"),
    ],
)
def test_messages_of_another_definition_are_refused(tmp_path, monkeypatch, before, after):
    """What was written under the true definition is read under the other one."""
    assert before in ros_messages.IMU
    path = made.write_mcap(tmp_path / "log.mcap", span=(0, 2))
    from mcap_ros2.decoder import DecoderFactory

    decoder_for = DecoderFactory.decoder_for

    class Odd:
        def __init__(self, message):
            self.header = message.header
            if "speed" not in after:
                self.angular_velocity = [0.0] * 3 if "float64" in after else message.header

    def other(self, encoding, schema):
        decode: Any = decoder_for(self, encoding, schema)
        return (lambda data: Odd(decode(data))) if schema.name.endswith("Imu") else decode

    monkeypatch.setattr(DecoderFactory, "decoder_for", other)
    with pytest.raises(FlightLogError, match="differ from the definition of sensor_msgs/Imu"):
        import_log(path)


def test_a_table_without_rows_is_refused(tmp_path):
    columns = {name: pa.array([], pa.float64()) for name in flight(end=2.0)}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    with pytest.raises(FlightLogError, match="holds no position"):
        import_log(tmp_path / "log.parquet")


@pytest.mark.parametrize(
    ("column", "factor"), [("time", 1e300), ("time", 1e-310), ("pos", 1e300), ("rate", 1e300)]
)
def test_numbers_beyond_any_unit_are_refused_without_a_warning(tmp_path, column, factor):
    columns = flight(end=3.0)
    columns[column] = columns[column] * factor
    with pytest.raises(FlightLogError, match="1e\\+20|does not increase"):
        import_log(write(tmp_path / "log.csv", columns))


def test_steps_of_time_that_nothing_can_be_divided_by_are_no_steps():
    time = np.array([0.0, 1e-310, 1.0, 2.0, *range(3, 60)])
    found, finding = make_signal(time, np.zeros(len(time)), "log", "gyro")
    assert found is not None and len(found.time_s) == len(time) - 1 and finding is not None


@pytest.mark.parametrize("name", [b"", b"timestamp", b"gyro.y"])
def test_a_variable_without_a_name_of_its_own_is_a_broken_header(tmp_path, name):
    path = made.write_usd(tmp_path / "log.usd", (0.0, 1.2))
    whole = path.read_bytes()
    for old in (b"gyro.x(", b"stateEstimateZ.rateRoll("):
        whole = whole.replace(old, name + b"(")
    path.write_bytes(whole)
    with pytest.raises(FlightLogError, match="header is broken .*with no name or a repeated one"):
        import_log(path, "crazyflie", ImportOptions(partial=True))
