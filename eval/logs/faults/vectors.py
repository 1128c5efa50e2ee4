"""Checks of gyro, velocity and accelerometer against the pose: axes, signs, frames and units.

The *path* is the logged position over time; its derivatives are the reference for velocity and
accelerometer. The rotations of the attitude are the reference for the gyro.
"""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import conjugate, rotate
from eval.logs.faults.clocks.delay import CLEARLY, LATE_S, late_against
from eval.logs.faults.clocks.path import check_position_delay
from eval.logs.faults.clocks.rotation import rotated_to
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import CALM_RATE, WIDTH_S, Rows, turns_of
from eval.logs.faults.reading import DEG, option, read_as
from eval.logs.faults.relation import (
    LEAST,
    OK,
    SEEN,
    axes_finding,
    match,
    rms,
    scale_findings,
    smooth,
    unseen_axes,
    within,
)
from eval.logs.velocity import velocity_from_position

COUNTS = 16.384
"""Counts per deg/s of a 16-bit gyro with a range of 2000 deg/s."""
RATES = {
    "deg/s": 1.0 / DEG,
    "raw counts of a gyro, read as deg/s": COUNTS,
    "raw counts of a gyro": COUNTS / DEG,
    "ten times too large (blackbox_high_resolution)": 10.0,
    "rad/s, read as deg/s": DEG,
    "mrad/s": 1000.0,
}
"""Wrong unit of the gyro -> factor by which its values are then too large."""
GYRO_TOP = 75.0
"""Largest body rate that a gyro of a drone measures: a range of 4000 deg/s [rad/s]."""
SPEEDS = {"cm/s": 100.0, "mm/s": 1000.0, "km/h": 3.6, "knots": 1.0 / 0.514444}
"""Wrong unit of the velocity -> factor by which its values are then too large."""
FORCES = {
    "g": 1.0 / GRAVITY,
    "mg": 1000.0 / GRAVITY,
    "m/s^2, taken for g": GRAVITY,
    "m/s^2, taken for raw counts of 2048 per g": GRAVITY / 2048.0,
    "g, taken for raw counts of 2048 per g": 1.0 / 2048.0,
} | {f"raw counts of {per_g} per g": per_g / GRAVITY for per_g in (512, 2048, 4096, 8192, 16384)}
"""Wrong unit of the accelerometer -> factor by which its values are then too large."""
SLOW = 1.25
"""A velocity within this factor of 1 is correct: its filters change it more than a gyro's."""
CALM_SPEED = 0.3
"""Smallest usable speed, root mean square [m/s]."""
GOOD, BAD, TIMES_BETTER = 0.35, 0.6, 2.0
"""Relative residuals: a signal fits below the first and does not fit above the second. Another
reading must lower the residual by the third factor."""
SIGNS = {"": "", "-x,-y,-z": "of the other sign", "x,-y,-z": "in forward-right-down axes",
         "-x,y,z": "with axes -x,y,z", "x,-y,z": "with axes x,-y,z"}  # fmt: skip
"""Signs of an accelerometer's axes that a mistake could have made -> in words."""
MIRRORS = ("-x,y,z", "x,-y,z")
"""Signs of single axes: they turn a right-handed frame into a left-handed one."""
SIMPLER = 0.03
"""Penalty on the relative residual of an accelerometer's unusual readings, so that the usual ones
are chosen where both fit."""
UPWARDS = 0.5
"""Least share of an accelerometer's median that must be along body z, the direction of thrust."""
APART = 0.5
"""Least relative difference of two frames at which they are distinguishable."""


def check_gyro(rows: Rows) -> list[Finding]:
    """Return the findings on the gyro's axes, frame and unit, by the body rates of the attitude."""
    if "rate" not in rows:
        return []
    if "quat" not in rows:
        return _gyro_alone(rows, "the log has no attitude", "gyro_axes", "gyro_frame")
    time_s = rows["time"]
    turns = smooth(time_s, turns_of(time_s, rows["quat"]), WIDTH_S)
    gyro = smooth(time_s, rows["rate"], WIDTH_S)
    size = rms(turns)
    if size < CALM_RATE:
        text = f"turns of {size:.2g} rad/s are too small to check it by"
        return _gyro_alone(rows, text, "gyro_axes", "gyro_frame", "body_frame")
    found = match(turns, gyro)
    world = match(rotate(rows["quat"], turns), gyro)
    in_body, in_world = found.misfit(found.as_given), world.misfit(world.as_given)
    is_off = in_body > max(BAD, TIMES_BETTER * in_world)
    if is_off and in_world < GOOD and not found.is_turned:
        rotated = match(rotated_to(turns, gyro), gyro)
        if in_world < rotated.misfit(rotated.as_given):  # `check_clock` names a rotated body
            text = (
                f"its turns are off the attitude's by {100 * in_body:.0f} % in body axes and by "
                f"{100 * in_world:.0f} % in world axes"
            )
            fix = option(("rate", "from-world"))
            return [Finding("corrected", "gyro", text, "gyro_frame", None, 0.98, fix)]
    findings = []
    apart = rms(rotate(rows["quat"], turns) - turns) / size
    if apart < APART:
        text = f"body and world axes are {100 * apart:.0f} % of its turns apart only"
        findings += unseen("gyro", text, "gyro_frame")
    if found.is_turned or found.is_mirrored:
        findings.append(axes_finding(found, "rate", "gyro"))
    elif not found.seen.any():
        text = "its noise hides how the attitude turns"
        return _gyro_alone(rows, text, "gyro_axes", "gyro_frame", "body_frame")
    findings += unseen_axes(found, "gyro", "gyro_axes", "body_frame")
    findings += scale_findings(found, RATES, "rate", "gyro", "gyro_scale", "the attitude's turns")
    return findings


def _gyro_alone(rows: Rows, why: str, *faults: str) -> list[Finding]:
    """Return the findings on the gyro without an attitude to compare it with, for the reason `why`.

    `faults` are not identifiable then. Rates that no vehicle reaches are a fault of its scale.
    """
    size = np.linalg.norm(rows["rate"], axis=1)
    known = size[np.isfinite(size)]
    top = float(np.quantile(known, 0.99)) if len(known) else 0.0
    if top < GYRO_TOP:
        return unseen("gyro", why, *faults, "gyro_scale")
    unknown = unseen("gyro", why, *faults)
    text = f"it reads up to {top:.4g} rad/s, and no gyro of a drone measures that; {why}"
    command = rms(rows["cmd_rate"]) if "cmd_rate" in rows else 0.0
    ratio = rms(rows["rate"]) / command if command > CALM_RATE else 0.0
    for words in within(RATES, 1.5, ratio) if ratio > 0.0 else ():
        text = f"{text}. It is {ratio:.3g} times the commanded rates: {words}"
        fix = option(("rate", f"{1.0 / RATES[words]:.10g}"))
        found = Finding("corrected", "gyro", text, "gyro_scale", RATES[words], 0.95, fix)
        return [*unknown, found]
    fix = f"{option(('rate', f'{DEG:.6g}'))} for deg/s, or {DEG / COUNTS:.6g} for raw counts"
    return [*unknown, Finding("doubt", "gyro", text, "gyro_scale", None, 0.95, fix)]


def check_velocity(rows: Rows) -> list[Finding]:
    """Return the findings on the velocity's frame and unit, by the path's derivative."""
    if "vel" not in rows or "pos" not in rows:
        return []
    time_s = rows["time"]
    path = smooth(time_s, velocity_from_position(time_s, rows["pos"]), WIDTH_S)
    speed = rms(path)
    if speed < CALM_SPEED:
        text = f"a speed of {speed:.2g} m/s is too little to check the velocity by"
        return unseen("velocity", text, "velocity_frame", "velocity_unit")
    quat = rows.get("quat")
    ways = ["", "from-body", "x,-y,-z+from-body", "from-world"] if quat is not None else [""]
    matches = {}
    for way in ways:
        value = read_as("vel", rows["vel"], way, lambda: rows["quat"]) if way else rows["vel"]
        matches[way] = match(path, smooth(time_s, value, WIDTH_S))
    residual = {way: matched.misfit(matched.as_given) for way, matched in matches.items()}
    best = min(residual, key=lambda way: residual[way])
    here = matches[""]
    figures = f"it is off the path's derivative by {100 * residual['']:.0f} %, its scale left out"
    if best and residual[best] < GOOD and residual[""] > max(0.3, TIMES_BETTER * residual[best]):
        words = {
            "from-body": "in body axes",
            "x,-y,-z+from-body": "in forward-right-down body axes",
            "from-world": "in world axes already, and was turned by the attitude",
        }[best]
        text = f"{figures}, but by {100 * residual[best]:.0f} % if it is {words}"
        findings = [Finding("corrected", "velocity", text, "velocity_frame", None, 0.98,
                            option(("vel", best)))]  # fmt: skip
        here = matches[best]
    elif here.is_turned or here.is_mirrored:
        findings = [axes_finding(here, "vel", "velocity")._replace(fault="velocity_frame")]
    elif residual[""] > BAD:
        text = f"{figures}, and no other frame of it fits"
        sure = 0.9 if residual[""] > 0.9 else 0.6
        return [Finding("doubt", "velocity", text, "velocity_frame", residual[""], sure)]
    else:
        findings = [Finding("note" if residual[""] > OK else "ok", "velocity", figures)]
        apart = 1.0 if quat is None else rms(rotate(quat, path) - path) / speed
        if apart < APART:
            text = f"body and world axes are {100 * apart:.0f} % of it apart only"
            findings += unseen("velocity", text, "velocity_frame")
        findings += unseen_axes(here, "velocity", "velocity_frame")
        findings += _velocity_delay(rows, path)
    of = "the path's derivative"
    unit = scale_findings(here, SPEEDS, "vel", "velocity", "velocity_unit", of, SLOW)
    return findings + [matched for matched in unit if matched.status != "ok"]


def _velocity_delay(rows: Rows, path: np.ndarray) -> list[Finding]:
    """Return the finding on the delay of the velocity against the `path`'s derivative, if clear.

    If the velocity is early, either the position is late, or the velocity is a set point. The
    attitude decides.
    """
    found = late_against(rows["time"], path, smooth(rows["time"], rows["vel"], WIDTH_S))
    if found is None or abs(found[0]) < max(LATE_S, CLEARLY * found[1]):
        return []
    late_s, error_s = found
    size = f"it is {1e3 * abs(late_s):.0f} ms (± {1e3 * error_s:.1f} ms)"
    about = ("velocity_delay", late_s, 0.95, option(("vel", "drop")))
    if late_s > 0.0:
        text = f"{size} late against the path's derivative (a filter, or its time stamp)"
        return [Finding("doubt", "velocity", text, *about)]
    if any(finding.status == "ok" for finding in check_position_delay(rows)):
        text = f"{size} early against the path's derivative, as a set point is"
        return [Finding("doubt", "velocity", text, *about)]
    about = ("velocity_delay", late_s, 0.8, "stamp positions with the time of their measurement")
    return [Finding("doubt", "position", f"{size} late against the velocity", *about)]


def check_accelerometer(rows: Rows, body_is_frd: bool = False) -> list[Finding]:
    """Return the findings on the accelerometer, by the path's acceleration.

    Without a path only its unit and direction are checked: in flight it measures about one g,
    upwards. If attitude or gyro were found in forward-right-down axes (`body_is_frd`), these are
    the first choice: a flight with little drag does not show the sign along x.
    """
    if "acc" in rows and not {"pos", "quat"} <= rows.keys():
        return _unit_alone(rows)
    if "acc" not in rows:
        return []
    time_s = rows["time"]
    acc_w = velocity_from_position(time_s, velocity_from_position(time_s, rows["pos"]))
    quat, acc = rows["quat"], rows["acc"]
    down = rotate(conjugate(quat), np.array([0.0, 0.0, GRAVITY]))
    force = smooth(time_s, rotate(conjugate(quat), acc_w) + down, WIDTH_S)
    # Every combination of axes, frame and unit that a mistake could have made.
    ratio = _middle(smooth(time_s, acc, WIDTH_S)) / max(_middle(force), 1e-9)
    unit, factor = _unit_of(ratio, 1.2)
    readings = {
        (steps, scale): smooth(time_s, read_as("acc", acc, steps or "1", lambda: quat), WIDTH_S)
        / scale
        for steps in (*SIGNS, "from-world", "plus-gravity")
        for scale in {1.0, factor}
        if steps != "plus-gravity" or scale == 1.0
    }
    size = rms(force)
    if not np.isfinite(force).all(axis=1).sum() > LEAST or size < 1.0:
        faults = ("accelerometer_unit", "accelerometer_axes", "accelerometer_gravity")
        return unseen("accelerometer", "there is no path to check it by", *faults)
    residual = {name: rms(value - force) / size for name, value in readings.items()}
    given = residual["", 1.0]
    first = "x,-y,-z" if body_is_frd else ""
    best = min(residual, key=lambda name: residual[name] + SIMPLER * (name[0] not in ("", first)))
    figures = f"it is off the path's acceleration less gravity by {100 * given:.0f} %"
    lateral = f" ({rms((readings['', 1.0] - force)[:, :2]):.2g} m/s^2 sideways)"
    if best[0] and best[1] == 1.0 and residual[best] > 0.6 * given and given < OK:
        best = ("", 1.0)
    if best == ("", 1.0) or residual[best] * TIMES_BETTER > given or residual[best] > GOOD:
        if given < OK:
            matched = match(force, readings["", 1.0])
            if matched.is_turned:
                return [axes_finding(matched, "acc", "accelerometer")]
            return [Finding("ok", "accelerometer", figures + lateral)]
        sure = 0.9 if given > 0.8 else 0.6
        text = f"{figures}, and no unit, sign or frame of it fits"
        return [Finding("doubt", "accelerometer", text, "accelerometer_unit", ratio, sure)]
    steps, scale = best
    words = {**SIGNS, "from-world": "in world axes", "plus-gravity": "without gravity"}
    reasons = [unit] if scale != 1.0 else []
    reasons += [words[steps]] if steps else []
    text = f"{figures}, but by {100 * residual[best]:.0f} % if it is {' and '.join(reasons)}"
    fault = "accelerometer_unit" if scale != 1.0 else "accelerometer_axes"
    fault = "accelerometer_gravity" if steps == "plus-gravity" else fault
    to_si = f"{1.0 / scale:.10g}+" if scale != 1.0 else ""
    fix = option(("acc", (to_si + steps).rstrip("+")))
    size_ = scale if scale != 1.0 else None
    if steps in MIRRORS:  # no mounting mirrors a sensor, so the reference may be wrong
        return [Finding("doubt", "accelerometer", text, fault, size_, 0.95, fix)]
    others = [] if body_is_frd and steps == first else _same_fit(steps, readings[best], force)
    if others:
        text = f"{text}; {' or '.join(words[other] for other in others)} fits as well"
        fix = f"{fix} if it is {words[steps]}, or {', or '.join(to_si + other for other in others)}"
        return [Finding("doubt", "accelerometer", text, fault, size_, 0.95, fix)]
    return [Finding("corrected", "accelerometer", text, fault, size_, 0.98, fix)]


def _same_fit(steps: str, acc: np.ndarray, force: np.ndarray) -> list[str]:
    """Return the signs of the axes, other than `steps`, that fit the flight as well.

    They differ only along axes on which the force is too small to show a sign. Along body x and y
    it consists of drag alone.

    Args:
        steps: a key of `SIGNS`; others have no alternatives.
        acc: (T, 3) accelerometer, read with these signs [m/s^2].
        force: (T, 3) force per mass along the path [m/s^2].
    """
    if not steps or steps not in SIGNS:
        return []
    rows = np.isfinite(acc).all(axis=1) & np.isfinite(force).all(axis=1)
    acc, force = acc[rows], force[rows]
    size = np.sqrt(np.sum(acc**2, axis=0) * np.sum(force**2, axis=0))
    seen = np.sum(acc * force, axis=0) > SEEN * size
    here = np.array(steps.split(","))
    differs = {other: here != other.split(",") for other in SIGNS if other not in ("", steps)}
    return [other for other, changed in differs.items() if not (changed & seen).any()]


def _unit_of(ratio: float, within: float) -> tuple[str, float]:
    """Return unit and factor of an accelerometer that measures `ratio` times the force.

    The unit is m/s^2 where no unit's factor is within the ratio `within` of `ratio`.
    """
    units = {"m/s^2": 1.0, **FORCES}
    unit = min(units, key=lambda name: abs(np.log(max(ratio, 1e-9) / units[name])))
    near = abs(np.log(max(ratio, 1e-9) / units[unit])) < np.log(within)
    return (unit, units[unit]) if near else ("m/s^2", 1.0)


def _unit_alone(rows: Rows) -> list[Finding]:
    """Return the finding on the accelerometer's unit and direction without a path.

    The usual specific force in flight is that of thrust: about one g, upwards.
    """
    acc = smooth(rows["time"], rows["acc"], WIDTH_S)
    ratio = _middle(acc) / GRAVITY
    figures = f"half of the flight it reads below {GRAVITY * ratio:.3g} m/s^2"
    mean, up = upwards(rows["acc"])
    if up < UPWARDS and ratio > 0.5:
        text = f"it reads ({', '.join(f'{v:.3g}' for v in mean)}) m/s^2, and thrust is along body z"
        fix = f"{option(('acc', 'x,-y,-z'))} for forward-right-down, or -x,-y,-z for its sign"
        fix = fix if up < -UPWARDS else "the accelerometer's columns"
        return [Finding("doubt", "accelerometer", text, "accelerometer_axes", None, 0.95, fix)]
    if 0.5 < ratio < 2.0:
        return [Finding("ok", "accelerometer", figures)]
    unit, factor = _unit_of(ratio, 1.5)
    if factor == 1.0:
        text = f"{figures}: no unit of it is one g, or gravity was taken out"
        return [Finding("doubt", "accelerometer", text, "accelerometer_unit", ratio, 0.9)]
    text = f"{figures}: it is in {unit}"
    fix = option(("acc", f"{1.0 / factor:.10g}"))
    return [Finding("corrected", "accelerometer", text, "accelerometer_unit", factor, 0.95, fix)]


def upwards(acc: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the accelerometer's median (3,), and the cosine between it and body z (1: upwards)."""
    known = acc[np.isfinite(acc).all(axis=1)]
    mean = np.median(known, axis=0) if len(known) else np.array([0.0, 0.0, 1.0])
    return mean, float(mean[2]) / max(float(np.linalg.norm(mean)), 1e-9)


def _middle(value: np.ndarray) -> float:
    """Return the median length of the vectors `value` (N, 3)."""
    size = np.linalg.norm(value, axis=1)
    known = size[np.isfinite(size)]
    return float(np.median(known)) if len(known) else 0.0
