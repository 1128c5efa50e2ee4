"""Convert a log's commands to those of a flight log.

Motors are sorted into the vehicle file's order by their positions. Attitude set points become rates
by the vehicle file's attitude loop. Normalised thrust (0 to 1) becomes thrust per mass. Its value
at full throttle is an option, or comes from the vehicle file (from its `[motors]` with the battery
voltage, if present), or is fitted to the accelerometer. Such a fit hides a wrong thrust scale from
a diagnosis, and a finding reports that.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.importers.options import ImportOptions
from eval.logs.faults.finding import Finding
from eval.vehicles.vehicle import MotorMap, Vehicle, motor_thrust

SHIPPED_ORDER = ((1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
"""Front right, rear right, rear left, front left: the order of the shipped vehicles."""
FULL = (8.0, 200.0)
"""Possible thrust per mass of a multirotor at full throttle [m/s^2]."""
SIDES = ("front right", "rear right", "rear left", "front left")


def order_motors(
    rows: dict[str, np.ndarray],
    motor_side: Sequence[tuple[float, float]] | None,
    vehicle: Vehicle | None,
) -> list[Finding]:
    """Sort `motor`, `motor_cmd` and `pwm` of `rows` into the vehicle's order, in place.

    Args:
        rows: see `eval.importers.rows`.
        motor_side: (x forward, y left) of the file's motors 1 to 4; None: already in order.
        vehicle: with the wanted order; None: that of the shipped vehicles.
    """
    if motor_side is None or not ({"motor", "motor_cmd", "pwm"} & rows.keys()):
        return []
    hubs = SHIPPED_ORDER if vehicle is None else [hub[:2] for hub in vehicle.rotors.position]
    have, wanted = _directions(motor_side), _directions(hubs)
    order = max(permutations(range(4)), key=lambda p: float(np.sum(have[list(p)] * wanted)))
    for name in ("motor", "motor_cmd", "pwm"):
        if name in rows:
            rows[name] = rows[name][:, list(order)]
    numbers = ", ".join(str(k + 1) for k in order)
    whose = "the shipped vehicles" if vehicle is None else f"vehicle {vehicle.name!r}"
    return [Finding("note", "motors", f"put in the order of {whose}: the file's {numbers}")]


def _directions(hubs: Sequence[Sequence[float]]) -> np.ndarray:
    array = np.asarray(hubs, dtype=np.float64)
    return array / np.linalg.norm(array, axis=1, keepdims=True)


def thrust_command(
    rows: dict[str, np.ndarray], options: ImportOptions, by_acc: bool = True
) -> list[Finding]:
    """Replace `throttle` of `rows` by `cmd_thrust` [m/s^2] in place, where possible.

    Args:
        rows: see `eval.importers.rows`.
        options: the vehicle, and thrust per mass at full throttle.
        by_acc: otherwise fit it to the accelerometer; False for a suspicious accelerometer.
    """
    if "cmd_thrust" in rows or "throttle" not in rows:
        return []
    throttle = rows["throttle"][:, 0]
    if options.full_thrust is None and options.vehicle and options.vehicle.motors:
        return _by_motors(rows, options.vehicle, options.vehicle.motors)
    full, findings = _full_thrust(rows, throttle, options, by_acc)
    if full is None:
        return findings
    rows["cmd_thrust"] = full * throttle[:, None]
    return findings


def _by_motors(rows: dict[str, np.ndarray], vehicle: Vehicle, motors: MotorMap) -> list[Finding]:
    """Convert a throttle to thrust by the vehicle's `[motors]`, in place; return the findings."""
    voltage = rows["voltage"][:, 0] if "voltage" in rows else None
    thrust = 4.0 * motor_thrust(motors, rows["throttle"], voltage)[:, 0] / vehicle.mass
    rows["cmd_thrust"] = thrust[:, None]
    with_battery = "with the battery's voltage" if voltage is not None else "without a voltage"
    text = f"normalised; by [motors] of vehicle {vehicle.name!r}, {with_battery}"
    return [Finding("note", "thrust", text), *_hover(rows, thrust)]


def _full_thrust(
    rows: dict[str, np.ndarray], throttle: np.ndarray, options: ImportOptions, by_acc: bool
) -> tuple[float | None, list[Finding]]:
    linear = "taking thrust as proportional to it"
    if options.full_thrust is not None:
        text = f"normalised; full throttle is {options.full_thrust:g} m/s^2 as given, {linear}"
        return options.full_thrust, [Finding("note", "thrust", text)]
    if options.vehicle is not None:
        full = options.vehicle.full_thrust
        text = f"normalised; full throttle is {full:.4g} m/s^2 by the vehicle file, {linear}"
        return full, [Finding("note", "thrust", text), *_hover(rows, full * throttle)]
    if "acc" in rows and by_acc:
        full, rest = _fitted_full(throttle, rows["acc"][:, 2])
        if FULL[0] <= full <= FULL[1]:
            text = (
                f"normalised; full throttle is {full:.4g} m/s^2 by the accelerometer "
                f"({rest:.2g} m/s^2 are left), {linear}. A wrong thrust scale cannot be seen "
                "in this log; with --vehicle it can"
            )
            return full, [Finding("note", "thrust", text)]
        if np.isfinite(full):
            text = (
                f"normalised; full throttle would be {full:.3g} m/s^2 by the accelerometer, and "
                f"{FULL[0]:g} to {FULL[1]:g} is possible: left out; give --vehicle FILE or "
                "--full-thrust M/S^2"
            )
            return None, [Finding("doubt", "thrust", text, "thrust_scale", full, 0.95,
                                  "--full-thrust M/S^2")]  # fmt: skip
    text = (
        "normalised, and nothing says what full throttle gives: left out; "
        "give --vehicle FILE or --full-thrust M/S^2"
    )
    return None, [Finding("doubt", "thrust", text)]


def _fitted_full(throttle: np.ndarray, acc: np.ndarray) -> tuple[float, float]:
    """Return thrust per mass at full throttle from an accelerometer's z, and the residual [m/s^2].

    Uses the median of their ratios, which is robust against outliers. NaN for too few samples.
    """
    good = np.isfinite(acc) & np.isfinite(throttle) & (throttle > 0.02) & (throttle <= 1.5)
    if np.sum(good) <= 100:
        return np.nan, np.nan
    full = float(np.median(acc[good] / throttle[good]))
    off = acc[good] - full * throttle[good]
    return full, 1.4826 * float(np.median(np.abs(off - np.median(off))))


def _hover(rows: dict[str, np.ndarray], thrust: np.ndarray) -> list[Finding]:
    """Return a doubt where the mean commanded thrust differs from the measured one."""
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


def rates_wanted(rows: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Replace `cmd_quat` of `rows` by `cmd_rate` in place, where the log has no rate command.

    The rate is the attitude gain times the rotation vector from the attitude to the set point,
    within the vehicle's `rate_max`.
    """
    if "cmd_quat" not in rows:
        return []
    wanted = rows.pop("cmd_quat")
    if "cmd_rate" in rows or "quat" not in rows:
        return []
    if vehicle is None:
        text = "are attitudes, and nothing says the attitude loop's gains: left out; give --vehicle"
        return [Finding("doubt", "set points", text)]
    norm = np.linalg.norm(wanted, axis=1, keepdims=True)
    error = rotation_vector(multiply(conjugate(rows["quat"]), wanted / norm))
    limit = np.asarray(vehicle.controller.rate_max)
    gain = np.asarray(vehicle.controller.attitude_gain)
    rows["cmd_rate"] = np.clip(gain * error, -limit, limit)
    text = f"are attitudes; rates by the attitude gains of {vehicle.name!r}, {gain.tolist()} 1/s"
    return [Finding("note", "set points", text)]
