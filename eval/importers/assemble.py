"""Convert a recording to a checked flight log: the steps that all formats share.

A recording holds the signals that a format's reader found in a file, each at its own rate. The
steps are: add a pose from another file, check clock and frames, cut the time on the ground,
resample to common rows, convert the commands, and check these. Each check returns findings.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from eval.importers.cleaning import (
    airborne,
    check_delay,
    check_evenness,
    clean,
    without_far,
    without_lost,
    without_repeats,
)
from eval.importers.commands import SHARE, order_motors, rates_wanted, thrust_command
from eval.importers.options import ImportOptions
from eval.importers.rows import GAP_S, GAP_STEPS, row_times, rows_at, sampled_rows, slowest
from eval.importers.signals import KEPT, NEEDED, Recording, Signal, median_step, with_readings
from eval.logs.columns import COMMANDS, GROUPS, FlightLogError
from eval.logs.faults.check import DRIVE, POSE, CheckContext, run_checks
from eval.logs.faults.clocks.delay import OF_POSE
from eval.logs.faults.clocks.stamps import CUT, PAUSE_S, check_time
from eval.logs.faults.finding import Finding, finding_lines
from eval.logs.faults.position import check_jumps
from eval.logs.faults.reading import BY_ATTITUDE, MOTORS, read_rows
from eval.logs.faults.sensors import check_copy
from eval.logs.faults.vehicle import check_controller, check_vehicle_name
from eval.logs.flight_log import FlightLog, log_from_columns
from tracks.common.figures import rounded

SLOW_HZ = 40.0
"""A signal below this rate gets a note [Hz]."""
END_S = 0.5
"""A signal that begins or ends this much later or earlier than the others gets a note [s]."""
SIGNAL_TEXTS = {
    "pos": "position",
    "quat": "attitude",
    "rate": "gyro",
    "cmd_rate": "rate command",
    "motor": "motors",
}
"""Signals that need a high rate, and their names in messages."""
GROUP_TEXTS = {"pos": "position", "quat": "attitude", "rate": "body rates", "command": "commands"}
"""Groups of columns that a partial log may lack, and their names in messages."""
_ROTORS = ("motor", "pwm")
"""Signals of the rotors; either is enough for the quantities that need rotor speeds."""
QUANTITIES = (
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
"""Identifiable quantity, required signals, and alternative signals of which one is required."""
UNIDENTIFIABLE_WITHOUT = {
    "pos": ("the path", "wind", "faults of position and velocity"),
    "quat": ("faults of the attitude", "the gyro's scale and axes against it"),
    "acc": ("thrust over mass", "drag"),
}
"""Signal -> quantities that a log without a pose does not identify where it lacks the signal."""


def assemble(
    recording: Recording, format: str, options: ImportOptions
) -> tuple[FlightLog, tuple[Finding, ...]]:
    """Return `recording` as a flight log, and the findings of all checks.

    The name of the file's `format` goes into the log's metadata.

    Raises:
        FlightLogError: where a required signal is missing or breaks a rule.
    """
    # An order of motors refers to the vehicle's order, so it is applied after `order_motors`.
    orders = tuple(
        (signal, steps) for signal, steps in options.read if signal in MOTORS and "," in steps
    )
    readings, later = tuple(r for r in options.read if r not in orders), ()
    if options.pose is not None:  # its signals are read with it, and the log has no attitude yet
        readings = tuple(r for r in readings if r[0] not in OF_POSE)
        later = tuple(r for r in readings if any(step in r[1] for step in BY_ATTITUDE))
    recording = with_readings(recording, tuple(r for r in readings if r not in later))
    context, of_time = CheckContext(options.vehicle), []
    if not recording.has_seconds and any(name in recording.signals for name in NEEDED):
        fastest = min(median_step(samples.time_s) for samples in recording.signals.values())
        of_time, readings, _ = run_checks(
            {"time": recording.signals[slowest(recording)].time_s},
            (lambda rows, _: check_time(rows, fastest),),
            context,
            options.fix,
        )
        # Rows need the time in seconds.
        recording = with_readings(recording.noting(*of_time), readings)
    origin_s = min((samples.time_s[0] for samples in recording.signals.values()), default=0.0)
    if options.pose is not None:
        from eval.importers.pose import with_pose

        recording = with_readings(with_pose(recording, options), later)
    recording = recording.noting(*_unused_options(recording.signals, format, options))
    _require_signals(recording, options.partial)
    recording = check_evenness(recording, options.fix)
    if options.fix:
        recording = without_lost(recording)
    new = without_repeats(recording)
    if options.fix:
        recording = new
    # Checks of the frames of position, attitude and gyro.
    checked = without_far(new)
    coarse = rows_at(checked, row_times(checked))
    copied = _copied(checked.signals)
    more_findings, readings, _ = run_checks(coarse, POSE, context, options.fix, copied)
    recording = recording.noting(*copied, *more_findings)
    if options.fix:
        recording = clean(with_readings(recording, readings))
    if {"quat", "rate"} <= recording.signals.keys() and options.pose is None and not copied:
        recording = check_delay(recording, options.fix)
    # Cut the time on the ground, and resample to common rows.
    findings, flight_span_s = list(recording.findings), (-np.inf, np.inf)
    if options.trim:
        flight_span_s, more_findings = airborne(recording)
        findings += more_findings
    time_s = row_times(
        recording, options.rate_hz, options.start_s, options.end_s, flight_span_s, origin_s
    )
    findings += _notes_on_rates(recording, time_s)
    if "pos" in recording.signals:
        times, pos = recording.signals["pos"]
        inside = (times >= time_s[0]) & (times <= time_s[-1])
        findings += check_jumps(times[inside] - origin_s, pos[inside])
    first_s = max(flight_span_s[0], origin_s + options.start_s)
    last_s = flight_span_s[1] if options.end_s is None else origin_s + options.end_s
    findings += _notes_on_ends(recording, (first_s, min(last_s, flight_span_s[1])), origin_s)
    rows = rows_at(recording, time_s)
    # Convert the commands, and check them.
    findings += order_motors(rows, recording.motor_side, options.vehicle)
    rows = read_rows(rows, orders)
    findings += rates_wanted(rows, options.vehicle)
    # Corrected faults and a wrong unit of time are no longer in the rows; other doubts are.
    doubts = [finding for finding in findings if finding.status == "doubt"]
    doubts = [finding for finding in doubts if finding not in of_time]
    more_findings, _, corrected_rows = run_checks(rows, DRIVE, context, options.fix, doubts)
    findings += more_findings
    rows = corrected_rows if options.fix else rows
    doubtful = {f.signal for f in findings if f.status == "doubt"}
    findings += thrust_command(rows, options, "accelerometer" not in doubtful)
    findings += _drop_half_commands(rows, options.partial)
    # Empty the cells of slow signals in rows without a sample, and make the flight log.
    for name, is_sample in sampled_rows(recording, time_s).items():
        rows[name] = np.where(is_sample[:, None], rows[name], np.nan)
    columns = _columns(rows)
    missing = [name for name in NEEDED if name not in rows]
    if not any(all(group in rows for group in groups) for groups in COMMANDS):
        missing.append("command")
    if missing == ["command"] and not options.partial:
        lines = "".join(f"\n{line}" for line in finding_lines(tuple(findings)))
        reason = (
            "neither a thrust and rate command nor motor speeds nor motor commands could be read; "
            f"--partial keeps the other signals{lines}"
        )
        raise FlightLogError(recording.name, reason)
    about = {
        "source": format,
        **{key: value for key, value in recording.about.items() if key != "partial"},
        "imported_from": recording.name.replace("\\", "/").rsplit("/", 1)[-1],
    }
    findings += check_vehicle_name(about, options.vehicle)
    findings += check_controller(about, options.vehicle)
    if options.vehicle is not None:
        about["vehicle"] = options.vehicle.name
    if missing:
        findings.append(usable_for(rows, missing))
        about["partial"] = missing
    about["findings"] = [finding._asdict() for finding in findings]
    log = log_from_columns(columns, about, recording.name)
    return log, tuple(findings)


def _copied(signals: Mapping[str, Signal]) -> list[Finding]:
    """Return the doubt of `check_copy` on samples with the same times, before rows average them."""
    rate, command = (signals.get(name) for name in ("rate", "cmd_rate"))
    if rate is None or command is None or not np.array_equal(rate.time_s, command.time_s):
        return []
    return check_copy({"rate": rate.value, "cmd_rate": command.value})


def _unused_options(signals: Collection[str], format: str, options: ImportOptions) -> list[Finding]:
    """Return a note on each of the `options` that a log with these signals does not need."""
    findings = [
        Finding("note", "file", f"--read {name}={steps} is not used: the log has no {name}")
        for name, steps in options.read
        if name not in ("time", *signals) and steps != "drop"
    ]
    has_throttle = not {"throttle", SHARE}.isdisjoint(signals) and "cmd_thrust" not in signals
    has_erpm = format == "betaflight" and "motor" in signals
    numbers = (
        ("--mass", options.mass, KEPT + "cmd_force" in signals, "thrust in N"),
        ("--full-thrust", options.full_thrust, has_throttle, "normalised thrust only"),
        ("--motor-poles", options.motor_poles, has_erpm, "Betaflight's eRPM"),
    )
    return findings + [
        Finding("note", "file", f"{flag} is not used: it is for a log with {what}")
        for flag, number, is_used, what in numbers
        if number is not None and not is_used
    ]


def _require_signals(recording: Recording, partial: bool) -> None:
    """Reject a recording without position, attitude or gyro; a partial log needs one of them."""
    missing = [SIGNAL_TEXTS[name] for name in NEEDED if name not in recording.signals]
    if missing and not (partial and len(missing) < len(NEEDED)):
        why = "".join(f" ({f.evidence})" for f in recording.findings if f.signal in missing)
        hint = "" if missing == ["gyro"] else "; --pose FILE adds position and attitude"
        reason = f"holds no {' and no '.join(missing)}{why}{hint}; --partial keeps what is there"
        raise FlightLogError(recording.name, reason)


def _notes_on_rates(recording: Recording, time_s: np.ndarray) -> list[Finding]:
    """Return notes on the row rate, slow signals and gaps."""
    name = slowest(recording)
    row_rate = f"at {rounded(1.0 / median_step(time_s), 3)} Hz, by the {SIGNAL_TEXTS[name]}"
    findings = [Finding("note", "rows", row_rate)]
    for name, subject in SIGNAL_TEXTS.items():
        if name not in recording.signals:
            continue
        times = recording.signals[name].time_s
        step = median_step(times)
        if step > 1.0 / SLOW_HZ:
            text = f"comes at {1 / step:.3g} Hz only; log it faster where you can"
            findings.append(Finding("note", subject, text))
        gaps = int(np.sum(np.diff(times) > max(GAP_S, GAP_STEPS * step)))
        if gaps:
            longest = float(np.max(np.diff(times)))
            text = f"{gaps} gaps, the longest {longest:.2g} s: left empty"
            if longest > PAUSE_S:
                text += f"; {CUT}"
            findings.append(Finding("note", subject, text))
    return findings


def _notes_on_ends(
    recording: Recording, within: tuple[float, float], origin_s: float
) -> list[Finding]:
    """Return notes on signals that begin late or end early, of the times `within` [s].

    Both are on the recording's clock, on which the file begins at `origin_s`.
    """
    times = {n: recording.signals[n].time_s for n in SIGNAL_TEXTS if n in recording.signals}
    first_s = max(within[0], min(t[0] for t in times.values()))
    last_s = min(within[1], max(t[-1] for t in times.values()))
    findings = []
    for name, t in times.items():
        what = "of other signals left out" if name in NEEDED else "left empty"
        for verb, at, missing_s in (
            ("begins", t[0], t[0] - first_s), ("ends", t[-1], last_s - t[-1])
        ):  # fmt: skip
            if missing_s > END_S:
                text = f"{verb} at {at - origin_s:.1f} s; {missing_s:.1f} s {what}"
                findings.append(Finding("note", SIGNAL_TEXTS[name], text))
    return findings


def _drop_half_commands(rows: dict[str, np.ndarray], partial: bool) -> list[Finding]:
    """Remove a thrust without rates or torques (unless `partial`), or the reverse, in place."""
    for name in ("cmd_thrust", "cmd_rate", "cmd_torque"):
        if name in rows and not np.isfinite(rows[name]).any():
            del rows[name]
    dropped = [name for name in ("cmd_rate", "cmd_torque") if name in rows]
    if "cmd_thrust" in rows:
        dropped = [] if dropped or partial else ["cmd_thrust"]
    for name in dropped:
        del rows[name]
    text = f"{' and '.join(dropped)} left out, as the other half of the command is missing"
    return [Finding("note", "command", text)] if dropped else []


def _columns(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the flight log's columns, and the columns that are kept unchanged."""
    columns = {"time": rows["time"]}
    for group, names in GROUPS.items():
        if group != "time" and group in rows:
            columns |= dict(zip(names, rows[group].T, strict=True))
    if "throttle" in rows:
        columns["throttle"] = rows["throttle"][:, 0]
    kept = {name: value[:, 0] for name, value in rows.items() if name.startswith(KEPT)}
    return columns | {name.removeprefix(KEPT): value for name, value in kept.items()}


def usable_for(rows: dict[str, np.ndarray], missing: list[str]) -> Finding:
    """Return what a log without the groups `missing` (of `GROUP_TEXTS`) identifies by `rows`."""
    no_pose = "pos" in missing and "quat" in missing
    identifiable = [
        quantity
        for quantity, needed, inputs in QUANTITIES
        if all(name in rows for name in needed) and any(name in rows for name in inputs)
    ]
    without = " and no ".join(GROUP_TEXTS[name] for name in missing)
    text = f"no {without}; identifiable from it: {'; '.join(identifiable) or 'only its path'}"
    if no_pose:
        text = f"this log has no pose: {text}; not identifiable from it: "
        text += ", ".join(
            quantity
            for name, quantities in UNIDENTIFIABLE_WITHOUT.items()
            if name not in rows
            for quantity in quantities
        )
    return Finding("note", "partial", text)
