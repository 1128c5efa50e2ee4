"""Prepares flights for the views (force and torque): fills missing signals, and smooths.

A partial log lacks a required signal, which is then derived from others. Rates are derived from the
attitude. A missing attitude is derived from the path: thrust is along body z, and in slow flight it
is nearly all of the force, so body z is along the acceleration minus gravity (differential
flatness; Mellinger and Kumar 2011). Yaw is set to 0. From such an attitude, forces across the
thrust are not identifiable, and rates only as means over 1 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.effects.log_faults import true_log
from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mix
from eval.quadrotor.plant import make_plant, nominal_quadrotor
from eval.vehicles.vehicle import Vehicle, motor_speed
from suite.diagnose.data.inertial import InertialLog, is_inertial, posed
from suite.diagnose.data.noise import noise_like
from suite.diagnose.data.sampling import (
    HOLE_STEPS,
    interpolate,
    on_every_row,
    own_spacing_s,
    with_fewer_rows,
)
from suite.diagnose.data.steps import (
    LONGEST_S,
    rows_show_torque,
    torque_between_rows,
    wrench_difference,
)
from suite.diagnose.data.view import (
    FORCE,
    LEAST_ROWS,
    SPECIFIC,
    TORQUE,
    SmoothedFlight,
    View,
    rows_of,
    smoothed,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.rotation import rot_to_quat

SLOW_WIDTH_S = 1.0
"""Width of the bumps (smooth weights over time) where rates come from a path [s]."""
HIDDEN_TORQUE = (
    "torque: rotor speeds every {:.2g} ms do not show the torque between rows, as the lag of the "
    "rotors in the vehicle file is {:.2g} ms (rotors.time_constant): a named torque effect may "
    "not be real; correct the file or log faster"
)
"""Note if the rotors of the vehicle file are faster than the rows of a log."""
SMOOTH_S = 0.1
"""Standard deviation of the Gaussian that smooths the velocity before it is differentiated [s]."""


@dataclass(frozen=True)
class ViewFlights:
    """Flights, ready for views."""

    views: tuple[View, ...]
    """The views that all flights allow."""
    logs: tuple[FlightLog, ...]
    """The F logs that have a usable stretch, as they were given."""
    smoothed: dict[str, list[SmoothedFlight]]
    """The F flights with their mean accelerations, by name of the view."""
    floor: dict[str, np.ndarray]
    """(3,) noise of a mean acceleration, by name of the view; from that of velocity or rates."""
    source: str
    """Where the rotor speeds come from, in words."""
    notes: tuple[str, ...]
    """What was left out and why, in words."""


def ready(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    limits: Thresholds = THRESHOLDS,
    others: Sequence[FlightLog] = (),
) -> ViewFlights:
    """Return those of `logs` that have a usable stretch, for the views that all of them allow.

    `others` are flights with which these are compared. Axes and widths of the views are then those
    that the signals of both allow.

    Raises:
        ValueError: if rotor speeds of a log are unknown, if the logs allow no view, or if no log
            has a usable stretch.
    """
    given, (logs, notes) = logs, with_fewer_rows(logs, limits)
    rotors = [acting_rotors(log, vehicle, limits) for log in logs]
    true_logs = [true_log(log, vehicle.effects) for log in logs]
    complete = [completed(log) for log in posed(true_logs)]
    rows = [
        rows_of(on_every_row(log, limits), vehicle, one.speed, limits)
        for log, one in zip(complete, rotors, strict=True)
    ]
    # Choose the views, with the axes and widths that the available signals allow.
    inertial = [is_inertial(log) for log in logs]
    views = [SPECIFIC if all(inertial) else FORCE]
    if any("pos" in log.partial and not own for log, own in zip(logs, inertial, strict=True)):
        views = []
    elif any("quat" in log.partial and not is_inertial(log) for log in (*logs, *others)):
        views = [replace(views[0], axes=(2,))]
    if all(one.each for one in rotors):
        slow = any({"quat", "rate"} <= set(log.partial) for log in (*logs, *others))
        views.append(replace(TORQUE, width_s=SLOW_WIDTH_S) if slow else TORQUE)
    if not views:
        raise ValueError(
            f"{', '.join(log.name for log in logs)}: no position, and no accelerometer or no motor "
            "of its own next to the gyro: nothing shows what moved"
        )
    parts = {
        view.name: [
            _calibrated(view, smoothed(view, row, limits), one, vehicle)
            for row, one in zip(rows, rotors, strict=True)
        ]
        for view in views
    }
    # Leave out flights without a usable stretch, and a second view that some flight does not allow.
    main, *second = views
    kept = [k for k, flight in enumerate(parts[main.name]) if len(flight.form.middle_s)]
    without = f"no stretch of {main.width_s:g} s in flight without a hole"
    if not kept:
        raise ValueError(f"{', '.join(log.name for log in logs)}: {without}")
    notes += [f"{log.name}: {without}" for k, log in enumerate(logs) if k not in kept]
    parts = {name: [flights[k] for k in kept] for name, flights in parts.items()}
    for view in second:
        flights = zip(kept, parts[view.name], strict=True)
        empty = [logs[k].name for k, flight in flights if not len(flight.form.middle_s)]
        if empty:
            notes.append(
                f"{view.name}: not examined, as {', '.join(empty)} has no {view.width_s:g} s "
                f"with {LEAST_ROWS} rows; log faster"
            )
            views.remove(view)
            del parts[view.name]
    step_s = max(rotors[k].spacing_s for k in kept)
    is_hidden = torque_between_rows(vehicle, step_s).any() and not rows_show_torque(vehicle, step_s)
    if is_hidden and TORQUE.name in parts:
        notes.append(HIDDEN_TORQUE.format(1e3 * step_s, 1e3 * vehicle.rotors.time_constant))
    return ViewFlights(
        tuple(views),
        tuple(given[k] for k in kept),
        parts,
        {view.name: _floor(view, parts[view.name], [complete[k] for k in kept]) for view in views},
        " and ".join(sorted({rotors[k].source for k in kept})),
        tuple(notes),
    )


def _calibrated(
    view: View, flight: SmoothedFlight, rotors: ActingRotors, vehicle: Vehicle
) -> SmoothedFlight:
    """Return a flight whose model is corrected for measured rotor speeds, if these drive a torque.

    Noise in a model's input makes every slope smaller, as more inertia would. The expected true
    input, given the measured one, does not (regression calibration; Carroll et al. 2006,
    Measurement Error in Nonlinear Models, Ch. 4). Torque between rows is added, too.
    """
    if view.in_world or rotors.noise is None or not len(flight.form.middle_s):
        return flight
    speed, noise = np.nan_to_num(rotors.speed), np.nan_to_num(rotors.noise)
    _, turned = wrench_difference(speed, np.zeros_like(speed), vehicle)
    _, noisy = wrench_difference(speed + noise, speed, vehicle)
    reliability = 1.0 + torque_between_rows(vehicle, rotors.spacing_s)
    mean = flight.form.mean
    if len(flight.form.middle_s) > 1:
        variance = np.maximum(np.var(mean @ turned, axis=0), 1e-12)
        reliability *= np.maximum(1.0 - np.mean((mean @ noisy) ** 2, axis=0) / variance, 0.0)
    return flight._replace(reliability=reliability)


def _floor(view: View, flights: Sequence[SmoothedFlight], logs: Sequence[FlightLog]) -> np.ndarray:
    """Return the noise (3,) of the mean accelerations, from differences of neighbouring rows.

    Only the signal's own rows count, by `logs`, the flights before the interpolation.
    """
    power = []
    for flight, log in zip(flights, logs, strict=True):
        imu_acc_w = flight.rows.imu_acc_w if view.in_world else None
        motion = flight.rows.motion
        path = motion.vel_w if view.in_world else motion.rate_b
        good = np.asarray(flight.rows.good)
        own = good & np.isfinite(log.vel_w if view.in_world else log.rate_b).all(axis=1)
        series = np.asarray(path if imu_acc_w is None else imu_acc_w)[own]
        bend = series[2:] - 2.0 * series[1:-1] + series[:-2]
        # The median ignores the occasional steps of a filter or an estimator. It is 0.6745 standard
        # deviations of a normal variable; a second difference has 6 times the variance of a row.
        sigma = np.median(np.abs(bend), axis=0) / 0.6745 / np.sqrt(6.0)
        weights = flight.form.change if imu_acc_w is None else flight.form.mean
        # Each measured value stands for several rows.
        gain = weights.power(2).sum(axis=1).mean() * good.sum() / max(own.sum(), 1)
        power.append(sigma**2 * gain)
    floor = np.sqrt(np.mean(power, axis=0))
    return np.full(3, floor.mean()) if view.in_world else floor


def completed(log: FlightLog) -> FlightLog:
    """Return `log` with a missing attitude from its path, and missing rates from the attitude.

    Without position and accelerometer only rotation is used, so the pose is constant.

    Raises:
        ValueError: for a log without positions and without rates.
    """
    if isinstance(log, InertialLog):
        return log
    if "pos" in log.partial and "rate" in log.partial:
        raise ValueError(f"{log.name}: no position and no gyro: no signal shows its motion")
    if "pos" in log.partial:
        level, still = np.tile([1.0, 0.0, 0.0, 0.0], (len(log.time_s), 1)), 0.0 * log.rate_b
        return replace(log, pos_w=still, vel_w=still, quat_wxyz=level)
    if "quat" in log.partial:
        log = replace(log, quat_wxyz=np.asarray(rot_to_quat(leaning(log))))
    if "rate" in log.partial:
        log = replace(log, rate_b=turning_of(log.time_s, log.quat_wxyz))
    return log


def leaning(log: FlightLog) -> np.ndarray:
    """Return attitudes (N, 3, 3) whose z axis is along the path's acceleration minus gravity."""
    step = float(np.median(np.diff(log.time_s)))
    if not np.isfinite(log.vel_w).any(axis=0).all():
        raise ValueError(f"{log.name}: no velocity and no positions to derive it from")
    vel_w = interpolate(log.time_s, log.time_s, log.vel_w)
    smooth = gaussian_filter1d(vel_w, SMOOTH_S / step, axis=0)
    acc_w = np.gradient(smooth, log.time_s, axis=0) + [0.0, 0.0, GRAVITY]
    up = acc_w / np.linalg.norm(acc_w, axis=1, keepdims=True)
    left = np.cross(up, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=-1)


def turning_of(time_s: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the body rates (T, 3) [rad/s] by the neighbours of each row of attitudes (T, 4).

    NaN without an attitude, in the first and the last row that has one, and next to a hole.
    """
    rate_b = np.full((len(quat_wxyz), 3), np.nan)
    own = np.flatnonzero(np.isfinite(quat_wxyz).all(axis=1))
    if len(own) > 2:
        attitude = Rotation.from_quat(quat_wxyz[own], scalar_first=True)
        step_s = time_s[own[2:]] - time_s[own[:-2]]
        dense = step_s <= HOLE_STEPS * np.median(np.diff(time_s[own]))
        rates_b = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / step_s[:, None]
        rate_b[own[1:-1][dense]] = rates_b[dense]
    return rate_b


class ActingRotors(NamedTuple):
    """Rotor speeds of a log."""

    speed: np.ndarray
    """(N, 4) rotor speeds, measured or from commands [rad/s]."""
    source: str
    """Where the speeds come from, for people."""
    each: bool
    """Whether the speed of each rotor is known. From a collective thrust only the sum is known."""
    noise: np.ndarray | None = None
    """(N, 4) simulated noise like that of measured speeds [rad/s]; None without measured ones."""
    spacing_s: float = 0.0
    """Time between the rows of the measured speeds [s]."""


def acting_rotors(log: FlightLog, vehicle: Vehicle, limits: Thresholds) -> ActingRotors:
    """Return the rotor speeds of `log`, measured or from commands, in every row but in holes.

    Commanded speeds pass through the vehicle's delay and rotor lag.

    Raises:
        ValueError: if no signal gives the rotor speeds.
    """
    noise, spacing_s = None, 0.0
    if log.rotor_speed is not None:
        spacing_s = own_spacing_s(log.time_s, log.rotor_speed)
        drawn = replace(log, rotor_speed=noise_like(log.rotor_speed, limits))
        noise = on_every_row(drawn, limits).rotor_speed
    log = on_every_row(log, limits)
    if log.rotor_speed is not None:
        return ActingRotors(log.rotor_speed, "measured rotor speeds", True, noise, spacing_s)
    if log.rotor_speed_cmd is not None:
        return ActingRotors(_lagged(log, vehicle, log.rotor_speed_cmd), "motor commands", True)
    if log.pwm is not None and vehicle.motors is not None:
        voltage = log.voltage
        if voltage is not None:
            voltage = interpolate(log.time_s, log.time_s, voltage[:, None])[:, 0]
        speed = np.asarray(motor_speed(vehicle, log.pwm, voltage))
        return ActingRotors(_lagged(log, vehicle, speed), "motor commands and battery", True)
    if log.thrust_cmd is None:
        needs = "[motors] in the vehicle file" if log.pwm is not None else "thrust or rotors"
        raise ValueError(f"{log.name}: no signal gives its rotor speeds; it needs {needs}")
    force, each = vehicle.mass * np.maximum(log.thrust_cmd, 0.0), log.torque_cmd_b is not None
    torque_b = np.zeros((len(force), 3)) if log.torque_cmd_b is None else log.torque_cmd_b
    nominal, _ = nominal_quadrotor(vehicle)
    thrusts = mix(nominal.unmixer, nominal.thrust_max, force, torque_b, nominal.unequal_arms)
    speed = np.sqrt(np.maximum(thrusts, 0.0) / vehicle.rotors.thrust_coefficient)
    source = "commanded thrust and torques" if each else "commanded thrust"
    return ActingRotors(_lagged(log, vehicle, speed), source, each)


def _lagged(log: FlightLog, vehicle: Vehicle, wanted: np.ndarray) -> np.ndarray:
    """Return the rotor speeds (N, 4) behind held commands (N, 4), by delay and lag; NaN stays."""
    constants = make_plant(vehicle, LONGEST_S).constants
    acts_s, lag = log.time_s + float(constants.delay), float(constants.time_constant)
    # A delayed command may begin to act between two rows.
    at_s = np.union1d(log.time_s, acts_s) if lag > 0.0 else log.time_s
    row = np.searchsorted(acts_s, at_s + 1e-9, side="right") - 1
    wanted = wanted[np.maximum(row, 0)]  # NaN in holes stay NaN
    if lag <= 0.0:
        return wanted
    remaining_share = np.exp(-np.diff(at_s) / lag)[:, None]
    speed = wanted.copy()
    for k in range(1, len(wanted)):
        last_speed = np.where(np.isfinite(speed[k - 1]), speed[k - 1], wanted[k])
        target = np.where(np.isfinite(wanted[k - 1]), wanted[k - 1], last_speed)
        speed[k] = target + remaining_share[k - 1] * (last_speed - target)
    return np.where(np.isfinite(wanted), speed, np.nan)[np.searchsorted(at_s, log.time_s)]
