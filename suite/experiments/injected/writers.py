"""Write flights in the log formats of PX4, Betaflight with motion capture, Crazyflie, and a table.

Each writer follows the public description of its format (docs.px4.io, blackbox_decode, Bitcraze's
micro SD card deck). Its input is signals in SI units and the suite's frames, all at the same times.
It converts them to the units, frames and motor order of the other program.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np

from eval.importers.formats.betaflight import DSHOT
from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN
from eval.importers.options import ImportOptions
from suite.experiments.injected.changes import Signals
from suite.experiments.injected.kinds import DEG, RPM


class Written(NamedTuple):
    """A written log."""

    path: Path
    """File of the log."""
    options: ImportOptions
    """Options with which the log must be imported."""


def write_ulog(folder: Path, signals: Signals) -> Written:
    """Write a ULog of PX4: north-east-down, forward-right-down, motors in PX4's order."""
    # Time in microseconds; the start of the log is not 0 in real logs either.
    stamp = np.round(signals["time"] * 1e6).astype(np.int64) + 5_000_000
    motors = signals["motor"][:, [0, 2, 3, 1]] * RPM
    thrust = np.concatenate([np.zeros((len(stamp), 2)), -signals["throttle"]], axis=1)
    topics = {
        "vehicle_attitude": ([("float[4]", "q")], signals["quat"] * QUAT_HALF_TURN),
        "vehicle_angular_velocity": ([("float[3]", "xyz")], signals["rate"] * HALF_TURN),
        "sensor_combined": ([("float[3]", "accelerometer_m_s2")], signals["acc"] * HALF_TURN),
        "vehicle_local_position": (
            [("float", name) for name in ("x", "y", "z", "vx", "vy", "vz")],
            np.concatenate([signals["pos"] * HALF_TURN, signals["vel"] * HALF_TURN], axis=1),
        ),
        "vehicle_rates_setpoint": (
            [*(("float", name) for name in ("roll", "pitch", "yaw")), ("float[3]", "thrust_body")],
            np.concatenate([signals["cmd_rate"] * HALF_TURN, thrust], axis=1),
        ),
        "esc_status": ([("esc_report[4]", "esc")], motors),
        "battery_status": ([("float", "voltage_v")], signals["voltage"]),
    }
    # Messages of a ULog: B flags, F definition of a format, P parameter (here the positions of the
    # motors), A announcement of a topic, D one row of a topic.
    data = b"ULog\x01\x12\x35" + struct.pack("<BQ", 1, 112574307) + _message("B", bytes(40))
    data += _message("F", b"esc_report:float esc_rpm;")
    for k, (x, y) in enumerate([(0.1, 0.1), (-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1)]):
        for axis, value in (("X", x), ("Y", y)):
            key = f"float CA_ROTOR{k}_P{axis}".encode()
            data += _message("P", bytes([len(key)]) + key + struct.pack("<f", value))
    for name, (fields, _) in topics.items():
        text = "".join(f"{kind} {field};" for kind, field in fields)
        data += _message("F", f"{name}:uint64_t timestamp;{text}".encode())
    for number, name in enumerate(topics):
        data += _message("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (_, value) in enumerate(topics.values()):
        values = value.astype("<f4")
        for when, row in zip(stamp, values, strict=True):
            data += _message("D", struct.pack("<HQ", number, max(int(when), 1)) + row.tobytes())
    path = folder / "log.ulg"
    path.write_bytes(data)
    return Written(path, ImportOptions())


def _message(kind: str, payload: bytes) -> bytes:
    """Return a ULog message with its header."""
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def write_usd(folder: Path, signals: Signals) -> Written:
    """Write a log of the Crazyflie's micro SD card deck."""
    columns = {"controller.cmd_thrust(f)": signals["throttle"][:, 0] * 65535.0}
    for k, axis in enumerate("xyz"):
        columns[f"stateEstimate.{axis}(f)"] = signals["pos"][:, k]
        columns[f"stateEstimate.v{axis}(f)"] = signals["vel"][:, k]
        columns[f"gyro.{axis}(f)"] = signals["rate"][:, k] * DEG
        columns[f"acc.{axis}(f)"] = signals["acc"][:, k] / 9.81
    for k, component in enumerate("wxyz"):
        columns[f"stateEstimate.q{component}(f)"] = signals["quat"][:, k]
    for k, name in enumerate(("rollRate", "pitchRate", "yawRate")):
        columns[f"controller.{name}(f)"] = signals["cmd_rate"][:, k] * DEG * [1.0, -1.0, 1.0][k]
    for k in range(4):
        columns[f"rpm.m{k + 1}(f)"] = signals["motor"][:, k] * RPM
        columns[f"pwm.m{k + 1}_pwm(f)"] = signals["pwm"][:, k] * 65535.0
    columns["pm.vbat(f)"] = signals["voltage"][:, 0]
    # Header with one event type (number 7) and the names of its columns; then the rows; then a
    # checksum.
    data = b"\xbc" + struct.pack("<HHH", 2, 1, 7) + b"fixedFrequency\0"
    data += struct.pack("<H", len(columns)) + b"".join(n.encode() + b"\0" for n in columns)
    table = np.column_stack(list(columns.values())).astype("<f4")
    stamp = np.round(signals["time"] * 1e6).astype(np.int64) + 9_000_000
    for when, row in zip(stamp, table, strict=True):
        data += struct.pack("<HQ", 7, max(int(when), 0)) + row.tobytes()
    path = folder / "log00"
    path.write_bytes(data + struct.pack("<I", crc32(data)))
    return Written(path, ImportOptions())


def write_blackbox(folder: Path, signals: Signals) -> Written:
    """Write a CSV as `blackbox_decode` makes it, and a second file with the pose of motion capture.

    The two files have different clocks, as in a real recording.
    """
    columns = {"loopIteration": np.arange(len(signals["time"]), dtype=float)}
    columns["time (us)"] = np.round(signals["time"] * 1e6) + 52e6
    for k in range(3):
        columns[f"gyroADC[{k}]"] = np.round(signals["rate"][:, k] * DEG)
        columns[f"setpoint[{k}]"] = np.round(signals["cmd_rate"][:, k] * DEG)
        columns[f"accSmooth[{k}]"] = np.round(signals["acc"][:, k] / 9.81 * 2048.0)
    columns["setpoint[3]"] = np.round(signals["throttle"][:, 0] * 1000.0)
    columns["vbatLatest (V)"] = np.round(signals["voltage"][:, 0], 2)
    for k, motor in enumerate((1, 0, 2, 3)):
        columns[f"eRPM[{k}]"] = np.round(signals["motor"][:, motor] * RPM * 7.0 / 100.0)
        columns[f"motor[{k}]"] = np.round(DSHOT[0] + signals["pwm"][:, motor] * np.ptp(DSHOT))
    names = ["time", "pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"]
    pose = np.column_stack([signals["time"] + 3.0, signals["pos"], signals["quat"]])
    _csv(folder / "pose.csv", dict(zip(names, pose.T, strict=True)))
    path = _csv(folder / "log.csv", columns)
    return Written(path, ImportOptions(pose=folder / "pose.csv"))


MAPPING = """[frames]
world = "ned"
body = "frd"
motors = [[1, -1], [-1, 1], [1, 1], [-1, -1]]
[time]
column = "t"
"""
"""Beginning of the mapping file, which describes frames, units and columns of the table."""


def write_table(folder: Path, signals: Signals) -> Written:
    """Write a table as teams export it from PX4, north-east-down, with its mapping file."""
    converted = {
        "pos": signals["pos"] * HALF_TURN,
        "vel": signals["vel"] * HALF_TURN,
        "quat": signals["quat"] * QUAT_HALF_TURN,
        "rate": signals["rate"] * HALF_TURN * DEG,
        "acc": signals["acc"] * HALF_TURN,
        "cmd_rate": signals["cmd_rate"] * HALF_TURN,
        "motor": signals["motor"][:, [0, 2, 3, 1]] * RPM,
        "pwm": signals["pwm"][:, [0, 2, 3, 1]],
        "throttle": signals["throttle"],
        "voltage": signals["voltage"],
    }
    units = {"rate": "deg/s", "motor": "rpm"}
    columns, text = {"t": signals["time"]}, MAPPING
    for signal, value in converted.items():
        names = [f"{signal}_{k}" for k in range(value.shape[1])]
        columns |= dict(zip(names, value.T, strict=True))
        listed = ", ".join(f'"{name}"' for name in names)
        text += f"[{signal}]\n" + (
            f"column = {listed}\n" if len(names) == 1 else f"columns = [{listed}]\n"
        )
        text += f'unit = "{units[signal]}"\n' if signal in units else ""
    (folder / "map.toml").write_text(text, encoding="utf-8")
    return Written(_csv(folder / "log.csv", columns), ImportOptions(map=folder / "map.toml"))


def _csv(path: Path, columns: Mapping[str, np.ndarray]) -> Path:
    """Write columns to a CSV file and return its path."""
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8")
    return path


WRITERS: dict[str, Callable[[Path, Signals], Written]] = {
    "px4": write_ulog,
    "crazyflie": write_usd,
    "betaflight": write_blackbox,
    "table": write_table,
}
"""Format -> its writer."""
