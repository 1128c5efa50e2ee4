"""Convert a file's columns to signals in the flight log's units and frames, by a mapping.

A mapping (`eval.importers.mapping_file`) names the columns, units and frames of each signal. The
readers of tables and of Crazyflie logs use it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import attitude, body_vector, conjugate, from_euler, world_vector
from eval.importers.mapping_file import MIXERS, Column, LogMap
from eval.importers.options import ImportOptions
from eval.importers.rows import continuous, measured, turn_axes
from eval.importers.signals import KEPT, Part, Recording, Signal, collect, make_signal
from eval.logs.columns import ESTIMATE, GROUPS, FlightLogError
from eval.logs.faults.drive.commands import clip_commands, is_share
from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import BAD, CALM_RATE, TIMES_BETTER, WIDTH_S, turns_of
from eval.logs.faults.reading import DEG
from eval.logs.faults.relation import match, rms, smooth
from eval.logs.faults.vectors import GOOD

Find = Callable[[tuple[str, ...]], Part | None]
"""Function that returns the times and values of named columns, or None where one is missing."""
ESTIMATED = ("pos", "quat", "vel")
"""Signals that may come as motion capture and as on-board estimate."""
ANGLES = ("roll", "pitch", "yaw")
"""The order in which angles are read."""
ANGLE_UNITS = {
    1.0 / DEG: ("rad, read as deg", (0.0, 1.05 * np.pi * DEG)),
    DEG: ("deg, read as rad", (2.1 * np.pi, np.inf)),
}
"""Factor that corrects the angles -> their unit in words, and the range of the largest angle as
read [rad]. Within it the gyro's unit is less likely to be wrong than that of the angles."""


def recording_of(
    path: Path, mapping: LogMap, find: Find, missing: Callable[[str], str], options: ImportOptions
) -> Recording:
    """Return the signals of the file at `path` by `mapping`.

    `find` returns the times and values of columns, `missing` the error text for a missing one. Of
    the options, `source`, `mass`, `vehicle` and `fix` are used.

    Raises:
        FlightLogError: for a column that the mapping needs and the file lacks.
        ValueError: for `options.source` where the mapping has no sources.
    """
    name, parts, used_columns = str(path), {}, {}
    about, findings = _text_file(path, mapping)
    if options.source and not any(c.source for each in mapping.columns.values() for c in each):
        raise ValueError(
            f"--source {options.source}: the mapping of {name} names no source of any signal; "
            'leave it out, or add source = "mocap" and "estimate" to the mapping'
        )
    for signal, alternatives in mapping.columns.items():
        column, part = _first_alternative(alternatives, find, options.source)
        if part is None:
            if mapping.optional or signal == "time":
                continue
            names = alternatives[0].names
            absent = next((c for c in names if find((c,)) is None), None)
            if absent is None:
                reason = f"not in one kind of event with {', '.join(names[1:])}; log them together"
                raise FlightLogError(name, reason, names[0])
            raise FlightLogError(name, missing(absent), absent)
        if options.source and column.source not in ("", options.source):
            if signal == "pos":
                reason = f"has no position of the {options.source}; it has --source {column.source}"
                raise FlightLogError(name, reason)
            text = f"{signal} is of the {column.source}; there is none of the {options.source}"
            findings.append(Finding("note", "file", text))
        used_columns[signal], parts[signal] = column, _in_log_unit(part, column, name)
        if signal in ("throttle", "pwm") and not is_share(parts[signal][1], 0.9):
            # The mapping's unit is wrong: `check_throttle` finds it by the values of the file.
            column = replace(column, factor=tuple(float(np.sign(f)) for f in column.factor))
            parts[signal] = _in_log_unit(part, column, name)
        if column.mixer:
            time_s, value = parts[signal]
            parts[signal] = time_s, clip_commands(value)
    parts.pop("time", None)
    # Angles become quaternions, unless the file has quaternions too.
    euler: dict[str, Part] = {}
    has_quat = "quat" in parts
    for angles, quat in (("euler", "quat"), ("cmd_euler", "cmd_quat")):
        if angles in parts:
            time_s, value = euler[quat] = parts.pop(angles)
            parts.setdefault(quat, (time_s, from_euler(value)))
            used_columns.setdefault(quat, Column((), ()))
    parts = {
        signal: (time_s, _in_log_frame(signal, value, used_columns[signal], mapping))
        for signal, (time_s, value) in parts.items()
    }
    parts |= _estimates(mapping, used_columns, find, name)
    for column in mapping.keep:
        part = find((column,))
        if part is None and not mapping.optional:
            raise FlightLogError(name, missing(column), column)
        if part is not None:
            time_s, value = part
            width = value.shape[1]  # a column of lists becomes one column per number
            names = [column] if width == 1 else [f"{column}[{k}]" for k in range(width)]
            parts |= {f"{KEPT}{n}": (time_s, value[:, k, None]) for k, n in enumerate(names)}
    signals, more_findings = collect(parts, name)
    for signal in ("vel", "rate", "acc"):
        if signal in signals and used_columns[signal].other_axes:
            _change_axes(signals, signal, used_columns[signal])
    if "quat" in euler and not has_quat and {"quat", "rate"} <= signals.keys():

        def quat_of(angles: np.ndarray) -> np.ndarray:
            return _in_log_frame("quat", from_euler(angles), used_columns["quat"], mapping)

        angles, _ = make_signal(euler["quat"][0], euler["quat"][1], name, "quat")
        assert angles is not None
        value, found = check_angles(angles, quat_of, signals["rate"], options.fix)
        findings += found
        if value is not None:
            signals["quat"] = signals["quat"]._replace(value=quat_of(value))
    if "cmd_thrust" in signals and not used_columns["cmd_thrust"].per_mass:
        findings += _per_mass(signals, about.get("mass"), options)
    return Recording(name, signals, (*findings, *more_findings), mapping.motor_side, about)


def _first_alternative(
    alternatives: tuple[Column, ...], find: Find, source: str
) -> tuple[Column, Part | None]:
    """Return the first alternative that the file has, those of `source` first, and its samples."""
    for column in sorted(alternatives, key=lambda c: bool(source) and c.source != source):
        if (part := find(column.names)) is not None:
            return column, part
    return alternatives[0], None


def _estimates(
    mapping: LogMap, used_columns: Mapping[str, Column], find: Find, name: str
) -> dict[str, Part]:
    """Return the on-board estimates of signals from motion capture, as columns to keep.

    Only those in the flight log's axes are kept: of velocities, those in world axes.
    """
    estimates = {}
    for signal in ESTIMATED:
        if signal not in used_columns or used_columns[signal].source != "mocap":
            continue
        for column in mapping.columns[signal]:
            part = find(column.names) if column.source == "estimate" else None
            if part is None or _is_world(signal, column) != (signal == "vel"):
                continue
            time_s, value = _in_log_unit(part, column, name)
            value = _in_log_frame(signal, value, column, mapping)
            value = continuous(value) if signal == "quat" else value
            for k, column_name in enumerate(GROUPS[signal]):
                estimates[f"{KEPT}{ESTIMATE}{column_name}"] = (time_s, value[:, k : k + 1])
            break
    return estimates


def _in_log_unit(part: Part, column: Column, name: str) -> Part:
    """Return a signal in the flight log's unit, with the motor mixer applied, not yet clipped."""
    time_s, value = part
    if value.shape[1] != len(column.factor):
        wanted = f"give {len(column.factor)} columns, or one whose cells hold as many"
        reason = f"{value.shape[1]} a row for a signal of {len(column.factor)} numbers; {wanted}"
        raise FlightLogError(name, reason, column.names[0])
    value = value * np.asarray(column.factor)
    if column.mixer:
        value = value @ MIXERS[column.mixer].T
    return time_s, value


def _in_log_frame(signal: str, value: np.ndarray, column: Column, mapping: LogMap) -> np.ndarray:
    """Return samples in a z-up world or forward-left-up body.

    A vector in world axes remains in world axes, and one in body axes in body axes.
    """
    if signal in ("quat", "cmd_quat"):
        quat = conjugate(value) if column.inverse else value
        return attitude(quat, mapping.world, mapping.body)
    if signal == "pos" or (signal in ("vel", "rate", "acc") and _is_world(signal, column)):
        return world_vector(value, mapping.world)
    if signal in ("vel", "rate", "acc", "cmd_rate", "cmd_torque"):
        return body_vector(value, mapping.body)
    return value


def _is_world(signal: str, column: Column) -> bool:
    """Return whether a velocity, rate or acceleration is in world axes."""
    return column.other_axes != (signal == "vel")


def _change_axes(signals: dict[str, Signal], signal: str, column: Column) -> None:
    """Rotate a signal into the flight log's axes in place; without an attitude, drop it.

    An acceleration in world axes is then kept as `acc_w_x`, ...
    """
    time_s, value = signals[signal]
    if signal == "acc" and not column.gravity:
        value = value + [0.0, 0.0, GRAVITY]  # a specific force is 9.81 m/s^2 upwards at rest
    if signal == "acc" and "quat" not in signals:
        for k, axis in enumerate("xyz"):
            kept = (value - [0.0, 0.0, GRAVITY])[:, k : k + 1]
            signals[f"{KEPT}acc_w_{axis}"] = Signal(time_s, kept)
    signals[signal] = Signal(time_s, value)
    turn_axes(signals, signal, to_world=signal == "vel")


def _per_mass(signals: dict[str, Signal], file_mass: Any, options: ImportOptions) -> list[Finding]:
    """Divide a thrust in N by the nominal mass in place, and keep it as `cmd_force` too."""
    thrust = signals.pop("cmd_thrust")
    signals[KEPT + "cmd_force"] = thrust
    mass, mass_source = options.mass, "by --mass"
    if mass is None and options.vehicle is not None:
        mass, mass_source = options.vehicle.mass, f"by the vehicle {options.vehicle.name!r}"
    if mass is None and isinstance(file_mass, float):
        mass, mass_source = file_mass, "by its text file"
    if mass is None:
        text = "is in N, and the mass is unknown: kept as cmd_force; give --mass or --vehicle"
        return [Finding("doubt", "thrust", text)]
    status = "note"
    if options.mass is None and isinstance(file_mass, float) and abs(file_mass / mass - 1) > 0.02:
        status = "doubt"
        mass_source += f"; its text file has {file_mass:g} kg: give the right one as --mass"
    signals["cmd_thrust"] = Signal(thrust.time_s, thrust.value / mass)
    return [Finding(status, "thrust", f"in N; divided by a mass of {mass:g} kg, {mass_source}")]


def _text_file(path: Path, mapping: LogMap) -> tuple[dict[str, Any], list[Finding]]:
    """Return metadata from the text file next to the log (`LogMap.text_file`), and a note.

    Its entries are under `beside`, and the vehicle's mass [kg] under `mass`, if present.
    """
    if not mapping.text_file:
        return {}, []
    number = "".join(c for c in path.stem if c.isdigit())
    file = path.parent / mapping.text_file.format(stem=path.stem, number=number)
    if not file.is_file():
        return {}, [Finding("note", "file", f"no {file.name} in its folder")]
    entries: dict[str, Any] = {}
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines()[:1000]:
        key, colon, value = line.partition(":")
        if colon and value.strip():
            entries[key.strip()] = _number_or_text(value.strip())
    about: dict[str, Any] = {"beside": entries}
    mass = entries.get(mapping.mass_key) if mapping.mass_key else None
    if isinstance(mass, float) and mass > 0.0:
        about["mass"] = mass
    return about, [Finding("note", "file", f"{file.name} of its folder is read as well")]


def _number_or_text(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def check_angles(
    angles: Signal, quat_of: Callable[[np.ndarray], np.ndarray], rate: Signal, fix_order: bool
) -> tuple[np.ndarray | None, list[Finding]]:
    """Return corrected `angles` (N, 3) [rad], None to keep them, and the finding.

    `angles` are roll, pitch and yaw as read [rad], and `quat_of` converts such to quaternions wxyz
    (N, 4) in the log's frames. Another order, corrected with `fix_order`, must explain them better
    than other axes of the gyro do. Another unit is only reported, since small angles in a wrong
    unit look like a gyro in a wrong unit.
    """
    time_s, value = angles
    if len(time_s) < 4:
        return None, []
    gyro = smooth(time_s, measured(rate, time_s, smooth=False), WIDTH_S)
    size = max(rms(gyro), CALM_RATE)

    def turns(value: np.ndarray) -> np.ndarray:
        return smooth(time_s, turns_of(time_s, quat_of(value)), WIDTH_S)

    as_given = turns(value)
    given = rms(as_given - gyro) / size
    if not given > BAD:
        return None, []
    largest = float(np.nanmax(np.abs(value)))
    units = [f for f, (_, (low, high)) in ANGLE_UNITS.items() if low < largest < high]
    tried = {
        **{(order, 1.0): value[:, order] for order in permutations(range(3))},
        **{((0, 1, 2), factor): factor * value for factor in units},
    }
    misfit = {key: rms(turns(angles) - gyro) / size for key, angles in tried.items()}
    order, factor = min(misfit, key=lambda key: misfit[key])
    best = misfit[order, factor]
    if factor == 1.0:  # other axes of the gyro may explain as much
        alike = np.clip(match(as_given, gyro).alike.min(), 0.0, 1.0)
        given = min(given, float(np.sqrt(1.0 - alike**2)))
    if best > GOOD or best * TIMES_BETTER > given:
        return None, []
    text = f"its turns are off the gyro's by {100 * given:.0f} %, but by {100 * best:.0f} % if the "
    if factor != 1.0:
        text += f"angles are in {ANGLE_UNITS[factor][0]}"
        fix = "unit of [euler] in the mapping file, or the gyro's unit"
        return None, [Finding("doubt", "attitude", text, "attitude", None, 0.95, fix)]
    text += f"columns are {', '.join(ANGLES[order.index(k)] for k in range(3))}"
    about = ("attitude", None, 0.98, "columns of [euler] in the mapping file")
    status = "corrected" if fix_order else "doubt"
    return (value[:, order] if fix_order else None), [Finding(status, "attitude", text, *about)]
