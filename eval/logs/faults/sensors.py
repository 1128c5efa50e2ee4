"""Checks of single sensors: voltage, barometer, vibration, and signals that stand still."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import rotate
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import CALM_RATE, Rows, turns_of
from eval.logs.faults.reading import option
from eval.logs.faults.relation import forward_mean, rms, smooth
from eval.logs.velocity import velocity_from_position
from eval.vehicles.vehicle import Vehicle

LEAST_V, MOST_V = 2.5, 70.0
"""Possible battery voltages, from one empty cell to sixteen full cells [V]."""
NOMINAL = 1.5
"""A battery's median voltage is within this factor of its nominal one: full and loaded empty cells
are within 1.2 and 1.3."""
SUNK_M = 0.5
"""Least fall of the height as the motors start [m]."""
SPAN_S = 0.6
"""Time over which changes of the vertical speed are compared [s]."""
BIAS, ALIKE = 0.15, 0.6
"""Least median error of the accelerometer that the throttle causes [m/s^2], and least size of the
correlation of the accelerometer's error with the squared throttle."""
LOST_S, LOST_HOLDS, LOST_RATE = 0.2, 5.0, 0.3
"""A pose that repeats for longer [s], and for so many times the usual hold, is lost where the gyro
turns faster [rad/s]."""
LOST_SHARE = 0.1
"""Share of lost rows above which the signal is doubtful."""
MEAN_SPEED = 0.4
"""Least median difference between the velocity and the path's that is a fault [m/s]."""
COPIED = 0.95
"""Share of rows in which the gyro equals the rate command, above which it is no measurement."""
COARSE = 4.0
"""A signal is coarse if its median change between samples is below this many steps of its
resolution. Repeated samples of a coarse signal may be real."""
TURN_S = 0.2
"""Averaging time of the attitude's turns, next to which an axis of the gyro is constant [s]."""


def check_voltage_fails(value: np.ndarray) -> bool:
    """Return whether the median of `value` [V] is impossible for a battery, or unknown."""
    known = value[np.isfinite(value)]
    return not len(known) or not LEAST_V <= float(np.median(known)) <= MOST_V


def check_voltage(rows: Rows, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return a finding on whether the battery's voltage is possible, and on its unit.

    The voltage must be near the nominal one of `vehicle`, if its motors depend on the voltage.
    """
    value = rows.get("voltage")
    if value is None or not np.isfinite(value).any():
        return []
    middle = float(np.nanmedian(value))
    if LEAST_V <= middle <= MOST_V:
        motors = None if vehicle is None else vehicle.motors
        ratio = middle / motors.voltage if motors and motors.voltage_exponent else 1.0
        if 1.0 / NOMINAL < ratio < NOMINAL:
            return [Finding("ok", "voltage", f"{middle:.3g} V")]
        text = f"{middle:.3g} V is {ratio:.3g} times motors.voltage of the vehicle file"
        fix = "the number of cells or the unit in the log, or motors.voltage"
        return [Finding("doubt", "voltage", text, "voltage", middle, 0.95, fix)]
    for unit, scale in (("mV", 1e-3), ("hundredths of a volt", 1e-2), ("tenths of a volt", 0.1)):
        if middle > MOST_V and LEAST_V <= middle * scale <= MOST_V:
            text = f"{middle:.4g} V in the file: it is in {unit}"
            fix = option(("voltage", f"{scale:g}"))
            return [Finding("corrected", "voltage", text, "voltage", middle, 0.95, fix)]
    text = f"{middle:.3g} V is no battery's: left out, so that no thrust is scaled by it"
    return [
        Finding("corrected", "voltage", text, "voltage", middle, 0.97, option(("voltage", "drop")))
    ]


def check_accelerometer_bias(rows: Rows) -> list[Finding]:
    """Return a finding where the accelerometer's error along z grows with the throttle squared.

    The true acceleration is the change of the vertical speed over `SPAN_S`. The error of the
    accelerometer's mean over the same time is fitted by a line over the throttle squared.
    """
    drive = next((n for n in ("throttle", "pwm", "motor", "cmd_thrust") if n in rows), None)
    if not {"acc", "pos", "quat"} <= rows.keys() or drive is None:
        return []
    time_s = rows["time"]
    vel = rows["vel"] if "vel" in rows else velocity_from_position(time_s, rows["pos"])
    load = np.mean(np.abs(rows[drive]), axis=1)
    load = load / (1.0 if drive in ("throttle", "pwm") else np.nanquantile(load, 0.99))
    up = rotate(rows["quat"], np.array([0.0, 0.0, 1.0]))[:, 2]
    acc_up = rotate(rows["quat"], rows["acc"])[:, 2] - GRAVITY
    both = np.stack([acc_up, up * load**2], axis=1)
    count = max(1, round(SPAN_S / float(np.median(np.diff(time_s)))))
    if len(time_s) <= count:
        return []
    acc_up, power = forward_mean(both, count)[1:].T
    error_up = acc_up - (vel[count:, 2] - vel[:-count, 2]) / (time_s[count:] - time_s[:-count])
    good = np.isfinite(error_up) & np.isfinite(power)
    if good.sum() < 5 * count or min(np.std(power[good]), np.std(error_up[good])) < 1e-6:
        return []
    slope, level = np.polyfit(power[good], error_up[good], 1)
    correlation = float(np.corrcoef(power[good], error_up[good])[0, 1])
    median_error = float(np.median(error_up[good]))
    usual_power = float(np.median(power[good]))
    residual = error_up[good] - np.polyval((slope, level), power[good])
    independent = max((time_s[-1] - time_s[0]) / SPAN_S, 3.0)
    error = float(residual.std() / (power[good].std() * np.sqrt(independent)))
    if 2.0 * error * usual_power > 2.0 * BIAS:
        text = f"its bias at full throttle is {slope:+.1f} m/s^2 with an error of {error:.1f}"
        return unseen("accelerometer", text, "accelerometer_throttle_bias")
    share = slope * usual_power
    if share > -BIAS or median_error > 0.5 * share or correlation > -ALIKE:
        return []
    text = (
        f"it reads {median_error:+.2f} m/s^2 too much along body z and {slope:+.2f} more at full "
        f"throttle (correlation {correlation:+.2f}): vibration biases it"
    )
    fix = "soft mounting or a wider range; do not scale thrust by it"
    about = ("accelerometer_throttle_bias", float(slope), 0.92, fix)
    return [Finding("doubt", "accelerometer", text, *about)]


def check_barometer(rows: Rows) -> list[Finding]:
    """Return a finding on whether the barometer's height falls as the motors spin up."""
    height = rows.get("baro")
    drive = next((n for n in ("throttle", "pwm", "motor") if n in rows), None)
    if height is None or drive is None:
        return []
    load = np.mean(np.abs(rows[drive]), axis=1)
    known = np.isfinite(load)  # whether the motors run is unknown in other rows
    rows = {name: rows[name][known] for name in ("time", "pos") if name in rows}
    height, load = height[known], load[known]
    running = load > 0.3 * np.quantile(load, 0.9) if len(load) else known
    if running.all() or not running.any():
        text = "the log has no row before the motors start"
        return unseen("barometer", text, "barometer_spin_up")
    start_s = rows["time"][np.argmax(running)]
    up = rows["pos"][:, 2] if "pos" in rows else np.zeros(len(height))
    known = np.isfinite(height[:, 0]) & np.isfinite(up)
    time_s, value, up = rows["time"][known], height[known, 0], up[known]
    before, after = time_s < start_s, (time_s > start_s) & (time_s < start_s + 1.0)
    shortly_before = before & (time_s > start_s - 2.0)
    if not shortly_before.any() or not after.any():
        return []
    rise = float(np.median(up[after]) - np.median(up[before]))
    fall = float(np.min(value[after]) - np.median(value[shortly_before])) - min(rise, 0.0)
    if fall < -SUNK_M:
        text = f"its height falls by {-fall:.2g} m in the second in which the motors start"
        fix = "foam over the barometer, or a height from elsewhere; leave baro out"
        return [Finding("doubt", "barometer", text, "barometer_spin_up", fall, 0.95, fix)]
    return [Finding("ok", "barometer", f"it moves by {fall:+.2g} m as the motors start")]


def check_still(rows: Rows) -> list[Finding]:
    """Return doubts on a pose that is lost for much of the flight, and on a gyro's dead axes."""
    findings = _dead_axes(rows) if {"quat", "rate"} <= rows.keys() else []
    for name, subject, fault in (
        ("quat", "attitude", "attitude"),
        ("pos", "position", "position_jump"),
    ):
        if not {name, "rate"} <= rows.keys():
            continue
        known, turned = (np.isfinite(rows[n]).all(axis=1) for n in (name, "rate"))
        time_s, value = rows["time"][known], rows[name][known]
        is_lost = lost_samples(time_s, value, rows["time"][turned], rows["rate"][turned])
        share = float(np.mean(is_lost)) if len(is_lost) else 0.0
        if share > LOST_SHARE:
            text = f"{100 * share:.0f} % of it stands still while the gyro turns"
            fix = option((name, "drop"))
            fix += "" if is_lost[1:].all() else " or suite import, which leaves this part out"
            findings.append(Finding("doubt", subject, text, fault, share, 0.95, fix))
    return findings


def check_velocity_mean(rows: Rows) -> list[Finding]:
    """Return the doubt on a velocity whose mean differs from that of the path; [] for none."""
    if not {"pos", "vel"} <= rows.keys():
        return []
    apart = rows["vel"] - velocity_from_position(rows["time"], rows["pos"])
    apart = apart[np.isfinite(apart).all(axis=1)]
    mean = np.median(apart, axis=0) if len(apart) else np.zeros(3)
    size = float(np.linalg.norm(mean))
    if size < MEAN_SPEED:
        return []
    values = ", ".join(f"{value:+.2g}" for value in mean)
    text = f"it differs from the path's by ({values}) m/s on average: an air speed, or an offset"
    return [
        Finding("doubt", "velocity", text, "velocity_mean", size, 0.95, option(("vel", "drop")))
    ]


def check_copy(rows: Mapping[str, np.ndarray]) -> list[Finding]:
    """Return the doubt on a gyro whose samples equal the rate command: one column was read twice.

    Both signals have the same times; no body follows a command without a delay.
    """
    if not {"rate", "cmd_rate"} <= rows.keys() or rows["rate"].shape != rows["cmd_rate"].shape:
        return []
    rate, command = rows["rate"], rows["cmd_rate"]
    known = np.isfinite(rate).all(axis=1) & np.isfinite(command).all(axis=1)
    turns = known & (np.abs(command) > 0.0).all(axis=1)
    share = float(np.mean(np.isclose(rate, command)[turns].all(axis=1))) if turns.any() else 0.0
    if share < COPIED or not np.ptp(command[turns], axis=0).all():
        return []
    text = f"it equals the rate command in {100 * share:.0f} % of the rows, without a delay"
    fix = "map the gyro's columns: the measured rates, not the set points"
    return [Finding("doubt", "gyro", text, "gyro_axes", None, 0.97, fix)]


def _dead_axes(rows: Rows) -> list[Finding]:
    """Return the doubt on axes of the gyro that are constant while the attitude turns there."""
    turns = smooth(rows["time"], turns_of(rows["time"], rows["quat"]), TURN_S)
    turns, rate = (value[np.isfinite(value).all(axis=1)] for value in (turns, rows["rate"]))
    if not len(turns) or not len(rate):
        return []
    is_dead = (np.ptp(rate, axis=0) == 0.0) & (turns.std(axis=0) > CALM_RATE)
    if not is_dead.any():
        return []
    axes = " and ".join(np.array(list("xyz"))[is_dead])
    text = f"it never changes about {axes}, and the attitude turns there"
    fix = option(("rate", "drop")) + " or log it again"
    return [Finding("doubt", "gyro", text, "gyro_axes", None, 0.95, fix)]


def lost_samples(
    time_s: np.ndarray, value: np.ndarray, rate_time_s: np.ndarray, rate: np.ndarray
) -> np.ndarray:
    """Return which samples (N,) bool of a pose stand still while the gyro turns.

    Args:
        time_s: (N,) times of the pose [s].
        value: (N, C) positions or attitudes.
        rate_time_s: (M,) times of the gyro, on the same clock [s].
        rate: (M, 3) body rates [rad/s].
    """
    is_lost = np.zeros(len(time_s), dtype=bool)
    changes = np.flatnonzero(np.diff(value, axis=0).any(axis=1)) + 1
    if not len(time_s) or (len(changes) and is_coarse(value)):
        return is_lost
    starts, stops = np.append(0, changes), np.append(changes, len(time_s))
    held_s = time_s[stops - 1] - time_s[starts]
    usual_s = np.median(held_s) if len(changes) else 0.0
    longest_s = LOST_S + LOST_HOLDS * usual_s  # a slow signal is held in fast rows
    for first, stop, hold_s in zip(starts, stops, held_s, strict=True):
        if hold_s > longest_s:
            inside = (rate_time_s >= time_s[first]) & (rate_time_s <= time_s[stop - 1])
            is_lost[first + 1 : stop] = inside.any() and rms(rate[inside]) > LOST_RATE
    return is_lost


def is_coarse(value: np.ndarray) -> bool:
    """Return whether changes of `value` (N, C) are a few steps of a coarse resolution (1 mm)."""
    change = np.abs(np.diff(value, axis=0))
    change = change[change > 0.0]
    if not len(change):
        return True
    # A low quantile, because rounding makes the very smallest change smaller than a step.
    resolution_step = float(np.quantile(change, 0.02))
    return float(np.median(change)) < COARSE * resolution_step
