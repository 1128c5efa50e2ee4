"""Prepares flights for the views: fills missing signals, smooths, splits off held-out flights.

Missing signals of a partial log follow from others. Rates are derived from the attitude. Without an
attitude, the body's z axis is along the path's acceleration less gravity, since thrust is along
body z and nearly all of the force in slow flight (differential flatness; Mellinger and Kumar 2011);
yaw is set to 0. A force across the thrust is not identifiable then, and rates only as means over 1
s.
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
    FlightRows,
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
"""Width of the bumps where rates come from a path, which gives them as means over a second [s]."""


@dataclass(frozen=True)
class ViewFlights:
    """Flights, ready for the views that all of them allow."""

    views: tuple[View, ...]
    """What all of them allow."""
    names: tuple[str, ...]
    """Of F flights."""
    smoothed: dict[str, list[SmoothedFlight]]
    """By view, F each."""
    floor: dict[str, np.ndarray]
    """By view: noise (3,) of a mean acceleration, from the noise of velocity or rates."""
    source: str
    """Where the rotor speeds come from, in words."""
    kept: tuple[int, ...] = ()
    """Numbers of the logs that these flights are of; others have no stretch."""
    notes: tuple[str, ...] = ()
    """What was left out, in words."""


def ready(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    limits: Thresholds = THRESHOLDS,
    others: Sequence[FlightLog] = (),
) -> ViewFlights:
    """Return those of `logs` that have a stretch, for the views that all of them allow.

    `others` are flights that these are compared with: axes and means are what they allow too.

    Raises:
        ValueError: where a log has nothing that turns or pushes, or none has a stretch.
    """
    logs, notes = with_fewer_rows(logs, limits)
    rotors = [acting_rotors(log, vehicle, limits) for log in logs]
    for log, one in zip(logs, rotors, strict=True):
        if one is None:
            needs = "[motors] in the vehicle file" if log.pwm is not None else "thrust or rotors"
            raise ValueError(f"{log.name}: no signal gives its rotor speeds; it needs {needs}")
    acting = [one for one in rotors if one is not None]
    whole = [on_every_row(completed(log), limits) for log in posed(logs)]
    rows = [
        rows_of(log, vehicle, one.speed, limits) for log, one in zip(whole, acting, strict=True)
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
    parts = {view.name: [smoothed(view, one, limits) for one in rows] for view in views}
    main = views[0]
    if TORQUE.name in parts:
        parts[TORQUE.name] = [
            _calibrated(flight, one, vehicle)
            for flight, one in zip(parts[TORQUE.name], acting, strict=True)
        ]
    kept = [k for k, flight in enumerate(parts[main.name]) if len(flight.form.middle_s)]
    without = f"no stretch of {main.width_s:g} s in flight without a hole"
    if not kept:
        raise ValueError(f"{', '.join(log.name for log in logs)}: {without}")
    notes += [f"{log.name}: {without}" for k, log in enumerate(logs) if k not in kept]
    parts = {name: [flights[k] for k in kept] for name, flights in parts.items()}
    for view in views[1:]:
        empty = [
            logs[k].name
            for k, flight in zip(kept, parts[view.name], strict=True)
            if not len(flight.form.middle_s)
        ]
        if empty:
            notes.append(
                f"{view.name}: not examined, as {', '.join(empty)} has no {view.width_s:g} s "
                f"with {LEAST_ROWS} rows; log faster"
            )
            views, parts = views[:1], {main.name: parts[main.name]}
    return ViewFlights(
        tuple(views),
        tuple(logs[k].name for k in kept),
        parts,
        {view.name: _floor(view, parts[view.name]) for view in views},
        acting[0].source,
        tuple(kept),
        tuple(notes),
    )


def _calibrated(flight: SmoothedFlight, rotors: ActingRotors, vehicle: Vehicle) -> SmoothedFlight:
    if rotors.noise is None:
        return flight
    speed, noise = np.nan_to_num(rotors.speed), np.nan_to_num(rotors.noise)
    _, turned = wrench_difference(speed, np.zeros_like(speed), vehicle)
    _, noisy = wrench_difference(speed + noise, speed, vehicle)
    flight = calibrated(flight, turned, noisy)
    step_s = float(np.median(np.diff(flight.rows.time_s)))
    between = 1.0 + torque_between_rows(vehicle, step_s)
    return flight._replace(reliability=flight.reliability * between)


def parted(
    flights: ViewFlights, held: Sequence[int], limits: Thresholds = THRESHOLDS
) -> tuple[dict[str, list[SmoothedFlight]], dict[str, list[SmoothedFlight]]]:
    """Return the fitted and the `held` flights by view; a lone flight is split in time.

    Raises:
        ValueError: for a lone flight that is too short to part.
    """
    count = len(flights.names)
    if count > 1:
        inside = [k for k in range(count) if k not in held]
        return (
            {name: [part[k] for k in inside] for name, part in flights.smoothed.items()},
            {name: [part[k] for k in held] for name, part in flights.smoothed.items()},
        )
    first, last = {}, {}
    # Of what was flown: a log may begin or end on the ground.
    flown_s = flights.smoothed[flights.views[0].name][0].form.middle_s
    until_s = float(np.quantile(flown_s, limits.lone_fitted_share))
    for view in flights.views:
        whole = flights.smoothed[view.name][0]
        rows, reliability = whole.rows, whole.reliability
        early = rows.time_s <= until_s
        for part, chosen in ((first, early), (last, ~early)):
            some = smoothed(view, _only(rows, chosen), limits)
            if not len(some.form.middle_s):
                raise ValueError(
                    f"{flights.names[0]}: too short to hold a part of it out; fly longer"
                )
            part[view.name] = [some._replace(reliability=reliability)]
    return first, last


def _only(rows: FlightRows, chosen: np.ndarray) -> FlightRows:
    return rows._replace(good=np.asarray(rows.good) & chosen)


def _floor(view: View, flights: Sequence[SmoothedFlight]) -> np.ndarray:
    """Return the noise (3,) of the measured accelerations, by that of neighbouring rows."""
    power = []
    for flight in flights:
        imu_acc_w = flight.rows.imu_acc_w if view.in_world else None
        path = flight.rows.vel_w if view.in_world else flight.rows.rate_b
        series = np.asarray(path if imu_acc_w is None else imu_acc_w)[np.asarray(flight.rows.good)]
        bend = series[2:] - 2.0 * series[1:-1] + series[:-2]
        # The median ignores the occasional steps of a filter or an estimator.
        sigma = np.median(np.abs(bend), axis=0) / 0.6745 / np.sqrt(6.0)
        weights = flight.form.change if imu_acc_w is None else flight.form.mean
        gain = weights.power(2).sum(axis=1).mean()
        power.append(sigma**2 * gain)
    floor = np.sqrt(np.mean(power, axis=0))
    return np.full(3, floor.mean()) if view.in_world else floor


SMOOTH_S = 0.1
"""Standard deviation of what smooths the path's acceleration [s]."""


def completed(log: FlightLog) -> FlightLog:
    """Return `log` with a missing attitude from its path, and missing rates from the attitude.

    A flight without position and accelerometer gets a constant pose: only its rotation is used. See
    `posed` for flights with an accelerometer.

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
    """Return attitudes (N, 3, 3) whose z axis is along the path's acceleration less gravity."""
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
    """Return the body rates (T, 3) of attitudes (T, 4), by each row's neighbours [rad/s].

    NaN where one of them is missing, and in the first and the last row.
    """
    rate_b = np.full((len(quat_wxyz), 3), np.nan)
    whole = np.asarray(np.isfinite(quat_wxyz).all(axis=1))
    rows = 1 + np.flatnonzero(whole[:-2] & whole[2:])
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
    """Return which windows are fitted, (W,) bool, and the names of what is held out.

    `flight` (W,) is the number of each window's flight, `start_s` (W,) when it starts there.

    The flights are held out whose `information` (W, K), of each window on each number, the others
    contain best. Only the manoeuvres decide, not the errors: a single chirp or the only pass near
    the ground is fitted.
    """
    flight = np.asarray(flight)
    there = list(np.unique(flight))
    if len(there) == 1:
        log = logs[int(there[0])]
        cut_s = limits.lone_fitted_share * log.duration_s
        return np.asarray(start_s) + LENGTH_S <= cut_s, [f"{log.name} from {cut_s:.1f} s"]
    by_flight = {k: information[flight == k].sum(axis=0) for k in there}
    held: list[int] = []
    for _ in range(max(1, round(limits.held_out_share * len(there)))):
        kept = [k for k in there if k not in held]
        whole = np.sum([by_flight[k] for k in kept], axis=0)
        seen = whole > 0.0
        lost = {k: (by_flight[k][seen] / whole[seen]).max(initial=0.0) for k in kept}
        held.append(min(reversed(kept), key=lambda k: lost[k]))
    return ~np.isin(flight, held), [logs[int(k)].name for k in sorted(held)]


class ActingRotors(NamedTuple):
    """Rotor speeds of a log."""

    speed: np.ndarray
    """(N, 4) [rad/s]."""
    source: str
    """For people."""
    each: bool
    """Whether each rotor's speed is known; a collective thrust gives only their sum."""
    noise: np.ndarray | None = None
    """(N, 4) simulated noise of the same size [rad/s]; None where speeds were not measured."""


def acting_rotors(
    log: FlightLog, vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> ActingRotors | None:
    """Return the rotor speeds of `log`, measured or from commands; None where neither is there.

    They are interpolated to every row, but not across holes. Commanded speeds pass through the
    vehicle's delay and lag.
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
    each = mix(nominal.unmixer, nominal.thrust_max, force, torque_b)
    speed = np.sqrt(np.maximum(each, 0.0) / vehicle.rotors.thrust_coefficient)
    if log.torque_cmd_b is None:
        return ActingRotors(_lagged(log, vehicle, speed), "commanded thrust", False)
    return ActingRotors(_lagged(log, vehicle, speed), "commanded thrust and torques", True)


def _lagged(log: FlightLog, vehicle: Vehicle, wanted: np.ndarray) -> np.ndarray:
    """Return commanded speeds `wanted` (N, 4), held until the next row, behind delay and lag."""
    constants = make_plant(vehicle, LONGEST_S).constants
    since = log.time_s - float(constants.delay)
    row = np.searchsorted(log.time_s, since + 1e-9, side="right") - 1
    wanted = wanted[np.maximum(row, 0)]  # with its gaps
    lag = float(constants.time_constant)
    if lag <= 0.0:
        return wanted
    left = np.exp(-np.diff(log.time_s) / lag)[:, None]
    speed = wanted.copy()
    for row in range(1, len(wanted)):
        before = np.where(np.isfinite(speed[row - 1]), speed[row - 1], wanted[row])
        target = np.where(np.isfinite(wanted[row - 1]), wanted[row - 1], before)
        speed[row] = target + left[row - 1] * (before - target)
    return np.where(np.isfinite(wanted), speed, np.nan)
