"""Raw logs of Betaflight and ArduPilot of the known flight, written message by message."""

import struct

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import foreign_logs as made

FIELDS = (
    *("loopIteration", "time", *(f"gyroADC[{k}]" for k in range(3))),
    *(f"setpoint[{k}]" for k in range(4)),
    *(f"accSmooth[{k}]" for k in range(3)),
    *("vbatLatest", *(f"motor[{k}]" for k in range(4)), *(f"eRPM[{k}]" for k in range(4))),
)


def write_raw(path, truth, fine=10, poles=12):
    """Write a raw Blackbox log of whole (I) frames, each field as a zigzag variable byte."""
    degrees = np.rad2deg(1.0)
    erpm = truth.motor[:, [1, 0, 2, 3]] * 60 / (2 * np.pi) * poles / 2 / 100
    columns = [
        np.arange(len(truth.time)),
        52e6 + truth.time * 1e6,
        *(truth.rate * degrees * fine).T,
        *(truth.cmd_rate * degrees * fine).T,
        truth.thrust / 30.0 * 1000.0,
        *(truth.acc / 9.81 * 4096.0).T,
        truth.voltage * 100.0,
        *(48.0 + 1999.0 * truth.motor[:, [1, 0, 2, 3]] / 2100.0).T,
        *erpm.T,
    ]
    head = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock",
        "Data version": 2,
        "Field I name": ",".join(FIELDS),
        "Field I signed": ",".join("1" for _ in FIELDS),
        **{f"Field {kind} predictor": ",".join("0" for _ in FIELDS) for kind in "IP"},
        **{f"Field {kind} encoding": ",".join("0" for _ in FIELDS) for kind in "IP"},
        "Firmware revision": "Betaflight 4.5.1 (77d01ba3b) STM32F7X2",
        **{"acc_1G": 4096, "motor_poles": poles, "motorOutput": "158,2047"},
        "blackbox_high_resolution": int(fine == 10),
    }
    data = bytearray("".join(f"H {key}:{value}\n" for key, value in head.items()).encode())
    for row in np.round(np.column_stack(columns)).astype(int).tolist():
        data += b"I"
        for value in row:
            left = (value << 1) ^ (value >> 63)
            while left > 127:
                data.append(left & 127 | 128)
                left >>= 7
            data.append(left)
    path.write_bytes(bytes(data) + b"E\xffEnd of log\0")
    return path


ARDUPILOT = {
    "PARM": (1, "QNff", "TimeUS,Name,Value,Default"),
    "IMU": (2, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RATE": (3, "Qfff", "TimeUS,RDes,PDes,YDes"),
    "RCOU": (4, "QHHHH", "TimeUS,C1,C2,C3,C4"),
    "ESC": (5, "QBf", "TimeUS,Instance,RPM"),
    "BAT": (6, "QBf", "TimeUS,Inst,Volt"),
    "CTUN": (7, "Qf", "TimeUS,ThO"),
    "ATT": (8, "Qfff", "TimeUS,Roll,Pitch,Yaw"),
    "XKF1": (9, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD"),
}
TYPES = {"Q": "Q", "N": "16s", "f": "f", "B": "B", "H": "H"}


def write_bin(path, truth, pose=False, frame_type=1, lowest=0):
    """Write ArduPilot's .bin: messages are two bytes, their number, and their packed columns.

    `lowest` is the first instance of IMU and battery.
    """
    data = bytearray()

    def put(number, layout, *values):
        data.extend(b"\xa3\x95" + struct.pack(f"<B{layout}", number, *values))

    put(128, "BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for name, (number, kinds, columns) in ARDUPILOT.items():
        size = 3 + struct.calcsize("<" + "".join(TYPES[k] for k in kinds))
        put(128, "BB4s16s64s", number, size, name.encode(), kinds.encode(), columns.encode())

    def send(name, *values):
        number, kinds, _ = ARDUPILOT[name]
        put(number, "".join(TYPES[k] for k in kinds), *values)

    for output, motor in enumerate((36, 33, 34, 35), start=1):
        send("PARM", 0, f"SERVO{output}_FUNCTION".encode(), motor, 0.0)
    send("PARM", 0, b"MOT_PWM_MIN", 1100, 1000)
    send("PARM", 0, b"FRAME_TYPE", frame_type, 1)
    flip, motors = np.array([1.0, -1.0, -1.0]), truth.motor[:, [0, 2, 3, 1]]
    ned, angles = made.ned(truth.pos), _angles(truth)
    for k, t in enumerate((truth.time * 1e6).astype(int) + 7_000_000):
        send("IMU", t, lowest, *(truth.rate[k] * flip), *(truth.acc[k] * flip))
        send("IMU", t, lowest + 1, *np.zeros(6))
        send("RATE", t, *np.rad2deg(truth.cmd_rate[k] * flip))
        pulse = np.round(1100 + 900 * motors[k] / 2100).astype(int)
        send("RCOU", t, *pulse[[3, 0, 1, 2]])
        for esc, motor in enumerate((3, 0, 1, 2)):  # in the order of the outputs
            send("ESC", t, esc, motors[k, motor] * 30 / np.pi)
        send("BAT", t, lowest, truth.voltage[k])
        send("BAT", t, lowest + 1, 5.0)
        send("CTUN", t, truth.thrust[k] / 30.0)
        if pose:
            send("ATT", t, *angles[k])
            send("XKF1", t, 0, *made.ned(truth.vel[k]), *ned[k])
    path.write_bytes(bytes(data))
    return path


def _angles(truth):
    quat = Rotation.from_quat(made.ned_quat(truth), scalar_first=True)
    return quat.as_euler("ZYX", degrees=True)[:, ::-1]
