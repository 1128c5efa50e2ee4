"""Normalised thrust (0 to 1) as thrust per mass.

What full throttle gives is told by the user, or follows from the vehicle file (by its `[motors]`
with the battery's voltage, where it has them), or is fitted to the accelerometer. The last takes
what a diagnosis would look for in the thrust's scale into the command, and says so.
"""

from __future__ import annotations

import numpy as np

from eval.importers.findings import Finding
from eval.importers.options import ImportOptions
from eval.vehicles.motors import motor_thrust
from eval.vehicles.vehicle import MotorMap, Vehicle


def thrust_command(rows: dict[str, np.ndarray], options: ImportOptions) -> list[Finding]:
    """Replace `throttle` of `rows` by `cmd_thrust` [m/s^2], in place, where that can be done."""
    if "cmd_thrust" in rows or "throttle" not in rows:
        return []
    throttle = rows["throttle"][:, 0]
    if options.full_thrust is None and options.vehicle and options.vehicle.motors:
        return _by_motors(rows, options.vehicle, options.vehicle.motors)
    full, findings = _full_thrust(rows, throttle, options)
    if full is None:
        return findings
    rows["cmd_thrust"] = full * throttle[:, None]
    return findings


def _by_motors(rows: dict[str, np.ndarray], vehicle: Vehicle, motors: MotorMap) -> list[Finding]:
    """Return findings of a throttle that the vehicle's `[motors]` turn into thrust, in place."""
    voltage = rows["voltage"][:, 0] if "voltage" in rows else None
    thrust = 4.0 * motor_thrust(motors, rows["throttle"], voltage)[:, 0] / vehicle.mass
    rows["cmd_thrust"] = thrust[:, None]
    with_battery = "with the battery's voltage" if voltage is not None else "without a voltage"
    text = f"normalised; by [motors] of vehicle {vehicle.name!r}, {with_battery}"
    return [Finding("note", "thrust", text), *_hover(rows, thrust)]


def _full_thrust(
    rows: dict[str, np.ndarray], throttle: np.ndarray, options: ImportOptions
) -> tuple[float | None, list[Finding]]:
    linear = "taking thrust as proportional to it"
    if options.full_thrust is not None:
        text = f"normalised; full throttle is {options.full_thrust:g} m/s^2 as told, {linear}"
        return options.full_thrust, [Finding("note", "thrust", text)]
    if options.vehicle is not None:
        full = options.vehicle.full_thrust
        text = f"normalised; full throttle is {full:.4g} m/s^2 by the vehicle file, {linear}"
        return full, [Finding("note", "thrust", text), *_hover(rows, full * throttle)]
    if "acc" in rows:
        acc = rows["acc"][:, 2]
        good = np.isfinite(acc) & np.isfinite(throttle) & (throttle > 0.02)
        if np.sum(good) > 100:
            full = float(np.sum(acc[good] * throttle[good]) / np.sum(throttle[good] ** 2))
            rest = float(np.std(acc[good] - full * throttle[good]))
            if full > 0:
                text = (
                    f"normalised; full throttle is {full:.4g} m/s^2 by the accelerometer "
                    f"({rest:.2g} m/s^2 are left), {linear}. A wrong thrust scale cannot be seen "
                    "in this log; with --vehicle it can"
                )
                return full, [Finding("note", "thrust", text)]
    text = (
        "normalised, and nothing says what full throttle gives: left out; "
        "give --vehicle FILE or --full-thrust M/S^2"
    )
    return None, [Finding("doubt", "thrust", text)]


def _hover(rows: dict[str, np.ndarray], thrust: np.ndarray) -> list[Finding]:
    """Say where the mean commanded thrust is far from what the flight needed."""
    if "acc" not in rows:
        return []
    good = np.isfinite(thrust) & np.isfinite(rows["acc"][:, 2])
    needed = float(np.mean(rows["acc"][good, 2])) if good.any() else 0.0
    ratio = float(np.mean(thrust[good])) / needed if needed > 1.0 else 1.0
    if 0.7 < ratio < 1.4:
        return []
    text = (
        f"the mean command is {ratio:.2f} times what the accelerometer felt; the vehicle's mass, "
        "thrust coefficient or speed_max, or a curved throttle"
    )
    return [Finding("doubt", "thrust", text)]
