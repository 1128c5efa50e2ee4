"""Read ArduPilot's `.bin` logs with pymavlink (extra `mavlink`).

The vehicle's world is north-east-down and its body forward-right-down. Messages and units follow
ArduPilot's documentation of its log messages (Copter 4.x); the first one in the log is used.

| signal | messages |
|---|---|
| rate, acc | IMU (rad/s, m/s^2), of the lowest instance |
| quat | ATT (roll, pitch, yaw in deg) |
| pos, vel | XKF1, NKF1 (PN PE PD in m, VN VE VD in m/s), of the lowest core |
| cmd_rate | RATE (RDes PDes YDes in deg/s) |
| thrust | CTUN (ThO, 0 to 1: MOT_THST_EXPO and the battery's voltage are accounted for) |
| pwm | RCOU (pulses in us), the outputs that SERVOn_FUNCTION makes motors 1 to 4 |
| motor | ESC (RPM by instance, in the order of these outputs), where all four report |
| voltage | BAT (Volt) |
"""

from __future__ import annotations

import contextlib
import io
import os
import traceback
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from eval.importers.commands import SHARE
from eval.importers.formats.betaflight import MOTOR_SIDE as BETAFLIGHT_X
from eval.importers.formats.px4 import QUAD_X
from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN, from_euler
from eval.importers.options import ImportOptions
from eval.importers.signals import Part, Recording, collect
from eval.logs.columns import FlightLogError, damaged
from eval.logs.faults.drive.motors import check_count
from eval.logs.faults.finding import CUT, Finding
from eval.logs.faults.reading import DEG, RPM

SUMMARY = "ArduPilot log (.bin)"
TAKES_MAP = TAKES_SOURCE = False
"""The format has fixed names and a single pose, see `Format`."""
HEAD = b"\xa3\x95\x80"
"""First bytes of a log."""
MESSAGES = ("IMU", "ATT", "XKF1", "NKF1", "RATE", "CTUN", "RCOU", "ESC", "BAT", "PARM", "MSG")
"""Kinds of message that are read."""
OPEN_HANDLES = ("data_map", "filehandle")
"""Attributes of a pymavlink reader that must be closed."""
QUAD_PLUS = ((0.0, -1.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0))
"""Positions of motors 1 to 4 of a quadrotor plus (x forward, y left): right, left, front, rear."""
MOTOR_SIDES = {
    **dict.fromkeys((0, 6, 16), QUAD_PLUS),
    **dict.fromkeys((1, 2, 3, 17), QUAD_X),
    **dict.fromkeys((12, 18), BETAFLIGHT_X),
    13: ((1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)),
    14: ((1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)),
}
"""FRAME_TYPE of a quadrotor -> positions of motors 1 to 4 (ArduPilot's AP_MotorsMatrix.cpp)."""
INSTANCES = ("I", "C", "Inst", "Instance")
"""Columns with the number of the sensor, core or battery of a message."""
MOTOR_1 = 33
"""SERVOn_FUNCTION of motor 1; motors 2 to 4 have the next numbers."""
MISSING = "an ArduPilot log; pip install 'diffracing-suite[mavlink]' reads it"
"""Reason of the error if pymavlink is not installed."""

Rows = Mapping[str, np.ndarray]
"""The columns of one kind of message, by field name."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is an ArduPilot log."""
    return head.startswith(HEAD)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the log at `path`.

    Raises:
        FlightLogError: where the reader is not installed, or the file is not an ArduPilot log.
    """
    messages, parameters, about, findings = _load(path)
    parts: dict[str, Part] = {}

    def take(name: str, kinds: tuple[str, ...], columns: str, factor: Any) -> None:
        """Add a signal from the first message that has its columns."""
        names = columns.split()
        for kind in kinds:
            rows = messages.get(kind, {})
            if name not in parts and all(c in rows for c in ("TimeUS", *names)):
                value = np.stack([rows[c] for c in names], axis=1)
                parts[name] = (rows["TimeUS"] * 1e-6, value * factor)

    take("rate", ("IMU",), "GyrX GyrY GyrZ", HALF_TURN)
    take("acc", ("IMU",), "AccX AccY AccZ", HALF_TURN)
    take("quat", ("ATT",), "Roll Pitch Yaw", DEG)
    take("pos", ("XKF1", "NKF1"), "PN PE PD", HALF_TURN)
    take("vel", ("XKF1", "NKF1"), "VN VE VD", HALF_TURN)
    take("cmd_rate", ("RATE",), "RDes PDes YDes", DEG * HALF_TURN)
    take(SHARE, ("CTUN",), "ThO", 1.0)
    take("voltage", ("BAT",), "Volt", 1.0)
    if "quat" in parts:
        time_s, angles = parts["quat"]
        parts["quat"] = (time_s, from_euler(angles) * QUAT_HALF_TURN)
    outputs = _outputs(parameters)
    take("pwm", ("RCOU",), " ".join(f"C{k}" for k in outputs) if outputs else "-", 1.0)
    if "pwm" in parts:
        low, high = _pulse_range(parameters)
        time_s, pulse = parts["pwm"]
        parts["pwm"] = (time_s, np.clip((pulse - low) / (high - low), 0.0, 1.0))
        findings.append(Finding("note", "motors", f"pulses of {low:g} to {high:g} us are 0 to 1"))
    if "ESC" in messages:
        parts |= _motors(messages["ESC"], outputs, findings)
    frame_class = int(parameters.get("FRAME_CLASS", 1.0))
    if frame_class != 1:
        text = f"FRAME_CLASS is {frame_class}, not 1: no quadrotor"
        fault = ("motor_count", None, 0.95, "none: only quadrotors can be diagnosed")
        findings.append(Finding("doubt", "motors", text, *fault))
    frame_type = int(parameters.get("FRAME_TYPE", 1.0))
    if frame_type not in MOTOR_SIDES:
        text = f"the order of FRAME_TYPE {frame_type} is unknown; that of a quadrotor X is read"
        findings.append(Finding("note", "motors", text))
    motor_side = MOTOR_SIDES.get(frame_type, QUAD_X)
    signals, more_findings = collect(parts, str(path))
    return Recording(
        str(path), signals, (*findings, *more_findings), motor_side, about, has_seconds=True
    )


def _load(path: Path) -> tuple[dict[str, Rows], dict[str, float], dict[str, str], list[Finding]]:
    """Return columns by message, parameters, the log's metadata, and findings about the file."""
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError:
        raise FlightLogError(path, MISSING) from None

    class NoEmptyMessages(DFReader_binary):
        """Reader that rejects a message of no length, which pymavlink would read for ever."""

        def _parse_next(self) -> Any:
            before = self.offset
            message = super()._parse_next()
            if message is not None and self.offset <= before:
                raise ValueError(f"a message of 0 bytes at {before}")
            return message

    table: dict[str, list[dict[str, Any]]] = {name: [] for name in MESSAGES}
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
            _stderr_discarded(),
            contextlib.ExitStack() as opened,
        ):
            reader = NoEmptyMessages.__new__(NoEmptyMessages)
            # A constructor that fails on a damaged file leaves the file open.
            opened.push(partial(_close, reader))
            reader.__init__(str(path))
            while (message := reader.recv_match(type=list(MESSAGES))) is not None:
                table[message.get_type()].append(message.to_dict())
            findings = [Finding("note", "file", CUT)] if _is_cut(reader) else []
        parameters = {str(row["Name"]): float(row["Value"]) for row in table.pop("PARM")}
        texts = [str(row["Message"]) for row in table.pop("MSG")]
        messages = {name: _columns(rows, name) for name, rows in table.items() if rows}
    except Exception as error:  # a damaged file can cause any exception in the reader
        raise damaged(path, "an ArduPilot log", error) from None
    parameters = {name: value for name, value in parameters.items() if np.isfinite(value)}
    return messages, parameters, {"firmware": texts[0]} if texts else {}, findings


def _is_cut(reader: Any) -> bool:
    """Return whether the file ends within a message, or within its first three bytes."""
    kinds = (kind for kind in reader.formats if len(reader.offsets[kind]))
    end = max(reader.offsets[kind][-1] + reader.formats[kind].len for kind in kinds)
    return end > reader.data_len or 0 < reader.data_len - end < 3


@contextlib.contextmanager
def _stderr_discarded() -> Iterator[None]:
    """Discard what compiled code writes to standard error: one line per damaged byte."""
    try:
        stderr_copy = os.dup(2)
    except OSError:  # standard error is closed, so nothing can be written to it
        yield
        return
    try:
        with open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), 2)
        yield
    finally:
        os.dup2(stderr_copy, 2)
        os.close(stderr_copy)


def _close(reader: Any, kind: object, error: object, trace: TracebackType | None) -> None:
    """Close the files of a reader at the end of a context, also after an error."""
    # The frames of a failed constructor hold views of the memory map, which cannot close then.
    traceback.clear_frames(trace)
    for name in OPEN_HANDLES:
        if name in vars(reader):
            vars(reader)[name].close()


def _columns(rows: list[dict[str, Any]], name: str) -> Rows:
    """Return the numeric columns of a message: of its first instance or core, or of all ESCs."""
    if name != "ESC":
        key = next((k for k in INSTANCES if k in rows[0]), "")
        first = min(r.get(key, 0) for r in rows)
        rows = [r for r in rows if r.get(key, 0) == first]
    numeric = [k for k, v in rows[0].items() if isinstance(v, (int, float))]
    return {k: np.array([r.get(k, np.nan) for r in rows], dtype=np.float64) for k in numeric}


def _outputs(parameters: Mapping[str, float]) -> list[int]:
    """Return the outputs of motors 1 to 4: by default 1 to 4; [] if only some are assigned."""
    output_of = {parameters.get(f"SERVO{k}_FUNCTION"): k for k in range(14, 0, -1)}
    outputs = [output_of.get(float(MOTOR_1 + k)) for k in range(4)]
    assigned = [k for k in outputs if k is not None]
    if not assigned:
        return [1, 2, 3, 4]
    return assigned if len(assigned) == 4 else []


def _pulse_range(parameters: Mapping[str, float]) -> tuple[float, float]:
    """Return the pulses of no and of full output [us].

    Until Copter 4.0, MOT_PWM_MIN and MOT_PWM_MAX are 0 by default: the range is the throttle
    stick's.
    """
    ends = (("MIN", 1000.0), ("MAX", 2000.0))
    for prefix in ("MOT_PWM_", f"RC{parameters.get('RCMAP_THROTTLE', 3.0):.0f}_"):
        low, high = (parameters.get(prefix + end, default) for end, default in ends)
        if 0.0 < low < high:
            return low, high
    return 1000.0, 2000.0


def _motors(esc: Rows, outputs: list[int], findings: list[Finding]) -> dict[str, Part]:
    """Return rotor speeds [rad/s] of motors 1 to 4 on `outputs`, at the times of the first ESC.

    Motor controllers (ESCs) have instances in the order of their outputs.
    """
    name = "Instance" if "Instance" in esc else "I"
    instances = sorted(set(esc.get(name, np.zeros(0)).tolist()))
    findings += check_count(len(instances), "by the ESCs of the log")
    if len(instances) != 4 or not {"RPM", "TimeUS"} <= set(esc) or not np.any(esc["RPM"]):
        return {}
    order = np.argsort(np.argsort(outputs)) if outputs else range(4)
    rows_of = [esc[name] == instances[k] for k in order]
    time_s = esc["TimeUS"][rows_of[0]] * 1e-6
    speeds = [np.interp(time_s, esc["TimeUS"][rows] * 1e-6, esc["RPM"][rows]) for rows in rows_of]
    return {"motor": (time_s, np.stack(speeds, axis=1) * RPM)}
