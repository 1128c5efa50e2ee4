"""Read Blackbox logs of Betaflight: raw (`.bbl`, `.bfl`), or CSV files of `blackbox_decode`.

betaflight-chirp-core (Apache-2.0) decodes raw logs. Betaflight's body frame is forward-left-up
already: roll right, nose down and yaw left are positive in the gyro, the set points and the motor
mixer. Rates are in deg/s, also where the header names no unit. CSV files under
`blackbox_high_resolution` are in 0.1 deg/s, which a comparison with the attitude detects
(`eval/logs/faults/vectors.py`). Units that `blackbox_decode` was set to are in brackets after a
column's name. Position and attitude are not logged: --pose adds them, or --partial imports the log
without.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.formats.table import numbers
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, collect
from eval.logs.columns import FlightLogError, damaged
from eval.logs.faults.drive.motors import check_count
from eval.logs.faults.finding import Finding
from eval.logs.faults.reading import DEG
from eval.logs.files import first_line, read_columns, read_head
from eval.quadrotor.loops.betaflight import Settings

SUMMARY = "Blackbox log (.bbl, .bfl), or CSV of blackbox_decode; --pose or --partial"
TAKES_MAP = TAKES_SOURCE = False
"""The format has fixed names and no pose, see `Format`."""
MARKER = b"H Product:Blackbox"
"""Text that begins the header of each raw log in a file."""
ACC_1G = 2048.0
"""Raw counts of accSmooth per g, on all boards of Betaflight 4."""
MISSING = (
    "a raw Blackbox log; pip install 'diffracing-suite[blackbox]' reads it, or decode it with "
    "blackbox_decode and import the CSV"
)
"""Reason of the error if the decoder is not installed."""
MOTOR_SIDE = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
"""Motors 1 to 4 (x forward, y left): rear right, front right, rear left, front left."""
DSHOT, PULSES = (48.0, 2047.0), (1000.0, 2000.0)
"""Least and largest motor output, in steps of DShot or as pulses [us]."""
ABOUT = {"Firmware revision": "firmware", "Craft name": "craft", "Board information": "board"}
"""Entry of the log's header -> key in the flight log's metadata."""
_ROTATION = {"": DEG, "deg/s": DEG, "rad/s": 1.0}
_ACCELERATION = {"": GRAVITY / ACC_1G, "g": GRAVITY, "m/s/s": 1.0}
_TIME = {"": 1e-6, "us": 1e-6, "ms": 1e-3, "s": 1.0}
_VOLT = {"": 0.01, "V": 1.0, "mV": 1e-3}
"""Unit in a column's name -> factor to the suite's unit, for each quantity; "" is a column without
a unit. Raw voltages of Betaflight 4 are in 10 mV."""
LEAST_V, MOST_V = 2.5, 30.0
"""Range of plausible voltages [V]. A higher voltage is taken as ten times too large, because
`blackbox_decode` divides by ten to make volts, which was right before Betaflight 4 only. A battery
with more than seven cells is rarer than this error."""
_UNIT = re.compile(r"^(?P<name>.*?)(?: \((?P<unit>[^()]*)\))?$")
"""Pattern of a column's name, with its unit in brackets, if any."""
_ERPM = re.compile(r"^eRPM(?:\(/100\))?\[(\d)\]$")
"""Pattern of the name of a column with a motor's eRPM."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is a Blackbox log, decoded or not."""
    if MARKER in head:
        return True
    # Blackbox Explorer writes the log's settings before the header.
    explorer = head.lstrip(b'\xef\xbb\xbf"').startswith(b'Product","Blackbox')
    line = first_line(head)
    return b"\0" not in line and (explorer or b"loopIteration" in line or b"gyroADC[" in line)


class Blackbox:
    """The columns of one file, selected by their name without the unit."""

    def __init__(self, path: Path) -> None:
        """Read the log at `path`, raw or as a table."""
        self.name = str(path)
        self.header: Mapping[str, Any] = {}
        if MARKER in read_head(path):
            self.columns, self.header, self.findings = decode(path)
        else:
            self.columns, _, warnings = read_columns(path)
            self.findings = [Finding("note", "file", text) for text in warnings]
        self.units: dict[str, tuple[str, str]] = {}  # name without unit -> full name, unit
        for column in self.columns:
            if match := _UNIT.match(column):
                self.units[match["name"]] = (column, match["unit"] or "")

    def settings(self, name: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return the numbers of a header setting, or `default` if it has not as many numbers."""
        setting = self.header.get(name)
        entries = setting if isinstance(setting, (list, tuple)) else (setting,)
        values = tuple(v for v in entries if isinstance(v, (int, float)) and np.isfinite(v))
        return values if len(values) == len(entries) == len(default) else default

    def has(self, *names: str) -> bool:
        """Return whether the file has all these columns."""
        return all(name in self.units for name in names)

    def values(self, names: list[str], factor: Mapping[str, float]) -> np.ndarray:
        """Return the columns `names` (without units) times their units' factors, (N, C).

        Raises:
            FlightLogError: for a column that is missing, has an unknown unit, or is not numeric.
        """
        out = []
        for name in names:
            if name not in self.units:
                reason = "missing; was the file made by blackbox_decode?"
                raise FlightLogError(self.name, reason, name)
            column, unit = self.units[name]
            if unit not in factor:
                known = ", ".join(repr(u) for u in factor if u)
                raise FlightLogError(self.name, f"has the unit {unit!r}; known are {known}", column)
            values = np.asarray(self.columns[column])
            if name == "time":
                # Frames that could not be decoded have an X as their time.
                values = np.array([None if v == "X" else v for v in values.tolist()])
            out.append(numbers({column: values}, column, self.name) * factor[unit])
        return np.stack(out, axis=1)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the log at `path`.

    Raises:
        FlightLogError: where a column of every Betaflight log is missing or unusable.
    """
    box = Blackbox(path)
    findings = box.findings
    time_s = box.values(["time"], _TIME)[:, 0]
    if np.isfinite(time_s).any():
        time_s = time_s - np.nanmin(time_s)
    axes = range(3)
    gyro = "gyroADC" if box.has("gyroADC[0]") or not box.has("gyroUnfilt[0]") else "gyroUnfilt"
    parts = {"rate": box.values([f"{gyro}[{k}]" for k in axes], _ROTATION)}
    if box.has(*(f"accSmooth[{k}]" for k in axes)):
        parts["acc"] = box.values([f"accSmooth[{k}]" for k in axes], _ACCELERATION)
    if box.has(*(f"setpoint[{k}]" for k in range(4))):
        parts["cmd_rate"] = box.values([f"setpoint[{k}]" for k in axes], {"": DEG, "deg/s": DEG})
        parts["throttle"] = box.values(["setpoint[3]"], {"": 1e-3})
    elif box.has("rcCommand[3]"):
        text = "no setpoint columns: stick positions are not rates, so there is no rate command"
        findings.append(Finding("doubt", "command", text))
    if box.has("vbatLatest"):
        _, unit = box.units["vbatLatest"]
        parts["voltage"] = _volts(box.values(["vbatLatest"], _VOLT), unit, options.fix, findings)
    poles = options.motor_poles
    if poles is None:
        poles = int(box.settings("motor_poles", (14,))[0])
    parts |= _motors(box, poles) | _outputs(box)
    signals, more_findings = collect(
        {name: (time_s, value) for name, value in parts.items()}, box.name
    )
    about: dict[str, Any] = {
        our_key: str(box.header[key]) for key, our_key in ABOUT.items() if box.header.get(key)
    }
    if loop := _controller(box):
        about["controller"] = {"kind": "betaflight", **loop}
    findings = (*findings, *more_findings)
    return Recording(box.name, signals, findings, MOTOR_SIDE, about, has_seconds=True)


def _controller(box: Blackbox) -> dict[str, float]:
    """Return the header's settings of the rate loop, named as in the vehicle file."""
    found = {field.name: box.settings(field.name, (nan,))[0] for field in fields(Settings)}
    # From 4.0 to 4.5, D begins at a d_min below the D of the header's PID, and grows to it.
    none = (nan,) * 3
    least_d, forward = box.settings("d_min", (0.0,) * 3), box.settings("ff_weight", none)
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        p, i, d = box.settings(f"{name}PID", none)
        d = least_d[axis] if 0.0 < least_d[axis] < d else d
        found |= {f"p_{name}": p, f"i_{name}": i, f"d_{name}": d}
        found[f"f_{name}"] = forward[axis]
    if box.settings("iterm_relax", (1.0,))[0] == 0.0:
        found["iterm_relax_cutoff"] = 0.0
    # Filters whose cutoff changes in flight have no setting in the vehicle file.
    changing = [f"{name}_static_hz" for name in ("gyro_lpf1", "dterm_lpf1")
                if box.settings(f"{name}_dyn_hz", (0.0, 0.0))[0] > 0.0]  # fmt: skip
    if found["rc_smoothing_setpoint_cutoff"] == 0.0:  # automatic
        changing.append("rc_smoothing_setpoint_cutoff")
    return {name: float(v) for name, v in found.items() if name not in changing and np.isfinite(v)}


def _volts(voltage: np.ndarray, unit: str, fix: bool, findings: list[Finding]) -> np.ndarray:
    """Return voltages [V], corrected if their size contradicts the unit of the column's name."""
    median_v = float(np.nanmedian(voltage)) if np.isfinite(voltage).any() else 0.0
    raw = voltage / _VOLT[""]
    integers = np.all(np.mod(raw[np.isfinite(raw)], 1.0) == 0.0)
    if not unit and not integers and LEAST_V <= 100.0 * median_v <= MOST_V:
        corrected = 100.0 * voltage
        text = f"numbers around {100.0 * median_v:.3g}, not integer and without a unit: volts"
    elif median_v <= MOST_V:
        return voltage
    else:
        corrected = voltage / 10.0
        text = f"{median_v:.4g} V in the file: 10 times too high (blackbox_decode of Betaflight 4)"
    status = "corrected" if fix else "doubt"
    findings.append(Finding(status, "voltage", text, "voltage", median_v, 0.95))
    return corrected if fix else voltage


def _outputs(box: Blackbox) -> dict[str, np.ndarray]:
    """Return motor commands from 0 to 1, the shares of the range of DShot or of pulses.

    The header's `motorOutput` begins at the motors' idle and ends at the pilot's limit, so its
    lower number shows the protocol only.
    """
    names = [f"motor[{k}]" for k in range(4)]
    if not box.has(*names):
        return {}
    raw = box.values(names, {"": 1.0})
    least, _ = box.settings("motorOutput", (float(np.nanmin(raw)), 0.0))
    low, high = PULSES if least >= PULSES[0] else DSHOT
    names = [f"motor[{k}]" for k in range(8) if box.has(f"motor[{k}]")]
    if len(names) > 4 and not any(_ERPM.match(column) for column in box.columns):
        is_on = np.any(box.values(names, {"": 1.0}) > low, axis=0)
        box.findings += check_count(int(np.sum(is_on)), "of the log")
    text = f"motor outputs from {low:g} to {high:g} are 0 to 1"
    box.findings.append(Finding("note", "motors", text))
    return {"pwm": np.clip((raw - low) / (high - low), 0.0, 1.0)}


def _motors(box: Blackbox, poles: int) -> dict[str, np.ndarray]:
    """Return rotor speeds [rad/s] from eRPM, which is logged in hundreds."""
    columns = {match[1]: c for c in box.columns if (match := _ERPM.match(c))}
    turning = [(numbers(box.columns, c, box.name) > 0.0).any() for c in columns.values()]
    box.findings += check_count(int(sum(turning)), "of the log")
    if not set(columns) >= set("0123"):
        return {}
    if poles < 2 or poles % 2:
        raise FlightLogError(box.name, f"motor_poles is {poles}; it must be even, 2 or more")
    raw = [numbers(box.columns, columns[k], box.name) for k in "0123"]
    turns_per_s = np.stack(raw, axis=1) * 100.0 / (poles / 2) / 60.0
    text = f"rotor speeds from eRPM of motors with {poles} poles (--motor-poles)"
    box.findings.append(Finding("note", "motors", text))
    return {"motor": 2.0 * np.pi * turns_per_s}


def decode(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], list[Finding]]:
    """Return the columns of the longest log of the raw file at `path`, its settings, and notes.

    The columns are named as by `blackbox_decode`; an unusual unit in brackets ends a name.

    Raises:
        FlightLogError: where the decoder is not installed, or nothing can be decoded.
    """
    try:
        from betaflight_chirp_core import decoder
    except ImportError:
        raise FlightLogError(path, MISSING) from None
    raw = path.read_bytes()
    findings = []
    try:
        sessions = decoder.split_sessions(raw)
        number, (start, end) = max(enumerate(sessions, start=1), key=lambda s: s[1][1] - s[1][0])
        parser = decoder.FlightLogParser(raw, start, end)
        parser.parse_header()
        parser.parse_data()
        if not parser.main_frames:
            raise ValueError("it has no frame; log again")
        if len(sessions) > 1:
            text = f"holds {len(sessions)} logs; the longest, number {number}, is read"
            findings.append(Finding("note", "file", text))
        if frames := int(parser.stats["total_corrupt_frames"]):
            text = f"{frames} frames are damaged (a slow memory card?) and left out"
            findings.append(Finding("note", "file", text))
        table = np.array(parser.main_frames, dtype=np.float64).T
        columns = dict(zip(parser.main_field_names, table, strict=True))
        return _in_units(columns, parser.sys_config), parser.sys_config, findings
    except Exception as error:  # a damaged file can cause any exception in the decoder
        raise damaged(path, "a Blackbox log", error) from None


def _in_units(columns: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns with rates in deg/s and accelerations in g."""
    counts_per_deg_s = 10.0 if header.get("blackbox_high_resolution") == 1 else 1.0
    counts_per_g = header.get("acc_1G")
    if not isinstance(counts_per_g, (int, float)) or counts_per_g <= 0:
        counts_per_g = ACC_1G
    out = {}
    for name, value in columns.items():
        stem = name.partition("[")[0]
        if stem in ("gyroADC", "gyroUnfilt") or (stem == "setpoint" and name != "setpoint[3]"):
            out[name] = value / counts_per_deg_s
        elif stem == "accSmooth":
            out[f"{name} (g)"] = value / counts_per_g
        else:
            out[name] = value
    return out
