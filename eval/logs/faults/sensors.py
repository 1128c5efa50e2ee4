"""Checks of battery voltage, barometer and the accelerometer under vibration."""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import rotate
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import Rows
from eval.logs.faults.reading import option
from eval.logs.faults.relation import forward_mean
from eval.logs.velocity import velocity_from_position

LEAST_V, MOST_V = 2.5, 70.0
"""Possible battery voltages, from one empty cell to sixteen full cells [V]."""
SUNK_M = 0.5
"""Least fall of the height as the motors start [m]."""
SPAN_S = 0.6
"""Time over which changes of the vertical speed are compared [s]."""
BIAS, ALIKE = 0.15, 0.6
"""Least median error of the accelerometer that the throttle causes [m/s^2], and least size of the
correlation of the accelerometer's error with the squared throttle."""


def check_voltage_fails(value: np.ndarray) -> bool:
    """Return whether the median of `value` [V] is impossible for a battery, or unknown."""
    known = value[np.isfinite(value)]
    return not len(known) or not LEAST_V <= float(np.median(known)) <= MOST_V


def check_voltage(rows: Rows) -> list[Finding]:
    """Return a finding on whether the battery's voltage is possible, and on its unit."""
    value = rows.get("voltage")
    if value is None or not np.isfinite(value).any():
        return []
    middle = float(np.nanmedian(value))
    if LEAST_V <= middle <= MOST_V:
        return [Finding("ok", "voltage", f"{middle:.3g} V")]
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
    running = load > 0.3 * np.nanquantile(load, 0.9)
    if running.all() or not running.any():
        text = "the log has no row before the motors start"
        return unseen("barometer", text, "barometer_spin_up")
    start = int(np.argmax(running))
    time_s, value = rows["time"], height[:, 0]
    before = value[(time_s < time_s[start]) & (time_s > time_s[start] - 2.0)]
    after = value[(time_s > time_s[start]) & (time_s < time_s[start] + 1.0)]
    if not len(before) or not len(after):
        return []
    true = 0.0
    if "pos" in rows:
        up = rows["pos"][:, 2]
        true = float(np.nanmedian(up[(time_s > time_s[start]) & (time_s < time_s[start] + 1.0)])
                     - np.nanmedian(up[time_s < time_s[start]]))  # fmt: skip
    fall = float(np.nanmin(after) - np.nanmedian(before)) - min(true, 0.0)
    if fall < -SUNK_M:
        text = f"its height falls by {-fall:.2g} m in the second in which the motors start"
        fix = "foam over the barometer, or a height from elsewhere; leave baro out"
        return [Finding("doubt", "barometer", text, "barometer_spin_up", fall, 0.95, fix)]
    return [Finding("ok", "barometer", f"it moves by {fall:+.2g} m as the motors start")]
