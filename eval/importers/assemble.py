"""Convert a recording to a checked flight log: the steps that all formats share."""

from __future__ import annotations

import numpy as np

from eval.importers.checks.airborne import airborne
from eval.importers.checks.glitches import clean
from eval.importers.checks.late import check_delay
from eval.importers.commands import order_motors, rates_wanted, thrust_command
from eval.importers.mapping import KEPT
from eval.importers.options import ImportOptions
from eval.importers.rows import HOLE_S, HOLE_STEPS, own_rows, row_times, rows_at, slowest
from eval.importers.signals import NEEDED, Recording, median_step, with_readings
from eval.logs.columns import COMMANDS, GROUPS, FlightLogError
from eval.logs.faults.check import CLOCK, DRIVE, POSE, CheckContext, run_checks
from eval.logs.faults.finding import Finding, finding_lines
from eval.logs.faults.reading import MOTORS, read_rows
from eval.logs.flight_log import FlightLog, log_from_columns

COARSE_HZ = 100.0
"""Largest row rate for the checks of the pose."""
SLOW_HZ = 40.0
"""A signal below this rate gets a note."""
TEXTS = {
    "pos": "position",
    "quat": "attitude",
    "rate": "gyro",
    "cmd_rate": "rate command",
    "motor": "motors",
}
"""Signals that need a high rate, and their names in messages."""
NAMES = {"pos": "position", "quat": "attitude", "rate": "body rates", "command": "commands"}
"""Groups that a partial log may lack, and their names in messages."""
_ROTORS = ("motor", "pwm")
QUESTIONS = (
    ("the force on the body (thrust, mass, drag)", ("pos", "quat"), (*_ROTORS, "cmd_thrust")),
    ("its torque (inertia, rotors, centre of mass)", ("rate",), (*_ROTORS, "cmd_torque")),
    ("the weight and the balance of the rotors in hover", ("pos",), (*_ROTORS, "cmd_torque")),
    ("the vertical force in slow flight (thrust, mass)", ("pos",), (*_ROTORS, "cmd_thrust")),
    (
        "thrust by the accelerometer (thrust over mass, battery sag, weak motor)",
        ("acc", "rate"),
        (*_ROTORS, "cmd_thrust"),
    ),
    ("the rate loop (gains, delay)", ("rate", "cmd_rate"), ("rate",)),
    ("the rotors' lag", ("motor",), ("pwm", "motor_cmd")),
)
"""Quantity, required signals, and alternative signals of which one is required."""
UNSEEN = {
    "pos": ("the path", "wind", "faults of position and velocity"),
    "quat": ("faults of the attitude", "the gyro's scale and axes against it"),
    "acc": ("thrust over mass", "drag"),
}
"""Signal -> quantities that are not identifiable without it and without a pose."""


def assemble(
    recording: Recording, format: str, options: ImportOptions
) -> tuple[FlightLog, tuple[Finding, ...]]:
    """Return `recording` as a flight log, and the findings of all checks.

    Raises:
        FlightLogError: where a required signal is missing or breaks a rule.
    """
    findings = list(recording.findings)
    if options.pose is not None:
        from eval.importers.pose import with_pose

        recording, more = with_pose(recording, options)
        findings += more
    # Orders of motors are relative to the vehicle's order, which `order_motors` makes.
    orders = tuple(one for one in options.read if one[0] in MOTORS and "," in one[1])
    recording = with_readings(recording, tuple(r for r in options.read if r not in orders))
    _need(recording, options.partial, findings)
    against = CheckContext(options.vehicle)
    more, readings, _ = run_checks(
        {"time": recording.signals[slowest(recording)].time_s}, CLOCK, against, options.fix
    )
    findings += more
    recording = with_readings(recording, readings)  # rows need the time in seconds
    coarse = row_times(recording, COARSE_HZ, 0.0, None)
    more, readings, _ = run_checks(rows_at(recording, coarse), POSE, against, options.fix)
    findings += more
    if options.fix:
        recording = with_readings(recording, readings)
        recording, more = clean(recording)
        findings += more
    if {"quat", "rate"} <= recording.signals.keys() and options.pose is None:
        recording, more = check_delay(recording, options.fix)
        findings += more
    within, more = _flight(recording, options)
    findings += more
    time_s = row_times(recording, options.rate_hz, options.start_s, options.end_s, within)
    findings += _rates(recording, time_s)
    rows = rows_at(recording, time_s)
    findings += order_motors(rows, recording.motor_side, options.vehicle)
    rows = read_rows(rows, orders)
    findings += rates_wanted(rows, options.vehicle)
    more, readings, right = run_checks(rows, DRIVE, against, options.fix)
    findings += more
    rows = right if options.fix else rows
    unsure = {f.signal for f in findings if f.status == "doubt"}
    findings += thrust_command(rows, options, "accelerometer" not in unsure)
    findings += _pair(rows, options.partial)
    for name, own in own_rows(recording, time_s).items():
        rows[name] = np.where(own[:, None], rows[name], np.nan)
    columns = _columns(rows)
    lacks = _lacks(rows)
    if lacks == ["command"] and not options.partial:
        lines = "".join(f"\n{line}" for line in finding_lines(tuple(findings)))
        reason = (
            "neither a thrust and rate command nor motor speeds nor motor commands could be read; "
            f"--partial keeps the rest{lines}"
        )
        raise FlightLogError(recording.name, None, None, reason)
    about = {
        "source": format,
        **{key: value for key, value in recording.about.items() if key != "partial"},
        "imported_from": recording.name.replace("\\", "/").rsplit("/", 1)[-1],
        "findings": [finding._asdict() for finding in findings],
    }
    if options.vehicle is not None:
        about["vehicle"] = options.vehicle.name
    if lacks:
        findings.append(usable_for(rows, lacks))
        about["partial"] = lacks
        about["findings"] = [finding._asdict() for finding in findings]
    log = log_from_columns(columns, about, recording.name)
    return log, tuple(findings)


def _need(recording: Recording, partial: bool, findings: list[Finding]) -> None:
    missing = [TEXTS[name] for name in NEEDED if name not in recording.signals]
    if missing and not (partial and len(missing) < len(NEEDED)):
        why = "".join(f" ({f.evidence})" for f in findings if f.signal in missing)
        hint = "" if missing == ["gyro"] else "; --pose FILE brings position and attitude"
        reason = f"holds no {' and no '.join(missing)}{why}{hint}; --partial keeps what is there"
        raise FlightLogError(recording.name, None, None, reason)


def _flight(
    recording: Recording, options: ImportOptions
) -> tuple[tuple[float, float], list[Finding]]:
    """Return the first and the last time in the air [s]; infinite where nothing is trimmed."""
    return airborne(recording) if options.trim else ((-np.inf, np.inf), [])


def _rates(recording: Recording, time_s: np.ndarray) -> list[Finding]:
    """Return notes on the row rate, slow signals and gaps."""
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


def _pair(rows: dict[str, np.ndarray], partial: bool) -> list[Finding]:
    """Remove half a command in place: a thrust without rates or torques, or these without it.

    A partial log keeps a thrust alone.
    """
    left = []
    if "cmd_thrust" in rows and not ({"cmd_rate", "cmd_torque"} & rows.keys()) and not partial:
        left.append("cmd_thrust")
    for name in ("cmd_rate", "cmd_torque"):
        if name in rows and "cmd_thrust" not in rows:
            left.append(name)
    for name in left:
        del rows[name]
    text = f"{' and '.join(left)} left out, as the other half of the command is not there"
    return [Finding("note", "command", text)] if left else []


def _lacks(rows: dict[str, np.ndarray]) -> list[str]:
    """Return the required groups that `rows` lack; `command` stands for any of `COMMANDS`."""
    lacks = [name for name in NEEDED if name not in rows]
    driven = any(all(group in rows for group in groups) for groups in COMMANDS)
    return lacks if driven else [*lacks, "command"]


def _columns(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    columns = {"time": rows["time"]}
    for group, names in GROUPS.items():
        if group != "time" and group in rows:
            columns |= dict(zip(names, rows[group].T, strict=True))
    if "throttle" in rows:
        columns["throttle"] = rows["throttle"][:, 0]
    kept = {name: value for name, value in rows.items() if name.startswith(KEPT)}
    return columns | {
        name.removeprefix(KEPT): value[:, 0] for name, value in kept.items() if value.shape[1] == 1
    }


def usable_for(rows: dict[str, np.ndarray], lacks: list[str]) -> Finding:
    """Return the finding that lists what a log without the groups `lacks` is usable for."""
    no_pose = "pos" in lacks and "quat" in lacks
    can = [
        question
        for question, needs, driven_by in QUESTIONS
        if all(name in rows for name in needs) and any(name in rows for name in driven_by)
    ]
    without = " and no ".join(NAMES[name] for name in lacks)
    text = f"no {without}; what can be asked of it: {'; '.join(can) or 'nothing but its path'}"
    if no_pose:
        text = f"this log has no pose: {text}; not identifiable from it: "
        text += ", ".join(
            what for name, whats in UNSEEN.items() if name not in rows for what in whats
        )
    return Finding("note", "partial", text)
