"""ArduPilot's `.bin` logs, read by pymavlink (extra `mavlink`).

The vehicle's world is north-east-down and its body forward-right-down. Messages and units as in
ArduPilot's documentation of its log messages (Copter 4.x); the first that is there is taken.

| signal | messages |
|---|---|
| rate, acc | IMU (rad/s, m/s^2), of the first instance |
| quat | ATT (roll, pitch, yaw in deg) |
| pos, vel | XKF1, NKF1 (PN PE PD in m, VN VE VD in m/s), of the first core |
| cmd_rate | RATE (RDes PDes YDes in deg/s) |
| throttle | CTUN (ThO, 0 to 1) |
| pwm | RCOU (pulses in us), the outputs that SERVOn_FUNCTION makes motors 1 to 4 |
| motor | ESC (RPM by instance), where all four report |
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

from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN, from_euler
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, collect
from eval.logs.columns import FlightLogError, quoted
from eval.logs.faults.finding import Finding
from eval.logs.faults.motors import check_count

SUMMARY = "ArduPilot log (.bin)"
TAKES_MAP = TAKES_SOURCE = False
HEAD = b"\xa3\x95\x80"
MESSAGES = ("IMU", "ATT", "XKF1", "NKF1", "RATE", "CTUN", "RCOU", "ESC", "BAT", "PARM", "MSG")
HELD = ("data_map", "filehandle")
"""What a reader of pymavlink has open."""
QUAD_X = ((1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0))
"""Motors 1 to 4 of a quadrotor X (x forward, y left): front right, rear left, front left, rear
right."""
QUAD_PLUS = ((0.0, -1.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0))
"""The same of a plus: right, left, front, rear."""
MOTOR_1 = 33
"""SERVOn_FUNCTION of motor 1; the others follow, 82 and up from motor 9 on."""
DEG, RPM = np.pi / 180.0, np.pi / 30.0
MISSING = "an ArduPilot log; pip install 'diffracing-suite[mavlink]' reads it"

Rows = Mapping[str, np.ndarray]
"""The columns of one message."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is an ArduPilot log."""
    return head.startswith(HEAD)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the log at `path`.

    Raises:
        FlightLogError: where the reader is not installed, or it is no such log.
    """
    messages, parameters, about = _load(path)
    findings: list[Finding] = []
    parts: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def take(name: str, kinds: tuple[str, ...], columns: str, factor: Any) -> None:
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
    take("throttle", ("CTUN",), "ThO", 1.0)
    take("voltage", ("BAT",), "Volt", 1.0)
    if "quat" in parts:
        time_s, angles = parts["quat"]
        parts["quat"] = (time_s, from_euler(angles) * QUAT_HALF_TURN)
    outputs = _outputs(parameters)
    take("pwm", ("RCOU",), " ".join(f"C{k}" for k in outputs) if outputs else "-", 1.0)
    if "pwm" in parts:
        low, high = (parameters.get(f"MOT_PWM_{end}") or default
                     for end, default in (("MIN", 1000.0), ("MAX", 2000.0)))  # fmt: skip
        low, high = (low, high) if high > low else (1000.0, 2000.0)
        time_s, pulse = parts["pwm"]
        parts["pwm"] = (time_s, np.clip((pulse - low) / (high - low), 0.0, 1.0))
        findings.append(Finding("note", "motors", f"pulses of {low:g} to {high:g} us are 0 to 1"))
    if "ESC" in messages:
        parts |= _motors(messages["ESC"], findings)
    kind = int(parameters.get("FRAME_CLASS", 1.0))
    if kind != 1:
        text = f"FRAME_CLASS is {kind}, not 1: no quadrotor"
        about_it = ("motor_count", None, 0.95, "none: only quadrotors can be diagnosed")
        findings.append(Finding("doubt", "motors", text, *about_it))
    side = QUAD_PLUS if parameters.get("FRAME_TYPE", 1.0) == 0.0 else QUAD_X
    signals, more = collect(parts, str(path))
    return Recording(str(path), signals, (*findings, *more), side, about)


def _load(path: Path) -> tuple[dict[str, Rows], dict[str, float], dict[str, str]]:
    """Return columns by message, parameters, and the log's metadata."""
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError:
        raise FlightLogError(str(path), None, None, MISSING) from None

    class Forward(DFReader_binary):
        """Refuses a message without a length, which the reader would read again for ever."""

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
            _native_lines_dropped(),
            contextlib.ExitStack() as opened,
        ):
            reader = Forward.__new__(Forward)
            # Where a damaged file ends its constructor, it leaves the file open.
            opened.push(partial(_close, reader))
            reader.__init__(str(path))
            while (message := reader.recv_match(type=list(MESSAGES))) is not None:
                table[message.get_type()].append(message.to_dict())
        parameters = {str(one["Name"]): float(one["Value"]) for one in table.pop("PARM")}
        texts = [str(one["Message"]) for one in table.pop("MSG")]
        messages = {name: _columns(rows, name) for name, rows in table.items() if rows}
    except Exception as error:  # whatever a damaged file makes of the reader
        reason = f"an ArduPilot log that cannot be read ({quoted(error)})"
        raise FlightLogError(str(path), None, None, reason) from None
    parameters = {name: value for name, value in parameters.items() if np.isfinite(value)}
    return messages, parameters, {"firmware": texts[0]} if texts else {}


@contextlib.contextmanager
def _native_lines_dropped() -> Iterator[None]:
    """Drop what compiled code writes to standard error: the reader's, a line a damaged byte."""
    try:
        kept = os.dup(2)
    except OSError:  # closed: nothing can be written there
        yield
        return
    try:
        with open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _close(reader: Any, kind: object, error: object, trace: TracebackType | None) -> None:
    """Close what a reader has open, at the end of a context that may end with an error."""
    # The frames of a failed constructor hold views of its map, which keep that from closing.
    traceback.clear_frames(trace)
    for name in HELD:
        if name in vars(reader):
            vars(reader)[name].close()


def _columns(rows: list[dict[str, Any]], name: str) -> Rows:
    """Return a message's numbers by column, of its first instance or core; of all ESCs."""
    first = [r for r in rows if not r.get("I", r.get("C", 0))] if name != "ESC" else rows
    rows = first or rows
    numbers = [k for k, v in rows[0].items() if isinstance(v, (int, float))]
    return {k: np.array([r.get(k, np.nan) for r in rows], dtype=np.float64) for k in numbers}


def _outputs(parameters: Mapping[str, float]) -> list[int]:
    """Return the outputs of motors 1 to 4; the first four where the log has no assignment."""
    by = {parameters.get(f"SERVO{k}_FUNCTION"): k for k in range(14, 0, -1)}
    wired = [by.get(float(MOTOR_1 + k)) for k in range(4)]
    found = [k for k in wired if k is not None]
    return found if len(found) == 4 else [] if any(wired) else [1, 2, 3, 4]


def _motors(esc: Rows, findings: list[Finding]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return rotor speeds [rad/s] at the times of the first ESC, by lines between the others'."""
    name = "Instance" if "Instance" in esc else "I"
    numbers = sorted(set(esc.get(name, np.zeros(0)).tolist()))
    findings += check_count(len(numbers), "by the ESCs of the log")
    if len(numbers) != 4 or not {"RPM", "TimeUS"} <= set(esc) or not np.any(esc["RPM"]):
        return {}
    each = [esc[name] == k for k in numbers]
    time_s = esc["TimeUS"][each[0]] * 1e-6
    speed = [np.interp(time_s, esc["TimeUS"][one] * 1e-6, esc["RPM"][one]) for one in each]
    return {"motor": (time_s, np.stack(speed, axis=1) * RPM)}
