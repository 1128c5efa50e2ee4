"""Flights as other programs write them: PX4, Betaflight with motion capture, Crazyflie, a table.

Each writer follows the public description of its format (docs.px4.io, blackbox_decode, Bitcraze's
micro SD card deck) and takes signals in our units and frames, all at the same times.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np

from eval.importers.frames import QUAT_HALF_TURN
from eval.importers.options import ImportOptions

FLIP = np.array([1.0, -1.0, -1.0])
DEG, RPM = float(180.0 / np.pi), float(60.0 / (2.0 * np.pi))
Parts = Mapping[str, np.ndarray]


class Written(NamedTuple):
    """A file, and the options of its import."""

    path: Path
    options: ImportOptions


def write_ulog(folder: Path, parts: Parts, full_thrust: float) -> Written:
    """Write PX4's ULog: north-east-down, forward-right-down, ESCs in PX4's order."""
    stamp = np.round(parts["time"] * 1e6).astype(np.int64) + 5_000_000
    motors = parts["motor"][:, [0, 2, 3, 1]] * RPM
    thrust = np.concatenate([np.zeros((len(stamp), 2)), -parts["throttle"]], axis=1)
    topics = {
        "vehicle_attitude": ([("float[4]", "q")], parts["quat"] * QUAT_HALF_TURN),
        "vehicle_angular_velocity": ([("float[3]", "xyz")], parts["rate"] * FLIP),
        "sensor_combined": ([("float[3]", "accelerometer_m_s2")], parts["acc"] * FLIP),
        "vehicle_local_position": (
            [("float", name) for name in ("x", "y", "z", "vx", "vy", "vz")],
            np.concatenate([parts["pos"] * FLIP, parts["vel"] * FLIP], axis=1),
        ),
        "vehicle_rates_setpoint": (
            [*(("float", name) for name in ("roll", "pitch", "yaw")), ("float[3]", "thrust_body")],
            np.concatenate([parts["cmd_rate"] * FLIP, thrust], axis=1),
        ),
        "esc_status": ([("esc_report[4]", "esc")], motors),
        "battery_status": ([("float", "voltage_v")], parts["voltage"]),
    }
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
        cells = value.astype("<f4")
        for when, row in zip(stamp, cells, strict=True):
            data += _message("D", struct.pack("<HQ", number, max(int(when), 1)) + row.tobytes())
    path = folder / "log.ulg"
    path.write_bytes(data)
    return Written(path, ImportOptions())


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def write_usd(folder: Path, parts: Parts, full_thrust: float) -> Written:
    """Write a log of the Crazyflie's micro SD card deck."""
    columns = {"controller.cmd_thrust(f)": parts["throttle"][:, 0] * 65535.0}
    for k, axis in enumerate("xyz"):
        columns[f"stateEstimate.{axis}(f)"] = parts["pos"][:, k]
        columns[f"stateEstimate.v{axis}(f)"] = parts["vel"][:, k]
        columns[f"gyro.{axis}(f)"] = parts["rate"][:, k] * DEG
        columns[f"acc.{axis}(f)"] = parts["acc"][:, k] / 9.81
    for k, part in enumerate("wxyz"):
        columns[f"stateEstimate.q{part}(f)"] = parts["quat"][:, k]
    for k, name in enumerate(("rollRate", "pitchRate", "yawRate")):
        columns[f"controller.{name}(f)"] = parts["cmd_rate"][:, k] * DEG * [1.0, -1.0, 1.0][k]
    for k in range(4):
        columns[f"rpm.m{k + 1}(f)"] = parts["motor"][:, k] * RPM
    columns["pm.vbat(f)"] = parts["voltage"][:, 0]
    data = b"\xbc" + struct.pack("<HHH", 2, 1, 7) + b"fixedFrequency\0"
    data += struct.pack("<H", len(columns)) + b"".join(n.encode() + b"\0" for n in columns)
    table = np.column_stack(list(columns.values())).astype("<f4")
    stamp = np.round(parts["time"] * 1e6).astype(np.int64) + 9_000_000
    for when, row in zip(stamp, table, strict=True):
        data += struct.pack("<HQ", 7, max(int(when), 0)) + row.tobytes()
    path = folder / "log00"
    path.write_bytes(data + struct.pack("<I", crc32(data)))
    return Written(path, ImportOptions())


def write_blackbox(folder: Path, parts: Parts, full_thrust: float) -> Written:
    """Write a CSV of `blackbox_decode`, and the pose by motion capture next to it."""
    columns = {"loopIteration": np.arange(len(parts["time"]), dtype=float)}
    columns["time (us)"] = np.round(parts["time"] * 1e6) + 52e6
    for k in range(3):
        columns[f"gyroADC[{k}]"] = np.round(parts["rate"][:, k] * DEG)
        columns[f"setpoint[{k}]"] = np.round(parts["cmd_rate"][:, k] * DEG)
        columns[f"accSmooth[{k}]"] = np.round(parts["acc"][:, k] / 9.81 * 2048.0)
    columns["setpoint[3]"] = np.round(parts["throttle"][:, 0] * 1000.0)
    columns["vbatLatest (V)"] = np.round(parts["voltage"][:, 0], 2)
    for k, motor in enumerate((1, 0, 2, 3)):
        columns[f"eRPM[{k}]"] = np.round(parts["motor"][:, motor] * RPM * 7.0 / 100.0)
    names = ["time", "pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"]
    pose = np.column_stack([parts["time"] + 3.0, parts["pos"], parts["quat"]])
    _csv(folder / "pose.csv", dict(zip(names, pose.T, strict=True)))
    path = _csv(folder / "log.csv", columns)
    return Written(path, ImportOptions(pose=folder / "pose.csv"))


MAP = """[frames]
world = "ned"
body = "frd"
motors = [[1, -1], [-1, 1], [1, 1], [-1, -1]]
[time]
column = "t"
"""


def write_table(folder: Path, parts: Parts, full_thrust: float) -> Written:
    """Write a table as teams export it from PX4, north-east-down, with its mapping file."""
    signals = {
        "pos": parts["pos"] * FLIP,
        "vel": parts["vel"] * FLIP,
        "quat": parts["quat"] * QUAT_HALF_TURN,
        "rate": parts["rate"] * FLIP * DEG,
        "acc": parts["acc"] * FLIP,
        "cmd_rate": parts["cmd_rate"] * FLIP,
        "motor": parts["motor"][:, [0, 2, 3, 1]] * RPM,
        "throttle": parts["throttle"],
        "voltage": parts["voltage"],
    }
    units = {"rate": "deg/s", "motor": "rpm"}
    columns, text = {"t": parts["time"]}, MAP
    for signal, value in signals.items():
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
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8")
    return path


WRITERS: dict[str, Callable[[Path, Parts, float], Written]] = {
    "px4": write_ulog,
    "crazyflie": write_usd,
    "betaflight": write_blackbox,
    "table": write_table,
}
"""Format -> its writer."""
