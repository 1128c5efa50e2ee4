"""The flight of `known_flight.py`, written as other programs write their logs.

Every writer follows the public description of its format and shares no code with the importers.
Another flight than this one is written by giving its function of time in place of `fly`.
"""

import struct
from pathlib import Path
from zlib import crc32

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.imported import write
from tests.support.known_flight import fly, ned, ned_quat

ROS_MESSAGES = Path(__file__).with_name("ros_messages")
"""Definitions of ROS 2 messages (ros2 interface show), and of their `parts`."""


class UlogWriter:
    """A ULog file, message by message (docs.px4.io, ULog File Format)."""

    SIZES = {"uint64_t": "Q", "float": "f", "int32_t": "i", "uint8_t": "B", "bool": "?"}

    def __init__(self):
        self.bytes = b"ULog\x01\x12\x35" + struct.pack("<BQ", 1, 112574307)
        self._message("B", bytes(40))
        self._ids = 0
        self.data = []

    def _message(self, kind, payload):
        self.bytes += struct.pack("<HB", len(payload), ord(kind)) + payload

    def parameter(self, name, value):
        """Write a float parameter."""
        key = f"float {name}".encode()
        self._message("P", bytes([len(key)]) + key + struct.pack("<f", value))

    def nested(self, name, fields):
        """Write the definition of a type that topics may hold."""
        self._message("F", (f"{name}:" + "".join(f"{t} {n};" for t, n in fields)).encode())

    def topic(self, name, fields, rows, code, multi_id=0):
        """Define `name`, and keep its packed `rows` for the data section; they start with time."""
        if multi_id == 0:
            self.nested(name, [("uint64_t", "timestamp"), *fields])
        number = self._ids
        self._ids += 1
        self.data.append(("A", 0, bytes([multi_id]) + struct.pack("<H", number) + name.encode()))
        for row in rows:
            payload = struct.pack("<HQ", number, row[0]) + struct.pack("<" + code, *row[1:])
            self.data.append(("D", row[0], payload))

    def write(self, path):
        """Write the file: subscriptions, then the data by time."""
        for kind, _, payload in sorted(self.data, key=lambda m: (m[0] == "D", m[1])):
            self._message(kind, payload)
        path.write_bytes(self.bytes)


def write_ulog(
    path, span=(0.0, 8.0), rate=200.0, esc=True, full_thrust=30.0, start_us=5_000_000,
    pos_hz=None, gyro_hz=None, command_hz=100.0, odometry=None, source=fly,
):  # fmt: skip
    """PX4 with attitude at `rate`, positions at half of it, commands at 100 Hz, ESCs at 50 Hz.

    `odometry` (new format, frame of the velocity) takes the place of vehicle_local_position.
    """

    def at(hz):
        truth = source(np.arange(span[0], span[1], 1 / hz))
        return truth, np.round(truth.time * 1e6).astype(int) + start_us

    log = UlogWriter()
    log.nested("esc_report", [("int32_t", "esc_rpm"), ("uint8_t", "actuator_function")])
    # Hubs (x forward, y right) in PX4's usual order.
    for k, (x, y) in enumerate([(0.03, 0.04), (-0.03, -0.04), (0.03, -0.04), (-0.03, 0.04)]):
        log.parameter(f"CA_ROTOR{k}_PX", x)
        log.parameter(f"CA_ROTOR{k}_PY", y)
    log.parameter("THR_MDL_FAC", 1.0)
    fast, t = at(rate)
    stamped = ("uint64_t", "timestamp_sample")
    # Published 300 us after it was measured.
    rows = [(k + 300, k, *q) for k, q in zip(t, ned_quat(fast), strict=True)]
    log.topic("vehicle_attitude", [stamped, ("float[4]", "q")], rows, "Qffff")
    fast, t = at(gyro_hz or rate)
    rows = [(k + 250, k, *v) for k, v in zip(t, ned(fast.rate), strict=True)]
    log.topic("vehicle_angular_velocity", [stamped, ("float[3]", "xyz")], rows, "Qfff")
    rows = [(k, *v) for k, v in zip(t, ned(fast.acc), strict=True)]
    log.topic("sensor_combined", [("float[3]", "accelerometer_m_s2")], rows, "fff")
    slow, t = at(pos_hz or rate / 2)
    if odometry is not None:
        _odometry(log, slow, t, *odometry)
    else:
        names = ["x", "y", "z", "vx", "vy", "vz"]
        both = np.concatenate([ned(slow.pos), ned(slow.vel)], axis=1)
        valid = [("bool", "xy_valid"), ("bool", "z_valid")]
        rows = [(k, k, *v, True, True) for k, v in zip(t, both, strict=True)]
        fields = [stamped, *(("float", n) for n in names), *valid]
        log.topic("vehicle_local_position", fields, rows, "Q6f??")
    slow, t = at(command_hz)
    wanted = ned(slow.cmd_rate)
    rows = [
        (k, *w, 0.0, 0.0, -c / full_thrust) for k, w, c in zip(t, wanted, slow.thrust, strict=True)
    ]
    fields = [("float", n) for n in ("roll", "pitch", "yaw")] + [("float[3]", "thrust_body")]
    log.topic("vehicle_rates_setpoint", fields, rows, "6f")
    if esc:
        slow, t = at(50.0)
        # Truth is front right, rear right, rear left, front left; PX4: FR, RL, FL, RR.
        rpm = np.round(slow.motor[:, [0, 2, 3, 1]] * 60 / (2 * np.pi)).astype(int)
        # Wired the other way round: esc[0] drives Motor4.
        rows = [
            (k, *(v for m in (3, 2, 1, 0) for v in (r[m], 101 + m)))
            for k, r in zip(t, rpm, strict=True)
        ]
        log.topic("esc_status", [("esc_report[4]", "esc")], rows, "iBiBiBiB")
    slow, t = at(5.0)
    rows = [(k, v) for k, v in zip(t, slow.voltage, strict=True)]
    log.topic("battery_status", [("float", "voltage_v")], rows, "f")
    log.write(path)
    return path


def _odometry(log, truth, t, new, frame):
    """Write vehicle_odometry as v1.14 has it, or as v1.11 had it, with the velocity in `frame`."""
    vel = ned(truth.vel)
    if frame == 3:
        vel = ned(np.einsum("tji,tj->ti", truth.rot, truth.vel))
    both = np.concatenate([ned(truth.pos), ned_quat(truth), vel], axis=1)
    if new:
        names = [("float[3]", "position"), ("float[4]", "q"), ("float[3]", "velocity")]
        frames, place = [("uint8_t", "pose_frame"), ("uint8_t", "velocity_frame")], 1
    else:
        names = [*(("float", n) for n in "xyz"), ("float[4]", "q")]
        names += [("float", n) for n in ("vx", "vy", "vz")]
        frames, place = [("uint8_t", "local_frame"), ("uint8_t", "velocity_frame")], 0
    rows = [(k, k, *v, place, frame) for k, v in zip(t, both, strict=True)]
    fields = [("uint64_t", "timestamp_sample"), *names, *frames]
    log.topic("vehicle_odometry", fields, rows, "Q10fBB")


BLACKBOX_HEADER = (
    "loopIteration, time (us), axisP[0], axisP[1], axisP[2], rcCommand[0], rcCommand[1], "
    "rcCommand[2], rcCommand[3], setpoint[0], setpoint[1], setpoint[2], setpoint[3], "
    "vbatLatest (V), amperageLatest (A), rssi, gyroADC[0], gyroADC[1], gyroADC[2], "
    "accSmooth[0], accSmooth[1], accSmooth[2], debug[0], motor[0], motor[1], motor[2], "
    "motor[3], eRPM[0], eRPM[1], eRPM[2], eRPM[3], energyCumulative (mAh), "
    "flightModeFlags (flags), stateFlags (flags), failsafePhase (flags), rxSignalReceived"
)


def write_blackbox(
    path, span=(0.0, 20.0), rate=1000.0, full_thrust=30.0, poles=14, gain=1, tenfold=1, source=fly
):
    """A CSV as `blackbox_decode` prints it: whole deg/s, hundreds of electrical turns a minute.

    `gain` is 10 under blackbox_high_resolution, and `tenfold` 10 where the tool turns the
    firmware's 10 mV into "volts" by a tenth.
    """
    truth = source(np.arange(span[0], span[1], 1 / rate))
    degrees = np.rad2deg(1.0)
    gyro = np.round(truth.rate * degrees * gain).astype(int)
    wanted = np.round(truth.cmd_rate * degrees * gain).astype(int)
    throttle = np.round(truth.thrust / full_thrust * 1000).astype(int)
    acc = np.round(truth.acc / 9.81 * 2048).astype(int)
    # Betaflight: rear right, front right, rear left, front left.
    erpm = truth.motor[:, [1, 0, 2, 3]] * 60 / (2 * np.pi) * poles / 2 / 100
    erpm = np.round(erpm).astype(int)
    lines = [BLACKBOX_HEADER]
    for k in range(len(truth.time)):
        time_us = 52_000_000 + round(truth.time[k] * 1e6)
        cells = [k, time_us, 1, -2, 3, 0, 0, 0, 1500, *wanted[k], throttle[k]]
        cells += [f"{tenfold * truth.voltage[k]:.1f}", "12.34", 785, *gyro[k], *acc[k], -5]
        cells += [900, 900, 900, 900, *erpm[k], 12, "ANGLE_MODE|AIR_MODE", "SMALL_ANGLE", "IDLE", 1]
        lines.append(", ".join(f"{cell:>3}" for cell in cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_mocap(
    path, span=(0.0, 20.0), rate=120.0, offset=0.0, drift=0.0, noise=0.0, turn=None, source=fly
):
    """Poses at flight times `span` on another clock: flight = offset + (1 + drift) * its time."""
    time = np.arange(span[0], span[1], 1 / rate)
    truth = source(time)
    rng = np.random.default_rng(7)
    rot = Rotation.from_matrix(truth.rot)
    if turn is not None:
        rot = rot * turn
    rot = rot * Rotation.from_rotvec(noise * rng.normal(size=(len(time), 3)))
    parts = {"time": (time - offset) / (1 + drift), "pos": truth.pos}
    return write(path, parts | {"quat": rot.as_quat(scalar_first=True)})


def write_usd(
    path, span=(0.0, 8.0), rate=100.0, version=2, compressed=False, crc=True, full_thrust=30.0,
    source=fly,
):  # fmt: skip
    """A log of the uSD deck: one event at a fixed rate, one rare one, CRC at the end."""
    truth = source(np.arange(span[0], span[1], 1 / rate))
    degrees = np.rad2deg(1.0)
    columns = {}
    if compressed:
        for k, axis in enumerate("xyz"):
            columns[f"stateEstimateZ.{axis}(h)"] = np.round(truth.pos[:, k] * 1000).astype(int)
            columns[f"stateEstimateZ.v{axis}(h)"] = np.round(truth.vel[:, k] * 1000).astype(int)
        columns["stateEstimateZ.quat(I)"] = [pack_quaternion(q) for q in truth.quat]
        for name, k, sign in (("Roll", 0, 1), ("Pitch", 1, -1), ("Yaw", 2, 1)):
            milli = np.round(sign * truth.rate[:, k] * 1000).astype(int)
            columns[f"stateEstimateZ.rate{name}(h)"] = milli
    else:
        for k, axis in enumerate("xyz"):
            columns[f"stateEstimate.{axis}(f)"] = truth.pos[:, k]
            columns[f"stateEstimate.v{axis}(f)"] = truth.vel[:, k]
            columns[f"gyro.{axis}(f)"] = truth.rate[:, k] * degrees
            columns[f"acc.{axis}(f)"] = truth.acc[:, k] / 9.81
        for k, part in enumerate("wxyz"):
            columns[f"stateEstimate.q{part}(f)"] = truth.quat[:, k]
    wanted = truth.cmd_rate * degrees * [1, -1, 1]
    for k, name in enumerate(("rollRate", "pitchRate", "yawRate")):
        columns[f"controller.{name}(f)"] = wanted[:, k]
    columns["controller.cmd_thrust(f)"] = truth.thrust / full_thrust * 65535
    for k in range(4):
        rpm = np.round(truth.motor[:, k] * 60 / (2 * np.pi)).astype(int)
        columns[f"rpm.m{k + 1}(H)"] = rpm
    data = b"\xbc" + struct.pack("<HH", version, 2)
    data += struct.pack("<H", 7) + b"fixedFrequency\0" + struct.pack("<H", len(columns))
    data += b"".join(name.encode() + b"\0" for name in columns)
    data += struct.pack("<H", 9) + b"power\0" + struct.pack("<H", 1) + b"pm.vbat(f)\0"
    code = "<" + "".join(name[-2] for name in columns)
    stamp = (lambda t: struct.pack("<Q", round(t * 1e6) + 9_000_000)) if version == 2 else None
    stamp = stamp or (lambda t: struct.pack("<I", round(t * 1e3) + 9_000))
    for k, row in enumerate(zip(*columns.values(), strict=True)):
        data += struct.pack("<H", 7) + stamp(truth.time[k]) + struct.pack(code, *row)
        if k % 20 == 0:
            data += struct.pack("<H", 9) + stamp(truth.time[k])
            data += struct.pack("<f", truth.voltage[k])
    path.write_bytes(data + struct.pack("<I", crc32(data)) if crc else data)
    return path


def pack_quaternion(wxyz):
    """The firmware's 32-bit form of a quaternion: the largest of xyzw left out."""
    parts = [*wxyz[1:], wxyz[0]]
    largest = int(np.argmax(np.abs(parts)))
    word = largest
    for k in range(4):
        if k != largest:
            negative = (parts[k] < 0) != (parts[largest] < 0)
            size = int(511 * abs(parts[k]) / np.sqrt(0.5) + 0.5)
            word = (word << 10) | (int(negative) << 9) | size
    return word


def write_mcap(
    path, span=(0.0, 6.0), imu=200.0, odometry=100.0, command=50.0, full_thrust=30.0, source=fly,
    mask=0, pose=None,
):  # fmt: skip
    """ROS 2: odometry (twist in the body), imu, mavros' attitude target and motors, in MCAP.

    `pose` is the rate of a PoseStamped, if any [Hz].
    """
    from mcap_ros2.writer import Writer

    origin = 1_700_000_000 * 10**9

    def xyz(v):
        return dict(zip("xyz", map(float, v), strict=True))

    def quaternion(q):
        return dict(zip("wxyz", map(float, q), strict=True))

    with path.open("wb") as file:
        writer = Writer(file)

        def send(topics, name, rate, message_of):
            """Write a topic at a rate; each further topic has every tenth message of it."""
            files = [ROS_MESSAGES / f"{part}.msg" for part in (name.rpartition("/")[2], "parts")]
            schema = writer.register_msgdef(name, "".join(file.read_text() for file in files))
            truth = source(np.arange(span[0], span[1], 1 / rate))
            quats = truth.quat
            for k, t in enumerate(truth.time):
                when = origin + round(t * 1e9)
                stamp = {"sec": when // 10**9, "nanosec": when % 10**9}
                header = {"stamp": stamp, "frame_id": "odom"}
                message = {"header": header, **message_of(truth, k, quats[k])}
                for topic in topics[: None if k % 10 == 0 else 1]:
                    writer.write_message(topic, schema, message, when)

        def moving(truth, k, quat):
            body = truth.rot[k].T @ truth.vel[k]
            pose = {"position": xyz(truth.pos[k]), "orientation": quaternion(quat)}
            twist = {"linear": xyz(body), "angular": xyz(truth.rate[k])}
            return {
                "child_frame_id": "base_link",
                "pose": {"pose": pose, "covariance": [0.0] * 36},
                "twist": {"twist": twist, "covariance": [0.0] * 36},
            }

        def placed(truth, k, quat):
            return {"pose": moving(truth, k, quat)["pose"]["pose"]}

        def measured(truth, k, quat):
            names = ("orientation", "angular_velocity", "linear_acceleration")
            return {
                "orientation": quaternion([1, 0, 0, 0]),
                "angular_velocity": xyz(truth.rate[k]),
                "linear_acceleration": xyz(truth.acc[k]),
                **{f"{name}_covariance": [0.0] * 9 for name in names},
            }

        def wanted(truth, k, quat):
            return {
                "type_mask": mask,
                "orientation": quaternion(quat),
                "body_rate": xyz(truth.cmd_rate[k]),
                "thrust": float(truth.thrust[k] / full_thrust),
            }

        def turning(truth, k, quat):
            return {"velocity": [float(speed) for speed in truth.motor[k]]}

        topics = ["/odom", "/odom_slow"]
        send(topics, "nav_msgs/msg/Odometry", odometry, moving)
        if pose:
            send(["/pose"], "geometry_msgs/msg/PoseStamped", pose, placed)
        send(["/imu"], "sensor_msgs/msg/Imu", imu, measured)
        send(["/target"], "mavros_msgs/msg/AttitudeTarget", command, wanted)
        send(["/motors"], "actuator_msgs/msg/Actuators", command, turning)
        writer.finish()
    return path
