"""From a recording to a checked flight log: the part that all formats share."""

from __future__ import annotations

import numpy as np

from eval.importers.checks.attitude import check_attitude
from eval.importers.checks.motion import (
    check_accelerometer,
    check_frames,
    check_rate_command,
    check_velocity,
)
from eval.importers.checks.units import check_units
from eval.importers.findings import Finding, said
from eval.importers.motors import order_motors
from eval.importers.options import ImportOptions
from eval.importers.rows import HOLE_S, HOLE_STEPS, NEEDED, own_rows, row_times, rows_at, slowest
from eval.importers.signals import Recording, median_step
from eval.importers.thrust import thrust_command
from eval.logs.columns import GROUPS, FlightLogError
from eval.logs.flight_log import FlightLog, log_from_columns

SLOW_HZ = 40.0
"""Signals that come more rarely than this are worth a word."""
TEXTS = {
    "pos": "position",
    "quat": "attitude",
    "rate": "gyro",
    "cmd_rate": "rate command",
    "motor": "motors",
}
"""Signals whose rate counts, in words."""


def assemble(
    recording: Recording, format: str, options: ImportOptions
) -> tuple[FlightLog, tuple[Finding, ...]]:
    """Return `recording` as a flight log, and what its checks found.

    Raises:
        FlightLogError: where something a log needs is missing or breaks a rule.
    """
    findings = list(recording.findings)
    if options.pose is not None:
        from eval.importers.pose import with_pose

        recording, more = with_pose(recording, options)
        findings += more
    _need(recording)
    recording, more = check_units(recording, options.fix)
    findings += more
    time_s = row_times(recording, options.rate_hz, options.start_s, options.end_s)
    findings += _rates(recording, time_s)
    rows = rows_at(recording, time_s)
    findings += check_attitude(rows, options.fix)
    findings += check_velocity(rows, options.fix)
    findings += check_frames(rows, options.fix)
    findings += check_accelerometer(rows, options.fix)
    findings += check_rate_command(rows, options.fix)
    findings += order_motors(rows, recording.motor_side, options.vehicle)
    findings += thrust_command(rows, options)
    findings += _pair(rows)
    for name, own in own_rows(recording, time_s).items():
        rows[name] = np.where(own[:, None], rows[name], np.nan)
    columns = _columns(rows)
    if "cmd_thrust" not in columns and "motor_1" not in columns:
        lines = "".join(f"\n{line}" for line in said(tuple(findings)))
        reason = f"neither a thrust and rate command nor motor speeds could be read{lines}"
        raise FlightLogError(recording.name, None, None, reason)
    about = {
        **recording.about,
        "source": format,
        "imported_from": recording.name.replace("\\", "/").rsplit("/", 1)[-1],
        "findings": [finding._asdict() for finding in findings],
    }
    if options.vehicle is not None:
        about["vehicle"] = options.vehicle.name
    log = log_from_columns(columns, about, recording.name)
    return log, tuple(findings)


def _need(recording: Recording) -> None:
    missing = [TEXTS[name] for name in NEEDED if name not in recording.signals]
    if missing:
        hint = "" if missing == ["gyro"] else "; --pose FILE brings position and attitude"
        reason = f"holds no {' and no '.join(missing)}{hint}"
        raise FlightLogError(recording.name, None, None, reason)


def _rates(recording: Recording, time_s: np.ndarray) -> list[Finding]:
    """Say what sets the rows, which signals are slow, and where holes are."""
    name = slowest(recording)
    every = f"at {1.0 / median_step(time_s):.3g} Hz, by the {TEXTS[name]}"
    findings = [Finding("note", "rows", every)]
    for name, subject in TEXTS.items():
        if name not in recording.signals:
            continue
        times = recording.signals[name].time_s
        step = median_step(times)
        if step > 1.0 / SLOW_HZ:
            text = f"comes at {1 / step:.3g} Hz only; log it faster where you can"
            findings.append(Finding("note", subject, text))
        holes = int(np.sum(np.diff(times) > max(HOLE_S, HOLE_STEPS * step)))
        if holes:
            longest = float(np.max(np.diff(times)))
            text = f"{holes} holes, the longest {longest:.2g} s: left empty"
            findings.append(Finding("note", subject, text))
    return findings


def _pair(rows: dict[str, np.ndarray]) -> list[Finding]:
    """Leave out half a command, in place: a thrust without rates, or rates without a thrust."""
    for one, other in (("cmd_thrust", "cmd_rate"), ("cmd_rate", "cmd_thrust")):
        if one in rows and other not in rows:
            del rows[one]
            return [Finding("note", "command", f"{one} is left out, as {other} is not there")]
    return []


def _columns(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    columns = {"time": rows["time"]}
    for group, names in GROUPS.items():
        if group != "time" and group in rows:
            columns |= dict(zip(names, rows[group].T, strict=True))
    if "throttle" in rows:
        columns["throttle"] = rows["throttle"][:, 0]
    return columns
