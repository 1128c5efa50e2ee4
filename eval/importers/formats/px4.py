"""Read PX4 logs (ULog files) with pyulog.

PX4's world is north-east-down and its body forward-right-down; quaternions are wxyz, body to
world. The log is converted to north-west-up and forward-left-up (`eval/importers/frames.py`).
Source of the topics and their units: the message definitions of PX4 v1.11 to v1.16.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN, rotate
from eval.importers.options import ImportOptions
from eval.importers.signals import Part, Recording, collect
from eval.logs.columns import FlightLogError, damaged
from eval.logs.faults.drive.motors import check_count
from eval.logs.faults.finding import CUT, Finding
from eval.logs.faults.reading import RPM
from eval.logs.faults.sensors import check_voltage_fails
from eval.logs.files import read_head
from eval.quadrotor.loops.px4 import Settings
from tracks.input.ranges import is_number

SUMMARY = "PX4 ULog (.ulg)"
TAKES_MAP = TAKES_SOURCE = False
"""The format has fixed names and a single pose, see `Format`."""
ULOG = b"ULog\x01\x12\x35"
"""First bytes of a log."""
QUAD_X = ((1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0))
"""PX4's motors 1 to 4 (x forward, y left): front right, rear left, front left, rear right."""
QUADROTOR = 2
"""MAV_TYPE of a quadrotor."""
FIRST_MOTOR = 101
"""Value of `actuator_function` for Motor1; Motor2 to Motor4 have the next values."""
BODY_FRAME = 3
"""Value of `velocity_frame` for a velocity in body axes."""

Topic = Mapping[str, np.ndarray]
"""The columns of one topic, by field name."""
Change = Callable[[Topic, np.ndarray], np.ndarray | None]
"""Function of a topic and its fields (N, C) that returns them changed, or None for no samples."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is ULog."""
    return head.startswith(ULOG)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the ULog file at `path`.

    Raises:
        FlightLogError: where the file is not a ULog file, or too damaged to read.
    """
    if not detect(read_head(path), options):
        raise FlightLogError(path, "not a ULog file (its first bytes differ)")
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
    for name, sources in _SOURCES.items():
        found = (_part(topics[topic], *how) for topic, *how in sources if topic in topics)
        if (part := next((p for p in found if p is not None), None)) is not None:
            parts[name] = part
    findings += _motor_count(log.initial_parameters, topics)
    batteries = [d.data for d in log.data_list if d.name == "battery_status" and d.multi_id > 0]
    findings += _other_battery(parts, batteries)
    findings += _check_position(topics.get("vehicle_local_position", {}))
    signals, more_findings = collect(parts, str(path))
    info, parameters = log.msg_info_dict, log.initial_parameters
    about: dict[str, Any] = {
        key: str(info[key]) for key in ("sys_name", "ver_hw", "ver_sw") if key in info
    }
    # A setting that changes within the log has more than one value.
    changing = {name for _, name, value in log.changed_parameters if value != parameters.get(name)}
    loop = {f.name: parameters.get(f.name) for f in fields(Settings) if f.name not in changing}
    if loop := {name: float(value) for name, value in loop.items() if is_number(value)}:
        about["controller"] = {"kind": "px4", **loop}
    return Recording(
        str(path), signals, (*findings, *more_findings), motor_side, about, has_seconds=True
    )


class _TruncationSafeReader(io.BufferedReader):
    """A file reader that keeps pyulog from an endless loop in a truncated file.

    After an invalid message pyulog seeks back by the length of its body. If the file ends within
    the body, it would parse the same bytes again and again. This reader corrects the seek.
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
            topics = {topic for sources in _SOURCES.values() for topic, *_ in sources}
            log: Any = ULog(file, [*topics, "actuator_motors"])
            log.is_cut = file.is_cut
            return log
    except Exception as error:
        raise damaged(path, "a ULog file", error) from None


def _columns(topic: Topic, names: str) -> np.ndarray | None:
    """Return the fields `names` of a topic as (N, C); None where one is missing."""
    if any(name not in topic for name in names.split()):
        return None
    return np.stack([np.asarray(topic[n], dtype=np.float64) for n in names.split()], axis=1)


def _part(topic: Topic, names: str, factor: Any, change: Change | None = None) -> Part | None:
    """Return the times of measurement [s] and the fields `names`, changed and times `factor`."""
    value = _columns(topic, names)
    value = change(topic, value) if change is not None and value is not None else value
    if value is None:
        return None
    stamp = topic.get("timestamp_sample", topic["timestamp"])
    stamp = np.where(np.asarray(stamp) > 0, stamp, topic["timestamp"])
    return stamp.astype(np.float64) * 1e-6, value * factor


def _valid(*flags: str) -> Change:
    """Return a change to NaN where a flag is false; to None where no sample is valid."""

    def change(topic: Topic, value: np.ndarray) -> np.ndarray | None:
        good = np.ones(len(value), dtype=bool)
        for flag in flags:
            good &= np.asarray(topic.get(flag, good)).astype(bool)
        return np.where(good[:, None], value, np.nan) if good.any() else None

    return change


def _in_odometry_world(topic: Topic, value: np.ndarray) -> np.ndarray | None:
    """Return a velocity that is in the position's world frame or in body axes, else None.

    Frames are 1 (north-east-down; also 0 before PX4 v1.14), 2 (from v1.14 on: z down with another
    heading) and 3 (body).
    """
    frame = topic.get("velocity_frame")
    since_v1_14 = "pose_frame" in topic
    world = topic.get("pose_frame" if since_v1_14 else "local_frame")
    if frame is None:
        return None
    frame = np.asarray(frame)
    if np.all(frame == BODY_FRAME):
        quat = _columns(topic, QUAT)
        return None if quat is None else rotate(quat, value)
    is_world = np.isin(frame, (1, 2) if since_v1_14 else (0, 1))
    return value if world is not None and np.all(is_world & (frame == world)) else None


def _in_motor_order(topic: Topic, speed: np.ndarray) -> np.ndarray | None:
    """Return the speeds (N, 4) of Motor1 to Motor4, on whichever outputs they are."""
    if not np.any(speed):
        return None
    wired = _columns(topic, " ".join(f"esc[{k}].actuator_function" for k in range(4)))
    if wired is not None:
        order = np.argsort(wired[-1])
        if np.array_equal(wired[-1][order], FIRST_MOTOR + np.arange(4)):
            speed = speed[:, order]
    return np.abs(speed)


QUAT = "q[0] q[1] q[2] q[3]"
VOLTAGE = ("voltage_v", 1.0, lambda _, value: np.where(value > 0, value, np.nan))
_SOURCES: dict[str, list[tuple[Any, ...]]] = {
    "quat": [(t, QUAT, QUAT_HALF_TURN) for t in ("vehicle_attitude", "vehicle_odometry")],
    "pos": [
        ("vehicle_local_position", "x y z", HALF_TURN, _valid("xy_valid", "z_valid")),
        ("vehicle_odometry", "position[0] position[1] position[2]", HALF_TURN),
        ("vehicle_odometry", "x y z", HALF_TURN),
    ],
    "vel": [
        ("vehicle_local_position", "vx vy vz", HALF_TURN, _valid("v_xy_valid", "v_z_valid")),
        ("vehicle_odometry", "velocity[0] velocity[1] velocity[2]", HALF_TURN, _in_odometry_world),
        ("vehicle_odometry", "vx vy vz", HALF_TURN, _in_odometry_world),
    ],
    "rate": [
        ("vehicle_angular_velocity", "xyz[0] xyz[1] xyz[2]", HALF_TURN),
        ("sensor_combined", "gyro_rad[0] gyro_rad[1] gyro_rad[2]", HALF_TURN),
    ],
    "acc": [
        ("sensor_combined", " ".join(f"accelerometer_m_s2[{k}]" for k in range(3)), HALF_TURN),
        ("vehicle_acceleration", "xyz[0] xyz[1] xyz[2]", HALF_TURN),
    ],
    "cmd_rate": [("vehicle_rates_setpoint", "roll pitch yaw", HALF_TURN)],
    "throttle": [
        ("vehicle_rates_setpoint", "thrust_body[2]", -1.0),
        ("vehicle_rates_setpoint", "thrust", 1.0),  # before v1.10, positive upwards
    ],
    "motor": [
        ("esc_status", " ".join(f"esc[{k}].esc_rpm" for k in range(4)), RPM, _in_motor_order)
    ],
    "voltage": [("battery_status", *VOLTAGE)],
}
"""Signal -> the topics that may hold it, in the order of preference, each with its fields, their
factor, and a change before the factor."""


def _motor_count(parameters: Mapping[str, Any], topics: Mapping[str, Topic]) -> list[Finding]:
    """Return a finding where type, rotors or turning motors show that it is no quadrotor.

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
        part = _part(topic, *VOLTAGE) if "timestamp" in topic else None
        if part is not None and not check_voltage_fails(part[1]):
            median_v = float(np.nanmedian(parts["voltage"][1]))
            parts["voltage"] = part
            text = f"battery 0 reports {median_v:.3g} V, not plausible; battery {number} is read"
            return [Finding("corrected", "voltage", text, "voltage", median_v, 0.97)]
    return []


def _check_position(topic: Topic) -> list[Finding]:
    """Return findings where the local position is never valid, or was reset by the estimator."""
    findings = []
    if invalid := [f for f in ("xy_valid", "z_valid") if f in topic and not np.any(topic[f])]:
        text = f"{' and '.join(invalid)} of vehicle_local_position are false throughout"
        findings.append(Finding("note", "position", text))
    counters = [topic[f] for f in ("xy_reset_counter", "z_reset_counter") if f in topic]
    if jumps := sum(int(np.count_nonzero(np.diff(np.asarray(counter)))) for counter in counters):
        text = f"the estimator moved the position {jumps} times in the log; it jumps there"
        findings.append(Finding("doubt", "position", text))
    return findings


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
        findings.append(Finding("note", "file", CUT))
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
