"""All checks of a log, as pure functions; later checks rely on earlier ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.rows import HELD, continuous, held
from eval.importers.signals import Signal
from eval.logs.columns import GROUPS
from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.clocks.delay import check_clock
from eval.logs.faults.clocks.path import check_position_delay
from eval.logs.faults.clocks.stamps import check_pause, check_stamps, check_time, with_even_stamps
from eval.logs.faults.drive.commands import (
    check_controller_rate,
    check_gyro_scale,
    check_gyro_signs,
    check_rate_command,
    check_throttle,
    check_thrust_command,
)
from eval.logs.faults.drive.motor_map import check_motor_map
from eval.logs.faults.drive.motors import check_inertia, check_lift, check_motors
from eval.logs.faults.drive.telemetry import check_telemetry
from eval.logs.faults.finding import Finding, findings_of
from eval.logs.faults.heading import check_heading
from eval.logs.faults.pose import Rows, check_pose
from eval.logs.faults.position import check_clock_rate, check_height, check_jumps, jumps_of
from eval.logs.faults.reading import Readings, read_rows, readings_in
from eval.logs.faults.relation import interpolate
from eval.logs.faults.sensors import (
    check_accelerometer_bias,
    check_barometer,
    check_copy,
    check_still,
    check_velocity_mean,
    check_voltage,
)
from eval.logs.faults.vectors import check_accelerometer, check_gyro, check_velocity
from eval.logs.faults.vehicle import (
    LIFT,
    check_camera,
    check_controller,
    check_vehicle_name,
    check_vehicle_numbers,
    has_unusual_arms,
)
from eval.logs.flight_log import FlightLog, columns_from_log, log_from_columns
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.camera import Camera

LEAST_ROWS = 50
"""Least rows for any check."""
SLOWEST_S = 0.1
"""Largest time between rows at which the checks find faults [s]."""
QUARTER_DEG = 15.0
"""An angle within this of a quarter turn may be that of swapped axes [deg]."""
NOT_CHECKED = "not checked"
"""Subject of the note on a log with too few or too slow rows."""


@dataclass(frozen=True)
class CheckContext:
    """References for the checks of a log: what the log is compared with."""

    vehicle: Vehicle | None = None
    """The vehicle file; None: checks that need it are skipped."""
    policy_hz: float | None = None
    """Rate of the policy that flew [Hz]."""
    policy_camera: Camera | None = None
    """The policy's camera."""
    implausible: bool = False
    """Whether a vehicle file is given, but so implausible that no check uses it."""
    found: frozenset[str] = frozenset()
    """Faults that earlier checks of the log found."""


Check = Callable[[Rows, CheckContext], list[Finding]]
CLOCK: tuple[Check, ...] = (lambda rows, _: check_time(rows), lambda rows, _: check_stamps(rows))
"""Unit and evenness of the time, which all other checks need."""
POSE: tuple[Check, ...] = (
    lambda rows, _: check_copy(rows),
    lambda rows, _: check_still(rows),
    lambda rows, _: _check_pose(rows),
    lambda rows, against: [] if "attitude" in against.found else check_clock_rate(rows),
    lambda rows, against: [] if "attitude" in against.found else check_position_delay(rows),
    lambda rows, against: [] if "attitude" in against.found else check_heading(rows),
    lambda rows, against: [] if "attitude" in against.found else check_height(rows),
    lambda rows, _: check_gyro(rows),
    lambda rows, _: check_velocity(rows),
    lambda rows, _: check_velocity_mean(rows),
    lambda rows, against: check_accelerometer(rows, "body_frame" in against.found),
)
"""Position, attitude, rates, velocity and acceleration; each check relies on those before it."""
DRIVE: tuple[Check, ...] = (
    lambda rows, against: check_voltage(rows, against.vehicle),
    lambda rows, against: check_gyro_signs(rows, against.vehicle),
    lambda rows, against: check_gyro_scale(rows, against.vehicle),
    lambda rows, against: check_telemetry(rows, against.vehicle, "clock_offset" in against.found),
    lambda rows, against: check_motors(rows, against.vehicle),
    lambda rows, against: check_lift(rows, against.vehicle, against.implausible),
    lambda rows, against: _check_inertia(rows, against),
    lambda rows, _: check_throttle(rows),
    lambda rows, against: check_thrust_command(rows, against.vehicle),
    lambda rows, against: check_motor_map(rows, against.vehicle),
    lambda rows, against: _check_rate_command(rows, against),
    lambda rows, _: check_accelerometer_bias(rows),
    lambda rows, _: check_barometer(rows),
)
"""Motors, commands and other sensors."""


SIGNALS = {
    "time": "time",
    "attitude": "quat",
    "position": "pos",
    "velocity": "vel",
    "gyro": "rate",
    "accelerometer": "acc",
    "motors": "motor",
    "rotor speeds": "motor",
    "motor commands": "pwm",
    "throttle": "throttle",
    "rate command": "cmd_rate",
    "thrust command": "cmd_thrust",
    "voltage": "voltage",
}
"""Subject of a finding (`Finding.signal`) -> name of the signal in the rows."""


OF_VEHICLE_FILE = ("motor_map", "thrust_scale", "vehicle_inertia", "controller_settings")
"""Faults of the vehicle file, not of the log: with a vehicle file, only its own ones count."""


def run_checks(
    rows: Rows,
    checks: Sequence[Check],
    against: CheckContext,
    fix: bool,
    before: Sequence[Finding] = (),
) -> tuple[list[Finding], Readings, dict[str, np.ndarray]]:
    """Return the findings, the readings that correct certain faults, and the corrected rows.

    Rows are samples (T, C) by name, NaN where unknown, and `time` (T,). Each check gets the rows
    after the corrections of earlier ones; with `fix` these are reported as made, otherwise as
    doubts. `before` are findings of earlier checks on the same rows.
    """
    findings, readings, rows = [], (), dict(rows)
    if len(rows["time"]) < LEAST_ROWS:
        return findings, readings, rows
    # No vehicle has such a full thrust: `check_files` reports the file, and no check uses it.
    implausible = against.vehicle is not None and against.vehicle.full_thrust > LIFT[1] * GRAVITY
    against = replace(against, vehicle=None, implausible=True) if implausible else against
    trusted = dict(rows)
    if implausible and "throttle" in rows:
        trusted.pop("cmd_thrust", None)  # made of the throttle by that vehicle file
    for finding in before:
        trusted = _without_doubted(trusted, finding)
    for check in checks:
        for finding in check(trusted, against):
            if finding.status == "corrected":
                new_readings = readings_in(finding.fix)
                rows, trusted = read_rows(rows, new_readings), read_rows(trusted, new_readings)
                readings += new_readings
                finding = finding if fix else finding._replace(status="doubt")
            else:
                trusted = _without_doubted(trusted, finding)
            findings.append(finding)
            if finding.status in ("corrected", "doubt"):
                against = replace(against, found=against.found | {finding.fault})
    return findings, readings, rows


def _check_pose(rows: Rows) -> list[Finding]:
    """Return the findings on attitude and position.

    An attitude that fits at another time, or with another heading, has no other fault. Neither has
    a position whose heading is no quarter turn.
    """
    found = check_pose(rows)
    doubts = {f.fault for f in found if f.status in ("doubt", "corrected")}
    if "attitude" in doubts:
        for check in (check_position_delay, check_heading):
            if other := [f for f in check(rows) if f.is_open]:
                return other
        is_late = any(f.fault == "clock_offset" and f.is_open for f in check_clock(rows))
        return [] if is_late else found  # a later check reports the clock
    if "position_axes" in doubts:
        other = [f for f in check_heading(rows) if f.is_open]
        far = [abs(((f.size or 0.0) + 45.0) % 90.0 - 45.0) > QUARTER_DEG for f in other]
        return other if any(far) else found
    return found


def _check_inertia(rows: Rows, against: CheckContext) -> list[Finding]:
    """Return the finding on an inertia; `check_vehicle_numbers` reports arms in a wrong unit."""
    vehicle = against.vehicle
    return [] if vehicle and has_unusual_arms(vehicle) else check_inertia(rows, vehicle)


def _check_rate_command(rows: Rows, against: CheckContext) -> list[Finding]:
    """Return the findings on rate commands; a delay only if no other signal is late."""
    found = check_rate_command(rows, against.vehicle)
    is_late = "clock_offset" in against.found
    return [f for f in found if not is_late or f.fault != "command_delay"]


def _without_doubted(rows: dict[str, np.ndarray], finding: Finding) -> dict[str, np.ndarray]:
    """Return the rows for later checks, without the error of an open finding.

    Otherwise a later check would name a second fault for the same error. A signal with an open
    doubt is read as its fix says, or left out where the fix is no reading.
    """
    signal = SIGNALS.get(finding.signal)
    if finding.fault == "accelerometer_axes" and not {"pos", "quat"} <= rows.keys():
        return rows  # `check_gyro_signs` needs it to decide on the axes of the whole body
    if not finding.is_open or signal not in rows:
        return rows
    if readings := readings_in(finding.fix):
        return read_rows(rows, readings)
    if signal == "time":
        return with_even_stamps(rows) if finding.fault == "clock_jitter" else rows
    return {name: value for name, value in rows.items() if name != signal}


def check_log(
    log: FlightLog, against: CheckContext = CheckContext(), fix: bool = False
) -> tuple[list[Finding], Readings]:
    """Return the faults of a flight log, and the readings that correct them.

    Stored findings of an import are repeated, unless a check finds the same fault again, or they
    are of the import's vehicle file and `against` has one.
    """
    checks = (*CLOCK, *POSE, lambda rows, given: check_clock(rows, given.vehicle), *DRIVE)
    rows = rows_of(log)
    findings, readings, _ = run_checks(rows, checks, against, fix)
    action = {} if log.action_b is None else {"action": log.action_b}
    measured = {"time": log.time_s, **action, **signals_of(columns_from_log(log))}
    measured = read_rows(measured, readings)
    findings += check_controller_rate(measured, against.policy_hz)
    time_s = measured["time"]
    if "pos" in measured:
        # Between stamps that jitter, a usual step seems to be a jump.
        is_jittery = any(finding.fault == "clock_jitter" for finding in findings)
        even_s = with_even_stamps(read_rows(rows, readings))["time"] if is_jittery else time_s
        findings += check_jumps(even_s, measured["pos"])
    findings += check_pause(time_s)
    step_s = float(np.median(np.diff(time_s)))
    if len(log.time_s) < LEAST_ROWS or step_s > SLOWEST_S:
        text = f"{len(log.time_s)} rows, {step_s:.2g} s apart: at least {LEAST_ROWS} rows, "
        text += f"{SLOWEST_S:g} s apart or less, are needed"
        findings.append(Finding("note", NOT_CHECKED, text))
    findings += check_vehicle_name(log.about, against.vehicle)
    findings += check_controller(log.about, against.vehicle)
    again = {finding.fault for finding in findings if finding.fault}
    stored = [f for f in findings_of(log.about) if f.status in ("doubt", "corrected")]
    if against.vehicle is not None:
        stored = [f for f in stored if f.fault not in OF_VEHICLE_FILE]
    return [*(f for f in stored if f.fault not in again or not f.fault), *findings], readings


def with_fixes(log: FlightLog, readings: Readings) -> FlightLog:
    """Return a log with its signals read in another way; missing values are kept."""
    columns = columns_from_log(log)
    signals = {**GROUPS, "throttle": ("throttle",)}  # a checked column that no group has
    rows = {"time": log.time_s, **signals_of(columns, signals)}
    attitude = {"quat": _filled_attitude(log.time_s, rows["quat"])} if "quat" in rows else {}
    corrected = read_rows(rows | attitude, readings)
    if "quat" in corrected:  # missing attitudes serve other signals, but stay missing
        corrected["quat"] = read_rows({"time": log.time_s, "quat": rows["quat"]}, readings)["quat"]
    for group, names in signals.items():
        if group in rows and group not in corrected:
            columns = {name: value for name, value in columns.items() if name not in names}
        elif group in rows and group != "time":
            columns |= dict(zip(names, corrected[group].T, strict=True))
    columns["time"] = corrected["time"]
    return log_from_columns(columns, log.about, log.name, limits=False)


def check_files(against: CheckContext) -> list[Finding]:
    """Return the findings for the vehicle file and the policy's camera."""
    found = [] if against.vehicle is None else check_vehicle_numbers(against.vehicle)
    return found + check_camera(against.policy_camera, against.vehicle)


def not_identifiable(findings: Sequence[Finding]) -> list[dict[str, str]]:
    """Return the faults that are not identifiable from the flights, each with a manoeuvre."""
    faults = {f.fault: f.evidence for f in findings if f.status == "not identifiable"}
    return [
        {"fault": fault, "why": why, "manoeuvre": FAULTS[fault][1]} for fault, why in faults.items()
    ]


def rows_of(log: FlightLog) -> dict[str, np.ndarray]:
    """Return a log's signals on its rows (see `run_checks`).

    Missing values of slower signals are interpolated linearly; commands hold their last value.
    """
    columns, rows = columns_from_log(log), {"time": log.time_s}
    more = {name: (name,) for name in ("throttle", "baro") if _is_number(columns.get(name))}
    for group, value in signals_of(columns, {**GROUPS, **more}).items():
        if group == "pos":  # its jumps are one fault, which `check_jumps` names
            is_far = jumps_of(log.time_s, value, in_metres=False) > 0.0
            value = np.where(is_far[:, None], np.nan, value)
        if np.isfinite(value).all(axis=1).sum() > LEAST_ROWS:
            fill = _filled_attitude if group == "quat" else _held if group in HELD else filled
            rows[group] = fill(log.time_s, value.astype(np.float64))
    return rows


def _is_number(column: np.ndarray | None) -> bool:
    """Return whether a log has this column, and it has numbers."""
    return column is not None and np.asarray(column).dtype.kind in "fiu"


def filled(time_s: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return `value` (T, C); missing values over less than 0.5 s are interpolated linearly."""
    known = np.isfinite(value).all(axis=1)
    if known.all() or known.sum() < 2:
        return value
    known_time = time_s[known]
    result = interpolate(time_s, known_time, value[known])
    after = np.clip(np.searchsorted(known_time, time_s), 1, len(known_time) - 1)
    too_far = (known_time[after] - known_time[after - 1] > 0.5) & ~known
    result[too_far | (time_s < known_time[0]) | (time_s > known_time[-1])] = np.nan
    return result


def _filled_attitude(time_s: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return attitudes (T, 4) as `filled` does, of unit norm and by the shorter way round."""
    known = np.asarray(np.isfinite(quat).all(axis=1))
    same_sign = quat.copy()
    same_sign[known] = continuous(quat[known])
    value = filled(time_s, same_sign)
    return np.where(known[:, None], quat, value / np.linalg.norm(value, axis=1, keepdims=True))


def _held(time_s: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return commands (T, C), each held until the next one; NaN before the first."""
    known = np.isfinite(value).all(axis=1)
    return held(Signal(time_s[known], value[known]), time_s)


def signals_of(
    columns: Mapping[str, np.ndarray], groups: Mapping[str, Sequence[str]] = GROUPS
) -> dict[str, np.ndarray]:
    """Return the signals (T, C) of a log's columns, by name; NaN where a row lacks them."""
    return {
        group: np.stack([columns[name] for name in names], axis=1)
        for group, names in groups.items()
        if group != "time" and all(name in columns for name in names)
    }
