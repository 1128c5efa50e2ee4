"""Entries of a vehicle file with intervals, and why other numbers are not identified."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.inertial import UNSEEN
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.identify.fit import Fitted
from suite.diagnose.identify.grid import IMU_ACC, FlightGrid
from tracks.common.figures import with_unit

DELAY = "effects.command_delay.delay"
"""Key of the command delay in a vehicle file."""
OTHER_INERTIA = "the rotors' lag may be another, or the file is over 100 times wrong"
"""Other reasons for which an inertia is not identifiable."""
WHY = {
    "thrust": "thrust: too little of the force along body z is explained",
    "curve": "curvature of the thrust curve: the motor commands hardly change",
    "battery": "voltage_exponent: the voltage hardly changes",
    **{f"drag_{a}": f"drag along body {a}: too slow, or too little of it" for a in "xyz"},
    "inertia_x": f"inertia about x: the body hardly rolls, {OTHER_INERTIA}",
    "inertia_y": f"inertia about y: the body hardly pitches, {OTHER_INERTIA}",
    "inertia_z": "inertia about z: the body hardly yaws, or not while it rolls and pitches",
    "yaw": "torque_coefficient: the body hardly yaws",
    "lag": "time_constant of the rotors: nothing fast enough is commanded",
    "late": "command_delay: nothing fast enough is commanded",
    "gain_x": "rate_gain about x: the body hardly rolls",
    "gain_y": "rate_gain about y: the body hardly pitches",
    "gain_z": "rate_gain about z: the body hardly yaws",
}
"""Description of each fitted number, by name, with the reason why flights may not identify it."""
WELL_EXPLAINED, SMALL_MISFIT = 0.5, 1.0
"""A model fits an axis if it explains this share of the measured mean square, or if the root mean
square of the rest is below the second value: 1 m/s^2 or 1 rad/s^2."""
MOTIONS = {"force": "acceleration along", "torque": "angular acceleration about"}
"""Name of a fit -> what it explains."""
NO_RATES = "no body rates and no attitude in these logs"
"""Reason if a fit needs body rates and the logs have none."""
NEVER_BOTH = "these logs have no stretch with both"
"""Reason if the logs have the columns that a fit needs, but never all in one window."""


class Number(NamedTuple):
    """One entry of a vehicle file, with its intervals."""

    key: str
    """Key in the vehicle file, with its table: `table.key`."""
    unit: str
    value: list[float]
    """Value of each component."""
    ci95: list[tuple[float, float] | None]
    """95 % interval of each component; None for one that is not identified."""
    follows: bool = False
    """Whether an unidentified component is in the file, as the rest of an identified sum."""

    @property
    def is_identified(self) -> bool:
        """Whether any component is identified."""
        return any(span is not None for span in self.ci95)

    @property
    def is_entered(self) -> bool:
        """Whether the value in the file comes from these flights."""
        return self.is_identified or self.follows


def numbers_json(numbers: Sequence[Number]) -> dict[str, Any]:
    """Return the identified entries for JSON; a single component is a plain value, not a list."""
    entries = {}
    for number in numbers:
        if not number.is_identified:
            continue
        is_single = len(number.value) == 1
        spans = [None if span is None else list(span) for span in number.ci95]
        entries[number.key] = {
            "value": number.value[0] if is_single else number.value,
            "unit": number.unit,
            "ci95": spans[0] if is_single else spans,
        }
    return entries


def number_lines(numbers: Sequence[Number]) -> list[str]:
    """Return a line for people with the interval of every identified component."""
    return [
        f"{entry.key}{f'[{k}]' if len(entry.value) > 1 else ''} = {value:.4g}: "
        + with_unit(f"{span[0]:.4g} to {span[1]:.4g}", entry.unit)
        for entry in numbers
        for k, (value, span) in enumerate(zip(entry.value, entry.ci95, strict=True))
        if span is not None
    ]


def not_identified(
    fitted: Mapping[str, Fitted], entries: Mapping[str, Number], file_delay_s: float
) -> list[str]:
    """Return a line for people for each number that was fitted and that no fit has identified.

    `file_delay_s` is the delay that is written to the vehicle file [s].
    """
    fits = list(fitted.values())
    identified = {name for fit in fits for name in fit.names if fit.identifies(name)}
    names = dict.fromkeys(name for fit in fits for name in fit.not_identified)
    lines = [WHY[name] for name in names if name not in identified and name in WHY]
    total_s = [fit.values()["late"] for fit in fits if fit.identifies("late")]
    if total_s and not entries[DELAY].is_identified:
        delay_s, words = entries[DELAY].value[0], "this sum minus the file's lag"
        if delay_s != file_delay_s:
            words = f"the nearest allowed value to {words}, {delay_s:.3g} s"
        lines.append(
            f"command_delay: only its sum with the rotors' lag, {total_s[-1]:.3g} s; the file's "
            f"delay, {file_delay_s:.3g} s, is {words}"
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
    """Return a line for people for each number that was not fitted, with the missing signal.

    Fits are force, torque, rotors and loop; those of `broken` had no complete window.
    """

    def any_has(name: str) -> bool:
        return any(flight.has(name) for flight in flights)

    lines = [*UNSEEN] if any_has(IMU_ACC) else []  # some flight has no position
    if "force" not in fitted and not {"drag", "motors"} <= set(leave):
        why = "these logs have no stretch with a position"
        if "force" in broken:
            slow = "" if any_has("rot_w") else ", slow enough to do without an attitude"
            why = f"{NEVER_BOTH} the path and the motors' commands or speeds{slow}"
        lines.append(f"thrust and drag: {why}")
    if "force" in fitted and "drag" not in leave and "drag_x" not in fitted["force"].names:
        lines.append(
            "drag along body x and y: without an attitude a force across the thrust equals "
            "a body that leans"
        )
    if drive == "pwm" and "motors" not in leave and not any_has("voltage"):
        motors = vehicle.motors
        effect = "it is 0, so the voltage has no effect"
        if motors is not None and motors.voltage_exponent:
            effect = f"their thrust is assumed to be that at {motors.voltage:.4g} V"
        lines.append(f"voltage_exponent: these logs have no voltage; {effect}")
    if "torque" not in fitted and "inertia" not in leave:
        why = NO_RATES
        if drive in ("rates", "thrust"):
            why = (
                "commanded rates and thrust contain no torques; that needs motor commands, rotor "
                "speeds or commanded torques"
            )
        elif "torque" in broken:
            why = f"{NEVER_BOTH} body rates and the motors' commands or speeds"
        lines.append(f"inertia and torque_coefficient: {why}")
    has_lag = any("late" in fit.names for fit in fitted.values())
    if not has_lag and "lag" not in leave:
        why = NO_RATES
        if "rotors" in broken:
            why = f"{NEVER_BOTH} measured and commanded rotor speeds"
        elif drive == "rotors":
            why = (
                "measured rotor speeds do not contain them; that needs commanded ones "
                "(motor_cmd_1 to motor_cmd_4) as well, and all four in every row"
            )
        elif {"torque", "loop"} & set(broken):
            why = f"{NEVER_BOTH} body rates and commands"
        elif drive in ("rates", "thrust") and any_has("rate_b"):
            why = "commanded thrust contains none; that needs the gains of a nominal rate loop"
        lines.append(f"time_constant and command_delay: {why}")
    if "loop" not in fitted and "loop" not in leave:
        why = "rate_gain: these logs have no commanded body rates"
        if vehicle.controller.kind != "p":
            why = f"the rate loop: settings of a {vehicle.controller.kind} loop are not fitted"
        elif "loop" in broken:
            why = f"rate_gain: {NEVER_BOTH} body rates and commanded ones"
        lines.append(why)
    return lines


def misfit_notes(fitted: Mapping[str, Fitted]) -> list[str]:
    """Return the warning that a fit leaves most of what was measured, [] if none does."""
    poor = []
    for name, motion in MOTIONS.items():
        if name not in fitted:
            continue
        left, measured = fitted[name].residual_rms, fitted[name].measured_rms
        for axis, rest, size in zip("xyz"[3 - len(left) :], left, measured, strict=True):
            share = 1.0 - float(rest / max(size, TINY)) ** 2
            if share < WELL_EXPLAINED and rest > SMALL_MISFIT:
                poor.append(f"{max(100.0 * share, 0.0):.0f} % of the {motion} {axis}")
    if not poor:
        return []
    text = f"with the identified numbers, the model explains only {', '.join(poor)}; "
    return [f"{text}a signal or another number of the file may be wrong, so do not rely on them"]


def notes_on(
    flights: Sequence[FlightGrid],
    without_voltage: Collection[str],
    start: Vehicle,
    identified: Vehicle,
) -> list[str]:
    """Return lines for people on what was done apart from the fits.

    `without_voltage` names the flights without a voltage, if others have one.
    """
    lines = [
        f"{flight.name}: no row has all columns of {', '.join(flight.in_turn)}; each column uses "
        "its own rows. That blurs fast changes, and makes a delay too short by up to half of "
        "their distance"
        for flight in flights
        if flight.in_turn
    ]
    if without_voltage:
        lines.append(
            f"no voltage in {', '.join(sorted(without_voltage))}: these flights do not count where "
            "the motors' thrust does"
        )
    merged = [name for name in start.effects if name not in {*identified.effects, "command_delay"}]
    if merged:
        lines.append(f"effects merged into other numbers of the new file: {', '.join(merged)}")
    motors, before = identified.motors, start.motors
    has_voltage = any(flight.has("voltage") for flight in flights)
    if has_voltage and motors is not None and (before is None or motors.voltage != before.voltage):
        lines.append(f"motors.voltage = {motors.voltage:.4g} V, the median of these flights")
    if identified.rotors.speed_max != start.rotors.speed_max:
        lines.append(
            f"rotors.speed_max = {identified.rotors.speed_max:.4g} rad/s, which these flights "
            f"reach: with the identified thrust, {start.rotors.speed_max:.4g} rad/s is too slow to "
            "hover"
        )
    return lines
