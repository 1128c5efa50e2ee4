"""Prepares flights for the views: fills missing signals, smooths, splits off held-out flights.

A view is one part of the dynamics, force or torque (`data/view.py`). Missing signals of a partial
log are derived from others. Rates are derived from the attitude. Without an attitude, the body's z
axis is set along the path's acceleration less gravity, since thrust is along body z and nearly all
of the force in slow flight (differential flatness; Mellinger and Kumar 2011), and yaw is set to 0.
A force across the thrust is not identifiable then, and rates only as means over 1 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mix
from eval.quadrotor.plant import make_plant, nominal_quadrotor
from eval.vehicles.vehicle import Vehicle, motor_speed
from suite.diagnose.data.inertial import InertialLog, is_inertial, posed
from suite.diagnose.data.noise import noise_like
from suite.diagnose.data.sampling import interpolate, on_every_row, with_fewer_rows
from suite.diagnose.data.steps import LONGEST_S, torque_between_rows
from suite.diagnose.data.view import (
    FORCE,
    LEAST_ROWS,
    SPECIFIC,
    TORQUE,
    SmoothedFlight,
    View,
    calibrated,
    rows_of,
    smoothed,
)
from suite.diagnose.data.windows import LENGTH_S
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import wrench_difference
from tracks.geometry.rotation import rot_to_quat

SLOW_WIDTH_S = 1.0
"""Width of the smoothing windows (bumps) where rates are derived from a path [s]."""


@dataclass(frozen=True)
class ViewFlights:
    """F flights, prepared for the views that all of them allow."""

    views: tuple[View, ...]
    """The views that all of them allow."""
    names: tuple[str, ...]
    """(F,) names of the flights."""
    smoothed: dict[str, list[SmoothedFlight]]
    """By view, F flights each."""
    floor: dict[str, np.ndarray]
    """By view, noise (3,) of a mean acceleration, by that of velocity or rates."""
    source: str
    """Signal that gives the rotor speeds, in words."""
    kept: tuple[int, ...] = ()
    """(F,) numbers of the logs of these flights; other logs have no usable stretch."""
    notes: tuple[str, ...] = ()
    """Parts of the logs that are not used, in words."""


def ready(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    limits: Thresholds = THRESHOLDS,
    others: Sequence[FlightLog] = (),
) -> ViewFlights:
    """Return those of `logs` that have a usable stretch, for the views that all of them allow.

    Args:
        logs: flights of one vehicle.
        vehicle: its vehicle file.
        limits: longest hole, and most rows.
        others: flights that are compared with these; views have only the axes that both allow.

    Raises:
        ValueError: for a log without any signal of thrust or rotors, or if none has a stretch.
    """
    logs, notes = with_fewer_rows(logs, limits)
    rotors = [acting_rotors(log, vehicle, limits) for log in logs]
    for log, one in zip(logs, rotors, strict=True):
        if one is None:
            needs = "[motors] in the vehicle file" if log.pwm is not None else "thrust or rotors"
            raise ValueError(f"{log.name}: no signal gives its rotor speeds; it needs {needs}")
    acting = [one for one in rotors if one is not None]
    filled = [on_every_row(completed(log), limits) for log in posed(logs)]
    rows = [
        rows_of(log, vehicle, one.speed, limits) for log, one in zip(filled, acting, strict=True)
    ]
    inertial = [is_inertial(log) for log in logs]
    views = [SPECIFIC if all(inertial) else FORCE]
    if any("pos" in log.partial and not own for log, own in zip(logs, inertial, strict=True)):
        views = []
    elif any("quat" in log.partial and not is_inertial(log) for log in (*logs, *others)):
        views = [replace(views[0], axes=(2,))]
    if all(one.each for one in acting):
        slow = any({"quat", "rate"} <= set(log.partial) for log in (*logs, *others))
        views.append(replace(TORQUE, width_s=SLOW_WIDTH_S) if slow else TORQUE)
    if not views:
        raise ValueError(
            f"{', '.join(log.name for log in logs)}: no position, and no accelerometer or no motor "
            "of its own next to the gyro: nothing shows what moved"
        )
    by_view = {view.name: [smoothed(view, one, limits) for one in rows] for view in views}
    main = views[0]
    if TORQUE.name in by_view:
        by_view[TORQUE.name] = [
            _calibrated(flight, one, vehicle)
            for flight, one in zip(by_view[TORQUE.name], acting, strict=True)
        ]
    usable = [k for k, flight in enumerate(by_view[main.name]) if len(flight.form.middle_s)]
    reason = f"no stretch of {main.width_s:g} s in flight without a hole"
    if not usable:
        raise ValueError(f"{', '.join(log.name for log in logs)}: {reason}")
    notes += [f"{log.name}: {reason}" for k, log in enumerate(logs) if k not in usable]
    by_view = {name: [flights[k] for k in usable] for name, flights in by_view.items()}
    for view in views[1:]:
        empty = [
            logs[k].name
            for k, flight in zip(usable, by_view[view.name], strict=True)
            if not len(flight.form.middle_s)
        ]
        if empty:
            notes.append(
                f"{view.name}: not examined, as {', '.join(empty)} has no {view.width_s:g} s "
                f"with {LEAST_ROWS} rows; log faster"
            )
            views, by_view = views[:1], {main.name: by_view[main.name]}
    return ViewFlights(
        tuple(views),
        tuple(logs[k].name for k in usable),
        by_view,
        {view.name: _floor(view, by_view[view.name]) for view in views},
        acting[0].source,
        tuple(usable),
        tuple(notes),
    )


def _calibrated(flight: SmoothedFlight, rotors: ActingRotors, vehicle: Vehicle) -> SmoothedFlight:
    """Return a flight in the torque view, corrected for noise and spacing of its rotor speeds."""
    if rotors.noise is None:
        return flight
    speed, noise = np.nan_to_num(rotors.speed), np.nan_to_num(rotors.noise)
    _, acceleration = wrench_difference(speed, np.zeros_like(speed), vehicle)
    _, by_noise = wrench_difference(speed + noise, speed, vehicle)
    flight = calibrated(flight, acceleration, by_noise)
    step_s = float(np.median(np.diff(flight.rows.time_s)))
    correction = 1.0 + torque_between_rows(vehicle, step_s)
    return flight._replace(reliability=flight.reliability * correction)


def split_held_out(
    flights: ViewFlights, held: Sequence[int], limits: Thresholds = THRESHOLDS
) -> tuple[dict[str, list[SmoothedFlight]], dict[str, list[SmoothedFlight]]]:
    """Return by view the fitted flights, and those at `held`; a single flight is split in time.

    Raises:
        ValueError: for a single flight that is too short to split.
    """
    count = len(flights.names)
    if count > 1:
        fitted = [k for k in range(count) if k not in held]
        return (
            {name: [part[k] for k in fitted] for name, part in flights.smoothed.items()},
            {name: [part[k] for k in held] for name, part in flights.smoothed.items()},
        )
    first, last = {}, {}
    # A share of the time in flight, as a log may begin or end on the ground.
    flown_s = flights.smoothed[flights.views[0].name][0].form.middle_s
    until_s = float(np.quantile(flown_s, limits.lone_fitted_share))
    for view in flights.views:
        rows, _, _, reliability = flights.smoothed[view.name][0]
        early, good = rows.time_s <= until_s, np.asarray(rows.good)
        for part, chosen in ((first, early), (last, ~early)):
            flight = smoothed(view, rows._replace(good=good & chosen), limits)
            if not len(flight.form.middle_s):
                raise ValueError(
                    f"{flights.names[0]}: too short to hold a part of it out; fly longer"
                )
            part[view.name] = [flight._replace(reliability=reliability)]
    return first, last


def _floor(view: View, flights: Sequence[SmoothedFlight]) -> np.ndarray:
    """Return the noise (3,) of the measured accelerations, from second differences of rows."""
    power = []
    for flight in flights:
        imu_acc_w = flight.rows.imu_acc_w if view.in_world else None
        path = flight.rows.vel_w if view.in_world else flight.rows.rate_b
        series = np.asarray(path if imu_acc_w is None else imu_acc_w)[np.asarray(flight.rows.good)]
        second = series[2:] - 2.0 * series[1:-1] + series[:-2]
        # A robust standard deviation: the median ignores occasional steps of an estimator. Noise of
        # variance 1 has second differences of variance 6.
        sigma = np.median(np.abs(second), axis=0) / 0.6745 / np.sqrt(6.0)
        weights = flight.form.change if imu_acc_w is None else flight.form.mean
        gain = weights.power(2).sum(axis=1).mean()
        power.append(sigma**2 * gain)
    floor = np.sqrt(np.mean(power, axis=0))
    return np.full(3, floor.mean()) if view.in_world else floor


SMOOTH_S = 0.1
"""Standard deviation of the Gaussian that smooths the path's velocity [s]."""


def completed(log: FlightLog) -> FlightLog:
    """Return `log` with a missing attitude from its path, and missing rates from the attitude.

    A flight without position and accelerometer gets a constant pose, as only its torque is used.
    Flights without position that have an accelerometer get their pose by `posed`.

    Raises:
        ValueError: for a log without positions and without rates.
    """
    if isinstance(log, InertialLog):
        return log
    if "pos" in log.partial and "rate" in log.partial:
        raise ValueError(f"{log.name}: no position and no gyro: no signal shows its motion")
    if "pos" in log.partial:
        level, zeros = np.tile([1.0, 0.0, 0.0, 0.0], (len(log.time_s), 1)), 0.0 * log.rate_b
        return replace(log, pos_w=zeros, vel_w=zeros, quat_wxyz=level)
    if "quat" in log.partial:
        log = replace(log, quat_wxyz=np.asarray(rot_to_quat(path_attitude(log))))
    if "rate" in log.partial:
        log = replace(log, rate_b=rates_of_attitude(log.time_s, log.quat_wxyz))
    return log


def path_attitude(log: FlightLog) -> np.ndarray:
    """Return attitudes (N, 3, 3) whose z axis is along the path's acceleration less gravity.

    Raises:
        ValueError: for a log without a velocity.
    """
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


def rates_of_attitude(time_s: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the body rates (T, 3) of attitudes (T, 4), by central differences [rad/s].

    NaN where a neighbouring row is missing, and in the first and the last row.
    """
    rate_b = np.full((len(quat_wxyz), 3), np.nan)
    complete = np.asarray(np.isfinite(quat_wxyz).all(axis=1))
    rows = 1 + np.flatnonzero(complete[:-2] & complete[2:])
    if len(rows):
        before, after = (
            Rotation.from_quat(quat_wxyz[rows + d], scalar_first=True) for d in (-1, 1)
        )
        step_s = (time_s[rows + 1] - time_s[rows - 1])[:, None]
        rate_b[rows] = (before.inv() * after).as_rotvec() / step_s
    return rate_b


def choose_held_out(
    logs: Sequence[FlightLog],
    flight: np.ndarray,
    start_s: np.ndarray,
    information: np.ndarray,
    limits: Thresholds = THRESHOLDS,
) -> tuple[np.ndarray, list[str]]:
    """Return which windows are fitted, (W,) bool, and the names of the held-out flights.

    Held out are the flights whose information the other flights contain best. The manoeuvres decide
    this, not the errors: a single chirp or the only pass near the ground is fitted. Of a single
    flight the end is held out.

    Args:
        logs: flights.
        flight: (W,) number of each window's flight.
        start_s: (W,) start of each window in its flight [s].
        information: (W, K) of each window on each of K parameters.
        limits: share that is held out.
    """
    flight = np.asarray(flight)
    numbers = list(np.unique(flight))
    if len(numbers) == 1:
        log = logs[int(numbers[0])]
        cut_s = limits.lone_fitted_share * log.duration_s
        return np.asarray(start_s) + LENGTH_S <= cut_s, [f"{log.name} from {cut_s:.1f} s"]
    by_flight = {k: information[flight == k].sum(axis=0) for k in numbers}
    held: list[int] = []
    for _ in range(max(1, round(limits.held_out_share * len(numbers)))):
        fitted = [k for k in numbers if k not in held]
        total = np.sum([by_flight[k] for k in fitted], axis=0)
        informed = total > 0.0
        loss = {k: (by_flight[k][informed] / total[informed]).max(initial=0.0) for k in fitted}
        held.append(min(reversed(fitted), key=lambda k: loss[k]))
    return ~np.isin(flight, held), [logs[int(k)].name for k in sorted(held)]


class ActingRotors(NamedTuple):
    """Rotor speeds of a log, measured or from commands."""

    speed: np.ndarray
    """(N, 4) [rad/s]."""
    source: str
    """Signal that they are from, for people."""
    each: bool
    """Whether each rotor's speed is known; a collective thrust gives only their sum."""
    noise: np.ndarray | None = None
    """(N, 4) simulated noise of the same size [rad/s]; None where speeds were not measured."""


def acting_rotors(
    log: FlightLog, vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> ActingRotors | None:
    """Return the rotor speeds of `log`, measured or from commands; None without either.

    They are interpolated to every row, but not across holes. Commanded speeds pass through the
    vehicle's delay and rotor lag.
    """
    noise = None
    if log.rotor_speed is not None:
        drawn = replace(log, rotor_speed=noise_like(log.rotor_speed, limits))
        noise = on_every_row(drawn, limits).rotor_speed
    log = on_every_row(log, limits)
    if log.rotor_speed is not None:
        return ActingRotors(log.rotor_speed, "measured rotor speeds", True, noise)
    if log.rotor_speed_cmd is not None:
        return ActingRotors(_lagged(log, vehicle, log.rotor_speed_cmd), "motor commands", True)
    if log.pwm is not None and vehicle.motors is not None:
        voltage = log.voltage
        if voltage is not None:
            voltage = interpolate(log.time_s, log.time_s, voltage[:, None])[:, 0]
        speed = np.asarray(motor_speed(vehicle, log.pwm, voltage))
        return ActingRotors(_lagged(log, vehicle, speed), "motor commands and battery", True)
    if log.thrust_cmd is None:
        return None
    force = vehicle.mass * np.maximum(log.thrust_cmd, 0.0)
    torque_b = np.zeros((len(force), 3)) if log.torque_cmd_b is None else log.torque_cmd_b
    nominal, _ = nominal_quadrotor(vehicle)
    thrust = mix(nominal.unmixer, nominal.thrust_max, force, torque_b)
    speed = np.sqrt(np.maximum(thrust, 0.0) / vehicle.rotors.thrust_coefficient)
    if log.torque_cmd_b is None:
        return ActingRotors(_lagged(log, vehicle, speed), "commanded thrust", False)
    return ActingRotors(_lagged(log, vehicle, speed), "commanded thrust and torques", True)


def _lagged(log: FlightLog, vehicle: Vehicle, commanded: np.ndarray) -> np.ndarray:
    """Return rotor speeds (N, 4) that follow `commanded` ones (N, 4) behind delay and lag.

    A command is held until the next row; NaN where it is missing.
    """
    constants = make_plant(vehicle, LONGEST_S).constants
    acting_s = log.time_s - float(constants.delay)
    row = np.searchsorted(log.time_s, acting_s + 1e-9, side="right") - 1
    target = commanded[np.maximum(row, 0)]
    lag_s = float(constants.time_constant)
    if lag_s <= 0.0:
        return target
    decay = np.exp(-np.diff(log.time_s) / lag_s)[:, None]
    speed = target.copy()
    for row in range(1, len(target)):
        before = np.where(np.isfinite(speed[row - 1]), speed[row - 1], target[row])
        goal = np.where(np.isfinite(target[row - 1]), target[row - 1], before)
        speed[row] = goal + decay[row - 1] * (before - goal)
    return np.where(np.isfinite(target), speed, np.nan)
