"""A log's commands as the flight log has them.

Motors are put in the vehicle file's order by where they are. Attitude set points become rates by
the vehicle file's attitude loop. Normalised thrust (0 to 1) becomes thrust per mass: what full
throttle gives is told by the user, or follows from the vehicle file (by its `[motors]` with the
battery's voltage, where it has them), or is fitted to the accelerometer. The last takes what a
diagnosis would look for in the thrust's scale into the command, and says so.
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
"""Front right, rear right, rear left, front left: the order of the vehicles that are shipped."""
FULL = (8.0, 200.0)
"""What full throttle of a multirotor that flies gives [m/s^2]."""
SIDES = ("front right", "rear right", "rear left", "front left")


def order_motors(
    rows: dict[str, np.ndarray],
    motor_side: Sequence[tuple[float, float]] | None,
    vehicle: Vehicle | None,
) -> list[Finding]:
    """Put `motor`, `motor_cmd` and `pwm` of `rows` in the vehicle's order, in place.

    Args:
        rows: see `eval.importers.rows`.
        motor_side: (x forward, y left) of the file's motors 1 to 4; None: the order is the
            vehicle's already.
        vehicle: whose order is wanted; None: that of the shipped vehicles.
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
    """Replace `throttle` of `rows` by `cmd_thrust` [m/s^2], in place, where that can be done.

    Args:
        rows: see `eval.importers.rows`.
        options: the vehicle, and what full throttle gives.
        by_acc: fit it to the accelerometer where nothing else says it; not where that looks wrong.
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
    """Return findings of a throttle that the vehicle's `[motors]` turn into thrust, in place."""
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
        text = f"normalised; full throttle is {options.full_thrust:g} m/s^2 as told, {linear}"
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
    """Return what full throttle gives by an accelerometer's z, and what is left [m/s^2]; or NaN.

    By the median of their ratios, which garbage in a part of the log does not move.
    """
    good = np.isfinite(acc) & np.isfinite(throttle) & (throttle > 0.02) & (throttle <= 1.5)
    if np.sum(good) <= 100:
        return np.nan, np.nan
    full = float(np.median(acc[good] / throttle[good]))
    off = acc[good] - full * throttle[good]
    return full, 1.4826 * float(np.median(np.abs(off - np.median(off))))


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


def rates_wanted(rows: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Replace `cmd_quat` of `rows` by `cmd_rate`, in place, where nothing commanded rates.

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
