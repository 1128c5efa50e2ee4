"""Blackbox logs of Betaflight: raw ones (`.bbl`, `.bfl`), and CSV files of `blackbox_decode`.

Betaflight's body is forward-left-up already: roll right, nose down and a turn to the left are
positive, in the gyro, the set points and the motor mixer alike. Rates are in deg/s, also where
the header names no unit (ten times that under `blackbox_high_resolution`, which the attitude shows:
`eval/logs/faults/vectors.py`). Units given to `blackbox_decode` stand in brackets after
a column's name.
Position and attitude are not logged: --pose brings them, or --partial does without.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.formats.blackbox import ACC_1G, MARKER, decode
from eval.importers.formats.table import numbers
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, collect
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding
from eval.logs.faults.motors import check_count
from eval.logs.files import first_line, read_columns, read_head

SUMMARY = "Blackbox log (.bbl, .bfl), or CSV of blackbox_decode; --pose or --partial"
TAKES_MAP = TAKES_SOURCE = False
MOTOR_SIDE = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
"""Motors 1 to 4 (x forward, y left): rear right, front right, rear left, front left."""
DSHOT, PULSES = (48.0, 2047.0), (1000.0, 2000.0)
"""Least and largest motor output, in steps of DShot or as pulses [us]."""
ABOUT = {"Firmware revision": "firmware", "Craft name": "craft", "Board information": "board"}
DEG = np.pi / 180.0
_ROTATION = {"": DEG, "deg/s": DEG, "rad/s": 1.0}
_ACCELERATION = {"": GRAVITY / ACC_1G, "g": GRAVITY, "m/s2": 1.0}
_TIME = {"": 1e-6, "us": 1e-6, "ms": 1e-3, "s": 1.0}
_VOLT = {"": 0.01, "V": 1.0, "mV": 1e-3}
"""Factors to our units by the unit in the header; raw voltages of Betaflight 4 are in 10 mV."""
LEAST_V, MOST_V = 2.5, 30.0
"""A higher voltage is ten times too large: `blackbox_decode` divides by ten to make volts, as was
right before Betaflight 4 (a quadrotor of more than seven cells and older firmware is rarer)."""
_UNIT = re.compile(r"^(?P<name>.*?)(?: \((?P<unit>[^()]*)\))?$")
_ERPM = re.compile(r"^eRPM(?:\(/100\))?\[(\d)\]$")


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is a Blackbox log, decoded or not."""
    if MARKER in head:
        return True
    # Blackbox Explorer writes the log's settings before the header.
    explorer = head.lstrip(b'\xef\xbb\xbf"').startswith(b'Product","Blackbox')
    line = first_line(head)
    return b"\0" not in line and (explorer or b"loopIteration" in line or b"gyroADC[" in line)


class Blackbox:
    """The columns of one file, found by name whatever their unit."""

    def __init__(self, path: Path) -> None:
        """Read the log at `path`, raw or as a table."""
        self.name = str(path)
        self.header: Mapping[str, Any] = {}
        self.findings: list[Finding] = []
        if MARKER in read_head(path):
            self.columns, self.header, findings = decode(path)
            self.findings += findings
        else:
            self.columns, _, warnings = read_columns(path)
            self.findings += [Finding("note", "file", text) for text in warnings]
        self._found: dict[str, tuple[str, str]] = {}
        for column in self.columns:
            match = _UNIT.match(column)
            if match:
                self._found[match["name"]] = (column, match["unit"] or "")

    def settings(self, name: str, given: tuple[float, ...]) -> tuple[float, ...]:
        """Return the numbers of a setting of the header, or `given` where it has others or none."""
        found = self.header.get(name)
        found = found if isinstance(found, (list, tuple)) else (found,)
        usable = tuple(one for one in found if isinstance(one, (int, float)) and np.isfinite(one))
        return usable if len(usable) == len(found) == len(given) else given

    def has(self, *names: str) -> bool:
        """Return whether all the columns are there."""
        return all(name in self._found for name in names)

    def unit(self, name: str) -> str:
        """Return the unit in a column's name, "" where there is none."""
        return self._found[name][1]

    def values(self, names: list[str], factor: Mapping[str, float]) -> np.ndarray:
        """Return columns (N, C) in our unit.

        Raises:
            FlightLogError: for a column that is missing, of an unknown unit, or not of numbers.
        """
        out = []
        for name in names:
            if name not in self._found:
                raise FlightLogError(self.name, name, None, "missing; is this of blackbox_decode?")
            column, unit = self._found[name]
            if unit not in factor:
                known = ", ".join(repr(u) for u in factor if u)
                raise FlightLogError(self.name, column, None, f"unit {unit!r}, not of {known}")
            values = np.asarray(self.columns[column])
            if name == "time":
                # Frames that could not be decoded have an X for their time.
                values = np.array([None if v == "X" else v for v in values.tolist()])
            out.append(numbers({column: values}, column, self.name) * factor[unit])
        return np.stack(out, axis=1)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the log at `path`; its motors have `options.motor_poles` magnets.

    Raises:
        FlightLogError: where a column of every Betaflight log is missing or unusable.
    """
    box = Blackbox(path)
    findings = list(box.findings)
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
        text = "no setpoint columns: sticks are not rates, so there is no rate command"
        findings.append(Finding("doubt", "command", text))
    if box.has("vbatLatest"):
        unit = box.unit("vbatLatest")
        parts["voltage"] = _volts(box.values(["vbatLatest"], _VOLT), unit, options.fix, findings)
    poles = int(box.settings("motor_poles", (options.motor_poles,))[0])
    parts |= _motors(box, poles if options.motor_poles == 14 else options.motor_poles, findings)
    parts |= _outputs(box, findings)
    signals, more = collect({name: (time_s, value) for name, value in parts.items()}, box.name)
    about = {ours: str(box.header[key]) for key, ours in ABOUT.items() if box.header.get(key)}
    return Recording(box.name, signals, (*findings, *more), MOTOR_SIDE, about)


def _volts(voltage: np.ndarray, unit: str, fix: bool, findings: list[Finding]) -> np.ndarray:
    middle = float(np.nanmedian(voltage)) if np.isfinite(voltage).any() else 0.0
    raw = voltage / _VOLT[""]
    whole = np.all(np.mod(raw[np.isfinite(raw)], 1.0) == 0.0)
    if not unit and not whole and LEAST_V <= 100.0 * middle <= MOST_V:
        text = f"numbers around {100.0 * middle:.3g}, not whole and without a unit: they are volts"
        about = ("voltage", middle, 0.95)
        findings.append(Finding("corrected" if fix else "doubt", "voltage", text, *about))
        return 100.0 * voltage if fix else voltage
    if middle <= MOST_V:
        return voltage
    text = f"{middle:.4g} V in the file: ten times too much, as blackbox_decode writes Betaflight 4"
    about = ("voltage", middle, 0.95)
    findings.append(Finding("corrected" if fix else "doubt", "voltage", text, *about))
    return voltage / 10.0 if fix else voltage


def _outputs(box: Blackbox, findings: list[Finding]) -> dict[str, np.ndarray]:
    """Return motor commands from 0 to 1, by the range in the header or by DShot's."""
    names = [f"motor[{k}]" for k in range(4)]
    if not box.has(*names):
        return {}
    raw = box.values(names, {"": 1.0})
    low, high = box.settings("motorOutput", PULSES if np.nanmin(raw) >= PULSES[0] else DSHOT)
    if not high > low:
        return {}
    text = f"motor outputs from {low:g} to {high:g} are 0 to 1"
    findings.append(Finding("note", "motors", text))
    return {"pwm": np.clip((raw - low) / (high - low), 0.0, 1.0)}


def _motors(box: Blackbox, poles: int, findings: list[Finding]) -> dict[str, np.ndarray]:
    """Return rotor speeds [rad/s] from eRPM, which is logged in hundreds."""
    columns = {match[1]: c for c in box.columns if (match := _ERPM.match(c))}
    turning = [(numbers(box.columns, c, box.name) > 0.0).any() for c in columns.values()]
    findings += check_count(int(sum(turning)), "of the log")
    if not set(columns) >= set("0123"):
        return {}
    if poles < 2 or poles % 2:
        raise FlightLogError(box.name, None, None, f"motor_poles is {poles}: even, 2 or more")
    raw = [numbers(box.columns, columns[k], box.name) for k in "0123"]
    turns_per_s = np.stack(raw, axis=1) * 100.0 / (poles / 2) / 60.0
    text = f"rotor speeds from eRPM of motors with {poles} poles (--motor-poles)"
    findings.append(Finding("note", "motors", text))
    return {"motor": 2.0 * np.pi * turns_per_s}
