"""Fitted numbers as those of a vehicle file, and what flights do not identify, in words."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.inertial import UNSEEN
from suite.diagnose.identify.fit import Z95, Fitted
from suite.diagnose.identify.grid import IMU_ACC, FlightGrid

DELAY = "effects.command_delay.delay"


class Number(NamedTuple):
    """One entry of a vehicle file, with its intervals."""

    key: str
    """As in the file, with a dot between table and key."""
    unit: str
    value: list[float]
    ci95: list[tuple[float, float] | None]
    """Of each component; None where it was left as it was."""
    follows: bool = False
    """Not identified, but in the file: the difference of an identified sum and another number."""

    @property
    def is_identified(self) -> bool:
        """Whether any component was identified."""
        return any(span is not None for span in self.ci95)

    @property
    def is_entered(self) -> bool:
        """Whether the file has it from these flights."""
        return self.is_identified or self.follows


Derived = Callable[[Mapping[str, float]], np.ndarray]
"""Values of a file's entry from the fit's numbers."""


def values_of(fitted: Fitted) -> dict[str, float]:
    """Return all numbers of a fit by name."""
    return {u.name: float(v) for u, v in zip(fitted.unknowns, fitted.value, strict=True)}


def number(
    key: str,
    unit: str,
    fitted: Fitted,
    derived: Derived,
    needs: Sequence[Sequence[str]],
    room: float = np.inf,
) -> Number:
    """Return an entry of the file, its intervals from the fit's by the slopes of `derived`.

    Args:
        key: of the file.
        unit: of the values.
        fitted: the fit.
        derived: the values.
        needs: for each value, the numbers of which one at least must be identified.
        room: a value whose interval reaches further than this to either side is not
            identified, and follows from the others.
    """
    names = [unknown.name for unknown in fitted.unknowns]
    value = np.atleast_1d(derived(values_of(fitted)))
    slopes = np.zeros((len(value), len(names)))
    for k, unknown in enumerate(fitted.unknowns):
        up, down = values_of(fitted), values_of(fitted)
        up[unknown.name] += unknown.step
        down[unknown.name] -= unknown.step
        change = np.atleast_1d(derived(up)) - np.atleast_1d(derived(down))
        slopes[:, k] = change / (2.0 * unknown.step)
    half = Z95 * np.sqrt(np.maximum(np.einsum("vi,ij,vj->v", slopes, fitted.covariance, slopes), 0))
    seen = [any(fitted.has(name) for name in need if name in names) for need in needs]
    spans = [
        (float(v - h), float(v + h)) if there and h <= room else None
        for v, h, there in zip(value, half, seen, strict=True)
    ]
    follows = any(there and span is None for there, span in zip(seen, spans, strict=True))
    return Number(key, unit, [float(v) for v in value], spans, follows)


def as_json(numbers: Sequence[Number]) -> dict[str, Any]:
    """Return the identified entries for JSON: a plain value where there is one component."""
    found = {}
    for entry in numbers:
        if not entry.is_identified:
            continue
        one = len(entry.value) == 1
        spans = [None if span is None else list(span) for span in entry.ci95]
        found[entry.key] = {
            "value": entry.value[0] if one else entry.value,
            "unit": entry.unit,
            "ci95": spans[0] if one else spans,
        }
    return found


def lines_of_numbers(numbers: Sequence[Number]) -> list[str]:
    """Return a line with the interval of every identified component, for people."""
    return [
        f"{entry.key}{f'[{k}]' if len(entry.value) > 1 else ''} = {value:.4g}: "
        f"{span[0]:.4g} to {span[1]:.4g} {entry.unit}"
        for entry in numbers
        for k, (value, span) in enumerate(zip(entry.value, entry.ci95, strict=True))
        if span is not None
    ]


WHY = {
    "thrust": "thrust: too little of the force along body z is explained",
    "curve": "curvature of the thrust curve: the motor commands hardly change",
    "battery": "voltage_exponent: the voltage hardly changes",
    "drag_x": "drag along body x: too slow, or too little of it",
    "drag_y": "drag along body y: too slow, or too little of it",
    "drag_z": "drag along body z: too slow, or too little of it",
    "inertia_x": "inertia about x: the body hardly rolls, or the rotors' lag may be another",
    "inertia_y": "inertia about y: the body hardly pitches, or the rotors' lag may be another",
    "inertia_z": "inertia about z: the body hardly yaws, or not while it rolls and pitches",
    "yaw": "torque_coefficient: the body hardly yaws",
    "lag": "time_constant of the rotors: nothing fast enough is commanded",
    "late": "command_delay: nothing fast enough is commanded",
    "gain_x": "rate_gain about x: the body hardly rolls",
    "gain_y": "rate_gain about y: the body hardly pitches",
    "gain_z": "rate_gain about z: the body hardly yaws",
}
"""What was fitted and not identified, and what the flights lack for it."""
STILL = "no body rates and no attitude in these logs"
NEVER = "these logs have no stretch with both"
"""Where the columns are there, and holes in them leave no window whole."""


def not_identified(fitted: Mapping[str, Fitted], entries: Mapping[str, Number]) -> list[str]:
    """Return what was fitted and no fit has identified.

    Args:
        fitted: what was fitted, by the fit's name.
        entries: of the vehicle file, by their keys.
    """
    seen = {u.name for found in fitted.values() for u in found.unknowns if found.has(u.name)}
    names = dict.fromkeys(name for found in fitted.values() for name in found.not_identified)
    lines = [WHY[name] for name in names if name not in seen and name in WHY]
    late = [values_of(found)["late"] for found in fitted.values() if found.has("late")]
    if late and not entries[DELAY].is_identified:
        rest = max(entries[DELAY].value[0], 0.0)
        lines.append(
            f"command_delay: only that it and the rotors' lag make {late[-1]:.3g} s together; of "
            f"that the file's lag leaves {rest:.3g} s, which is its delay"
        )
    return lines


def not_attempted(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    drive: str,
    fitted: Mapping[str, Fitted],
    leave: Sequence[str],
    broken: Collection[str] = (),
) -> list[str]:
    """Return what was not even fitted, since the logs have no such columns, or none whole.

    Args:
        flights: on their grids.
        vehicle: the start.
        drive: what drove the flights.
        fitted: what was fitted, by the fit's name.
        leave: what was not to be fitted.
        broken: fits for which the logs have the columns, and no stretch in which all of them go on.
    """
    lines = []

    def anywhere(*names: str) -> bool:
        return any(flight.has(*names) for flight in flights)

    if anywhere(IMU_ACC):
        lines += UNSEEN
    force = fitted.get("force")
    if force is None:
        if not {"drag", "motors"} <= set(leave):
            why = "these logs have no stretch with a position"
            if "force" in broken:
                slow = "" if anywhere("rot_w") else ", slow enough to do without an attitude"
                why = f"{NEVER} the path and what drove the motors{slow}"
            lines.append(f"thrust and drag: {why}")
    elif "drag" not in leave and not any(u.name == "drag_x" for u in force.unknowns):
        lines.append(
            "drag along body x and y: without an attitude a force across the thrust equals "
            "a body that leans"
        )
    if drive == "pwm" and "motors" not in leave and not anywhere("voltage"):
        motors = vehicle.motors
        by = "it is 0, so that none counts"
        if motors is not None and motors.voltage_exponent:
            by = f"the thrust that they show is taken for that at {motors.voltage:.4g} V"
        lines.append(f"voltage_exponent: these logs have no voltage; {by}")
    if "torque" not in fitted and "inertia" not in leave:
        if drive in ("rates", "thrust"):
            lines.append(
                "inertia and torque_coefficient: commanded rates and thrust contain no "
                "torques; that needs motor commands, rotor speeds or commanded torques"
            )
        else:
            why = f"{NEVER} body rates and what drove the motors" if "torque" in broken else STILL
            lines.append(f"inertia and torque_coefficient: {why}")
    lags = any(u.name == "late" for found in fitted.values() for u in found.unknowns)
    if not lags and "lag" not in leave:
        why = STILL
        if "rotors" in broken:
            why = f"{NEVER} measured and commanded rotor speeds"
        elif drive == "rotors":
            why = (
                "measured rotor speeds are past them; that needs commanded ones (motor_cmd_1 to "
                "motor_cmd_4) as well, and all four in every row"
            )
        elif {"torque", "loop"} & set(broken):
            why = f"{NEVER} body rates and what was commanded"
        elif drive in ("rates", "thrust") and anywhere("rate_b"):
            why = "commanded thrust contains none; that needs the gains of a nominal rate loop"
        lines.append(f"time_constant and command_delay: {why}")
    if "loop" not in fitted and "loop" not in leave:
        why = "rate_gain: these logs have no commanded body rates"
        if vehicle.controller.kind != "p":
            why = f"the rate loop: settings of a {vehicle.controller.kind} loop are not fitted"
        elif "loop" in broken:
            why = f"rate_gain: {NEVER} body rates and commanded ones"
        lines.append(why)
    return lines


def notes_on(
    flights: Sequence[FlightGrid], without_voltage: Collection[str], begun: Vehicle, found: Vehicle
) -> list[str]:
    """Return what was done with flights and vehicle that the numbers do not show.

    Args:
        flights: on their grids.
        without_voltage: names of flights without a voltage, where others have one.
        begun: the start.
        found: what became of it.
    """
    lines = [
        f"{flight.name}: no row has all columns of {', '.join(flight.in_turn)}; each is taken by "
        "its own rows, so that what is fast is blurred, and a delay too short by up to half of "
        "their distance"
        for flight in flights
        if flight.in_turn
    ]
    if without_voltage:
        lines.append(
            f"no voltage in {', '.join(sorted(without_voltage))}: the other flights alone identify "
            "what depends on the motors' thrust"
        )
    motors, had = found.motors, begun.motors
    volts = any(flight.has("voltage") for flight in flights)
    if volts and motors is not None and (had is None or motors.voltage != had.voltage):
        lines.append(f"motors.voltage = {motors.voltage:.4g} V, the usual one of these flights")
    if found.rotors.speed_max != begun.rotors.speed_max:
        lines.append(
            f"rotors.speed_max = {found.rotors.speed_max:.4g} rad/s, which these flights reach: by "
            f"the thrust that they show, {begun.rotors.speed_max:.4g} rad/s would be too slow to "
            "hover"
        )
    return lines
