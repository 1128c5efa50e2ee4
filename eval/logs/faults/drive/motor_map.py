"""Check of the map from motor commands or a throttle to thrust: its size, its curve, the battery.

The measured thrust T is computed from the rotor speeds. Without rotor speeds it is the mass times
the force per mass along body z, from the logged path (pose) or the accelerometer. F is the thrust
that the vehicle file's table `[motors]` gives for the same commands. Least squares over the flight
fits

    log(T / F) = size + curve (log F - mean) + battery (log V - mean)

with the battery's voltage V. All three coefficients are 0 where the file is correct. Their standard
errors come from fits that leave out one block of the flight at a time (jackknife).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from eval.logs.faults.drive.motors import FITS, fit_force
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import WIDTH_S, Rows
from eval.logs.faults.relation import jackknife_error, shift_rows, smooth
from eval.quadrotor.loops import command_of_throttle
from eval.vehicles.vehicle import MotorMap, Vehicle, motor_thrust

LATE_S, STEP_S = 0.16, 0.01
"""Largest delay from command to thrust that is tried, and the step between trials [s]."""
BLOCKS = 8
"""Number of blocks of the jackknife."""
LEAST_ROWS = 200
"""Least number of rows for the fit and for a correlation."""
USED = (0.02, 0.97)
"""Range of commands that the fit uses. Commands outside are at a limit, where the thrust does not
follow them."""
CURVE, BATTERY, SURE = 0.3, 0.8, 4.0
"""What counts as a fault: least relative error of the exponent of thrust over command, and least
error of the exponent of thrust over voltage. Each must also exceed `SURE` standard errors."""
FOLLOWS = 0.5
"""Least correlation of commanded and measured thrust."""
SPAN = 0.2
"""Least range of the thrust in which its curve is identifiable, as a difference of logarithms."""
AIR = 0.1
"""Change of the thrust over this range, as a share, that a drag may cause as well as the curve."""
SWUNG = 1.6
"""Factor by which a battery's voltage can change the thrust. A wrong size within this factor is not
identifiable where the voltage was not logged."""
FLAT = 0.005
"""Standard deviation of the voltage's logarithm below which the voltage counts as constant."""


class Drive(NamedTuple):
    """One kind of command in a log, and the vehicle file's map from it to thrust."""

    name: str
    """Name of the signal: `pwm`, `throttle` or `cmd_thrust`."""
    subject: str
    """Subject of the findings, in words."""
    fault: str
    """Name of the fault to report where size or curve is wrong."""
    motors: MotorMap | None
    """`[motors]` of the vehicle file; None: thrust is proportional to the command."""
    command: np.ndarray
    """(T, C) commands from 0 to 1; C = 4 motors, or 1 for a throttle, which all motors share."""
    vehicle: Vehicle | None
    """The vehicle file."""
    time_s: np.ndarray
    """(T,) time of the rows [s]."""
    volts: np.ndarray | None
    """(T,) voltage of the battery [V]."""

    def thrust(self, motors: MotorMap | None, volts: np.ndarray | None) -> np.ndarray:
        """Return the thrust (T, C) that the map gives: per motor, or for C = 1 of all four [N]."""
        if motors is None:
            vehicle = self.vehicle
            return (1.0 if vehicle is None else vehicle.full_thrust * vehicle.mass) * self.command
        share = 4.0 if self.command.shape[1] == 1 else 1.0
        return share * np.asarray(motor_thrust(motors, self.command, volts))

    @property
    def at_limit(self) -> np.ndarray:
        """(T, C) bool, whether a command is at a limit, as on the ground."""
        return (self.command < USED[0]) | (self.command > USED[1])

    def command_quantile(self, share: float) -> float:
        """Return a quantile of the commands that the fit uses."""
        used = np.isfinite(self.command) & ~self.at_limit
        return float(np.quantile(self.command[used], share))

    @property
    def exponent(self) -> float:
        """Power of the command with which thrust grows by the file, at the median command."""
        if self.motors is None:
            return 1.0
        command = self.command_quantile(0.5)
        linear, square = self.motors.thrust[0] * command, self.motors.thrust[1] * command**2
        return (linear + 2.0 * square) / (linear + square)


class Ratio(NamedTuple):
    """Result of the fit of log(T / F), see the module's docstring."""

    size: float
    """Coefficient `size`."""
    curve: float
    """Coefficient `curve`."""
    curve_error: float
    """Standard error of `curve`."""
    battery: float
    """Coefficient `battery`; 0 where the voltage is unknown or constant."""
    battery_error: float
    """Standard error of `battery`; infinite where the voltage is unknown or constant."""
    span: float
    """Difference of the 95 % and the 5 % quantile of log F."""
    late: int
    """Delay from command to thrust, in rows."""


def check_motor_map(rows: Rows, vehicle: Vehicle | None) -> list[Finding]:
    """Return the findings on `[motors]`, and on a throttle's curve and linearisation.

    Without a vehicle file, only a throttle's curve is checked. For the `rows` see
    `check.run_checks`.
    """
    return [one for drive in _drives(rows, vehicle) for one in _check(rows, drive)]


def _check(rows: Rows, drive: Drive) -> list[Finding]:
    """Return the findings on one kind of command."""
    measured = _measured(rows, drive)
    if measured is None:
        text = "neither rotor speeds, nor an accelerometer, nor a pose show the thrust"
        return unseen(drive.subject, text, drive.fault, "battery_scaling")
    ratio = _ratio(drive, measured)
    if ratio is None:
        text = "too few commands between the limits, or the thrust does not follow them"
        return unseen(drive.subject, text, drive.fault, "battery_scaling")
    findings = _findings(ratio, drive)
    if not any(finding.status == "doubt" for finding in findings):
        return findings
    # One fix repairs size, curve and battery together. It is only computed where it is needed.
    fix = _fix(drive, measured, ratio)
    return [f._replace(fix=fix) if f.status == "doubt" else f for f in findings]


def _drives(rows: Rows, vehicle: Vehicle | None) -> Iterator[Drive]:
    """Yield each kind of command in the log whose thrust can be computed."""
    motors = None if vehicle is None else vehicle.motors
    about = vehicle, rows["time"], rows["voltage"][:, 0] if "voltage" in rows else None
    if "pwm" in rows and motors is not None:
        yield Drive("pwm", "motor map", "motor_map", motors, rows["pwm"], *about)
    if "throttle" in rows:
        command = rows["throttle"]
        if vehicle is not None and motors is not None:
            command = command_of_throttle(vehicle.controller, command)
        yield Drive("throttle", "throttle", "throttle_curve", motors, command, *about)
    elif "cmd_thrust" in rows and vehicle is not None:
        share = rows["cmd_thrust"] / vehicle.full_thrust
        yield Drive("cmd_thrust", "thrust command", "throttle_curve", None, share, *about)


def _measured(rows: Rows, drive: Drive) -> np.ndarray | None:
    """Return the measured thrust: (T, 4) of each motor, or (T, 1) of all [N]; None: unknown.

    Without a vehicle file the mass is unknown, so the result is thrust per mass [m/s^2].
    """
    vehicle = drive.vehicle
    if drive.name == "pwm" and "motor" in rows and vehicle is not None:
        return vehicle.rotors.thrust_coefficient * rows["motor"] ** 2
    if not ({"quat", "pos"} <= rows.keys() or "acc" in rows):
        return None
    force, ratio = fit_force(rows, np.sum(drive.thrust(drive.motors, None), axis=1))
    return force[:, None] * (1.0 if vehicle is None else vehicle.mass) if ratio > 0.0 else None


def _ratio(drive: Drive, measured: np.ndarray) -> Ratio | None:
    """Return how the measured thrust differs from the file's; None where it is not identifiable."""
    time_s, volts = drive.time_s, drive.volts
    wanted = _averaged(drive, drive.motors, measured)
    thrust = smooth_columns(time_s, measured)
    thrust = np.where(thrust > 0.1 * np.nanmedian(thrust), thrust, np.nan)
    # Logarithms of the file's thrust (moved by the delay), the measured thrust and the voltage.
    log_wanted, log_thrust = np.log(wanted), np.log(thrust)
    late = _delay_rows(time_s, log_wanted, log_thrust)
    if late is None:
        return None
    log_wanted = shift_rows(log_wanted, late)
    log_volts = np.zeros(len(time_s)) if volts is None else np.log(np.maximum(volts, 0.1))
    log_volts = np.broadcast_to(log_volts[:, None], log_wanted.shape)
    block = np.broadcast_to(((np.arange(len(time_s)) * BLOCKS) // len(time_s))[:, None],
                            log_wanted.shape)  # fmt: skip
    good = np.isfinite(log_wanted) & np.isfinite(log_thrust) & np.isfinite(log_volts)
    if good.sum() < LEAST_ROWS:
        return None
    x, y, v, block = log_wanted[good], log_thrust[good], log_volts[good], block[good]
    design = np.column_stack([np.ones_like(x), x - x.mean(), v - v.mean()])
    columns = [0, 1, 2] if np.std(v) > FLAT else [0, 1]
    # The thrust must follow the commands. The battery's part is removed from both first, since a
    # wrong voltage exponent may hide that they agree.
    battery = design[:, [0, 2]]
    both = np.column_stack([x, y])
    changes = both - battery @ np.linalg.lstsq(battery, both, rcond=None)[0]
    if _correlation(*changes.T) < FOLLOWS:
        return None

    def fitted(keep: np.ndarray) -> np.ndarray:
        coefficients = np.zeros(3)
        a, b = design[keep][:, columns], (y - x)[keep]
        coefficients[columns] = np.linalg.lstsq(a, b, rcond=None)[0]
        return coefficients

    # Fit once with all rows, drop outliers, and fit again: with all blocks, and without each.
    residual = np.abs(y - x - design @ fitted(np.ones(len(x), dtype=bool)))
    usual = residual < 4.0 * np.median(residual) + 1e-9
    estimate = fitted(usual)
    without_block = np.array([fitted(usual & (block != k)) for k in range(BLOCKS)])
    errors = [jackknife_error(without_block[:, k]) for k in range(3)]
    errors[2] = errors[2] if len(columns) == 3 else np.inf
    span = float(np.ptp(np.quantile(x, (0.05, 0.95))))
    size, curve, battery_size = estimate.tolist()
    return Ratio(size, curve, errors[1], battery_size, errors[2], span, late)


def _findings(ratio: Ratio, drive: Drive) -> list[Finding]:
    """Return the findings on size, curve and battery, without their fix."""
    findings, exponent = [], drive.exponent
    low, high = drive.command_quantile(0.05), drive.command_quantile(0.95)
    true, error = exponent * (1.0 + ratio.curve), exponent * ratio.curve_error
    figures = (
        f"thrust grows with the command to the power {true:.2f} (± {error:.2f}) from "
        f"{low:.2f} to {high:.2f}, to {exponent:.2f} by the file"
    )
    is_other = abs(ratio.curve) > max(CURVE, SURE * ratio.curve_error)
    hardly = ratio.span < SPAN or (is_other and abs(ratio.curve) * ratio.span < AIR)
    if SURE * ratio.curve_error > CURVE or hardly:
        why = "the commands hardly change" if hardly else "too uncertain"
        findings += unseen(drive.subject, f"{figures}: {why}", drive.fault)
    elif is_other:
        about = (drive.fault, true, 0.95)
        text = f"{figures}: the curve or its linearisation is another"
        findings.append(Finding("doubt", drive.subject, text, *about))
    had = 0.0 if drive.motors is None else drive.motors.voltage_exponent
    per_volt = had * exponent + ratio.battery
    figures_of_battery = (
        f"thrust at one command grows with the voltage to the power {per_volt:.2f} "
        f"(± {ratio.battery_error:.2f}), to {had * exponent:.2f} by the file"
    )
    if not SURE * ratio.battery_error < BATTERY:
        known = np.isfinite(ratio.battery_error)
        text = f"{figures_of_battery}: too uncertain" if known else "no voltage that changes"
        findings += unseen(drive.subject, text, "battery_scaling")
    elif abs(ratio.battery) > max(BATTERY, SURE * ratio.battery_error):
        about = ("battery_scaling", per_volt, 0.95)
        text = f"{figures_of_battery}: the battery is taken into account twice, or not at all"
        findings.append(Finding("doubt", drive.subject, text, *about))
    if drive.vehicle is None:
        return findings
    # Size: `check_thrust_command` reports it for a command in m/s^2, so there is no limit here.
    times, reach = float(np.exp(-ratio.size)), np.inf if drive.name == "cmd_thrust" else FITS
    if had and not np.isfinite(ratio.battery_error):
        reach = max(reach, SWUNG)
    if not 1.0 / reach < times < reach and not any(f.status == "doubt" for f in findings):
        text = f"the file gives {times:.3g} times the measured thrust"
        text += "" if drive.name == "pwm" else ", or its mass is wrong"
        findings.append(Finding("doubt", drive.subject, text, drive.fault, times, 0.93))
    if any(f.status != "not identifiable" for f in findings):
        return findings
    return [*findings, Finding("ok", drive.subject, figures)]


def _fix(drive: Drive, measured: np.ndarray, ratio: Ratio) -> str:
    """Return the fix in words: `[motors]` of the vehicle file, with values that fit the flight."""
    if drive.vehicle is None:
        return "[motors] of a vehicle file, with --vehicle"
    from scipy.optimize import nnls

    nominal = drive.motors or MotorMap((0.0, 1.0), 1.0, 0.0)
    exponent, voltage = nominal.voltage_exponent, nominal.voltage
    if SURE * ratio.battery_error < BATTERY and drive.volts is not None:
        voltage = voltage if exponent else float(np.nanmedian(drive.volts))
        true_exponent = exponent + ratio.battery / max(drive.exponent * (1.0 + ratio.curve), 0.5)
        exponent = round(float(np.clip(true_exponent, 0.0, 4.0)), 2)
    thrust_of_terms = [
        shift_rows(_averaged(drive, motors, measured), ratio.late)
        for motors in (MotorMap(t, voltage, exponent) for t in ((1.0, 0.0), (0.0, 1.0)))
    ]
    columns = np.stack([term.ravel() for term in thrust_of_terms], axis=1)
    thrust = smooth_columns(drive.time_s, measured).ravel()
    good = np.isfinite(columns).all(axis=1) & np.isfinite(thrust)
    (linear, square), _ = nnls(columns[good], thrust[good])
    return (
        f"motors.thrust = [{linear:.4g}, {square:.4g}], motors.voltage = {voltage:.4g} and "
        f"motors.voltage_exponent = {exponent:g} in the vehicle file"
    )


def _delay_rows(time_s: np.ndarray, wanted: np.ndarray, thrust: np.ndarray) -> int | None:
    """Return the delay with the best correlation of the file's and the measured thrust, in rows.

    It is None if the longest delay that is tried correlates best: then the right one is unknown.
    """
    step = float(np.median(np.diff(time_s)))
    trials = list(dict.fromkeys(round(late / step) for late in np.arange(0.0, LATE_S, STEP_S)))

    def alike(count: int) -> float:
        moved = shift_rows(wanted, count)
        good = np.isfinite(moved) & np.isfinite(thrust)
        return _correlation(moved[good], thrust[good])

    best = max(trials, key=alike)
    return None if len(trials) > 1 and best == trials[-1] else best


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of `a` and `b` (N,); 0 where one is constant or N is too small."""
    if len(a) < LEAST_ROWS or not np.std(a) * np.std(b) > 1e-12:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def _averaged(drive: Drive, motors: MotorMap | None, measured: np.ndarray) -> np.ndarray:
    """Return the thrust by `motors`, summed and averaged in the same way as the measured thrust.

    It is NaN where a command is at a limit. A measured total force is already averaged once by
    `fit_force`, so the file's total is averaged twice as well.
    """
    time_s, thrust = drive.time_s, drive.thrust(motors, drive.volts)
    at_limit = drive.at_limit
    if measured.shape[1] > 1:
        return smooth_columns(time_s, np.where(at_limit, np.nan, thrust))
    total = np.where(at_limit.any(axis=1), np.nan, thrust.sum(axis=1))
    return smooth_columns(time_s, smooth_columns(time_s, total[:, None]))


def smooth_columns(time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the moving mean of each column of `values` (T, C) over `WIDTH_S`.

    Each column is averaged alone, since its NaN may be at other rows than those of its neighbours.
    """
    columns = (smooth(time_s, column[:, None], WIDTH_S) for column in values.T)
    return np.concatenate(list(columns), axis=1)
