"""Read PX4 logs (ULog files) with pyulog.

PX4's world is north-east-down and its body forward-right-down; quaternions are wxyz, body to
world. The log is converted to north-west-up and forward-left-up (`eval/importers/frames.py`).
Source of the topics and their units: the message definitions of PX4 v1.11 to v1.16.

| signal | topics, the first one in the log is used |
|---|---|
| quat | vehicle_attitude, vehicle_odometry |
| pos, vel | vehicle_local_position, vehicle_odometry |
| rate | vehicle_angular_velocity, sensor_combined |
| acc | sensor_combined, vehicle_acceleration |
| cmd_rate, throttle | vehicle_rates_setpoint |
| motor | esc_status |
| voltage | battery_status |
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN, rotate
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, collect
from eval.logs.columns import FlightLogError, quoted
from eval.logs.faults.drive.motors import check_count
from eval.logs.faults.finding import Finding
from eval.logs.faults.sensors import check_voltage_fails
from eval.logs.files import read_head
from tracks.input.ranges import is_number

SUMMARY = "PX4 ULog (.ulg)"
TAKES_MAP = TAKES_SOURCE = False
"""The format has fixed names and a single pose, see `Format`."""
ULOG = b"ULog\x01\x12\x35"
"""First bytes of a log."""
TOPICS = (
    "vehicle_attitude",
    "vehicle_odometry",
    "vehicle_local_position",
    "vehicle_angular_velocity",
    "vehicle_acceleration",
    "sensor_combined",
    "vehicle_rates_setpoint",
    "esc_status",
    "battery_status",
    "actuator_motors",
)
"""Topics that are read."""
QUAD_X = ((1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0))
"""PX4's motors 1 to 4 (x forward, y left): front right, rear left, front left, rear right."""
QUADROTOR = 2
"""MAV_TYPE of a quadrotor."""
FIRST_MOTOR = 101
"""Value of `actuator_function` for Motor1; Motor2 to Motor4 have the next values."""
BODY_FRAME = 3
"""Value of `velocity_frame` for a velocity in body axes."""
RPM = 2.0 * np.pi / 60.0

Topic = Mapping[str, np.ndarray]
"""The columns of one topic, by field name."""
Part = tuple[np.ndarray, np.ndarray]
"""Times (N,) [s] and values (N, C) of a signal."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is ULog."""
    return head.startswith(ULOG)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the ULog file at `path`.

    Raises:
        FlightLogError: where the file is not a ULog file, or too damaged to read.
    """
    if not detect(read_head(path), options):
        raise FlightLogError(str(path), None, None, "not a ULog file (its first bytes differ)")
    log = _load(path)
    topics: dict[str, Topic] = {}
    motor_side, findings = _motor_side(log.initial_parameters)
    findings += _check_file(log)
    # A later instance overwrites an earlier one, so the sort leaves instance 0 of each topic.
    for data in sorted(log.data_list, key=lambda data: -data.multi_id):
        if "timestamp" in data.data:
            topics[data.name] = data.data
        else:
            text = f"the topic {data.name} has no timestamp (damaged?): left out"
            findings.append(Finding("doubt", "file", text))
    parts: dict[str, Part] = {}
    for name, readers in _READERS.items():
        for topic, reader in readers:
            part = reader(topics[topic]) if topic in topics else None
            if part is not None:
                parts[name] = part
                break
    findings += _motor_count(log.initial_parameters, topics)
    batteries = [d.data for d in log.data_list if d.name == "battery_status" and d.multi_id > 0]
    findings += _other_battery(parts, batteries)
    findings += _no_position(topics)
    if "vehicle_local_position" in topics:
        findings += _resets(topics["vehicle_local_position"])
    signals, more_findings = collect(parts, str(path))
    info = log.msg_info_dict
    about = {key: str(info[key]) for key in ("sys_name", "ver_hw", "ver_sw") if key in info}
    return Recording(
        str(path), signals, (*findings, *more_findings), motor_side, about, has_seconds=True
    )


class _TruncationSafeReader(io.BufferedReader):
    """A file reader that keeps pyulog from an endless loop in a truncated file.

    After an invalid message pyulog seeks back by the length of its body. If the file ends within
    the body, pyulog has read fewer bytes than that, and would parse the same bytes again and again.
    This reader corrects the seek by the bytes that are missing.
    """

    _requested = _missing = 0
    is_cut = False
    """Whether the file ended within a message."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._requested = size or 0
        self._missing = max(self._requested - len(data), 0)
        self.is_cut |= bool(data) and self._missing > 0
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        if whence == 1 and -offset >= self._requested > 0:
            offset += self._missing
        return super().seek(offset, whence)


def _load(path: Path) -> Any:
    """Return the parsed file, a `pyulog.ULog`; `is_cut`: it ends within a message."""
    from pyulog import ULog

    try:
        # pyulog prints messages on damaged files, which a finding reports, and does not close a
        # file that it opened itself if it fails.
        with (
            _TruncationSafeReader(io.FileIO(path)) as file,
            contextlib.redirect_stdout(io.StringIO()),
        ):
            log: Any = ULog(file, list(TOPICS))
            log.is_cut = file.is_cut
            return log
    except Exception as error:
        reason = f"a ULog file that cannot be read ({quoted(error)})"
        raise FlightLogError(str(path), None, None, reason) from None


def _columns(topic: Topic, names: Sequence[str]) -> np.ndarray | None:
    """Return fields of a topic as (N, C); None where one is missing."""
    if any(name not in topic for name in names):
        return None
    return np.stack([np.asarray(topic[name], dtype=np.float64) for name in names], axis=1)


def _time(topic: Topic) -> np.ndarray:
    """Return the times of measurement (N,) [s]: `timestamp_sample` where the topic has it."""
    stamp = topic.get("timestamp_sample", topic["timestamp"])
    stamp = np.where(np.asarray(stamp) > 0, stamp, topic["timestamp"])
    return stamp.astype(np.float64) * 1e-6


def _vector(names: Sequence[str]) -> Callable[[Topic], Part | None]:
    """Return a reader of a vector whose frame, world or body, has z down."""

    def read_vector(topic: Topic) -> Part | None:
        value = _columns(topic, names)
        return None if value is None else (_time(topic), value * HALF_TURN)

    return read_vector


def _local(names: Sequence[str], valid: Sequence[str]) -> Callable[[Topic], Part | None]:
    """Return a reader of a vector in the local world, NaN where a flag of `valid` is false."""

    def read_local(topic: Topic) -> Part | None:
        part = _vector(names)(topic)
        if part is None:
            return None
        good = np.ones(len(part[0]), dtype=bool)
        for flag in valid:
            good &= np.asarray(topic.get(flag, good)).astype(bool)
        return (part[0], np.where(good[:, None], part[1], np.nan)) if good.any() else None

    return read_local


def _odometry_velocity(topic: Topic) -> Part | None:
    """Return the velocity if it is in the position's world frame or in body axes, else None.

    From PX4 v1.14 on, frames are 1 (north-east-down), 2 (z down with another heading) and 3 (body).
    Before, they are 0, 1 and 3.
    """
    frame = topic.get("velocity_frame")
    since_v1_14 = "pose_frame" in topic
    world = topic.get("pose_frame" if since_v1_14 else "local_frame")
    value = _columns(topic, [f"velocity[{k}]" for k in range(3)])
    value = _columns(topic, ["vx", "vy", "vz"]) if value is None else value
    if frame is None or value is None:
        return None
    frame = np.asarray(frame)
    if np.all(frame == BODY_FRAME):
        quat = _columns(topic, [f"q[{k}]" for k in range(4)])
        return None if quat is None else (_time(topic), rotate(quat, value) * HALF_TURN)
    is_world = np.isin(frame, (1, 2) if since_v1_14 else (0, 1))
    if world is None or not np.all(is_world & (frame == world)):
        return None
    return _time(topic), value * HALF_TURN


def _odometry_position(topic: Topic) -> Part | None:
    value = _columns(topic, [f"position[{k}]" for k in range(3)])
    value = _columns(topic, ["x", "y", "z"]) if value is None else value
    return None if value is None else (_time(topic), value * HALF_TURN)


def _attitude(topic: Topic) -> Part | None:
    value = _columns(topic, [f"q[{k}]" for k in range(4)])
    return None if value is None else (_time(topic), value * QUAT_HALF_TURN)


def _throttle(topic: Topic) -> Part | None:
    """Return the normalised collective thrust, positive along body z, of a rates set point."""
    value = _columns(topic, ["thrust_body[2]"])
    if value is None:
        value = _columns(topic, ["thrust"])  # before v1.10, positive upwards
        return None if value is None else (_time(topic), value)
    return _time(topic), -value


def _motors(topic: Topic) -> Part | None:
    """Return rotor speeds (N, 4) [rad/s] of Motor1 to Motor4, on whichever outputs they are."""
    speed = _columns(topic, [f"esc[{k}].esc_rpm" for k in range(4)])
    if speed is None or not np.any(speed):
        return None
    wired = _columns(topic, [f"esc[{k}].actuator_function" for k in range(4)])
    if wired is not None:
        order = np.argsort(wired[-1])
        if np.array_equal(wired[-1][order], FIRST_MOTOR + np.arange(4)):
            speed = speed[:, order]
    return _time(topic), np.abs(speed) * RPM


def _voltage(topic: Topic) -> Part | None:
    value = _columns(topic, ["voltage_v"])
    if value is None:
        return None
    return _time(topic), np.where(value > 0, value, np.nan)


_READERS: dict[str, list[tuple[str, Callable[[Topic], Part | None]]]] = {
    "quat": [("vehicle_attitude", _attitude), ("vehicle_odometry", _attitude)],
    "pos": [
        ("vehicle_local_position", _local(("x", "y", "z"), ("xy_valid", "z_valid"))),
        ("vehicle_odometry", _odometry_position),
    ],
    "vel": [
        ("vehicle_local_position", _local(("vx", "vy", "vz"), ("v_xy_valid", "v_z_valid"))),
        ("vehicle_odometry", _odometry_velocity),
    ],
    "rate": [
        ("vehicle_angular_velocity", _vector([f"xyz[{k}]" for k in range(3)])),
        ("sensor_combined", _vector([f"gyro_rad[{k}]" for k in range(3)])),
    ],
    "acc": [
        ("sensor_combined", _vector([f"accelerometer_m_s2[{k}]" for k in range(3)])),
        ("vehicle_acceleration", _vector([f"xyz[{k}]" for k in range(3)])),
    ],
    "cmd_rate": [("vehicle_rates_setpoint", _vector(("roll", "pitch", "yaw")))],
    "throttle": [("vehicle_rates_setpoint", _throttle)],
    "motor": [("esc_status", _motors)],
    "voltage": [("battery_status", _voltage)],
}
"""Signal -> the topics that may hold it, each with its reader, in the order of preference."""


def _motor_count(parameters: Mapping[str, Any], topics: Mapping[str, Topic]) -> list[Finding]:
    """Return a finding where the vehicle is not a quadrotor: by type, rotors and turning motors.

    `esc_count` is not used, because it counts ESCs that are connected, with or without a motor.
    """
    vehicle_type, rotors = (
        int(_parameter(parameters, name)) for name in ("MAV_TYPE", "CA_ROTOR_COUNT")
    )
    turning = 0
    for topic, name in (("esc_status", "esc[{}].esc_rpm"), ("actuator_motors", "control[{}]")):
        values = [np.asarray(topics.get(topic, {}).get(name.format(k), 0.0)) for k in range(12)]
        moved = sum(bool(np.any(np.nan_to_num(v.astype(np.float64)) > 0.0)) for v in values)
        turning = max(turning, moved)
    if rotors not in (0, 4):
        return check_count(rotors, "by CA_ROTOR_COUNT")
    if vehicle_type not in (0, QUADROTOR):
        text = f"MAV_TYPE is {vehicle_type}, not {QUADROTOR}: no quadrotor; {turning} motors turn"
        about = ("motor_count", float(turning), 0.95, "none: only quadrotors can be diagnosed")
        return [Finding("doubt", "motors", text, *about)]
    return check_count(turning, "of the log") if turning > 4 else []


def _other_battery(parts: dict[str, Part], others: Sequence[Topic]) -> list[Finding]:
    """Replace an impossible voltage of the first battery by another battery's, in place."""
    if "voltage" not in parts or not check_voltage_fails(parts["voltage"][1]):
        return []
    for number, topic in enumerate(others, start=1):
        part = _voltage(topic) if "timestamp" in topic else None
        if part is not None and not check_voltage_fails(part[1]):
            median_v = float(np.nanmedian(parts["voltage"][1]))
            parts["voltage"] = part
            text = f"battery 0 reports {median_v:.3g} V, not plausible; battery {number} is read"
            return [Finding("corrected", "voltage", text, "voltage", median_v, 0.97)]
    return []


def _no_position(topics: Mapping[str, Topic]) -> list[Finding]:
    """Return a note where the estimator's flags mark the local position as never valid."""
    topic = topics.get("vehicle_local_position", {})
    invalid = [f for f in ("xy_valid", "z_valid") if f in topic and not np.any(topic[f])]
    text = f"{' and '.join(invalid)} of vehicle_local_position are false throughout"
    return [Finding("note", "position", text)] if invalid else []


def _parameter(parameters: Mapping[str, Any], name: str) -> float:
    """Return a parameter; 0 where it is missing or, in a damaged file, not a number."""
    value = parameters.get(name, 0.0)
    return float(value) if is_number(value) else 0.0


def _motor_side(parameters: Mapping[str, Any]) -> tuple[Any, list[Finding]]:
    """Return the positions of motors 1 to 4 (x forward, y left), and a note if they are assumed."""
    side = tuple(
        (_parameter(parameters, f"CA_ROTOR{k}_PX"), -_parameter(parameters, f"CA_ROTOR{k}_PY"))
        for k in range(4)
    )
    if all(abs(x) + abs(y) > 0 for x, y in side):
        return side, []
    text = "the log has no positions of the motors; PX4's quadrotor X is assumed"
    return QUAD_X, [Finding("note", "motors", text)]


def _check_file(log: Any) -> list[Finding]:
    """Return findings on damage, dropouts and the thrust model's parameter."""
    findings = []
    if log.is_cut:
        text = "it ends within a message: the rest of the flight may be missing"
        findings.append(Finding("note", "file", text))
    if log.file_corruption:
        findings.append(Finding("doubt", "file", "damaged in places; undamaged messages were read"))
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) / 1000.0
        text = f"{len(log.dropouts)} dropouts, {lost:.2g} s in all (a slow memory card)"
        findings.append(Finding("note", "file", text))
    if _parameter(log.initial_parameters, "THR_MDL_FAC") == 0.0:
        text = (
            "THR_MDL_FAC is 0: PX4's thrust is the motors' signal, and thrust is not linear in it"
        )
        findings.append(Finding("note", "thrust", text))
    return findings


def _resets(topic: Topic) -> list[Finding]:
    """Return a doubt where the estimator has reset the position."""
    jumps = 0
    for name in ("xy_reset_counter", "z_reset_counter"):
        if name in topic:
            jumps += int(np.count_nonzero(np.diff(np.asarray(topic[name]))))
    text = f"the estimator moved the position {jumps} times in the log; it jumps there"
    return [Finding("doubt", "position", text)] if jumps else []
