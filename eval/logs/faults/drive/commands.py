"""Checks of commands: unit, signs and curve of rates, throttle range, delay, update rate.

*Rate loop*: the controller that makes the body follow a commanded body rate. *Rates curve*: the
map from a pilot's stick to a commanded body rate in the firmware. *Gain*: body rate over commanded
rate.
"""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.faults.drive.motors import fit_force, torque_correlations, turn_scale
from eval.logs.faults.drive.rate_following import bend, delayed, loop_gain
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import CALM_RATE, WIDTH_S, Rows
from eval.logs.faults.reading import DEG, option
from eval.logs.faults.relation import match, pooled_scale, rms, smooth, within
from eval.logs.faults.vectors import RATES, UPWARDS, check_gyro, upwards
from eval.vehicles.vehicle import Vehicle

LATE_S = 0.06
"""Allowed delay in addition to the delay of rate loop, rotors and a usual radio link [s]."""
EARLY = (0.03, 0.4, 0.5)
"""Commands that follow the gyro by more than the first [s] are logged too late, if their relative
residual is below the second and below the third times that of commands before the gyro."""
USUAL_S = 0.08
"""Delay of rate loop, rotors and radio link that is assumed without a vehicle file [s]."""
GAIN = (0.8, 1.25)
"""Correct range of the gain."""
UNITS = {"in degrees per second": 1.0 / DEG, "ten times too large (blackbox_high_resolution)": 10.0,
         "in rad/s, read as deg/s": DEG}  # fmt: skip
"""Wrong unit -> factor by which rate commands are then too large."""
LOOP_GAIN = (0.87, 1.1)
"""Correct range of the rate loop's gain at low frequency. Motors at their limits lower it."""
EQUAL = 1.2
"""The gains of the axes count as equal if the largest is within this factor of the smallest."""
SAME_UNIT = 1.15
"""A gain within this factor of a unit's conversion factor is explained by that unit."""
FASTEST_RMS = 8.0
"""Root mean square that correct rate commands do not exceed over a flight [rad/s]."""
MAPS = 3.0
"""A gain within this factor of 1 is explained by another rates curve, a larger one by a unit."""
OPPOSITE, FOLLOWED, BENT = -0.5, 0.92, 0.4
"""The first two are correlations of command and gyro: below the first the sign is wrong, above the
second the gain is reliable. The third is the least growth of the gain from small to large commands
(`bend`) that shows another rates curve."""
RANGES = (
    ("0 to 1", (0.0, 1.0), (0.03, 0.97), ""),
    ("percent", (0.0, 100.0), (8.0, 90.0), "0.01"),
    ("0 to 1000", (0.0, 1000.0), (100.0, 900.0), "0.001"),
    ("1000 to 2000 us", (1000.0, 2000.0), (1080.0, 1920.0), "1000-2000"),
    ("0 to 65535", (0.0, 65535.0), (6000.0, 62000.0), f"{1.0 / 65535.0:.10g}"),
)
"""Range of a throttle in words and as numbers, limits of its usual median in flight, and the step
of `--read` that converts it to 0 to 1 (empty where it is correct)."""
THRUST_FITS, THRUST_EFFECT, THRUST_SAME = 1.35, 2.0, 1.15
"""Limits of the commanded thrust over the force that the path needs. Within the first factor of a
unit's conversion factor, the ratio is explained by that unit. Within the second factor of 1 it may
be a physical effect or a wrong mass, and within the third it is m/s^2, whatever the mass is."""
OFFSET, OFFSET_RMS = 3.0, 3.0
"""Least constant difference of command and gyro that no unit explains: in rad/s, and relative to
the body rates (root mean square)."""
BOTH_SIGNS, ZERO = 0.05, 0.02
"""Share of negative and of positive values that no thrust has, since rotors only push; and the
share of the largest value below which a value has no sign."""
LEAST_TOP = 0.02
"""Throttle or mean motor command that every flight exceeds at least once, from 0 to 1."""
RATE_OFF = 0.1
"""Largest relative error of a controller's rate."""


def is_share(value: np.ndarray, quantile: float = 1.0) -> bool:
    """Return whether a throttle or motor commands (T, C) may go from 0 to 1, by this quantile."""
    known = value[np.isfinite(value).all(axis=1)].mean(axis=1)
    top = float(np.quantile(known, quantile)) if len(known) else 0.0
    return top <= 0.0 or LEAST_TOP <= top <= 1.5


def clip_commands(value: np.ndarray) -> np.ndarray:
    """Return motor commands (T, C) within their range, as motor drivers clip them.

    The range is 0 to 1, or the one of `RANGES` that fits where the commands are in another unit.
    """
    row = RANGES[0] if is_share(value, 0.9) else _range_of(float(np.nanmedian(value.mean(axis=1))))
    return value if row is None else np.clip(value, *row[1])


def _range_of(middle: float) -> tuple[str, tuple[float, float], tuple[float, float], str] | None:
    """Return the row of `RANGES` that fits a median of throttle or motor commands, if any."""
    return next((row for row in RANGES if row[2][0] <= middle <= row[2][1]), None)


def check_throttle(rows: Rows) -> list[Finding]:
    """Return a finding for throttle and for motor commands whose range is not 0 to 1."""
    findings = []
    for name, subject in (("throttle", "throttle"), ("pwm", "motor commands")):
        value = rows.get(name)
        if value is None or is_share(value):
            continue
        flying = value[np.isfinite(value).all(axis=1)].mean(axis=1)
        middle, top = float(np.median(flying)), float(np.max(flying))
        fit = _range_of(middle)
        figures = f"half of its values are below {middle:.4g} and all below {top:.4g}"
        if top < LEAST_TOP:
            text = f"{figures}, which lifts no vehicle: it was divided by too large a range"
            fix = "correct the unit in the mapping of suite import"
            findings.append(Finding("doubt", subject, text, "throttle_range", top, 0.95, fix))
            continue
        if fit is None:
            text = f"{figures}: no range from 0 to 1, percent, 1000 or 65535"
            findings.append(Finding("doubt", subject, text, "throttle_range", top, 0.95))
            continue
        range_in_words, (low, high), _, reading = fit
        if not reading:
            text = f"{figures}: it goes from 0 to 1, with {np.sum(flying > 1.5)} rows of outliers"
            about = ("throttle_range", top, 0.6, "leave these rows out of the file")
            findings.append(Finding("doubt", subject, text, *about))
            continue
        text = f"{figures}: it goes from {range_in_words}, not from 0 to 1"
        findings.append(Finding("corrected", subject, text, "throttle_range", high - low,
                             0.98, option((name, reading))))  # fmt: skip
    return findings


def has_both_signs(thrust: np.ndarray) -> bool:
    """Return whether a thrust (T,) pushes and pulls, as one without gravity does."""
    known = thrust[np.isfinite(thrust)]
    zero = ZERO * np.max(np.abs(known), initial=0.0)
    return bool(min(np.sum(known < -zero), np.sum(known > zero)) > BOTH_SIGNS * len(known))


def check_thrust_command(rows: Rows, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return a wrong unit or sign of the commanded thrust.

    The command is compared with the force that the measured motion needs.
    """
    subject, value = "thrust command", rows.get("cmd_thrust")
    if value is None or not ({"quat", "pos"} <= rows.keys() or "acc" in rows):
        return []
    thrust = value[:, 0]
    known = thrust[np.isfinite(thrust)]
    sign = -1.0 if len(known) and np.median(known) < 0.0 else 1.0
    ratio = fit_force(rows, thrust + GRAVITY)[1] if has_both_signs(thrust) else 0.0
    if 1.0 / THRUST_FITS < ratio < THRUST_FITS:
        text = f"it pushes and pulls, and with gravity added it is {ratio:.3g} times the force "
        text += "per mass that the path needs: gravity was taken out of it"
        fix = option(("cmd_thrust", "plus-gravity"))
        return [Finding("corrected", subject, text, "thrust_command_unit", None, 0.95, fix)]
    ratio = fit_force(rows, sign * thrust)[1]
    if ratio <= 0.0:
        return []
    figures = f"it is {sign * ratio:.3g} times the force per mass that the path needs"
    units = {"in m/s^2": 1.0, "in multiples of gravity (g)": 1.0 / GRAVITY}
    if vehicle is not None:
        units["in newtons"] = vehicle.mass
    # Units that explain the ratio. Newtons and m/s^2 are ambiguous for a mass near 1 kg.
    possible_units = within(units, THRUST_FITS, ratio)
    nearest_unit = min(possible_units, key=lambda n: abs(np.log(ratio / units[n])), default="")
    surely_not_m_s2 = abs(np.log(ratio)) > np.log(THRUST_SAME)
    may_be_newtons = nearest_unit == "in newtons" and "in m/s^2" in possible_units
    if surely_not_m_s2 and may_be_newtons and sign > 0.0:
        text = f"{figures}: it may be in newtons, as the mass is {units['in newtons']:.3g} kg, or "
        text += "thrust is off by so much"
        fix = option(("cmd_thrust", f"{1.0 / units['in newtons']:.6g}"))
        return [Finding("doubt", subject, text, "thrust_command_unit", ratio, 0.6, fix)]
    is_one_unit = len(possible_units) == 1 or "in m/s^2" in possible_units
    name = possible_units[0] if is_one_unit else ""
    if name != "in m/s^2" and abs(np.log(ratio)) < np.log(THRUST_EFFECT):
        text = f"{figures}: an effect, or a mass that is off"
        if sign < 0.0:
            about = ("thrust_command_unit", -1.0, 0.97, option(("cmd_thrust", "-1")))
            return [Finding("corrected", subject, f"{text}, and down is positive", *about)]
        return [Finding("note", subject, text, "thrust_scale", ratio, 0.9)]
    if not name:
        text = f"{figures}: another unit, a share of full thrust, or a mass that is far off"
        fix = "the unit of cmd_thrust in the mapping"
        return [Finding("doubt", subject, text, "thrust_command_unit", ratio, 0.95, fix)]
    factor = sign / units[name]
    if factor == 1.0:
        return [Finding("ok", subject, figures)]
    turned = ", and down is positive" if sign < 0.0 else ""
    fix = option(("cmd_thrust", f"{factor:.10g}"))
    text = f"{figures}: it is {name}{turned}, not in m/s^2 with up positive"
    return [Finding("corrected", subject, text, "thrust_command_unit", 1.0 / factor, 0.97, fix)]


def check_rate_command(rows: Rows, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return the findings on the commanded rates: sign, unit, rates curve and delay.

    The gyro is the reference, except where the gain is the factor of a wrong unit of the gyro.
    """
    if not {"cmd_rate", "rate"} <= rows.keys():
        return []
    time_s, subject = rows["time"], "rate command"
    both = np.isfinite(rows["cmd_rate"]).all(axis=1) & np.isfinite(rows["rate"]).all(axis=1)
    if both.sum() < 30:
        return [Finding("note", subject, "too few to check")]
    if min(rms(rows["cmd_rate"][both]), rms(rows["rate"][both])) == 0.0:
        constant_signal = "it" if rms(rows["cmd_rate"][both]) == 0.0 else "the gyro"
        return [Finding("note", subject, f"{constant_signal} is 0 throughout")]
    rate = smooth(time_s, rows["rate"], WIDTH_S)
    delay, command = delayed(time_s, rows["cmd_rate"], rate)
    if rms(rate) < CALM_RATE:
        text = f"turns of {rms(rate):.2g} rad/s are too small to check it by"
        return unseen(subject, text, "rate_curve")
    matched = match(command, rate)
    # No command follows the gyro. One that fits far better so is logged too late.
    smoothed = smooth(time_s, rows["cmd_rate"], WIDTH_S)
    early, gyro = delayed(time_s, rows["rate"], smoothed)
    reverse = match(smoothed, gyro)
    misfit, usual = (m.misfit(m.as_given) for m in (reverse, matched))
    if early > EARLY[0] and misfit < min(EARLY[1], EARLY[2] * usual):
        text = f"it follows the gyro after {1e3 * early:.0f} ms: it is logged too late"
        fix = "the link's or the logger's clock"
        return [Finding("doubt", subject, text, "command_delay", -early, 0.93, fix)]
    # Signs and order of the axes.
    correlations = ", ".join(f"{v:+.2f}" for v in matched.as_given)
    figures = f"the gyro follows it after {1e3 * delay:.0f} ms with correlations {correlations}"
    if not matched.seen.any():
        text = f"{figures}: the gyro does not follow it"
        return [Finding("doubt", subject, text, "rate_command_sign", None, 0.9)]
    if matched.is_turned or (matched.as_given < OPPOSITE).any():
        sign = [("-" if v < OPPOSITE else "") + "xyz"[k] for k, v in enumerate(matched.as_given)]
        axes = matched.axes if matched.is_turned else ",".join(sign)
        text = f"{figures}; its axes are {axes}: check the signs"
        sure = 0.98 if matched.is_turned else 0.9
        return [Finding("doubt" if sure < 0.95 else "corrected", subject, text,
                        "rate_command_sign", None, sure, option(("cmd_rate", axes)))]  # fmt: skip
    # Unit of the command, then unit of the gyro. A unit explains no offset, which sticks have.
    gain, low, high = pooled_scale(matched)
    middle, turned = (np.nanmedian(value, axis=0) for value in (command, rate))
    axis = int(np.argmax(np.abs(middle * gain - turned)))
    if np.abs(middle * gain - turned)[axis] > max(OFFSET, OFFSET_RMS * rms(rate)):
        text = f"half of its values about {'xyz'[axis]} are below {middle[axis]:.4g}, and the gyro "
        text += f"turns at {turned[axis]:.2g} rad/s there: stick pulses, or another offset"
        fix = "the firmware's map from sticks to rates"
        return [Finding("doubt", subject, text, "rate_command_unit", middle[axis], 0.95, fix)]
    for words, factor in UNITS.items():
        if abs(np.log(gain * factor)) < np.log(1.4) and (factor > 1.0 or _gyro_is_right(rows)):
            text = f"{figures}, by {gain:.3g} of it: it is {words}"
            fix = option(("cmd_rate", f"{1.0 / factor:.10g}"))
            return [Finding("corrected", subject, text, "rate_command_unit", factor, 0.98, fix)]
    for name in within({w: f for w, f in RATES.items() if f > 1.0}, 1.4, gain):
        text = f"{figures}, by {gain:.3g} of it: the gyro is in {name}"
        fix = option(("rate", f"{1.0 / RATES[name]:.10g}"))
        return [Finding("doubt", "gyro", text, "gyro_scale", RATES[name], 0.95, fix)]
    findings = []
    bent = bend(time_s, command, rate)
    if np.isfinite(gain) and (high < GAIN[0] or low > GAIN[1] or bent > BENT):
        shape = f", and {1.0 + bent:.2g} times as much of large ones as of small ones"
        text = f"{figures}, by {gain:.3g} of it ({low:.3g} to {high:.3g}){shape}: a stick map or "
        text += "a rates curve that the log's commands do not have"
        sure = 0.93 if matched.alike[matched.seen].min() > FOLLOWED else 0.7
        findings.append(_other_curve(text, gain, sure))
    if delay > LATE_S + (USUAL_S if vehicle is None else _response(vehicle)):
        text = f"{figures}: later than the rate loop, rotors and a link make it"
        fix = "the link's or the logger's clock; a delay in the simulation: effects.command_delay"
        findings.append(Finding("doubt", subject, text, "command_delay", delay, 0.93, fix))
    return findings or [Finding("ok", subject, figures)]


def _gyro_is_right(rows: Rows) -> bool:
    """Return whether the attitude confirms the gyro's unit; without one, whether it may be right.

    A gyro in deg/s, read as rad/s, exceeds usual rates.
    """
    if "quat" in rows:
        return any(f.signal == "gyro" and f.status == "ok" for f in check_gyro(rows))
    return rms(rows["rate"]) < FASTEST_RMS


def check_gyro_signs(rows: Rows, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return inverted axes of the gyro in a log without an attitude.

    An axis of the gyro is inverted where both the rate commands and the motors' torques contradict
    it; one of these alone could be wrong itself. All body axes are forward-right-down where the
    torques contradict y and z, and the accelerometer measures thrust downwards.
    """
    if "quat" in rows or not {"cmd_rate", "rate"} <= rows.keys():
        return []
    torque = torque_correlations(rows, vehicle)
    rate = smooth(rows["time"], rows["rate"], WIDTH_S)
    if torque is None or rms(rate) < CALM_RATE:
        return []
    _, command = delayed(rows["time"], rows["cmd_rate"], rate)
    followed = match(command, rate).as_given
    if not (np.minimum(np.abs(followed), np.abs(torque)) > -OPPOSITE).all():
        return []
    pairs = ", ".join(f"{c:+.2f} and {t:+.2f}" for c, t in zip(followed, torque, strict=True))
    text = f"its correlations with commands and with the motors' torques are {pairs} about x, y, z"
    inverted, signals = (followed < 0.0) & (torque < 0.0), ["rate"]
    axes = ",".join(("-" if w else "") + "xyz"[k] for k, w in enumerate(inverted))
    upside_down = "acc" in rows and upwards(rows["acc"])[1] < -UPWARDS
    if upside_down and (np.sign(torque) == [1.0, -1.0, -1.0]).all():
        axes, signals = "x,-y,-z", ["rate", "acc"]
        signals += ["cmd_rate"] if (followed > 0.0).all() else []
        text += ", and the accelerometer reads thrust downwards"
    elif not inverted.any():
        return []
    frame = "body_frame" if axes == "x,-y,-z" else "gyro_axes"
    fix = option(*((signal, axes) for signal in signals))
    return [Finding("corrected", "gyro", text, frame, None, 0.95, fix)]


def check_gyro_scale(rows: Rows, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return a wrong scale of the gyro in a log without an attitude, by the rate loop's gain.

    The loop makes the body rate equal to a steady command. Where it does not, the scale of the gyro
    or of the command is wrong. A known factor of a unit, or the motors' torques, decide which.
    """
    if "quat" in rows or not {"cmd_rate", "rate"} <= rows.keys():
        return []
    gains = loop_gain(rows["time"], rows["cmd_rate"], rows["rate"])
    if gains is None or LOOP_GAIN[0] < gains[0] < LOOP_GAIN[1]:
        return []
    gain, between_axes = gains
    text = f"it is {gain:.3g} times a steady rate command"
    unit = next(iter(within(RATES, SAME_UNIT, gain)), None)
    is_command = unit == "deg/s" and _gyro_is_right(rows)
    if unit is not None and rms(rows["cmd_rate"]) < FASTEST_RMS and not is_command:
        fix = option(("rate", f"{1.0 / RATES[unit]:.10g}"))
        text = f"{text}: {unit}"
        return [Finding("corrected", "gyro", text, "gyro_scale", RATES[unit], 0.95, fix)]
    if between_axes > EQUAL:
        return []
    scale, _ = turn_scale(rows, vehicle) or (None, None)
    if scale is not None:
        text += f", and {scale:.3g} times what the motors' torques give by the vehicle file"
    if scale is not None and abs(np.log(scale / gain)) < abs(np.log(scale)):
        fix = option(("rate", f"{1.0 / gain:.4g}"))
        return [Finding("doubt", "gyro", text, "gyro_scale", gain, 0.93, fix)]
    if gain < 1.0 / MAPS or gain > MAPS:
        return []  # `check_rate_command` names units
    text = f"the gyro is {text.removeprefix('it is ')}: another map from sticks to rates"
    text += "" if scale is not None else ", or the gyro's scale"
    return [_other_curve(text, gain, 0.9)]


def _other_curve(text: str, gain: float, sure: float) -> Finding:
    """Return the doubt that another rates curve causes the `gain`."""
    fix = "the firmware's rates curve for the map from sticks, or "
    fix += option(("cmd_rate", f"{gain:.4g}"))
    return Finding("doubt", "rate command", text, "rate_curve", gain, sure, fix)


def _response(vehicle: Vehicle) -> float:
    """Return the expected delay from rate command to body rate by the vehicle file [s].

    It is the sum of the link's delay, the rotors' time constant and that of the rate loop.
    """
    known = vehicle.effects.get("command_delay")
    loop = 0.0 if vehicle.controller.settings is not None else vehicle.controller.rate_gain[0]
    late = 0.03 if known is None else float(known.delay)
    return late + vehicle.rotors.time_constant + (1.0 / loop if loop else 0.05)


def check_controller_rate(rows: Rows, wanted_hz: float | None) -> list[Finding]:
    """Return a finding on whether commands change at the policy's rate `wanted_hz` [Hz]."""
    name = next((n for n in ("action", "cmd_rate", "cmd_thrust", "motor_cmd", "pwm")
                 if n in rows), None)  # fmt: skip
    if wanted_hz is None or name is None:
        return []
    complete = np.isfinite(rows[name]).all(axis=1)
    time_s, value = rows["time"][complete], rows[name][complete]
    if len(time_s) < 20:
        return unseen("controller", "its commands are in few rows", "controller_rate")
    change = np.flatnonzero(np.any(np.diff(value, axis=0) != 0.0, axis=1)) + 1
    row_hz = 1.0 / float(np.median(np.diff(time_s)))
    if len(change) < 20:
        return unseen("controller", "its commands hardly change", "controller_rate")
    hz = (len(change) - 1) / float(time_s[change[-1]] - time_s[change[0]])
    holds = float(np.median(np.diff(time_s[change])))
    figures = f"commands change {hz:.3g} times a second (each {1e3 * holds:.0f} ms)"
    if hz > 0.9 * row_hz:
        text = f"{figures}, with every row: log faster than the controller runs"
        return unseen("controller", text, "controller_rate")
    if abs(hz / wanted_hz - 1.0) < RATE_OFF:
        return [Finding("ok", "controller", figures)]
    text = f"{figures}, and the policy says {wanted_hz:g} Hz"
    fix = (
        f"the link or the computer that keeps it from {wanted_hz:g} Hz, or a policy of {hz:.0f} Hz"
    )
    return [Finding("doubt", "controller", text, "controller_rate", hz, 0.95, fix)]
