"""Read MCAP files with ROS 2 messages, with `mcap` and `mcap-ros2-support` (extra `mcap`).

ROS's worlds are z-up and its bodies forward-left-up; quaternions are xyzw. The velocity of an
Odometry is in its child frame, the body. A mapping file's [topics] selects a topic where several
hold the same kind of message; a pose without an odometry there replaces every odometry. Its
`[frames] motors` gives the positions of the motors.

| kind | messages |
|---|---|
| odometry | nav_msgs/Odometry |
| pose | geometry_msgs/PoseStamped, PoseWithCovarianceStamped |
| imu | sensor_msgs/Imu |
| command | mavros_msgs/AttitudeTarget (body_rate, thrust from 0 to 1) |
| motors | actuator_msgs/Actuators (velocity), mav_msgs/Actuators (angular_velocities) [rad/s] |
| battery | sensor_msgs/BatteryState |
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from eval.importers.mapping_file import map_file, motor_side_of
from eval.importers.options import ImportOptions
from eval.importers.rows import turn_axes
from eval.importers.signals import Part, Recording, collect
from eval.logs.columns import FlightLogError, damaged
from eval.logs.faults.drive.motors import check_count
from eval.logs.faults.finding import Finding
from eval.logs.files import read_head
from tracks.common.toml_table import read_toml

SUMMARY = "MCAP with ROS 2 messages (pip install 'diffracing-suite[mcap]')"
TAKES_SOURCE = False
MCAP = b"\x89MCAP0\r\n"
"""First bytes of a file."""
KINDS: dict[str, tuple[str, ...]] = {
    "odometry": ("nav_msgs/Odometry",),
    "pose": ("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"),
    "imu": ("sensor_msgs/Imu",),
    "command": ("mavros_msgs/AttitudeTarget",),
    "motors": ("actuator_msgs/Actuators", "mav_msgs/Actuators"),
    "battery": ("sensor_msgs/BatteryState",),
}
"""Kind of message -> ROS types that hold it, without `/msg/`."""
Stamped = tuple[int, int, Any]
"""A message with its times: time in its header [ns], time of recording [ns], message."""
IGNORE_RATES, IGNORE_THRUST, IGNORE_ATTITUDE = 7, 64, 128
"""Bits of `AttitudeTarget.type_mask` (MAVLink's ATTITUDE_TARGET_TYPEMASK)."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is MCAP."""
    return head.startswith(MCAP)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the MCAP file at `path`.

    Raises:
        FlightLogError: where the file is not MCAP or damaged, or the extra is not installed.
        ValueError: for a mapping file that cannot be used.
    """
    if not detect(read_head(path), options):
        raise FlightLogError(path, "not an MCAP file (its first bytes differ)")
    topic_of, motor_side = _choices(options.map)
    recorded = _messages(path)
    chosen: dict[str, list[Stamped]] = {}
    findings: list[Finding] = []
    for kind in KINDS:
        topics = {topic: messages for (k, topic), messages in recorded.items() if k == kind}
        if not topics or (kind == "odometry" and kind not in topic_of and "pose" in topic_of):
            continue
        topic = topic_of.get(kind) or max(topics, key=lambda name: len(topics[name]))
        if topic not in topics:
            types = " or ".join(KINDS[kind])
            reason = f"topic {topic!r} has no {types}; topics with it: {', '.join(topics)}"
            raise FlightLogError(path, reason)
        if len(topics) > 1 and kind not in topic_of:
            text = f"{kind} from {topic}; also there: {', '.join(sorted(topics.keys() - {topic}))}"
            findings.append(Finding("note", "topics", text + ". Choose with [topics] in --map"))
        chosen[kind] = topics[topic]
    missing = sorted(topic_of.keys() - chosen.keys())
    if missing:
        reason = f"the file has no topic {topic_of[missing[0]]!r}, which the mapping names"
        raise FlightLogError(path, reason)
    messages = _on_one_clock(chosen, findings)
    signals, more_findings = collect(_parts(messages, str(path)), str(path))
    if "vel" in signals:
        turn_axes(signals, "vel", to_world=True)
    findings += _motor_count(messages)
    return Recording(str(path), signals, (*findings, *more_findings), motor_side, has_seconds=True)


def _choices(
    map_path: Path | None,
) -> tuple[dict[str, str], tuple[tuple[float, float], ...] | None]:
    """Return the topics that a mapping file selects, by kind, and the positions of its motors."""
    if map_path is None:
        return {}, None
    top = read_toml(map_file(map_path))
    tables = [top.table(name, {}) for name in ("topics", "frames")]
    topics = {kind: tables[0].text(kind) for kind in KINDS if tables[0].has(kind)}
    motor_side = motor_side_of(tables[1])
    for table in (*tables, top):
        table.close()
    return topics, motor_side


def _messages(path: Path) -> dict[tuple[str, str], list[Stamped]]:
    """Return (kind, topic) -> the messages of the kinds in `KINDS`."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ModuleNotFoundError as error:
        reason = f"the package {error.name!r} is missing; run pip install 'diffracing-suite[mcap]'"
        raise FlightLogError(path, reason) from None
    kind_of = {type_: kind for kind, types in KINDS.items() for type_ in types}
    recorded: dict[tuple[str, str], list[Stamped]] = {}
    factory = DecoderFactory()
    try:
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                kind = kind_of.get(schema.name.replace("/msg/", "/")) if schema else None
                if kind is None:
                    continue
                decode = factory.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    continue
                decoded = decode(message.data)
                stamps = (_stamp(decoded), message.log_time)
                recorded.setdefault((kind, channel.topic), []).append((*stamps, decoded))
    except Exception as error:
        raise damaged(path, "an MCAP file", error) from None
    if not recorded:
        types = ", ".join(kind_of)
        raise FlightLogError(path, f"holds no ROS 2 message of {types}")
    return recorded


def _on_one_clock(
    chosen: dict[str, list[Stamped]], findings: list[Finding]
) -> dict[str, list[tuple[int, Any]]]:
    """Return (time [ns], message) by kind, all by the headers' clock or all by the recorder's.

    A header with a stamp of 0 was never set. Signals on two clocks would not match in time.
    """
    unset = sorted(k for k, messages in chosen.items() if any(m[0] <= 0 for m in messages))
    if unset:
        text = f"headers of {', '.join(unset)} have stamp 0: all times are the recorder's"
        findings.append(Finding("corrected", "time", text, "time_stamps", None, 0.95))
    time_index = 1 if unset else 0
    return {kind: [(m[time_index], m[2]) for m in messages] for kind, messages in chosen.items()}


def _motor_count(messages: dict[str, list[tuple[int, Any]]]) -> list[Finding]:
    """Return a finding where more than four motors turn."""
    speeds = [np.abs(np.asarray(_all_speeds(m), float)) for _, m in messages.get("motors", ())]
    width = max((len(s) for s in speeds), default=0)
    if width <= 4:
        return []
    table = np.array([[*s, *[0.0] * (width - len(s))] for s in speeds])
    return check_count(int(np.sum(table.max(axis=0) > 0.0)), "of the topic")


def _stamp(message: Any) -> int:
    """Return the time in a message's header [ns], 0 without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _parts(messages: dict[str, list[tuple[int, Any]]], name: str) -> dict[str, Part]:
    """Return the signals of the messages, with times from 0 [s]; a velocity is in body axes."""
    origin_ns = min(time_ns for stamped in messages.values() for time_ns, _ in stamped)
    parts: dict[str, Part] = {}

    def take(signal: str, kind: str, value: Callable[[Any], list[float]]) -> None:
        """Add a signal from messages of `kind`, unless an earlier kind has given it."""
        if kind not in messages or signal in parts:
            return
        time_s = np.array([(time_ns - origin_ns) * 1e-9 for time_ns, _ in messages[kind]])
        try:
            rows = np.array([value(message) for _, message in messages[kind]], dtype=float)
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            types = " or ".join(KINDS[kind])
            reason = f"messages differ from the definition of {types} ({error}); log them again"
            raise FlightLogError(name, reason, signal) from None
        parts[signal] = (time_s, rows)

    def pose(message: Any) -> Any:
        return message.pose.pose if hasattr(message.pose, "pose") else message.pose

    for kind in ("odometry", "pose"):
        take("pos", kind, lambda m: _xyz(pose(m).position))
        take("quat", kind, lambda m: _wxyz(pose(m).orientation))
    take("vel", "odometry", lambda m: _xyz(m.twist.twist.linear))
    take("rate", "imu", lambda m: _xyz(m.angular_velocity))
    take("rate", "odometry", lambda m: _xyz(m.twist.twist.angular))
    take("acc", "imu", lambda m: _xyz(m.linear_acceleration))
    take("cmd_rate", "command", lambda m: _unless(m, IGNORE_RATES, _xyz(m.body_rate)))
    take("cmd_quat", "command", lambda m: _unless(m, IGNORE_ATTITUDE, _wxyz(m.orientation)))
    take("throttle", "command", lambda m: _unless(m, IGNORE_THRUST, [m.thrust]))
    take("motor", "motors", _speeds)
    take("voltage", "battery", lambda m: [m.voltage])
    return parts


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _wxyz(quat: Any) -> list[float]:
    return [quat.w, quat.x, quat.y, quat.z]


def _unless(message: Any, ignored: int, value: list[float]) -> list[float]:
    """Return `value`, or NaN where the message's mask marks it as ignored."""
    return [float("nan")] * len(value) if message.type_mask & ignored else value


def _all_speeds(message: Any) -> Any:
    return message.velocity if hasattr(message, "velocity") else message.angular_velocities


def _speeds(message: Any) -> list[float]:
    """Return the speeds of the first four motors [rad/s], without sign, NaN for missing ones."""
    four = [abs(float(speed)) for speed in list(_all_speeds(message))[:4]]
    return four + [float("nan")] * (4 - len(four))
