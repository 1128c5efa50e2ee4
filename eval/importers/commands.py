"""Convert a log's commands to those of a flight log.

Motors are sorted into the vehicle file's order by their positions. Attitude set points become rate
commands by the vehicle file's attitude loop. Normalised thrust (0 to 1) becomes thrust per mass.
The thrust at full throttle is an option, or comes from the vehicle file (from its `[motors]` with
the battery voltage, if present), or is fitted to the accelerometer. Such a fit hides a wrong thrust
scale from a diagnosis, and a finding reports that.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.importers.options import ImportOptions
from eval.importers.signals import KEPT, MAD_TO_SD
from eval.logs.faults.drive.motors import SHIPPED_ORDER
from eval.logs.faults.finding import Finding
from eval.quadrotor.loops import command_of_throttle
from eval.vehicles.vehicle import Vehicle, motor_thrust

SHARE = f"{KEPT}thrust_share"
"""Signal of a normalised thrust that the firmware makes linear; a `throttle` may be the command of
the motors."""
FULL_THRUST_RANGE = (8.0, 200.0)
"""Possible thrust per mass of a multirotor at full throttle [m/s^2]."""


def order_motors(
    rows: dict[str, np.ndarray],
    motor_side: Sequence[tuple[float, float]] | None,
    vehicle: Vehicle | None,
) -> list[Finding]:
    """Sort motor signals of `rows` (see `rows_at`) into the vehicle's order, in place.

    `motor_side` has (x forward, y left) of the file's motors 1 to 4; None: they are in order.
    Without a vehicle, the order is that of the shipped ones.
    """
    if motor_side is None or not ({"motor", "motor_cmd", "pwm"} & rows.keys()):
        return []
    hubs = SHIPPED_ORDER if vehicle is None else [hub[:2] for hub in vehicle.rotors.position]
    # The best order is the one in which the hubs' directions from the centre agree best.
    file_hubs, wanted_hubs = (
        np.asarray(side) / np.linalg.norm(side, axis=1, keepdims=True)
        for side in (motor_side, hubs)
    )
    order = max(permutations(range(4)), key=lambda p: np.sum(file_hubs[list(p)] * wanted_hubs))
    for name in ("motor", "motor_cmd", "pwm"):
        if name in rows:
            rows[name] = rows[name][:, list(order)]
    numbers = ", ".join(str(k + 1) for k in order)
    owner = "the shipped vehicles" if vehicle is None else f"vehicle {vehicle.name!r}"
    return [Finding("note", "motors", f"put in the order of {owner}: the file's {numbers}")]


def thrust_command(
    rows: dict[str, np.ndarray], options: ImportOptions, by_acc: bool = True
) -> list[Finding]:
    """Add `cmd_thrust` [m/s^2] from `throttle` or `SHARE` of `rows` (see `rows_at`) in place.

    Without `vehicle` and `full_thrust` in `options`, the thrust is fitted to the accelerometer,
    unless `by_acc` is false, since that is in doubt.
    """
    name = "throttle" if "throttle" in rows else SHARE
    if "cmd_thrust" in rows or name not in rows:
        return []
    throttle = rows[name][:, 0]
    vehicle = options.vehicle
    if name != SHARE and options.full_thrust is None and vehicle and vehicle.motors:
        voltage = rows["voltage"][:, 0] if "voltage" in rows else None
        command = command_of_throttle(vehicle.controller, rows["throttle"])
        rows["cmd_thrust"] = 4.0 * motor_thrust(vehicle.motors, command, voltage) / vehicle.mass
        with_battery = "without a voltage" if voltage is None else "with the battery's voltage"
        text = f"normalised; by [motors] of vehicle {vehicle.name!r}, {with_battery}"
        return [Finding("note", "thrust", text)]
    full, finding = _full_thrust(rows, throttle, options, by_acc)
    if full is not None:
        rows["cmd_thrust"] = full * throttle[:, None]
    return [finding]


def _full_thrust(
    rows: dict[str, np.ndarray], throttle: np.ndarray, options: ImportOptions, by_acc: bool
) -> tuple[float | None, Finding]:
    """Return thrust per mass at full throttle [m/s^2] (None if unknown), and the finding."""
    linear = "taking thrust as proportional to throttle"
    if options.full_thrust is not None:
        text = f"normalised; full throttle is {options.full_thrust:g} m/s^2 as given, {linear}"
        return options.full_thrust, Finding("note", "thrust", text)
    if options.vehicle is not None:
        full = options.vehicle.full_thrust
        text = f"normalised; full throttle is {full:.4g} m/s^2 by the vehicle file, {linear}"
        return full, Finding("note", "thrust", text)
    if "acc" in rows and by_acc:
        full, residual = _fit_full_thrust(throttle, rows["acc"][:, 2])
        low, high = FULL_THRUST_RANGE
        if low <= full <= high:
            text = (
                f"normalised; full throttle is {full:.4g} m/s^2 by the accelerometer (residual "
                f"{residual:.2g} m/s^2), {linear}. A wrong thrust scale is not identifiable from "
                "this log; with --vehicle it is"
            )
            return full, Finding("note", "thrust", text)
        if np.isfinite(full):
            text = (
                f"normalised; full throttle would be {full:.3g} m/s^2 by the accelerometer, and "
                f"{low:g} to {high:g} is possible: left out; give --vehicle FILE or "
                "--full-thrust M/S^2"
            )
            about = ("thrust_scale", full, 0.95, "--full-thrust M/S^2")
            return None, Finding("doubt", "thrust", text, *about)
    text = (
        "normalised, and the thrust at full throttle is unknown: left out; "
        "give --vehicle FILE or --full-thrust M/S^2"
    )
    return None, Finding("doubt", "thrust", text)


def _fit_full_thrust(throttle: np.ndarray, acc_z: np.ndarray) -> tuple[float, float]:
    """Return thrust per mass at full throttle, and the residual's standard deviation [m/s^2].

    Both are by medians, so outliers do not count, and NaN for too few samples.
    """
    usable = np.isfinite(acc_z) & np.isfinite(throttle) & (throttle > 0.02) & (throttle <= 1.5)
    if np.sum(usable) <= 100:
        return np.nan, np.nan
    full = float(np.median(acc_z[usable] / throttle[usable]))
    residual = acc_z[usable] - full * throttle[usable]
    return full, MAD_TO_SD * float(np.median(np.abs(residual - np.median(residual))))


def rates_wanted(rows: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Replace `cmd_quat` (commanded attitudes) of `rows` (see `rows_at`) by `cmd_rate` [rad/s].

    A rate command in `rows` is kept. The rate is the attitude gain times the rotation vector to the
    set point, clipped to the vehicle's `rate_max`. Without a vehicle the set points are dropped.
    """
    if "cmd_quat" not in rows:
        return []
    wanted = rows.pop("cmd_quat")
    if "cmd_rate" in rows or "quat" not in rows:
        return []
    if vehicle is None:
        text = "are attitudes, and the attitude loop's gains are unknown: left out; give --vehicle"
        return [Finding("doubt", "set points", text)]
    norm = np.linalg.norm(wanted, axis=1, keepdims=True)
    error = rotation_vector(multiply(conjugate(rows["quat"]), wanted / norm))
    limit = np.asarray(vehicle.controller.rate_max)
    gain = np.asarray(vehicle.controller.attitude_gain)
    rows["cmd_rate"] = np.clip(gain * error, -limit, limit)
    text = f"are attitudes; rates by the attitude gains of {vehicle.name!r}, {gain.tolist()} 1/s"
    return [Finding("note", "set points", text)]
